"""Trained perceptrons as plain layers: whitening, units and scales folded in, several perceptrons side by side.

At batch one a node of a graph costs more than its arithmetic, so the layers are few: whitening goes into the first,
units into the last, and perceptrons that share their inputs run as one with block-diagonal weights.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.training.features import MISFIT_UNIT, SignedCharges, bent

Layer = tuple[Array, Array]
"""Weights (inputs, outputs) and bias."""

Lesson = tuple[Callable[[Array], Array], float]
"""From the present answers to other ones, both of shape (n, n_answer), and the ridge by which a last layer is taught
them, over the mean square of a feature of size one."""

EXACT, ROUGH = 1e-5, 0.03
"""Ridges for answers that are known, and for deviations of which single errors tell."""

FARTHEST = 3.0
"""Deviations as which a larger error counts where deviations are taught: its square changes their logarithms, and would
go too far."""


@dataclass(frozen=True)
class PlainPerceptron:
    """A trained perceptron in NumPy.

    Attributes:
        layers: Between which tanh stands, first to last.
        skip: Weights straight from the inputs to the outputs, shape (inputs, outputs).
    """

    layers: tuple[Layer, ...]
    skip: Array


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

    def with_angles(self, weight: Array, bias: Array, skip: Array) -> "FoldedLayers":
        """The layers with further columns for arguments of cosines, which stand before the misfit's."""
        pairs = zip((*self.last, self.skip), (weight, bias, skip), strict=True)
        *last, skip = (np.concatenate([own[..., :KNOWN], new, own[..., KNOWN:]], axis=-1) for own, new in pairs)
        return replace(self, last=(last[0], last[1]), skip=skip)

    @classmethod
    def of(cls, perceptrons: Sequence[PlainPerceptron], whitening: Array, mean: Array, units: Layer) -> "FoldedLayers":
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
        skip = whitening @ np.hstack([perceptron.skip for perceptron in perceptrons]) @ matrix
        return cls(
            hidden=((weight, first[1] - mean @ weight), *between),
            last=(last[0] @ matrix, last[1] @ matrix + shift - mean @ skip),
            skip=skip,
        )

    def answers(self, logs: Array) -> Array:
        """Logarithms of the charges (n, n_electrode) to (n, n_answer), in double precision."""
        return self.from_features(self.features(logs), logs)

    def from_features(self, features: Array, logs: Array) -> Array:
        """The same from what `features` gives of them."""
        return np.asarray(features @ self.last[0] + self.last[1] + logs @ self.skip)

    def features(self, logs: Array) -> Array:
        """Logarithms of the charges (n, n_electrode) to what the last hidden layer gives, in double precision."""
        value = logs
        for weight, bias in self.hidden:
            value = np.tanh(value @ weight + bias)
        return value

    def behind(self, matrix: Array, shift: Array) -> "FoldedLayers":
        """The layers that answer logarithms as these answer logarithms @ matrix + shift."""
        (weight, bias), *between = self.hidden
        return FoldedLayers(
            hidden=((matrix @ weight, bias + shift @ weight), *between),
            last=(self.last[0], self.last[1] + shift @ self.skip),
            skip=matrix @ self.skip,
        )

    def taught(self, logs: Array, *lessons: Lesson) -> "FoldedLayers":
        """The same layers but for the last, which is changed by as little as gives other answers (ridge regression).

        Each answer keeps the features that it was made of.

        Args:
            logs: Logarithms of charges, shape (n, n_electrode).
            lessons: One after the other.
        """
        features = self.features(logs)
        design = np.column_stack([features, logs, np.ones(len(logs))])
        weights = np.vstack([self.last[0], self.skip, self.last[1]])
        for wanted, ridge in lessons:
            before = design @ weights
            change = wanted(before) - before
            for column in np.flatnonzero(change.any(axis=0)):
                rows = np.append(weights[: features.shape[1], column] != 0.0, np.ones(logs.shape[1] + 1, dtype=bool))
                normal = design[:, rows].T @ design[:, rows]
                normal += ridge * len(logs) * np.eye(len(normal))
                weights[rows, column] += np.linalg.solve(normal, design[:, rows].T @ change[:, column])
        last, skip, bias = np.split(weights, [features.shape[1], features.shape[1] + logs.shape[1]])
        return replace(self, last=(last, bias[0]), skip=skip)


KNOWN = 6
"""Answers about the contact: x, y, ln F, and the logarithms of their standard deviations."""

COSINES = np.array([[1, 0, 0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0, 0, 0], [0, 0, 2, 2, 1, 1, -1, -1]]).T / [1, 1, 4]
"""From eight cosines to the correlations xy, xF and yF (`training.correlation`)."""


@dataclass(frozen=True)
class FoldedNetwork:
    """A whole model as plain layers: what the exported graph computes, here in double precision.

    Attributes:
        layers: From ln(Q / typical) to: x_mm and y_mm (2), ln F (1), logarithms of the standard deviations in mm and N
            (3), the arguments of the cosines that make the correlations (8, or 0 without these), the misfit vector
            (n_electrode).
        typical: Powers of two near the charges' geometric means, shape (n_electrode,), pC; see `Features`.
        signed: What stands for the logarithm if charges may have any sign.
    """

    layers: FoldedLayers
    typical: Array
    signed: SignedCharges | None = None

    def inputs(self, charge: Array) -> Array:
        """What the layers see of charges, shape (n, n_electrode), pC: their logarithms, or what stands for them."""
        return bent(charge, self.typical, self.signed)

    def corrected(self, charge: Array, as_if: Array, contact: Array) -> "FoldedNetwork":
        """The network that answers charges as this one answers others, with deviations as large as its errors are.

        A linear map between the logarithms goes into the first layer, and the last is taught the rest. For the
        deviations the likelihood of a Gaussian is maximised by Fisher's scoring (McCullagh and Nelder 1989, 2.5): three
        regressions on (error / deviation)^2.

        Args:
            charge: With noise, shape (n, n_electrode), pC.
            as_if: The others, of the same shape.
            contact: Which they are of, (x, y, F), shape (n, 3), mm and N.
        """
        logs, others = self.inputs(charge), self.inputs(as_if)
        *matrix, shift = np.linalg.lstsq(np.column_stack([logs, np.ones(len(logs))]), others)[0]
        answers, truth = self.layers.answers(others), np.column_stack([contact[:, :2], np.log(contact[:, 2])])

        def wanted(before: Array) -> Array:
            return np.concatenate([answers[:, :3], before[:, 3:6], answers[:, 6:]], axis=1)

        def nearer(before: Array) -> Array:
            error = np.minimum(np.abs(before[:, :3] - truth) * np.exp(-_relative(before)), FARTHEST)
            return np.concatenate([before[:, :3], before[:, 3:6] + 0.5 * (error**2 - 1.0), before[:, 6:]], axis=1)

        behind = self.layers.behind(np.array(matrix), shift)
        return replace(self, layers=behind.taught(logs, (wanted, EXACT), *[(nearer, ROUGH)] * 3))

    def predict(self, charge: Array) -> tuple[Array, Array, Array]:
        """Charges (n, n_electrode), pC, to contact (n, 3) in mm and N, contact_std (n, 3), misfit (n, 1)."""
        contact, std, *_, misfit = self.outputs(charge)
        return contact, std, misfit

    @property
    def angles(self) -> int:
        """How many arguments of cosines there are: 8, or 0 without correlations."""
        return int(self.layers.skip.shape[1]) - KNOWN - self.typical.size

    def outputs(self, charge: Array) -> tuple[Array, ...]:
        """As `predict`; between deviations and misfit contact_correlation (n, 3), if the network gives it."""
        return self.of_answers(self.layers.answers(self.inputs(charge)))

    def of_answers(self, answers: Array) -> tuple[Array, ...]:
        """The same from what the layers answer."""
        known, angles, vector = np.split(answers, [KNOWN, KNOWN + self.angles], axis=1)
        contact = np.concatenate([known[:, :2], np.exp(known[:, 2:3])], axis=1)
        correlation = (np.cos(angles) @ COSINES,) if self.angles else ()
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        return contact, np.exp(known[:, 3:]), *correlation, MISFIT_UNIT * np.sinh(length)

    def widened(self, position: float, force: float) -> "FoldedNetwork":
        """The network with larger standard deviations: factors for those of position and force."""
        weight, bias = self.layers.last
        added = np.zeros_like(bias)
        added[3:6] = np.log([position, position, force])
        return replace(self, layers=replace(self.layers, last=(weight, bias + added)))

    def widened_at(self, charge: Array, variance: Array) -> "FoldedNetwork":
        """The network with larger standard deviations.

        Args:
            charge: Shape (n, n_electrode), pC.
            variance: What is added to the variances of (x, y, ln F) at these charges, shape (n, 3).
        """

        def wanted(before: Array) -> Array:
            wider = before[:, 3:6] + 0.5 * np.log1p(variance * np.exp(-2.0 * _relative(before)))
            return np.concatenate([before[:, :3], wider, before[:, 6:]], axis=1)

        return replace(self, layers=self.layers.taught(self.inputs(charge), (wanted, EXACT)))


def _relative(answers: Array) -> Array:
    """Logarithms of the standard deviations of x, y and ln F, shape (n, 3), from the answers."""
    return np.asarray(answers[:, 3:6] - answers[:, 2:3] * [0.0, 0.0, 1.0])


def answer_units(domain: Domain, rotation: Array, offset: Array, n_electrode: int) -> Layer:
    """Matrix and shift from outputs of the perceptrons to answers.

    A force's deviation is relative to the force, so its logarithm adds ln F.

    Args:
        domain: Centre and scale of the unit coordinates.
        rotation: Matrix T, shape (3, 3), of the unit coordinates T u + o, u what the network gives.
        offset: The vector o, shape (3,).
        n_electrode: Width of the misfit vector.
    """
    scale, shift = domain.scale, np.zeros(6 + n_electrode)
    matrix = np.eye(6 + n_electrode)
    matrix[:3, :3] = rotation.T * scale
    shift[:3], shift[3:6] = offset * scale + domain.centre, np.log(scale)
    matrix[:3, 5] = matrix[:3, 2]
    shift[5] += shift[2]
    return matrix, shift


def _side_by_side(perceptrons: Sequence[PlainPerceptron]) -> tuple[list[Layer], Layer]:
    """Layers that tanh follows, and the last; the first shares its inputs, the others are block-diagonal."""
    stages = zip(*(perceptron.layers for perceptron in perceptrons), strict=True)
    layers = [
        (
            block_diag(*(weight for weight, _ in stage)) if number else np.hstack([weight for weight, _ in stage]),
            np.concatenate([bias for _, bias in stage]),
        )
        for number, stage in enumerate(stages)
    ]
    return layers[:-1], layers[-1]
