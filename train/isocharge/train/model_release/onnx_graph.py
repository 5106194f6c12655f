"""Writer of the ONNX graph of a network, and reader that recovers the network from such a graph.

The reader extracts the constants of a graph, writes a new graph with these constants, and compares both graphs.
Therefore, only the writer defines the structure of the graph. The reader refuses graphs that another program wrote.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import onnx
import onnx.parser
from onnx import helper, numpy_helper

from isocharge.common.errors import ModelError, cut
from isocharge.serve.model.session import CORRELATION, INPUT, OUTPUTS
from isocharge.train.training.activations import ACTIVATIONS
from isocharge.train.training.charge_features import ChargeFeatures
from isocharge.train.training.folded_network import (
    COSINES_TO_CORRELATIONS,
    LARGEST_LOGARITHM,
    MISFIT_UNIT,
    FoldedNetwork,
)
from isocharge.train.training.perceptron import Layer, Perceptron

OPSET = 17
"""Version of the ONNX operators, which runtimes since 2022 support."""


@dataclass
class GraphBuilder:
    """Builder of a graph, which collects nodes and constants in the order in which they are added.

    The nodes are lines in the textual syntax of ONNX, and a tensor is represented by its name.
    """

    nodes: list[str] = field(default_factory=list)
    constants: list[onnx.TensorProto] = field(default_factory=list)

    def add(self, operator: str, *inputs: str, to: str = "") -> str:
        """Add a node, and return the name of its result.

        Args:
            operator: ONNX operator of the node, with its attributes in angle brackets.
            *inputs: Names of the tensors that are the inputs of the node.
            to: Name of the result, or several names with commas between them; empty for a generated name.
        """
        result_name = to or f"t{len(self.nodes)}"
        self.nodes.append(f"{result_name} = {operator} ({', '.join(inputs)})")
        return result_name

    def constant(self, values: object, dtype: type = np.float32) -> str:
        """Add a constant tensor, and return its generated name."""
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.array(values, dtype=dtype, order="C"), name))
        return name


def write_graph(network: FoldedNetwork, properties: Mapping[str, str]) -> bytes:
    """Write a network as an ONNX file.

    Args:
        network: The network.
        properties: Metadata, which are written into `metadata_props`.

    Returns:
        The ONNX file. Its input is `charge_pC` [n, n_electrode]. Its outputs are `contact` [n, 3], `contact_std` [n,
        3], `contact_correlation` [n, 3] and `misfit` [n, 1]. All tensors are float32.
    """
    model = _whole_model(network)
    helper.set_model_props(model, dict(properties))
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _whole_model(network: FoldedNetwork) -> onnx.ModelProto:
    """Return the ONNX model of a network, without metadata.

    The outputs of the perceptron are called answers. The nodes after the perceptron convert the answers into the
    outputs of the graph: the contact, its standard deviations, the correlations and the misfit.

    Args:
        network: The network.
    """
    builder = GraphBuilder()
    n_electrode = network.features.n_electrode
    features = _add_features(builder, network.features)
    answers = _add_perceptron(builder, features, network.layers)

    # Split the answers: x and y, the logarithms of the force and of the three standard deviations, the angles that
    # determine the correlations, and the misfit vector. The exponentials of the limited logarithms are the force and
    # the standard deviations. A result of a split has the name of an output of the graph, so it needs no further node.
    widths = builder.constant((2, 4, len(COSINES_TO_CORRELATIONS), n_electrode), np.int64)
    builder.add("Split <axis = 1>", answers, widths, to="plane, logs, angles, misfit_vector")
    limits = (builder.constant(-LARGEST_LOGARITHM), builder.constant(LARGEST_LOGARITHM))
    exponentials = builder.add("Exp", builder.add("Clip", "logs", *limits))
    builder.add("Split <axis = 1>", exponentials, builder.constant((1, 3), np.int64), to="force, contact_std")
    builder.add("Concat <axis = 1>", "plane", "force", to="contact")
    cosines = builder.add("Cos", "angles")
    builder.add("MatMul", cosines, builder.constant(COSINES_TO_CORRELATIONS), to=CORRELATION)
    # The length of the misfit vector is asinh(misfit / MISFIT_UNIT).
    compressed_misfit = builder.add("ReduceL2 <axes = [1], keepdims = 1>", "misfit_vector")
    builder.add("Mul", builder.add("Sinh", compressed_misfit), builder.constant(MISFIT_UNIT), to="misfit")

    outputs = ", ".join(f"float[n, {width}] {name}" for name, width in OUTPUTS.items())
    model = onnx.parser.parse_model(
        f'<ir_version: 8, opset_import: ["" : {OPSET}], producer_name: "isocharge">\n'
        f"isocharge (float[n, {n_electrode}] {INPUT}) => ({outputs}) {{\n" + "\n".join(builder.nodes) + "\n}"
    )
    for node in model.graph.node:
        node.ClearField("domain")  # the parser states the empty domain, and `onnx.helper` does not
    model.graph.initializer.extend(builder.constants)
    return model


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


def _add_perceptron(builder: GraphBuilder, inputs: str, perceptron: Perceptron) -> str:
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

    try:
        network = _recover_network(model.graph)
        is_equal = _whole_model(network).graph == model.graph
    except (LookupError, ValueError, StopIteration):  # the constants are too few, or their shapes do not fit a network
        is_equal = False
    has_operators = [(entry.domain, entry.version) for entry in model.opset_import] == [("", OPSET)]
    if not (is_equal and has_operators):
        raise ModelError(f"{where}: expected a graph that isocharge has written, got another graph; export it again")
    return network


def _recover_network(graph: onnx.GraphProto) -> FoldedNetwork:
    """Return the network that a graph of `write_graph` evaluates.

    The constants are taken in the order in which `write_graph` uses them: those of the features, those of the hidden
    layers, the weights of the skip layer, and the bias and the weights of the last layer.

    Args:
        graph: The graph.

    Raises:
        LookupError: If the graph has no activation, or too few constants.
        ValueError: If the shapes of the constants do not fit a network, or a constant is not finite.
        StopIteration: If the graph has too few constants.
    """
    operators = [node.op_type for node in graph.node]
    activations = {activation.onnx_operator: activation for activation in ACTIVATIONS.values()}
    activation = activations[operators[operators.index("Gemm") + 1]]
    n_hidden = operators.count(activation.onnx_operator)  # each hidden layer has one activation
    is_signed = operators[0] == "Max"  # the first node of a graph for charges of both signs

    names = [name for node in graph.node for name in node.input]
    tensors = {tensor.name: numpy_helper.to_array(tensor).astype(float) for tensor in graph.initializer}
    constants = (np.asarray_chkfinite(tensors[name]) for name in names if name in tensors)
    low = next(constants)
    high = next(constants)
    typical = 1.0 / next(constants)
    features = ChargeFeatures(typical, low, high, next(constants) if is_signed else None)
    hidden = [Layer(weight=next(constants), bias=next(constants)) for _ in range(n_hidden)]
    skip = next(constants)
    bias = next(constants)
    last = Layer(weight=next(constants), bias=bias)
    # ONNX would also repeat a single number for all columns, C does not.
    if any(layer.bias.shape != layer.weight.shape[1:] for layer in (*hidden, last, Layer(skip, bias))):
        raise ValueError("expected a bias for each column of the weights")
    return FoldedNetwork(features, Perceptron(tuple(hidden), last, skip, activation))
