"""The trained network as an ONNX graph, written node by node from its weights: what the model needs and nothing else.

At batch one a node costs more than its arithmetic, so the graph is built for few nodes: whitening, units and scales are
folded into the first and last layers; the two perceptrons run as one with block-diagonal weights; the two starts of the
misfit lie side by side, (n, 2, 3), through the same nodes. A test compares it with `InverseNetwork.forward` on clean,
noisy and absurd charges.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from scipy.linalg import block_diag
from torch import nn

from isocharge.simulate.arrays import Array
from isocharge.train.network import HIGHEST_PC, LOWEST_PC, InverseNetwork

OPSET, IR_VERSION = 17, 8
"""Old enough for runtimes of 2022 on, new enough for every operator used."""

INSIDE = 1.0 + 1e-6
"""Factor by which projected points stay inside the domain, so that rounding never hands acos more than one."""


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

    def reshape(self, data: str, *shape: int) -> str:
        """Another shape for the same numbers."""
        return self.add("Reshape", data, self.constant(shape, np.int64))

    def sum_over(self, data: str, axis: int) -> str:
        """Sum over one axis, which goes."""
        return self.add("ReduceSum", data, self.constant([axis], np.int64), keepdims=0)

    def split(self, data: str, names: tuple[str, ...], sizes: tuple[int, ...], axis: int) -> tuple[str, ...]:
        """Cut a tensor into pieces."""
        return self.add_many("Split", data, self.constant(sizes, np.int64), to=names, axis=axis)


def export_onnx(network: InverseNetwork, properties: Mapping[str, str]) -> bytes:
    """Build the graph.

    Args:
        network: The trained model.
        properties: Metadata, written into `metadata_props`.

    Returns:
        The ONNX file: input `charge_pC` [n, n_electrode]; outputs `contact` [n, 3], `contact_std` [n, 3],
        `misfit` [n, 1], all float32.
    """
    build, n_electrode = GraphBuilder(), network.features.typical.size
    clipped = build.add("Clip", "charge_pC", build.constant(LOWEST_PC), build.constant(HIGHEST_PC))
    logs = build.add("Log", build.add("Mul", clipped, build.constant(1.0 / network.features.typical)))
    starts, plane, log_force, log_std = build.split(
        _perceptrons(build, network, logs), ("starts", "plane", "log_force", "log_std"), (6, 2, 1, 3), axis=1
    )
    build.add("Concat", plane, build.add("Exp", log_force), to="contact", axis=1)
    build.add("Exp", log_std, to="contact_std")
    _misfit(build, network, logs, starts)
    graph = helper.make_graph(
        build.nodes,
        "isocharge",
        [helper.make_tensor_value_info("charge_pC", TensorProto.FLOAT, ["n", n_electrode])],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", width])
            for name, width in (("contact", 3), ("contact_std", 3), ("misfit", 1))
        ],
        build.constants,
    )
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="isocharge")
    helper.set_model_props(model, dict(properties))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _perceptrons(build: GraphBuilder, network: InverseNetwork, logs: str) -> str:
    """Both perceptrons as one, layer by layer side by side.

    Columns of the result: mean and proposal in unit coordinates (6), x_mm and y_mm (2), ln F (1), logarithms of the
    standard deviations in mm and N (3). A force's deviation is relative to the force, so its logarithm adds ln F.
    """
    contact, nearest = _layers(network, network.contact), _layers(network, network.nearest)
    weight, bias = _outputs(network, contact.pop(), nearest.pop())
    value = logs
    for number, ((first, first_bias), (second, second_bias)) in enumerate(zip(contact, nearest, strict=True)):
        both = np.hstack([first, second]) if number == 0 else block_diag(first, second)
        value = build.add("Gemm", value, build.constant(both), build.constant(np.r_[first_bias, second_bias]))
        value = build.add("Tanh", value)
    return build.add("Gemm", value, build.constant(weight), build.constant(bias))


def _layers(network: InverseNetwork, layers: nn.Sequential) -> list[tuple[Array, Array]]:
    """Weights (inputs, outputs) and biases of a perceptron, the whitening folded into the first."""
    weights = [
        (layer.weight.detach().double().numpy().T, layer.bias.detach().double().numpy())
        for layer in layers
        if isinstance(layer, nn.Linear)
    ]
    weights[0] = (network.features.matrix @ weights[0][0], weights[0][1])
    return weights


def _outputs(
    network: InverseNetwork, contact: tuple[Array, Array], nearest: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Last layer of both perceptrons, with units, scales and the columns that `_perceptrons` lists."""
    centre, scale = network.centre.double().numpy(), network.scale.double().numpy()

    def columns(of_contact: Array, of_nearest: Array, shift: Array, log_scale: Array) -> Array:
        mean, log_std = of_contact[..., :3], of_contact[..., 3:] + log_scale
        value = mean * scale + shift
        log_std = log_std + value * np.array([0.0, 0.0, 1.0])
        return np.concatenate([mean, of_nearest, value, log_std], axis=-1)

    (weight, bias), (nearest_weight, nearest_bias) = contact, nearest
    above = columns(weight, np.zeros((len(weight), 3)), np.zeros(3), np.zeros(3))
    below = columns(np.zeros((len(nearest_weight), 6)), nearest_weight, np.zeros(3), np.zeros(3))
    return np.vstack([above, below]), columns(bias, nearest_bias, centre, np.log(scale))


def _misfit(build: GraphBuilder, network: InverseNetwork, logs: str, starts: str) -> None:
    """The smallest distance of two starts and their Gauss-Newton improvements."""
    n_electrode, series = network.features.typical.size, network.field.series.double().numpy()
    first = _project(build, build.reshape(starts, -1, 2, 3))
    rows = build.reshape(_series(build, series, first), -1, 2, 4, n_electrode)
    log_charge, inverse = build.split(rows, ("log_charge", "inverse"), (1, 3), axis=2)
    typical = build.constant(np.log(network.features.typical))
    measured = build.reshape(build.add("Add", logs, typical), -1, 1, 1, n_electrode)
    miss = build.add("Sub", measured, log_charge)
    step = build.sum_over(build.add("Mul", inverse, miss), 3)
    better = _project(build, build.add("Add", first, step))
    improved = build.reshape(_series(build, series[:1], better), -1, 2, 1, n_electrode)
    known = build.add("Exp", build.add("Concat", log_charge, improved, axis=1))
    distances = _distances(build, network, known)
    build.add("ReduceMin", distances, to="misfit", axes=[1], keepdims=0)


def _distances(build: GraphBuilder, network: InverseNetwork, known: str) -> str:
    """|(Q - known) / sigma| for known charges of shape (n, 4, 1, n_electrode), shape (n, 4, 1)."""
    white, gain = 1e12 * network.noise.white, network.noise.gain
    limits = build.constant(-HIGHEST_PC), build.constant(HIGHEST_PC)
    within = build.reshape(build.add("Clip", "charge_pC", *limits), -1, 1, 1, network.features.typical.size)
    square = build.add("Mul", within, within)
    variance = build.add("Add", build.add("Mul", square, build.constant(gain**2)), build.constant(white**2))
    deviation = build.add("Div", build.add("Sub", within, known), build.add("Sqrt", variance))
    return build.add("ReduceL2", deviation, axes=[3], keepdims=0)


def _project(build: GraphBuilder, unit: str) -> str:
    """Unit coordinates (n, 2, 3) into the domain: each over max(1, its distance from the axis or the middle)."""
    squares = build.add("Mul", unit, unit)
    shared = build.add("MatMul", squares, build.constant(INSIDE * np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]])))
    beyond = build.add("Sqrt", build.add("Max", shared, build.constant(1.0)))
    return build.add("Div", unit, beyond)


def _series(build: GraphBuilder, series: Array, unit: str) -> str:
    """Chebyshev series (rows, k, k, m, n_electrode) at unit coordinates (n, 2, 3): (2 n, 1, rows n_electrode)."""
    rows, count, _, in_force, n_electrode = series.shape
    angle = build.reshape(build.add("Acos", unit), -1, 3, 1)
    polynomials = build.add("Cos", build.add("Mul", angle, build.constant(np.arange(count))))
    number = len(build.nodes)
    x, y, force = build.split(polynomials, (f"x{number}", f"y{number}", f"force{number}"), (1, 1, 1), axis=1)
    plane = build.add("Mul", build.reshape(x, -1, count, 1), y)
    part = series.transpose(1, 2, 3, 0, 4).reshape(count * count, -1)
    by_force = build.add("MatMul", build.reshape(plane, -1, count * count), build.constant(part))
    chosen = build.split(force, (f"low{number}", f"rest{number}"), (in_force, count - in_force), axis=2)[0]
    return build.add("MatMul", chosen, build.reshape(by_force, -1, in_force, rows * n_electrode))
