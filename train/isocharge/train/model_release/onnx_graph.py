"""Writer of the ONNX graph of a network, and reader that recovers the network from such a graph.

The reader extracts the constants of a graph, writes a new graph with these constants, and compares both graphs node by
node. Therefore, only the writer defines the structure of the graph. The reader refuses graphs that another program
wrote.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from isocharge.common.activations import ACTIVATIONS, Activation
from isocharge.common.arrays import Array
from isocharge.common.charge_features import ChargeFeatures
from isocharge.common.errors import ModelError, cut
from isocharge.common.perceptron import Layer, Perceptron
from isocharge.serve.model.session import CORRELATION, INPUT, OUTPUTS
from isocharge.train.training.folded_network import (
    COSINES_TO_CORRELATIONS,
    LOG_STD,
    MISFIT_UNIT,
    N_CONTACT_ANSWERS,
    POSITION,
    FoldedNetwork,
)

OPSET = 17
"""Version of the ONNX operators, which runtimes since 2022 support."""

IR_VERSION = 8
"""Version of the ONNX file format that belongs to these operators."""


@dataclass
class GraphBuilder:
    """Builder of a graph, which collects nodes and constants in the order in which they are added."""

    nodes: list[onnx.NodeProto] = field(default_factory=list)
    constants: list[onnx.TensorProto] = field(default_factory=list)

    def add(self, operator: str, *inputs: str, to: str = "", **attributes: Any) -> str:
        """Add a node with one result, and return the name of the result.

        Args:
            operator: ONNX operator of the node.
            *inputs: Names of the tensors that are the inputs of the node.
            to: Name of the result; empty for a generated name.
            **attributes: Attributes of the node.
        """
        result_name = to or f"t{len(self.nodes)}"
        self.add_many(operator, *inputs, to=(result_name,), **attributes)
        return result_name

    def add_many(self, operator: str, *inputs: str, to: tuple[str, ...], **attributes: Any) -> tuple[str, ...]:
        """Add a node with several results, which get the names in `to`, and return these names."""
        self.nodes.append(helper.make_node(operator, list(inputs), list(to), **attributes))
        return to

    def constant(self, values: object, dtype: type = np.float32) -> str:
        """Add a constant tensor, and return its generated name."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=dtype, order="C"), name))
        return name

    def split(self, data: str, widths: Mapping[str, int]) -> tuple[str, ...]:
        """Add a node that splits the columns of a tensor into parts, and return the names of the parts.

        Args:
            data: Name of the tensor.
            widths: Number of columns of each part, by the name of the part.
        """
        sizes = self.constant(tuple(widths.values()), np.int64)
        return self.add_many("Split", data, sizes, to=tuple(widths), axis=1)


def write_graph(network: FoldedNetwork, properties: Mapping[str, str]) -> bytes:
    """Write a network as an ONNX file.

    Args:
        network: The network.
        properties: Metadata, which are written into `metadata_props`.

    Returns:
        The ONNX file. Its input is `charge_pC` [n, n_electrode]. Its outputs are `contact` [n, 3], `contact_std` [n,
        3], `contact_correlation` [n, 3] if the network has correlations, and `misfit` [n, 1]. All tensors are float32.
    """
    model = _whole_model(network)
    helper.set_model_props(model, dict(properties))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _whole_model(network: FoldedNetwork) -> onnx.ModelProto:
    """Return the ONNX model of a network, without metadata.

    The outputs of the perceptron are called answers. The nodes after the perceptron convert the answers into the
    outputs of the graph: the contact, its standard deviations, the correlations if the network has them, and the
    misfit. In this function, a tensor is represented by its name.

    Args:
        network: The network.
    """
    builder = GraphBuilder()
    n_electrode = network.features.n_electrode

    # Split the answers: x and y, the logarithms of the force and of the three standard deviations, the angles that
    # determine the correlations, and the misfit vector.
    n_std = LOG_STD.stop - LOG_STD.start
    widths = {"plane": POSITION.stop, "log_force": 1, "log_std": n_std}
    if network.log_std_limits is None:
        widths = {"plane": POSITION.stop, "logs": 1 + n_std}
    if network.n_angle:
        widths["angles"] = network.n_angle
    widths["misfit_vector"] = n_electrode
    position, *logarithms, misfit_vector = builder.split(_add_answers(builder, network), widths)
    optional_angles = logarithms[-1:] if network.n_angle else []

    # The exponentials of the logarithms are the force and the standard deviations.
    if network.log_std_limits is None:
        # A result of the split has the name of an output of the graph, `contact_std`, so it needs no further node.
        force, _ = builder.split(builder.add("Exp", logarithms[0]), {"force": 1, "contact_std": n_std})
    else:
        lower, upper = network.log_std_limits
        log_force, log_std = logarithms[:2]
        force = builder.add("Exp", log_force)
        limited_below = builder.add("Max", log_std, builder.constant(lower))
        builder.add("Exp", builder.add("Min", limited_below, builder.constant(upper)), to="contact_std")
    builder.add("Concat", position, force, to="contact", axis=1)
    for angles in optional_angles:  # one tensor, or none if the network has no correlations
        cosines = builder.add("Cos", angles)
        builder.add("MatMul", cosines, builder.constant(COSINES_TO_CORRELATIONS), to=CORRELATION)
    # The length of the misfit vector is asinh(misfit / MISFIT_UNIT).
    compressed_misfit = builder.add("ReduceL2", misfit_vector, axes=[1], keepdims=1)
    builder.add("Mul", builder.add("Sinh", compressed_misfit), builder.constant(MISFIT_UNIT), to="misfit")

    outputs = dict(OUTPUTS)
    if not network.n_angle:
        del outputs[CORRELATION]
    declared_inputs = _declare({INPUT: n_electrode})
    graph = helper.make_graph(builder.nodes, "isocharge", declared_inputs, _declare(outputs), builder.constants)
    opset = helper.make_opsetid("", OPSET)
    return helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="isocharge")


def _declare(widths: Mapping[str, int]) -> list[onnx.ValueInfoProto]:
    """Return the declarations of float32 tensors [n, width].

    Args:
        widths: Width of each tensor by its name.
    """
    return [helper.make_tensor_value_info(tensor, TensorProto.FLOAT, ["n", width]) for tensor, width in widths.items()]


def _add_answers(builder: GraphBuilder, network: FoldedNetwork) -> str:
    """Add nodes that compute the features and the perceptron of a network, and return the name of its answers."""
    features = _add_features(builder, network.features)
    return _add_perceptron(builder, features, network.layers)


def _add_features(builder: GraphBuilder, features: ChargeFeatures) -> str:
    """Add nodes that compute the input features of the charges.

    The charges Q are first limited to a range. If all charges are positive, the features are ln(Q / typical charge),
    and the operator `Clip` applies the same limits to all electrodes. If charges may be negative, the features are
    asinh(Q / typical charge) - mean. In this case, the operators `Max` and `Min` apply separate limits to each
    electrode.

    Args:
        builder: Builder of the graph.
        features: Limits, typical charges and means of the features.

    Returns:
        Name of the tensor with the features.
    """
    inverse_typical = 1.0 / features.typical_pC
    if features.mean is None:
        clipped = builder.add("Clip", INPUT, builder.constant(features.low_pC), builder.constant(features.high_pC))
        ratio = builder.add("Mul", clipped, builder.constant(inverse_typical))
        return builder.add("Log", ratio)
    clipped_below = builder.add("Max", INPUT, builder.constant(features.low_pC))
    clipped = builder.add("Min", clipped_below, builder.constant(features.high_pC))
    ratio = builder.add("Mul", clipped, builder.constant(inverse_typical))
    return builder.add("Sub", builder.add("Asinh", ratio), builder.constant(features.mean))


def _add_perceptron(builder: GraphBuilder, inputs: str, perceptron: Perceptron[Array]) -> str:
    """Add nodes that evaluate a perceptron with hidden layers and a skip layer.

    The operator `Gemm` computes inputs @ weights + bias. The last layer adds the output of the skip layer.

    Args:
        builder: Builder of the graph.
        inputs: Name of the tensor with the inputs.
        perceptron: Weights and biases of the layers, and the activation.

    Returns:
        Name of the tensor with the outputs.
    """
    hidden_outputs = inputs
    for layer in perceptron.hidden:
        linear = builder.add("Gemm", hidden_outputs, builder.constant(layer.weight), builder.constant(layer.bias))
        hidden_outputs = builder.add(perceptron.activation.onnx_operator, linear)
    output_layer = perceptron.last
    skip_and_bias = builder.add("Gemm", inputs, builder.constant(perceptron.skip), builder.constant(output_layer.bias))
    return builder.add("Gemm", hidden_outputs, builder.constant(output_layer.weight), skip_and_bias)


def read_graph(onnx_model: bytes, where: str) -> FoldedNetwork:
    """Recover a network from an ONNX file that `write_graph` wrote.

    Args:
        onnx_model: The ONNX file.
        where: Name of the file, for error messages.

    Returns:
        The network. Its arrays are float64, and contain the float32 numbers of the file.

    Raises:
        ModelError: If the file is damaged or was not written by `write_graph`.
    """
    try:
        model = onnx.load_model_from_string(onnx_model)
        onnx.checker.check_model(model, full_check=True)
    except Exception as error:  # protobuf's exceptions have no base in onnx
        raise ModelError(f"{where}: not a valid ONNX file ({cut(str(error))})") from error

    versions = {entry.domain: entry.version for entry in model.opset_import}
    if versions != {"": OPSET}:
        _refuse(where, f"expected ONNX operators of version {OPSET} alone, got {versions}")

    # A graph that is written for the recovered network must have the same nodes as the file. The nodes are compared
    # before the counts of the nodes, because a message about the first different node is more helpful.
    network = _recover_network(model.graph, where)
    expected_nodes = list(_plain_nodes(_whole_model(network).graph))
    given_nodes = list(_plain_nodes(model.graph))
    for expected_node, given_node in zip(expected_nodes, given_nodes, strict=False):
        if expected_node != given_node:
            _refuse(where, f"expected the node {expected_node}, got the node {given_node}")
    if len(expected_nodes) != len(given_nodes):
        _refuse(where, f"expected {len(expected_nodes)} nodes, got {len(given_nodes)}")
    return network


def _recover_network(graph: onnx.GraphProto, where: str) -> FoldedNetwork:
    """Return the network that a graph of `write_graph` evaluates.

    Args:
        graph: The graph.
        where: Beginning of the error messages.

    Raises:
        ModelError: If the number or the shapes of the constants do not fit a network.
    """
    operators = [node.op_type for node in graph.node]
    activation = _hidden_activation(operators, where)
    constants = _constants_in_order(graph, where)
    is_signed = operators[:1] == ["Max"]  # the first node of a graph for charges of both signs
    n_hidden = operators.count(activation.onnx_operator)  # each hidden layer has one activation
    # The order of the next statements is the order in which `write_graph` uses the constants: those of the features,
    # those of the hidden layers, the weights of the skip layer, and the bias and the weights of the last layer.
    try:
        features = _take_features(constants, is_signed=is_signed)
        hidden = [Layer(weight=next(constants), bias=next(constants)) for _ in range(n_hidden)]
        skip = next(constants)
        bias = next(constants)
        perceptron = Perceptron(tuple(hidden), Layer(next(constants), bias), skip, activation)
        next(constants)  # the widths of the split of the answers
        has_limits = operators.count("Max") > is_signed  # the standard deviations have limits
        limits = [next(constants), next(constants)] if has_limits else []
    except StopIteration:
        _refuse(where, f"expected more constants than these {len(graph.initializer)}")
    _check_shapes(features, perceptron, where)
    n_std = LOG_STD.stop - LOG_STD.start
    if any(limit.shape != (n_std,) for limit in limits):
        _refuse(where, f"expected {n_std} limits of standard deviations, got {[limit.shape for limit in limits]}")
    return FoldedNetwork(features, perceptron, np.array(limits) if has_limits else None)


def _hidden_activation(operators: Sequence[str], where: str) -> Activation:
    """Return the activation of the hidden layers, which is the operator after the first linear layer.

    Args:
        operators: Operators of the nodes, in order.
        where: Beginning of the error message.

    Raises:
        ModelError: If this operator is not an activation, or does not exist.
    """
    activation_of_operator = {activation.onnx_operator: activation for activation in ACTIVATIONS.values()}
    # The operator `Gemm` is a linear layer.
    operators_after_gemm = [following for operator, following in pairwise(operators) if operator == "Gemm"]
    first_following = operators_after_gemm[:1]  # empty if no operator follows a Gemm
    if not first_following or first_following[0] not in activation_of_operator:
        known_operators = ", ".join(activation_of_operator)
        _refuse(where, f"expected one of the activations {known_operators} after a Gemm, got {first_following}")
    return activation_of_operator[first_following[0]]


def _constants_in_order(graph: onnx.GraphProto, where: str) -> Iterator[Array]:
    """Yield the values of the constants of a graph in the order in which the nodes use them.

    Args:
        graph: The graph.
        where: Beginning of the error message about constants that are not finite.
    """
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    for node in graph.node:
        for name in node.input:
            if name not in constants:  # the input is the result of another node, or the charges
                continue
            if not np.isfinite(constants[name]).all():
                _refuse(where, f"node {node.op_type} {list(node.output)}: expected finite constants")
            yield constants[name].astype(float)


def _take_features(constants: Iterator[Array], *, is_signed: bool) -> ChargeFeatures:
    """Read the features from the first constants of a graph.

    Args:
        constants: Iterator over the constants, which is advanced.
        is_signed: Whether charges may be negative. Only the features of such charges have a mean.

    Raises:
        StopIteration: If there are too few constants.
    """
    low = next(constants)
    high = next(constants)
    inverse_typical = next(constants)
    mean = next(constants) if is_signed else None
    return ChargeFeatures(1.0 / inverse_typical, low, high, mean)


def _check_shapes(features: ChargeFeatures, perceptron: Perceptron[Array], where: str) -> None:
    """Raise an error if the shapes of the constants of a network do not fit each other.

    Args:
        features: Limits, typical charges and means of the features.
        perceptron: Weights and biases of the layers.
        where: Beginning of the error messages.

    Raises:
        ModelError: If the shapes do not fit.
    """
    _check_feature_shapes(features, where)
    n_electrode = features.n_electrode
    width = n_electrode  # number of inputs of the next layer
    for layer in (*perceptron.hidden, perceptron.last):
        if layer.weight.ndim != 2 or layer.weight.shape[0] != width:
            _refuse(where, f"expected weights for {width} inputs, got an array of shape {layer.weight.shape}")
        width = layer.weight.shape[1]
        if layer.bias.shape != (width,):
            _refuse(where, f"expected a bias for each column of {layer.weight.shape}, got {layer.bias.shape}")

    if perceptron.skip.shape != (n_electrode, width):
        _refuse(where, f"expected a skip layer of shape {(n_electrode, width)}, got {perceptron.skip.shape}")
    if width < N_CONTACT_ANSWERS + n_electrode:
        _refuse(where, f"expected at least {N_CONTACT_ANSWERS} + {n_electrode} answers, got {width}")


def _check_feature_shapes(features: ChargeFeatures, where: str) -> None:
    """Raise an error if the limits, the typical charges and the means of features have wrong shapes.

    The limits of logarithmic features are single numbers. Features of charges of both signs have limits and a mean for
    each electrode.

    Args:
        features: The features.
        where: Beginning of the error message.

    Raises:
        ModelError: If the shapes do not fit.
    """
    n_electrode = features.n_electrode
    limits_and_means = [features.low_pC, features.high_pC]
    expected_shapes: list[tuple[int, ...]] = [(), ()]
    if features.mean is not None:
        limits_and_means.append(features.mean)
        expected_shapes = [(n_electrode,)] * len(limits_and_means)
    given_shapes = [values.shape for values in limits_and_means]
    if given_shapes != expected_shapes or features.typical_pC.shape != (n_electrode,):
        _refuse(
            where, f"expected limits and means of the charges with the shapes {expected_shapes}, got {given_shapes}"
        )


@dataclass(frozen=True)
class _PlainNode:
    """Description of a node without the arbitrary names of its tensors.

    Two descriptions are equal if their nodes compute the same results from the same inputs.

    Attributes:
        operator: The operator.
        inputs: Description of each input: the name of an input of the graph, the node that computes the tensor, or the
            values of a constant.
        outputs: Name of each result of the node that is an output of the graph; None for each other result.
        attributes: Attributes by name.
    """

    operator: str
    inputs: tuple[object, ...]
    outputs: tuple[str | None, ...]
    attributes: dict[str, object]

    def __str__(self) -> str:
        inputs = ", ".join(str(value)[:60] for value in self.inputs)
        outputs = ", ".join(name or "a result" for name in self.outputs)
        return f"{self.operator}({inputs}) {self.attributes or ''} to {outputs}"


def _plain_nodes(graph: onnx.GraphProto) -> Iterator[_PlainNode]:
    """Yield a description of each node of a graph, for a comparison with another graph.

    The names of the tensors inside a graph are arbitrary. The name of a constant is replaced by the values of the
    constant. The name of every other inner tensor is replaced by the number of the node that computes the tensor.

    Args:
        graph: The graph.
    """
    # This dictionary contains the descriptions of all tensors that can be inputs of the next node, by their names.
    description_of_tensor: dict[str, object] = {tensor.name: tensor.name for tensor in graph.input}
    for tensor in graph.initializer:
        description_of_tensor[tensor.name] = _plain_constant(numpy_helper.to_array(tensor))
    graph_outputs = {tensor.name for tensor in graph.output}
    for node_index, node in enumerate(graph.node):
        yield _PlainNode(
            operator=node.op_type,
            # An unknown name, such as the empty name of an omitted input, gets the description None.
            inputs=tuple(description_of_tensor.get(name) for name in node.input),
            outputs=tuple(name if name in graph_outputs else None for name in node.output),
            attributes={attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute},
        )
        for output_index, name in enumerate(node.output):
            description_of_tensor[name] = f"result {output_index} of node {node_index}"


def _plain_constant(values: NDArray[Any]) -> tuple[object, ...]:
    """Return the number type, the shape and the numbers of a constant."""
    return values.dtype.str, values.shape, values.tolist()


def _refuse(where: str, reason: str) -> NoReturn:
    """Raise a ModelError about a graph that was not written by `write_graph`."""
    raise ModelError(f"{where}: {reason}; only models of isocharge can be read")
