"""A folded network as an ONNX graph, written node by node from its weights: what the model needs and nothing else."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from isocharge.serve.model.session import OUTPUTS
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.training.folding import FoldedLayers, FoldedNetwork
from isocharge.train.training.network import MISFIT_UNIT

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


def export_onnx(network: FoldedNetwork, properties: Mapping[str, str]) -> bytes:
    """The model as an ONNX file.

    Args:
        network: The model, folded (`training.folding`).
        properties: Metadata, written into `metadata_props`.

    Returns:
        The ONNX file: input `charge_pC` [n, n_electrode]; outputs `contact` [n, 3], `contact_std` [n, 3],
        `misfit` [n, 1], all float32.
    """
    build, n_electrode = GraphBuilder(), network.typical.size
    within = build.add("Clip", "charge_pC", build.constant(LOWEST_CHARGE), build.constant(HIGHEST_CHARGE))
    ratios = build.add("Mul", within, build.constant(1.0 / network.typical))
    answers = add_layers(build, build.add("Log", ratios), network.layers)
    plane, logs, vector = build.split(answers, ("plane", "logs", "misfit_vector"), (2, 4, n_electrode), axis=1)
    force, _ = build.split(build.add("Exp", logs), ("force", "contact_std"), (1, 3), axis=1)
    build.add("Concat", plane, force, to="contact", axis=1)
    length = build.add("ReduceL2", vector, axes=[1], keepdims=1)
    build.add("Mul", build.add("Sinh", length), build.constant(MISFIT_UNIT), to="misfit")
    model = make_model(build, "isocharge", n_electrode, OUTPUTS, producer_name="isocharge")
    helper.set_model_props(model, dict(properties))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


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
