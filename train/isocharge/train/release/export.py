"""The trained network as an ONNX graph, written node by node from its weights: what the model needs and nothing else.

At batch one a node costs more than its arithmetic, so the graph is built for few nodes: whitening, units and scales are
folded into the first and last layers; the two perceptrons run as one with block-diagonal weights. A test compares it
with `InverseNetwork.forward` on clean, noisy and absurd charges.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from scipy.linalg import block_diag
from torch import nn

from isocharge.arrays import Array
from isocharge.train.data.domain import HIGHEST_PC, LOWEST_PC
from isocharge.train.training.network import MISFIT_UNIT, InverseNetwork

OPSET, IR_VERSION = 17, 8
"""Old enough for runtimes of 2022 on, new enough for every operator used."""


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
    within = build.add("Clip", "charge_pC", build.constant(LOWEST_PC), build.constant(HIGHEST_PC))
    ratios = build.add("Mul", within, build.constant(1.0 / network.features.typical))
    answers = _perceptrons(build, network, build.add("Log", ratios))
    plane, logs, missing = build.split(answers, ("plane", "logs", "missing"), (2, 4, n_electrode), axis=1)
    force, _ = build.split(build.add("Exp", logs), ("force", "contact_std"), (1, 3), axis=1)
    build.add("Concat", plane, force, to="contact", axis=1)
    squeezed = build.add("ReduceL2", missing, axes=[1], keepdims=1)
    build.add("Mul", build.add("Sinh", squeezed), build.constant(MISFIT_UNIT), to="misfit")
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
    """Both perceptrons as one, layer by layer side by side, from the logarithms of the charges.

    Columns of the result: x_mm and y_mm (2), ln F (1), logarithms of the standard deviations in mm and N (3), the
    squeezed vector of the misfit (n_electrode).
    """
    whitening, mean = network.whitening.double().numpy(), network.logs_mean.double().numpy()
    value = logs
    *hidden, last = zip(network.contact.layers(), network.missing.layers(), strict=True)
    for number, (first, second) in enumerate(hidden):
        both = block_diag(*map(_matrix, (first, second))) if number else whitening @ _side_by_side(first, second)
        bias = np.r_[_bias(first), _bias(second)] - (0.0 if number else mean @ both)
        value = build.add("Tanh", build.add("Gemm", value, build.constant(both), build.constant(bias)))
    units, shift = _in_units(network)
    straight = whitening @ _side_by_side(network.contact.straight, network.missing.straight) @ units
    bias = np.r_[_bias(last[0]), _bias(last[1])] @ units + shift - mean @ straight
    beside = build.add("Gemm", logs, build.constant(straight), build.constant(bias))
    return build.add("Gemm", value, build.constant(block_diag(*map(_matrix, last)) @ units), beside)


def _matrix(layer: nn.Linear) -> Array:
    """Weights of a layer, shape (inputs, outputs)."""
    weights: Array = layer.weight.detach().double().numpy().T
    return weights


def _bias(layer: nn.Linear) -> Array:
    bias: Array = layer.bias.detach().double().numpy()
    return bias


def _side_by_side(first: nn.Linear, second: nn.Linear) -> Array:
    """Weights of two layers with the same inputs as one layer's."""
    return np.hstack([_matrix(first), _matrix(second)])


def _in_units(network: InverseNetwork) -> tuple[Array, Array]:
    """Matrix and shift from the perceptrons' outputs to `_perceptrons`' columns.

    A force's deviation is relative to the force, so its logarithm adds ln F.
    """
    scale, n_electrode = network.domain.scale, network.features.typical.size
    matrix, shift = np.diag(np.r_[scale, np.ones(3 + n_electrode)]), np.zeros(6 + n_electrode)
    matrix[2, 5] = scale[2]
    shift[:3], shift[3:6] = network.domain.centre, np.log(scale)
    shift[5] += network.domain.centre[2]
    return matrix, shift
