"""A folded network as an ONNX graph, written node by node: what the model needs and nothing else.

The graph is compared with the network that it was made from before anybody gets it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import TrainingError
from isocharge.serve.model.golden import FLOORS
from isocharge.serve.model.session import CORRELATION, OUTPUTS, open_session, run
from isocharge.serve.prediction.tables.number_table import LARGEST
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses
from isocharge.train.training.features import MISFIT_UNIT
from isocharge.train.training.folding import COSINES, FoldedLayers, FoldedNetwork

Exact = Callable[[Array], tuple[Array, ...]]

OPSET, IR_VERSION = 17, 8
"""Old enough for runtimes of 2022 on, new enough for every operator used."""

GOLDEN = 64
"""Golden vectors per model: half clean, a quarter noisy, a quarter absurd."""

AGREEMENT = {
    "contact": 1e-5,
    "contact_std": 1e-5,
    CORRELATION: 5e-5,
    "misfit": 2e-4,
}
"""By output: how far file and network may be apart (float32)."""

COMPARED = 10_000
"""Noisy presses on which file and network are compared."""

NEARLY_ALL = 0.999
"""Share of the presses that the limits are for: where charges tell little, a float32 has not the digits."""

OF_STD = 100.0
"""Deviations of a contact that count as its size: where charges tell a millimetre, a thousandth of it is exact."""

ABSURD = 10.0
"""Factor on the limits for all other presses, and for charges that no film gives."""


@dataclass
class GraphBuilder:
    """Nodes and constants in the order they are added; a method returns the name of its result."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: list[onnx.TensorProto] = field(default_factory=list)

    def add(self, operator: str, *inputs: str, to: str = "", **attributes: Any) -> str:
        """Add a node with one result, named `to` if given."""
        return self.add_many(operator, *inputs, to=(to or f"t{len(self.nodes)}",), **attributes)[0]

    def add_many(self, operator: str, *inputs: str, to: tuple[str, ...], **attributes: Any) -> tuple[str, ...]:
        """Add a node with several results."""
        self.nodes.append(helper.make_node(operator, list(inputs), list(to), **attributes))
        return to

    def constant(self, values: object, dtype: type = np.float32) -> str:
        """Add a constant tensor."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=dtype, order="C"), name))
        return name

    def split(self, data: str, names: tuple[str, ...], sizes: tuple[int, ...], axis: int) -> tuple[str, ...]:
        """Cut a tensor into pieces."""
        return self.add_many("Split", data, self.constant(sizes, np.int64), to=names, axis=axis)


def export_onnx(network: FoldedNetwork, properties: Mapping[str, str]) -> bytes:
    """The model as an ONNX file.

    Args:
        network: The model, folded (`training.folding`).
        properties: Metadata, written into `metadata_props`.

    Returns:
        The ONNX file: input `charge_pC` [n, n_electrode]; outputs `contact` [n, 3], `contact_std` [n, 3],
        `contact_correlation` [n, 3] if the network gives it, `misfit` [n, 1], all float32.
    """
    build, n_electrode = GraphBuilder(), network.typical.size
    answers = add_layers(build, add_inputs(build, network), network.layers)
    parts = {"plane": 2, "logs": 4, "angles": network.angles, "misfit_vector": n_electrode}
    parts = {name: width for name, width in parts.items() if width}
    plane, logs, *angles, vector = build.split(answers, tuple(parts), tuple(parts.values()), axis=1)
    force, _ = build.split(build.add("Exp", logs), ("force", "contact_std"), (1, 3), axis=1)
    build.add("Concat", plane, force, to="contact", axis=1)
    for arguments in angles:
        build.add("MatMul", build.add("Cos", arguments), build.constant(COSINES), to=CORRELATION)
    length = build.add("ReduceL2", vector, axes=[1], keepdims=1)
    build.add("Mul", build.add("Sinh", length), build.constant(MISFIT_UNIT), to="misfit")
    widths = {name: width for name, width in OUTPUTS.items() if angles or name != CORRELATION}
    model = make_model(build, "isocharge", n_electrode, widths, producer_name="isocharge")
    helper.set_model_props(model, dict(properties))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def add_inputs(build: GraphBuilder, network: FoldedNetwork) -> str:
    """Add what the layers see of the input `charge_pC`: logarithms, or what stands for them."""
    if not (signed := network.signed):
        within = build.add("Clip", "charge_pC", build.constant(LOWEST_CHARGE), build.constant(HIGHEST_CHARGE))
        return build.add("Log", build.add("Mul", within, build.constant(1.0 / network.typical)))
    above = build.add("Max", "charge_pC", build.constant(signed.low))
    within = build.add("Min", above, build.constant(signed.high))
    ratios = build.add("Mul", within, build.constant(1.0 / network.typical))
    return build.add("Sub", build.add("Asinh", ratios), build.constant(signed.mean))


def add_layers(build: GraphBuilder, logs: str, layers: FoldedLayers) -> str:
    """Add folded layers behind the logarithms of the charges."""
    value = logs
    for weight, bias in layers.hidden:
        value = build.add("Tanh", build.add("Gemm", value, build.constant(weight), build.constant(bias)))
    weight, bias = layers.last
    skipped = build.add("Gemm", logs, build.constant(layers.skip), build.constant(bias))
    return build.add("Gemm", value, build.constant(weight), skipped)


def make_model(
    build: GraphBuilder, name: str, n_electrode: int, widths: Mapping[str, int], **attributes: Any
) -> onnx.ModelProto:
    """The model of a finished graph with the input `charge_pC` [n, n_electrode] and outputs [n, width], all float32."""
    inputs, outputs = (
        [helper.make_tensor_value_info(tensor, TensorProto.FLOAT, ["n", width]) for tensor, width in columns.items()]
        for columns in ({"charge_pC": n_electrode}, widths)
    )
    graph = helper.make_graph(build.nodes, name, inputs, outputs, build.constants)
    opset = helper.make_opsetid("", OPSET)
    return helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, **attributes)


def check_graph(
    graph: bytes, exact: Exact, presses: LabelledPresses, noise: Noise, floors: Sequence[float] = FLOORS["contact"]
) -> Singles:
    """Compare a graph with the network that it was made from.

    Args:
        graph: The ONNX file.
        exact: The network in double precision: from charges to its outputs in the order of the graph's.
        presses: Presses of the film.
        noise: Noise of good presses.
        floors: Of x and y, mm, and force, N, below which differences count absolutely.

    Returns:
        Charges for the golden vectors, float32, shape (GOLDEN, n_electrode), pC.

    Raises:
        TrainingError: If an answer is not finite, or file and network disagree.
    """
    session = open_session(graph, "the exported graph")
    good, absurd = _golden_charges(exact, presses, noise)
    _check_finite(session, presses.charge.shape[1])
    _compare(session, exact, absurd, floors, ABSURD)
    rows = np.arange(COMPARED) % len(presses)
    _compare(session, exact, presses[rows].noisy(noise, seed=3).astype(np.float32), floors, 1.0)
    return np.concatenate([good, absurd])


def _golden_charges(exact: Exact, presses: LabelledPresses, noise: Noise) -> tuple[Singles, Singles]:
    """Charges for the golden vectors: GOLDEN * 3 / 4 of presses, and absurd ones, shape (n, n_electrode).

    They are chosen where charges tell the position better than the median: where 0.2 % is a millimetre, the last digit
    of a float32 is 3e-5 mm, and no two runtimes agree to the tolerance of golden vectors.
    """
    std = exact(presses.charge)[1]
    sure = presses[np.flatnonzero(std[:, 0] + std[:, 1] <= np.median(std[:, 0] + std[:, 1]))]
    clean = sure[np.linspace(0, len(sure) - 1, GOLDEN // 2).astype(int)]
    half = clean[np.arange(0, len(clean), 2)]
    noisy = half.noisy(noise, seed=2)
    absurd = half.charge * np.geomspace(1e-3, 1e3, len(half))[:, None]
    absurd[0], absurd[1] = 0.0, -absurd[1]
    return np.concatenate([clean.charge, noisy]).astype(np.float32), absurd.astype(np.float32)


def _check_finite(session: ort.InferenceSession, n_electrode: int) -> None:
    """The graph goes on straight in the logarithms beyond its presses: its answers must stay finite up to the ends."""
    ends = (
        np.random.default_rng(4).choice([-LARGEST, LOWEST_CHARGE, LARGEST], (COMPARED, n_electrode)).astype(np.float32)
    )
    for name, rows in run(session, ends).items():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad.size:
            raise TrainingError(
                f"the network answers {name} = {rows[bad[0]]} to the charges {ends[bad[0]]} pC; expected finite "
                "numbers for any charges: train with more steps or another seed"
            )


def _compare(
    session: ort.InferenceSession, exact: Exact, charge: Singles, floors: Sequence[float], slack: float
) -> None:
    """The file must answer as the network does; below `floors` and `OF_STD` differences count absolutely."""
    answers = exact(charge.astype(float))
    least = np.maximum(floors, OF_STD * answers[1])
    for mine, (name, theirs) in zip(answers, run(session, charge).items(), strict=True):
        unit = least if name in ("contact", "contact_std") else 1.0
        apart = np.max(np.abs(mine - theirs) / np.maximum(np.abs(mine), unit), axis=1)
        got, allowed = np.quantile(apart, [NEARLY_ALL, 1.0]), np.array([slack, ABSURD]) * AGREEMENT[name]
        if not (got <= allowed).all():
            raise TrainingError(
                f"the exported graph disagrees with the network on {name}: expected at most {allowed[0]:g} for "
                f"{NEARLY_ALL:.1%} of the charges and {allowed[1]:g} for all, got {got[0]:.3g} and {got[1]:.3g}"
            )
