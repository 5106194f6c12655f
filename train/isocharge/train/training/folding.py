"""Folding of several trained perceptrons into one perceptron that has fewer but larger layers.

In a prediction for a single press, the overhead of each node of the graph takes more time than the arithmetic. The
whitening of the inputs is therefore included in the first layer, and the scaling of the outputs is included in the last
layer. Two perceptrons with the same inputs become one perceptron. Its later layers have block-diagonal weights.

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

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.train.training.folded_network import (
    LOG_FORCE,
    LOG_STD,
    MEAN,
    N_CONTACT_ANSWERS,
    UNIT_LOG_STD_RANGE,
)
from isocharge.train.training.perceptron import Layer, Perceptron

N_CONTACT_OUTPUTS = 9
"""Number of outputs of the contact perceptron: means, logarithms of the standard deviations, and turns."""

TURN = slice(N_CONTACT_ANSWERS, N_CONTACT_OUTPUTS)
"""Columns of the outputs of the contact perceptron with the turns, which are the angles minus a right angle."""

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
            of layers and the same activation.
        mean: Mean of the features, shape (n_electrode,).
        matrix: Whitening matrix, shape (n_electrode, n_electrode).
        answer_map: Linear map from the outputs of all perceptrons, one after the other, to the answers: weight, shape
            (n_output, n_answer), and bias, shape (n_answer,).

    Returns:
        Perceptron that computes the answers from the features.
    """
    joined = _join_perceptrons(perceptrons)
    first, *other_hidden = joined.hidden
    # ((features - mean) @ matrix) @ weight + bias  =  features @ (matrix @ weight) + (bias - mean @ matrix @ weight)
    first_weight = matrix @ first.weight
    first_bias = first.bias - mean @ first_weight
    skip = matrix @ joined.skip @ answer_map.weight
    last_weight = joined.last.weight @ answer_map.weight
    # The skip layer has no bias. The term - mean @ skip is therefore added to the bias of the last layer.
    last_bias = joined.last.bias @ answer_map.weight + answer_map.bias - mean @ skip
    return replace(
        joined,
        hidden=(Layer(first_weight, first_bias), *other_hidden),
        last=Layer(last_weight, last_bias),
        skip=skip,
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
    weight = np.asarray(block_diag(np.eye(N_CONTACT_ANSWERS), ANGLES_TO_COSINE_ARGUMENTS, np.eye(n_electrode)))
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
    n_angle = ANGLES_TO_COSINE_ARGUMENTS.shape[1]
    bias[N_CONTACT_ANSWERS : N_CONTACT_ANSWERS + n_angle] = 0.5 * np.pi * ANGLES_TO_COSINE_ARGUMENTS.sum(axis=0)
    return Layer(weight, bias)


def log_std_limits(domain: Domain) -> Array:
    """Return the smallest and largest answers for the logarithms of the standard deviations, shape (2, 3).

    The limits are `UNIT_LOG_STD_RANGE` relative to the scale of the domain. The third answer belongs to the absolute
    standard deviation of the force. Its limits are those of the smallest and of the largest force.

    Args:
        domain: Domain that defines the centre and the scale of the unit coordinates.
    """
    log_force_limits = domain.centre[LOG_FORCE] + domain.scale[LOG_FORCE] * [-1.0, 1.0]
    limits = np.log(domain.scale) + np.array(UNIT_LOG_STD_RANGE)[:, None]
    limits[:, LOG_FORCE] += log_force_limits[:, None]
    return np.asarray(limits)


def _join_perceptrons(perceptrons: Sequence[Perceptron]) -> Perceptron:
    """Join several perceptrons with the same inputs into one perceptron, which computes all their outputs."""
    # Group the hidden layers by depth: each group contains one layer of each perceptron.
    first_layers, *later_groups = zip(*(perceptron.hidden for perceptron in perceptrons), strict=True)
    first = _join_layers(first_layers, np.hstack)  # the first layers have the same inputs
    later = [_join_layers(layers, _block_diagonal) for layers in later_groups]  # each layer has its own inputs
    return Perceptron(
        hidden=(first, *later),
        last=_join_layers([perceptron.last for perceptron in perceptrons], _block_diagonal),
        skip=np.hstack([perceptron.skip for perceptron in perceptrons]),
        activation=perceptrons[0].activation,
    )


def _join_layers(layers: Sequence[Layer], join_weights: Callable[[Sequence[Array]], Array]) -> Layer:
    """Join several layers into one layer, which computes the outputs of all these layers in order.

    Args:
        layers: Layers to join.
        join_weights: Function that joins the weights, which is `np.hstack` if the layers have the same inputs, and
            `_block_diagonal` if each layer has its own inputs.
    """
    weight = join_weights([layer.weight for layer in layers])
    bias = np.concatenate([layer.bias for layer in layers])
    return Layer(weight, bias)


def _block_diagonal(matrices: Sequence[Array]) -> Array:
    """Return a block-diagonal matrix with the given matrices as its blocks."""
    return np.asarray(block_diag(*matrices))
