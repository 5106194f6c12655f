"""The trained network as an ONNX graph, written node by node from its weights: what the model needs and nothing else.

At batch one a node costs more than its arithmetic, so the graph is built for few nodes: whitening, units and scales are
folded into the first and last layers; the two perceptrons run as one with block-diagonal weights; the two starts of the
misfit lie side by side, (n, 2, 1, 3), through the same nodes. A test compares it with `InverseNetwork.forward` on
clean, noisy and absurd charges.
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
    press = build.reshape("charge_pC", -1, 1, 1, n_electrode)
    within = build.add("Clip", press, build.constant(-HIGHEST_PC), build.constant(HIGHEST_PC))
    typical = build.constant(1.0 / network.features.typical)
    logs = build.add("Log", build.add("Mul", build.add("Clip", within, build.constant(LOWEST_PC)), typical))
    answers = _perceptrons(build, network, build.reshape(logs, -1, n_electrode))
    starts, plane, log_force, log_std = build.split(
        answers, ("starts", "plane", "log_force", "log_std"), (6, 2, 1, 3), axis=1
    )
    build.add("Concat", plane, build.add("Exp", log_force), to="contact", axis=1)
    build.add("Exp", log_std, to="contact_std")
    _misfit(build, network, build.add("Mul", within, typical), logs, starts)
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


def _misfit(build: GraphBuilder, network: InverseNetwork, charge: str, logs: str, starts: str) -> None:
    """The smallest distance of two starts and their Gauss-Newton improvements.

    Charges here are relative to the typical ones, `charge` and its logarithm, shape (n, 1, 1, n_electrode).
    """
    n_electrode, series = network.features.typical.size, network.field.series.double().numpy()
    of_logs, of_step = series[0].copy(), np.moveaxis(series[1:], 0, -1)  # the step as (n_electrode, 3), to multiply
    of_logs[0, 0, 0] -= np.log(network.features.typical)
    both = np.concatenate([of_logs, of_step.reshape(*of_logs.shape[:3], -1)], axis=-1)
    first = _project(build, build.reshape(starts, -1, 2, 1, 3))
    sizes = (n_electrode, 3 * n_electrode)
    log_charge, inverse = build.split(_series(build, both, first), ("log_charge", "inverse"), sizes, axis=3)
    miss = build.add("Sub", logs, log_charge)
    step = build.add("MatMul", miss, build.reshape(inverse, -1, 2, n_electrode, 3))
    better = _project(build, build.add("Add", first, step))
    improved = _series(build, of_logs, better)
    known = build.add("Exp", build.add("Concat", log_charge, improved, axis=1))
    distances = _distances(build, network, charge, known)
    build.add("ReduceMin", distances, to="misfit", axes=[1], keepdims=1)


def _distances(build: GraphBuilder, network: InverseNetwork, charge: str, known: str) -> str:
    """|(Q - known) / sigma| for known charges of shape (n, 4, 1, n_electrode), shape (n, 4)."""
    white, gain = 1e12 * network.noise.white / network.features.typical, network.noise.gain
    square = build.add("Mul", charge, charge)
    variance = build.add("Add", build.add("Mul", square, build.constant(gain**2)), build.constant(white**2))
    deviation = build.add("Div", build.add("Sub", charge, known), build.add("Sqrt", variance))
    return build.add("ReduceL2", deviation, axes=[2, 3], keepdims=0)


def _project(build: GraphBuilder, unit: str) -> str:
    """Unit coordinates (n, 2, 1, 3) into the domain: each over max(1, its distance from the axis or the middle)."""
    squares = build.add("Mul", unit, unit)
    shared = build.add("MatMul", squares, build.constant(INSIDE * np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]])))
    beyond = build.add("Sqrt", build.add("Clip", shared, build.constant(1.0)))
    return build.add("Div", unit, beyond)


def _series(build: GraphBuilder, series: Array, unit: str) -> str:
    """Chebyshev series with coefficients (k, k, m, columns) at unit coordinates (n, 2, 1, 3): (n, 2, 1, columns).

    With y = cos b and F = cos c, the products of the series are cosines too, T_k(y) T_m(F) = (cos(k b + m c) +
    cos(k b - m c)) / 2. So one product with a constant makes every angle, and two more make the sum.
    """
    count, _, in_force, columns = series.shape
    pairs = [(k, m) for m in range(1 - in_force, in_force) for k in range(count)]
    orders = np.zeros((3, count + len(pairs)))
    orders[0, :count], orders[1:, count:] = np.arange(count), np.transpose(pairs)
    angles = build.add("MatMul", build.add("Acos", unit), build.constant(orders))
    number, sizes = len(build.nodes), (count, len(pairs))
    in_x, others = build.split(build.add("Cos", angles), (f"x{number}", f"others{number}"), sizes, axis=3)
    parts = np.stack([series[:, k, abs(m)] * (0.5 if m else 1.0) for k, m in pairs])  # (pairs, k, columns)
    by_x = build.reshape(
        build.add("MatMul", others, build.constant(parts.reshape(len(pairs), -1))), -1, 2, count, columns
    )
    return build.add("MatMul", in_x, by_x)
