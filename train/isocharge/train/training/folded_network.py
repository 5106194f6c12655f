"""Network that computes contacts from charges, in the form of a release, and the ONNX graph of the network.

The network has three parts:

- The input features are functions of the charges. If all charges are positive, the input features are logarithms of the
  charges. If the charges can have both signs, the input features are inverse hyperbolic sines of the charges.
- Two perceptrons compute vectors from the input features. The entries of these vectors are called answers.
- The output functions convert the answers to position, force, standard deviations, correlations and misfit.

The ONNX graph defines how a network is evaluated. A runtime evaluates the graph of a released model in single
precision. The reference implementation of ONNX evaluates a graph of the same network in double precision. The C export
(`isocharge.train.export_c.model_source`) writes networks of the same form.

Perceptron
----------

For inputs x, the hidden layer l computes h_l = tanh(h_(l-1) W_l + b_l), where h_0 = x.
The output layer computes y = h_L V + c + x S from the result h_L of the last hidden layer. The skip layer S maps the
inputs linearly to the outputs. The hidden layers therefore only need to learn the nonlinear part of the function.

A network has one perceptron for the contact, and one perceptron for the misfit. Both perceptrons have the same number
of layers. The function `fold` includes the whitening of the features in the first layer of each perceptron, and the
units of the answers in the last layer. In a prediction for a single press, the overhead of each node of the graph takes
more time than the arithmetic. The graph therefore joins both perceptrons into a single perceptron, whose later layers
have block-diagonal weights.

Correlations
------------

The contact perceptron estimates three angles a, b and c that determine the correlations between the errors of x, y and
ln F. Every matrix of correlations between three errors is the Gram matrix of three unit vectors. The vectors (1, 0, 0),
(cos a, sin a, 0) and (cos b, sin b cos c, sin b sin c) have unit length for all angles, so they always give a valid
correlation matrix. The vectors are also the rows of the Cholesky factor of this matrix. Products of sines and cosines
can be written as sums of cosines. The correlations are therefore linear in eight cosines:

    xy = cos a,  xF = cos b,
    yF = (cos(a - b) + cos(a + b)) / 2 + (cos(a - b - c) + cos(a - b + c) - cos(a + b - c) - cos(a + b + c)) / 4.

In the exported graph, one node computes the cosines, and another node computes their weighted sums.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnx.parser
from numpy.typing import NDArray
from onnx import numpy_helper
from onnx.reference import ReferenceEvaluator
from scipy.linalg import block_diag

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.serve.model.contact import MISFIT_LIMIT
from isocharge.serve.model.session import CORRELATION, INPUT, OUTPUTS
from isocharge.train.data.channel_noise import LARGEST_LOGARITHM


@dataclass(frozen=True)
class ChargeFeatures:
    """Function that computes features from charges Q. The features are the inputs of a network's first layer.

    If all charges are positive, the features are ln(clip(Q) / typical). If the charges can have both signs, the
    features are asinh(clip(Q) / typical) - mean. The function asinh is linear for small arguments and logarithmic for
    large arguments.

    Attributes:
        typical_pC: Charge by which the charge of each electrode is divided, shape (n_electrode,), pC, positive.
        low_pC: Lower limit to which smaller charges are clipped, shape () or (n_electrode,), pC.
        high_pC: Upper limit to which larger charges are clipped, shape () or (n_electrode,), pC.
        mean: Mean of the inverse hyperbolic sines over the training presses, shape (n_electrode,); None if all charges
            are positive.
    """

    typical_pC: Array
    low_pC: Array
    high_pC: Array
    mean: Array | None = None

    @property
    def n_electrode(self) -> int:
        """Number of electrodes, which is also the number of charges of a press."""
        return self.typical_pC.size


LARGEST_INT8 = np.iinfo(np.int8).max
"""Largest absolute value of the 8-bit integers that represent weights. A weight is an integer times a scale."""


class Layer(NamedTuple):
    """Weights of a linear layer, which computes inputs @ weight + bias.

    Attributes:
        weight: Matrix of the layer, shape (n_input, n_output).
        bias: Bias of the layer, shape (n_output,).
    """

    weight: Array
    bias: Array


@dataclass(frozen=True)
class Perceptron:
    """A multilayer perceptron with a skip layer.

    Attributes:
        hidden: Hidden layers, from the first to the last layer. The hyperbolic tangent follows each hidden layer.
        last: Output layer.
        skip: Weights of the skip layer from the inputs directly to the outputs, shape (n_input, n_output).
    """

    hidden: tuple[Layer, ...]
    last: Layer
    skip: Array


POSITION = slice(0, 2)
"""Columns of the answers that contain x and y, mm."""

LOG_FORCE = slice(2, 3)
"""Column of the answers that contains the logarithm of the force in N."""

MEAN = slice(0, 3)
"""Columns of the answers that contain x, y and the logarithm of the force."""

LOG_STD = slice(3, 6)
"""Columns of the answers that contain the logarithms of the standard deviations of x, y (mm) and the force (N)."""

LOG_FORCE_STD = slice(LOG_STD.stop - 1, LOG_STD.stop)
"""Column of the answers that contains the logarithm of the standard deviation of the force."""

ANGLES = slice(6, 14)
"""Columns of the answers that contain the angles whose cosines determine the correlations, rad.

The angles come after the other answers about the contact and before the misfit vector.
"""

COSINES_TO_CORRELATIONS = np.array(
    [
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 2],
        [0, 0, 2],
        [0, 0, 1],
        [0, 0, 1],
        [0, 0, -1],
        [0, 0, -1],
    ]
) / [1, 1, 4]
"""Matrix, shape (8, 3), by which the cosines of the eight angles are multiplied to get the correlations.

The three columns give the correlations between x and y, between x and the force, and between y and the force.
"""

OPSET = 17
"""Version of the ONNX operator set. Runtimes support this version since 2022."""


@dataclass
class GraphBuilder:
    """Builder that collects the nodes and constants of a graph in the order in which they are added.

    The nodes are lines in the textual syntax of ONNX, and a tensor is represented by its name.

    Attributes:
        number_type: NumPy type of all constants that are not integers.
        nodes: Lines of the nodes.
        constants: Constant tensors.
    """

    number_type: type
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

    def constant(self, values: object, dtype: type | None = None) -> str:
        """Add a constant tensor, and return its generated name."""
        name = f"c{len(self.constants)}"
        array: NDArray[Any] = np.array(values, dtype=dtype or self.number_type, order="C")
        self.constants.append(numpy_helper.from_array(array, name))
        return name


@dataclass(frozen=True)
class FoldedNetwork:
    """A whole network that computes contacts from charges.

    Attributes:
        features: Input features.
        contact: Perceptron whose answers are x and y (2), ln F (1), logarithms of the standard deviations (3), and
            angles of the correlations (8).
        misfit: Perceptron whose answers are the misfit vector (n_electrode). The misfit perceptron has as many layers
            as `contact`.
    """

    features: ChargeFeatures
    contact: Perceptron
    misfit: Perceptron

    def outputs(self, charge: Array) -> tuple[Array, Array, Array, Array]:
        """Compute the outputs of the graph in double precision.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Standard deviations of the contacts, shape (n, 3). Correlations,
            shape (n, 3). Misfits, shape (n, 1), in standard deviations of the noise.
        """
        evaluator: Any = ReferenceEvaluator(self.onnx_model(np.float64))
        contact, std, correlation, misfit = evaluator.run(None, {INPUT: charge.astype(float)})
        return contact, std, correlation, misfit

    def onnx_model(self, number_type: type = np.float32) -> onnx.ModelProto:
        """Return the network as an ONNX model without metadata.

        The nodes after the perceptrons convert the answers into the outputs of the graph. Each tensor is represented by
        its name, which the methods of the builder return, and which the argument `to` can set.

        Args:
            number_type: NumPy type of the charges, of the constants and of the outputs.

        Returns:
            Model with the input `charge_pC` [n, n_electrode], and the outputs `contact` [n, 3], `contact_std` [n, 3],
            `contact_correlation` [n, 3] and `misfit` [n, 1].
        """
        builder = GraphBuilder(number_type)
        n_electrode = self.features.n_electrode
        tensor_type = "double" if number_type is np.float64 else "float"
        features = _add_features(builder, self.features)  # name of the tensor with the features
        answers = _add_perceptrons(builder, features, [self.contact, self.misfit])

        # Split the answers: x and y, the logarithms of the force and of the three standard deviations, the angles that
        # determine the correlations, and the misfit vector. The exponentials of the limited logarithms are the force
        # and the standard deviations. `COSINES_TO_CORRELATIONS` has a row for each of the eight angles.
        widths = builder.constant((2, 4, len(COSINES_TO_CORRELATIONS), n_electrode), np.int64)
        builder.add("Split <axis = 1>", answers, widths, to="plane, logs, angles, misfit_vector")
        limits = (builder.constant(-LARGEST_LOGARITHM), builder.constant(LARGEST_LOGARITHM))
        exponentials = builder.add("Exp", builder.add("Clip", "logs", *limits))
        builder.add("Split <axis = 1>", exponentials, builder.constant((1, 3), np.int64), to="force, contact_std")
        builder.add("Concat <axis = 1>", "plane", "force", to="contact")
        cosines = builder.add("Cos", "angles")
        builder.add("MatMul", cosines, builder.constant(COSINES_TO_CORRELATIONS), to=CORRELATION)
        # The length of the misfit vector is asinh(misfit / MISFIT_LIMIT).
        asinh_misfit = builder.add("ReduceL2 <axes = [1], keepdims = 1>", "misfit_vector")
        builder.add("Mul", builder.add("Sinh", asinh_misfit), builder.constant(MISFIT_LIMIT), to="misfit")

        outputs = ", ".join(f"{tensor_type}[n, {width}] {name}" for name, width in OUTPUTS.items())
        nodes = "\n".join(builder.nodes)
        model = onnx.parser.parse_model(
            f'<ir_version: 8, opset_import: ["" : {OPSET}], producer_name: "isocharge">\n'
            f"isocharge ({tensor_type}[n, {n_electrode}] {INPUT}) => ({outputs}) {{\n{nodes}\n}}"
        )
        for node in model.graph.node:
            node.ClearField("domain")  # the parser states the empty domain, and `onnx.helper` does not
        model.graph.initializer.extend(builder.constants)
        return model

    def with_scaled_std(self, position_factor: float, force_factor: float) -> "FoldedNetwork":
        """Return a network whose standard deviations are multiplied by a factor for the position and one for the force.

        The answers are logarithms of the standard deviations. Therefore, the logarithms of the factors are added to the
        bias of the last layer.
        """
        weight, bias = self.contact.last  # the last layer
        bias_change = np.zeros_like(bias)
        bias_change[LOG_STD] = np.log([position_factor, position_factor, force_factor])
        return replace(self, contact=replace(self.contact, last=Layer(weight, bias + bias_change)))


def _add_features(builder: GraphBuilder, features: ChargeFeatures) -> str:
    """Add the nodes that compute the input features from the charges.

    The charges Q are first limited to a range. If all charges are positive, the features are ln(Q / typical charge),
    and the operator `Clip` applies the same limits to all electrodes. If charges may be negative, the features are
    asinh(Q / typical charge) - mean. For charges that may be negative, the operators `Max` and `Min` apply separate
    limits to each electrode.

    Args:
        builder: Builder of the graph.
        features: Limits, typical charges and means of the features.

    Returns:
        Name of the tensor with the features.
    """
    low = builder.constant(features.low_pC)
    high = builder.constant(features.high_pC)
    factor = 1.0 / features.typical_pC
    if features.mean is None:  # all charges are positive
        clipped = builder.add("Clip", INPUT, low, high)
        return builder.add("Log", builder.add("Mul", clipped, builder.constant(factor)))
    clipped = builder.add("Min", builder.add("Max", INPUT, low), high)
    ratio = builder.add("Mul", clipped, builder.constant(factor))
    return builder.add("Sub", builder.add("Asinh", ratio), builder.constant(features.mean))


def _add_perceptrons(builder: GraphBuilder, inputs: str, perceptrons: Sequence[Perceptron]) -> str:
    """Add the nodes that evaluate several perceptrons together. All perceptrons have the same inputs.

    In the first layer and in the skip layer, the weights of the perceptrons stand side by side. In the later layers,
    the weights are blocks on the diagonal of a matrix. The operator `Gemm` computes inputs @ weights + bias. The last
    layer adds the output of the skip layer.

    Args:
        builder: Builder of the graph.
        inputs: Name of the tensor with the inputs.
        perceptrons: Weights and biases of the layers.

    Returns:
        Name of the tensor with the outputs of all perceptrons.
    """
    hidden_outputs = inputs
    for layers in zip(*(perceptron.hidden for perceptron in perceptrons), strict=True):  # one layer of each perceptron
        weights, biases = zip(*layers, strict=True)
        is_first = hidden_outputs is inputs  # the first layer reads the inputs
        joined_weight = builder.constant(np.hstack(weights) if is_first else block_diag(*weights))
        joined_bias = builder.constant(np.concatenate(biases))
        hidden_outputs = builder.add("Tanh", builder.add("Gemm", hidden_outputs, joined_weight, joined_bias))

    # In the last `Gemm`, the output of the skip layer takes the place of the bias. This output includes the bias of the
    # last layer.
    skip = builder.constant(np.hstack([perceptron.skip for perceptron in perceptrons]))
    last_weights, last_biases = zip(*(perceptron.last for perceptron in perceptrons), strict=True)
    skip_and_bias = builder.add("Gemm", inputs, skip, builder.constant(np.concatenate(last_biases)))
    return builder.add("Gemm", hidden_outputs, builder.constant(block_diag(*last_weights)), skip_and_bias)


def fold(perceptron: Perceptron, mean: Array, matrix: Array, answer_map: Layer) -> Perceptron:
    """Include the whitening of the features and a linear map of the outputs in the layers of a perceptron.

    The whitening of the features becomes part of the first layer and of the skip layer. The linear map from the outputs
    to the answers becomes part of the last layer and of the skip layer.

    Args:
        perceptron: Perceptron whose inputs are (features - mean) @ matrix.
        mean: Mean of the features, shape (n_electrode,).
        matrix: Whitening matrix, shape (n_electrode, n_electrode).
        answer_map: Linear map from the outputs of the perceptron to the answers: weight, shape (n_output, n_answer),
            and bias, shape (n_answer,).

    Returns:
        Perceptron that computes the answers from the features.
    """
    # ((features - mean) @ matrix) @ weight + bias  =  features @ (matrix @ weight) + (bias - mean @ matrix @ weight)
    first, *later = perceptron.hidden
    first_weight = matrix @ first.weight
    first_bias = first.bias - mean @ first_weight
    skip = matrix @ perceptron.skip @ answer_map.weight
    last_weight = perceptron.last.weight @ answer_map.weight
    # The skip layer has no bias. The term - mean @ skip is therefore added to the bias of the last layer.
    last_bias = perceptron.last.bias @ answer_map.weight + answer_map.bias - mean @ skip
    return Perceptron((Layer(first_weight, first_bias), *later), Layer(last_weight, last_bias), skip)


TURN = slice(6, 9)
"""Columns of the contact perceptron's outputs that contain the turns. A turn is an angle minus a right angle.

The means and the logarithms of the standard deviations come before the turns.
"""

ANGLES_TO_COSINE_ARGUMENTS = np.array(
    [
        [1, 0, 1, 1, 1, 1, 1, 1],  # coefficients of a
        [0, 1, -1, 1, -1, -1, 1, 1],  # coefficients of b
        [0, 0, 0, 0, -1, 1, -1, 1],  # coefficients of c
    ],
    dtype=float,
)
"""Matrix, shape (3, 8), that converts the angles (a, b, c) to the arguments of the eight cosines.

The arguments are a, b, a - b, a + b, a - b - c, a - b + c, a + b - c and a + b + c.
"""


def linear_answer_map(domain: Domain) -> Layer:
    """Return the linear map from the outputs of the contact perceptron to its answers.

    The 9 outputs are three means (`MEAN`), three logarithms of standard deviations (`LOG_STD`), and three turns
    (`TURN`). A turn is an angle a, b or c minus a right angle. The 14 answers have the same columns `MEAN` and
    `LOG_STD`, followed by the arguments of eight cosines (`ANGLES`). Each of these names is a slice of columns.

    - The means are unit coordinates, which range from -1 to 1. The map converts the means to x, y and ln F.
    - The perceptron computes the logarithm of the relative standard deviation of the force. The answer is the logarithm
      of the absolute standard deviation in N. The map therefore adds ln F.
    - The correlations are weighted sums of eight cosines. The argument of each cosine is a sum of the angles, in which
      some angles have a negative sign. The map adds the right angles, and computes the eight arguments.

    Args:
        domain: Domain that defines the centre and the scale of the unit coordinates.
    """
    # The map copies the outputs before the turns, and computes the arguments of the cosines from the turns.
    weight = block_diag(np.eye(TURN.start), ANGLES_TO_COSINE_ARGUMENTS)  # shape (9, 14)
    bias = np.zeros(weight.shape[1])

    # Means: u * scale + centre. Each column is multiplied by its scale.
    weight[MEAN, MEAN] *= domain.scale
    bias[MEAN] = domain.centre

    # Logarithms of the standard deviations: add ln(scale). For the force, also add ln F: copy the weights and the bias
    # that compute ln F from the means.
    bias[LOG_STD] = np.log(domain.scale)
    weight[MEAN, LOG_FORCE_STD] = weight[MEAN, LOG_FORCE]
    bias[LOG_FORCE_STD] += bias[LOG_FORCE]

    # Arguments of the cosines: the turns are the angles minus a right angle, so add the arguments for right angles.
    bias[ANGLES] = 0.5 * np.pi * ANGLES_TO_COSINE_ARGUMENTS.sum(axis=0)
    return Layer(weight, bias)
