"""Trained perceptrons as plain layers: whitening, units and scales folded in, several perceptrons side by side.

At batch one a node of a graph costs more than its arithmetic, so the layers are few: whitening goes into the first,
units into the last, and perceptrons that share their inputs run as one with block-diagonal weights.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag
from torch import nn

from isocharge.arrays import Array
from isocharge.train.training.network import InverseNetwork, Perceptron

Layer = tuple[Array, Array]
"""Weights (inputs, outputs) and bias."""


@dataclass(frozen=True)
class FoldedLayers:
    """Layers from logarithms of the charges to answers in units.

    Attributes:
        hidden: The layers that tanh follows.
        last: The last layer.
        skip: Weights straight from the inputs to the answers, shape (n_electrode, n_answer).
    """

    hidden: tuple[Layer, ...]
    last: Layer
    skip: Array

    @classmethod
    def of(cls, perceptrons: Sequence[Perceptron], whitening: Array, mean: Array, units: Layer) -> "FoldedLayers":
        """Fold perceptrons of equally many layers.

        Args:
            perceptrons: Side by side: their outputs one after the other.
            whitening: Their inputs are (logarithm - mean) @ whitening, shape (n_electrode, n_electrode).
            mean: Shape (n_electrode,).
            units: Matrix (n_output, n_answer) and shift (n_answer,) from their outputs to the answers.
        """
        (first, *between), last = _side_by_side(perceptrons)
        matrix, shift = units
        weight = whitening @ first[0]
        skip = whitening @ np.hstack([_matrix(perceptron.skip) for perceptron in perceptrons]) @ matrix
        return cls(
            hidden=((weight, first[1] - mean @ weight), *between),
            last=(last[0] @ matrix, last[1] @ matrix + shift - mean @ skip),
            skip=skip,
        )


def all_answers(network: InverseNetwork) -> FoldedLayers:
    """Both perceptrons, from ln(Q / typical).

    Answers: x_mm and y_mm (2), ln F (1), logarithms of the standard deviations in mm and N (3), the misfit vector
    (n_electrode). A force's deviation is relative to the force, so its logarithm adds ln F.
    """
    scale, centre, n_electrode = network.domain.scale, network.domain.centre, network.features.typical.size
    matrix, shift = np.diag(np.r_[scale, np.ones(3 + n_electrode)]), np.zeros(6 + n_electrode)
    matrix[2, 5] = scale[2]
    shift[:3], shift[3:6] = centre, np.log(scale)
    shift[5] += centre[2]
    whitening, mean = network.whitening.double().numpy(), network.logs_mean.double().numpy()
    return FoldedLayers.of((network.contact, network.misfit_vector), whitening, mean, (matrix, shift))


def contact_alone(network: InverseNetwork) -> FoldedLayers:
    """The contact network without standard deviations, from ln Q to (x_mm, y_mm, ln F)."""
    matrix = np.vstack([np.diag(network.domain.scale), np.zeros((3, 3))])
    features = network.features
    mean = np.log(features.typical) + features.mean
    return FoldedLayers.of((network.contact,), features.matrix, mean, (matrix, network.domain.centre))


def _side_by_side(perceptrons: Sequence[Perceptron]) -> tuple[list[Layer], Layer]:
    """Layers that tanh follows, and the last; the first shares its inputs, the others are block-diagonal."""
    stages = zip(*(perceptron.layers() for perceptron in perceptrons), strict=True)
    layers = [
        (
            block_diag(*map(_matrix, stage)) if number else np.hstack([_matrix(layer) for layer in stage]),
            np.concatenate([layer.bias.detach().double().numpy() for layer in stage]),
        )
        for number, stage in enumerate(stages)
    ]
    return layers[:-1], layers[-1]


def _matrix(layer: nn.Linear) -> Array:
    """Weights of a layer, shape (inputs, outputs)."""
    weights: Array = layer.weight.detach().double().numpy().T
    return weights
