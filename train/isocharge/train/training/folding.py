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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.train.training.folded_network import ANGLES, LOG_FORCE, LOG_STD, MEAN
from isocharge.train.training.perceptron import Layer, Perceptron

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
            of layers and the same activation.
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
    return replace(
        perceptrons[0],
        hidden=(Layer(first_weight, first_bias), *later),
        last=Layer(last.weight @ answer_map.weight, last_bias),
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
