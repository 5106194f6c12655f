"""Whole network that computes contacts from charges. NumPy evaluates the network in double precision.

The network has three parts:

- The input features are functions of the charges (`isocharge.train.training.charge_features`). For positive charges,
  they are logarithms.
- A perceptron (`isocharge.train.training.perceptron`) computes a vector from the input features. The entries of this
  vector are called answers. The whitening of the features and the units of the answers are folded into the first and
  the last layer of the perceptron (`isocharge.train.training.folding`).
- The output functions convert the answers to position, force, standard deviations, correlations and misfit.

The ONNX export (`isocharge.train.model_release.onnx_graph`) and the C export (`isocharge.train.export_c.model_source`)
write networks of this form.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.train.training.charge_features import ChargeFeatures
from isocharge.train.training.perceptron import Layer, Perceptron

POSITION = slice(0, 2)
"""Columns of the answers with x and y, mm."""

LOG_FORCE = slice(2, 3)
"""Column of the answers with the logarithm of the force in N."""

MEAN = slice(0, 3)
"""Columns of the answers with x, y and the logarithm of the force."""

LOG_STD = slice(3, 6)
"""Columns of the answers with the logarithms of the standard deviations of x and y in mm and of the force in N."""

N_CONTACT_ANSWERS = 6
"""Number of answers about the contact. They come before the angles of the correlations and before the misfit vector."""

UNIT_LOG_STD_RANGE = (-10.0, 3.0)
"""Smallest and largest logarithm of a standard deviation, relative to half of the width of the domain.

The range includes all standard deviations that have a meaning: from a twenty-thousandth of the half width to twenty
times the half width. Without these limits, charges unlike those of the training could have infinite standard deviations
or standard deviations of zero, and a training could diverge.
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

The correlations are those of x with y, of x with the force, and of y with the force
(`isocharge.train.training.folding`).
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
            logarithms of the standard deviations (3), angles of the correlations (8, or 0 without correlations), and
            the misfit vector (n_electrode).
        log_std_limits: Smallest and largest logarithms of the standard deviations, shape (2, 3), in the units of the
            answers (`isocharge.train.training.folding.log_std_limits`). None for a network without limits, as in models
            of which the graph contains none.
    """

    features: ChargeFeatures
    layers: Perceptron
    log_std_limits: Array | None = None

    @property
    def n_angle(self) -> int:
        """Number of answers that are angles of the correlations: 8, or 0 if the network estimates no correlations."""
        return int(self.layers.skip.shape[1]) - N_CONTACT_ANSWERS - self.features.n_electrode

    @property
    def angle_columns(self) -> slice:
        """Columns of the answers with the angles of the correlations."""
        return slice(N_CONTACT_ANSWERS, N_CONTACT_ANSWERS + self.n_angle)

    def answers(self, charge: Array) -> Array:
        """Compute the answers of the perceptron, which `outputs_from_answers` converts to outputs.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Answers, shape (n, n_answer).
        """
        return np.asarray(self.layers.evaluate(self.features.evaluate(charge)), dtype=float)

    def predict(self, charge: Array) -> tuple[Array, Array, Array]:
        """Estimate contacts.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Standard deviations of the contacts, shape (n, 3). Misfits,
            shape (n, 1).
        """
        contact, std, *_, misfit = self.outputs(charge)
        return contact, std, misfit

    def outputs(self, charge: Array) -> tuple[Array, ...]:
        """Compute the outputs of the exported graph.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts and standard deviations, as `predict` returns them. Correlations, shape (n, 3), if the network
            estimates them. Misfits, shape (n, 1).
        """
        return self.outputs_from_answers(self.answers(charge))

    def outputs_from_answers(self, answers: Array) -> tuple[Array, ...]:
        """Compute the outputs of the model from the answers of the perceptron.

        Args:
            answers: Answers, shape (n, n_answer): x, y and ln F, the logarithms of the standard deviations, the angles
                of the correlations if the network estimates them, and the misfit vector.

        Returns:
            Contacts, shape (n, 3), standard deviations, shape (n, 3), correlations, shape (n, 3), if the network
            estimates them, and misfits, shape (n, 1).
        """
        force = np.exp(answers[:, LOG_FORCE])
        contact = np.concatenate([answers[:, POSITION], force], axis=1)
        log_std = answers[:, LOG_STD]
        if self.log_std_limits is not None:
            log_std = np.clip(log_std, *self.log_std_limits)
        std = np.exp(log_std)
        outputs = [contact, std]
        if self.n_angle > 0:
            # Each correlation is a weighted sum of the cosines of the eight angles.
            correlations = np.cos(answers[:, self.angle_columns]) @ COSINES_TO_CORRELATIONS
            outputs.append(correlations)
        # The misfit vector follows the angles. Its length is asinh(misfit / MISFIT_UNIT).
        misfit_vector = answers[:, self.angle_columns.stop :]
        compressed_misfit = np.linalg.norm(misfit_vector, axis=1, keepdims=True)
        outputs.append(MISFIT_UNIT * np.sinh(compressed_misfit))
        return tuple(outputs)

    def with_scaled_std(self, position_factor: float, force_factor: float) -> "FoldedNetwork":
        """Return a network whose standard deviations of position and force are multiplied by two given factors.

        The answers are logarithms of the standard deviations. Therefore, the logarithms of the factors are added to the
        bias of the last layer.
        """
        weight, bias = self.layers.last
        bias_change = np.zeros_like(bias)
        bias_change[LOG_STD] = np.log([position_factor, position_factor, force_factor])
        return replace(self, layers=replace(self.layers, last=Layer(weight, bias + bias_change)))
