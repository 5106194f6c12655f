"""Folding of trained perceptrons into one perceptron with few, larger layers.

In a prediction for a single press, each node of the graph costs more time than its arithmetic. The whitening of the
inputs is therefore multiplied into the first layer and the units of the outputs into the last layer. Two perceptrons
with the same inputs become one perceptron whose hidden layers have block-diagonal weights.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from isocharge.common.arrays import Array
from isocharge.common.perceptron import Layer, Perceptron
from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.training.folded_network import LOG_FORCE, LOG_STD, MEAN, N_CONTACT_ANSWERS

LOG_FORCE_STD = slice(LOG_STD.stop - 1, LOG_STD.stop)
"""Column of the answers with the logarithm of the standard deviation of the force."""


def fold(
    perceptrons: Sequence[Perceptron[Array]], mean: Array, matrix: Array, units: Layer[Array]
) -> Perceptron[Array]:
    """Fold perceptrons with the same inputs, number of layers and activation into one perceptron.

    The whitening of the features becomes part of the first layer and of the skip layer. The linear map to the answers
    becomes part of the last layer and of the skip layer.

    Args:
        perceptrons: Perceptrons whose inputs are (features - mean) @ matrix.
        mean: Mean of the features, shape (n_electrode,).
        matrix: Whitening matrix, shape (n_electrode, n_electrode).
        units: Linear map from the outputs of all perceptrons, one after the other, to the answers: weight of shape
            (n_output, n_answer) and bias of shape (n_answer,).

    Returns:
        Perceptron from the features to the answers.
    """
    joined = _join_perceptrons(perceptrons)
    first, *other_hidden = joined.hidden
    # ((features - mean) @ matrix) @ W + b  =  features @ (matrix W) + (b - mean @ (matrix W))
    first_weight = matrix @ first.weight
    first_bias = first.bias - mean @ first_weight
    skip = matrix @ joined.skip @ units.weight
    last_weight = joined.last.weight @ units.weight
    # The skip layer has no bias, so its part - mean @ skip becomes part of the bias of the last layer.
    last_bias = joined.last.bias @ units.weight + units.bias - mean @ skip
    return replace(
        joined,
        hidden=(Layer(first_weight, first_bias), *other_hidden),
        last=Layer(last_weight, last_bias),
        skip=skip,
    )


def transform_inputs(perceptron: Perceptron[Array], transform: Layer[Array]) -> Perceptron[Array]:
    """Return the perceptron whose output for x is the output of the given perceptron for x @ weight + bias.

    Args:
        perceptron: The given perceptron.
        transform: Weight, shape (n_input, n_input), and bias, shape (n_input,).
    """
    first, *others = perceptron.hidden
    last = perceptron.last
    return replace(
        perceptron,
        hidden=(Layer(transform.weight @ first.weight, first.bias + transform.bias @ first.weight), *others),
        last=Layer(last.weight, last.bias + transform.bias @ perceptron.skip),
        skip=transform.weight @ perceptron.skip,
    )


def answer_units(domain: Domain, rotation: Array, offset: Array, n_electrode: int) -> Layer[Array]:
    """Return the linear map from the outputs of the contact and misfit perceptrons to the answers.

    The outputs contain the relative standard deviation of the force, and the answers contain the absolute one. To
    convert it, ln F is added to the logarithm of the relative standard deviation.

    Args:
        domain: Centre and scale of the unit coordinates.
        rotation: Matrix T, shape (3, 3). If the contact perceptron gives u, the unit coordinates are T u + o.
        offset: Vector o, shape (3,).
        n_electrode: Width of the misfit vector.
    """
    # The identity matrix leaves the logarithms of the standard deviations and the misfit vector as they are.
    n_answer = N_CONTACT_ANSWERS + n_electrode
    weight = np.eye(n_answer)
    bias = np.zeros(n_answer)

    # Mean: (T u + o) * scale + centre. Layers multiply row vectors from the right, so the matrix is transposed.
    weight[MEAN, MEAN] = rotation.T * domain.scale
    bias[MEAN] = offset * domain.scale + domain.centre

    # Logarithms of the standard deviations: add ln(scale), and for the force also ln F.
    bias[LOG_STD] = np.log(domain.scale)
    weight[MEAN, LOG_FORCE_STD] = weight[MEAN, LOG_FORCE]
    bias[LOG_FORCE_STD] += bias[LOG_FORCE]
    return Layer(weight, bias)


def _join_perceptrons(perceptrons: Sequence[Perceptron[Array]]) -> Perceptron[Array]:
    """Return one perceptron that gives the outputs of several perceptrons with the same inputs, one after the other."""
    # Each entry of `first` and `others` contains the layers of all perceptrons at one depth.
    first, *others = zip(*(perceptron.hidden for perceptron in perceptrons), strict=True)
    hidden = [_join_layers(first, np.hstack)]  # the first layers have the same inputs
    hidden += [_join_layers(layers, _block_diagonal) for layers in others]
    return Perceptron(
        hidden=tuple(hidden),
        last=_join_layers([perceptron.last for perceptron in perceptrons], _block_diagonal),
        skip=np.hstack([perceptron.skip for perceptron in perceptrons]),
        activation=perceptrons[0].activation,
    )


def _join_layers(layers: Sequence[Layer[Array]], join_weights: Callable[[Sequence[Array]], Array]) -> Layer[Array]:
    """Return one layer that gives the outputs of several layers, one after the other.

    Args:
        layers: The layers.
        join_weights: Function that joins the weights: `np.hstack` if the layers have the same inputs, `_block_diagonal`
            if each layer has its own inputs.
    """
    weight = join_weights([layer.weight for layer in layers])
    bias = np.concatenate([layer.bias for layer in layers])
    return Layer(weight, bias)


def _block_diagonal(matrices: Sequence[Array]) -> Array:
    """Return a matrix with the given matrices along its diagonal and zeros elsewhere."""
    return np.asarray(block_diag(*matrices))
