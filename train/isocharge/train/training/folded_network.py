"""Whole network that computes contacts from charges. NumPy evaluates the network in double precision.

The network has three parts:

- The input features are functions of the charges. They are logarithms of positive charges. If the charges can have both
  signs, they are inverse hyperbolic sines of the charges.
- A perceptron computes a vector from the input features. The entries of this vector are called answers.
- The output functions convert the answers to position, force, standard deviations, correlations and misfit.

The ONNX export (`isocharge.train.model_release.onnx_graph`) and the C export (`isocharge.train.export_c.model_source`)
write networks of this form.

Perceptron
----------

For inputs x, the hidden layer l computes h_l = f(h_(l-1) W_l + b_l), where h_0 = x and f is the activation function.
The output layer computes y = h_L V + c + x S from the result h_L of the last hidden layer. The skip layer S maps the
inputs linearly to the outputs. The hidden layers therefore only need to learn the nonlinear part of the function.

The training makes two perceptrons, for the contact and for the misfit. In a prediction for a single press, the overhead
of each node of the graph takes more time than the arithmetic. Both perceptrons are therefore folded into one, whose
later layers have block-diagonal weights. The whitening of the features becomes part of its first layer, and the units
of the answers become part of its last layer.

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
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.train.training.activations import Activation


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

    def evaluate(self, charge_pC: Array) -> Array:
        """Compute the features of charges.

        Args:
            charge_pC: Charges, shape (..., n_electrode), pC.

        Returns:
            Features, of the same shape, dimensionless.
        """
        ratio = np.clip(charge_pC, self.low_pC, self.high_pC) / self.typical_pC
        if self.mean is None:
            return np.asarray(np.log(ratio))
        return np.asarray(np.arcsinh(ratio) - self.mean)


LARGEST_INT8 = np.iinfo(np.int8).max
"""Largest absolute value of the integers by which weights are represented in 8 bits, in units of their scale."""


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
        hidden: Hidden layers, from the first to the last layer. The activation function follows each hidden layer.
        last: Output layer.
        skip: Weights of the skip layer from the inputs directly to the outputs, shape (n_input, n_output).
        activation: Activation function of the hidden layers.
    """

    hidden: tuple[Layer, ...]
    last: Layer
    skip: Array
    activation: Activation

    def evaluate(self, inputs: Array) -> Array:
        """Compute the outputs, shape (n, n_output), of inputs of shape (n, n_input)."""
        value = inputs
        for layer in self.hidden:
            value = self.activation.numpy_function(value @ layer.weight + layer.bias)
        return np.asarray(value @ self.last.weight + self.last.bias + inputs @ self.skip)


POSITION = slice(0, 2)
"""Columns of the answers with x and y, mm."""

LOG_FORCE = slice(2, 3)
"""Column of the answers with the logarithm of the force in N."""

MEAN = slice(0, 3)
"""Columns of the answers with x, y and the logarithm of the force."""

LOG_STD = slice(3, 6)
"""Columns of the answers with the logarithms of the standard deviations of x and y in mm and of the force in N."""

LARGEST_LOGARITHM = 50.0
"""Limit of the magnitudes of the logarithms of the force and of the standard deviations.

Their exponentials are finite in single precision, also for charges that are far from those of the training.
"""

ANGLES = slice(6, 14)
"""Columns of the answers with the angles whose cosines determine the correlations, rad.

They come after the other answers about the contact and before the misfit vector.
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

The correlations are those of x with y, of x with the force, and of y with the force.
"""

MISFIT_UNIT = 5.0
"""Scale of the misfit, in standard deviations of the noise: misfit = MISFIT_UNIT * sinh(|misfit vector|).

The network learns misfits below this value on a linear scale and misfits above this value on a logarithmic scale.
"""


@dataclass(frozen=True)
class FoldedNetwork:
    """A whole network that computes contacts from charges.

    Attributes:
        features: Input features.
        layers: Perceptron that computes the answers from the features. The answers are x and y (2), ln F (1),
            logarithms of the standard deviations (3), angles of the correlations (8), and the misfit vector
            (n_electrode).
    """

    features: ChargeFeatures
    layers: Perceptron

    def predict(self, charge: Array) -> tuple[Array, Array, Array]:
        """Estimate contacts.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Standard deviations of the contacts, shape (n, 3). Misfits,
            shape (n, 1).
        """
        contact, std, _, misfit = self.outputs(charge)
        return contact, std, misfit

    def outputs(self, charge: Array) -> tuple[Array, Array, Array, Array]:
        """Compute the outputs of the exported graph.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts and standard deviations, as `predict` returns them. Correlations, shape (n, 3). Misfits, shape
            (n, 1).
        """
        answers = self.layers.evaluate(self.features.evaluate(charge))
        position = answers[:, POSITION]
        force = _limited_exp(answers[:, LOG_FORCE])
        contact = np.concatenate([position, force], axis=1)
        std = _limited_exp(answers[:, LOG_STD])
        # Each correlation is a weighted sum of the cosines of the eight angles.
        correlation = np.cos(answers[:, ANGLES]) @ COSINES_TO_CORRELATIONS
        # The misfit vector follows the angles. Its length is asinh(misfit / MISFIT_UNIT).
        compressed_misfit = np.linalg.norm(answers[:, ANGLES.stop :], axis=1, keepdims=True)
        return contact, std, correlation, MISFIT_UNIT * np.sinh(compressed_misfit)

    def with_scaled_std(self, position_factor: float, force_factor: float) -> "FoldedNetwork":
        """Return a network whose standard deviations of position and force are multiplied by two given factors.

        The answers are logarithms of the standard deviations. Therefore, the logarithms of the factors are added to the
        bias of the last layer.
        """
        weight, bias = self.layers.last
        bias_change = np.zeros_like(bias)
        bias_change[LOG_STD] = np.log([position_factor, position_factor, force_factor])
        return replace(self, layers=replace(self.layers, last=Layer(weight, bias + bias_change)))


def _limited_exp(logarithm: Array) -> Array:
    """Return the exponentials of logarithms whose magnitudes are limited to `LARGEST_LOGARITHM`."""
    return np.exp(np.clip(logarithm, -LARGEST_LOGARITHM, LARGEST_LOGARITHM))


TURN = slice(6, 9)
"""Columns of the outputs of the contact perceptron with the turns, which are the angles minus a right angle.

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
"""Matrix, shape (3, 8), from the angles (a, b, c) to the arguments of the eight cosines.

The arguments are a, b, a - b, a + b, a - b - c, a - b + c, a + b - c and a + b + c.
"""

LOG_FORCE_STD = slice(LOG_STD.stop - 1, LOG_STD.stop)
"""Column of the answers with the logarithm of the standard deviation of the force."""


def fold(perceptrons: Sequence[Perceptron], mean: Array, matrix: Array, answer_map: Layer) -> Perceptron:
    """Fold several perceptrons into one perceptron that computes answers from features without whitening.

    The whitening of the features becomes part of the first layer and of the skip layer. The linear map from the outputs
    to the answers becomes part of the last layer and of the skip layer.

    Args:
        perceptrons: Perceptrons whose inputs are (features - mean) @ matrix. All perceptrons must have the same number
            of layers.
        mean: Mean of the features, shape (n_electrode,).
        matrix: Whitening matrix, shape (n_electrode, n_electrode).
        answer_map: Linear map from the outputs of all perceptrons, one after the other, to the answers: weight, shape
            (n_output, n_answer), and bias, shape (n_answer,).

    Returns:
        Perceptron that computes the answers from the features.
    """
    first_layers, *later_groups = zip(*(perceptron.hidden for perceptron in perceptrons), strict=True)
    first = _join_layers(first_layers, np.hstack([layer.weight for layer in first_layers]))
    later = [_join_blocks(layers) for layers in later_groups]
    last = _join_blocks([perceptron.last for perceptron in perceptrons])
    # ((features - mean) @ matrix) @ weight + bias  =  features @ (matrix @ weight) + (bias - mean @ matrix @ weight)
    first_weight = matrix @ first.weight
    first_bias = first.bias - mean @ first_weight
    skip = matrix @ np.hstack([perceptron.skip for perceptron in perceptrons]) @ answer_map.weight
    # The skip layer has no bias. The term - mean @ skip is therefore added to the bias of the last layer.
    last_bias = last.bias @ answer_map.weight + answer_map.bias - mean @ skip
    return Perceptron(
        hidden=(Layer(first_weight, first_bias), *later),
        last=Layer(last.weight @ answer_map.weight, last_bias),
        skip=skip,
        activation=perceptrons[0].activation,
    )


def linear_answer_map(domain: Domain, n_electrode: int) -> Layer:
    """Return the linear map from the outputs of the contact perceptron and the misfit perceptron to the answers.

    The contact perceptron estimates unit coordinates, which the map converts to (x, y, ln F). The perceptron also
    computes the logarithm of the relative standard deviation of the force. The corresponding answer is the logarithm of
    the absolute standard deviation of the force in N. The map therefore adds ln F to the logarithm. The correlations
    follow from three angles that the perceptron computes. The map converts these angles to eight sums of angles, whose
    cosines the graph adds to the correlations.

    Args:
        domain: Domain that defines the centre and the scale of the unit coordinates.
        n_electrode: Number of electrodes, which is also the number of entries of the misfit vector.
    """
    # The identity matrices leave the logarithms of the standard deviations and the misfit vector unchanged.
    weight = block_diag(np.eye(TURN.start), ANGLES_TO_COSINE_ARGUMENTS, np.eye(n_electrode))
    bias = np.zeros(weight.shape[1])

    # Means: u * scale + centre.
    weight[MEAN, MEAN] *= domain.scale
    bias[MEAN] = domain.centre

    # Logarithms of the standard deviations: add ln(scale). For the force, also add ln F, and therefore copy the weights
    # and the bias with which the map computes ln F from the means.
    bias[LOG_STD] = np.log(domain.scale)
    weight[MEAN, LOG_FORCE_STD] = weight[MEAN, LOG_FORCE]
    bias[LOG_FORCE_STD] += bias[LOG_FORCE]

    # The perceptron computes the angles minus a right angle.
    bias[ANGLES] = 0.5 * np.pi * ANGLES_TO_COSINE_ARGUMENTS.sum(axis=0)
    return Layer(weight, bias)


def _join_blocks(layers: Sequence[Layer]) -> Layer:
    """Join layers with different inputs into one layer. Its weights are a block-diagonal matrix."""
    return _join_layers(layers, block_diag(*[layer.weight for layer in layers]))


def _join_layers(layers: Sequence[Layer], weight: Array) -> Layer:
    """Return a layer with the given weights, which computes the outputs of all given layers in order."""
    return Layer(weight, np.concatenate([layer.bias for layer in layers]))
