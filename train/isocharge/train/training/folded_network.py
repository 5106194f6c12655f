"""The definition of a whole network, from charges to contacts, and its evaluation with NumPy in double precision.

The network has three parts:

- Input features: logarithms of the charges (`isocharge.common.charge_features`).
- A perceptron (`isocharge.common.perceptron`), whose outputs are called answers here. Whitening and units are folded
  into its first and last layer (`isocharge.train.training.folding`).
- Output functions, which turn the answers into position, force, standard deviations, correlations and misfit.

The ONNX export (`isocharge.train.model_release.onnx_graph`) and the C export (`isocharge.train.export_c.model_source`)
write this definition.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.charge_features import ChargeFeatures
from isocharge.common.perceptron import Layer, Perceptron, evaluate

POSITION = slice(0, 2)
"""Columns of the answers with x and y, mm."""

LOG_FORCE = slice(2, 3)
"""Column of the answers with the logarithm of the force in N."""

MEAN = slice(0, 3)
"""Columns of the answers with x, y and the logarithm of the force."""

LOG_STD = slice(3, 6)
"""Columns of the answers with the logarithms of the standard deviations of x and y in mm and of the force in N."""

N_CONTACT_ANSWERS = 6
"""Number of answers about the contact, which come before the angles and the misfit vector."""

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
"""Matrix from the cosines of the eight angles to the correlations of x with y, x with the force, and y with the force
(`isocharge.train.training.correlation`)."""

MISFIT_UNIT = 5.0
"""Scale of the misfit, in standard deviations of the noise: misfit = MISFIT_UNIT * sinh(|misfit vector|). The network
learns smaller misfits on a linear scale and larger ones on a logarithmic scale."""


@dataclass(frozen=True)
class FoldedNetwork:
    """A whole network.

    Attributes:
        features: Input features.
        layers: Perceptron from the features to the answers: x and y (2), ln F (1), logarithms of the standard
            deviations (3), angles of the correlations (8, or 0 without correlations), misfit vector (n_electrode).
    """

    features: ChargeFeatures
    layers: Perceptron[Array]

    @property
    def n_angle(self) -> int:
        """Number of angles of the correlations: 8, or 0 if the network gives no correlations."""
        return int(self.layers.skip.shape[1]) - N_CONTACT_ANSWERS - self.features.n_electrode

    @property
    def angle_columns(self) -> slice:
        """Columns of the answers with the angles."""
        return slice(N_CONTACT_ANSWERS, N_CONTACT_ANSWERS + self.n_angle)

    def answers(self, charge: Array) -> Array:
        """Compute the answers to charges of shape (n, n_electrode), pC; shape (n, n_answer)."""
        return np.asarray(evaluate(self.layers, self.features.evaluate(charge)), dtype=float)

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
            Contacts and standard deviations as `predict` returns them. Correlations, shape (n, 3), if the network gives
            them. Misfits, shape (n, 1).
        """
        return self.outputs_from_answers(self.answers(charge))

    def outputs_from_answers(self, answers: Array) -> tuple[Array, ...]:
        """Compute the outputs of the model from the outputs of the last layer.

        Args:
            answers: Outputs of the last layer, shape (n, n_answer): x, y and ln F, the logarithms of the standard
                deviations, the angles of the correlations if there are any, and the misfit vector.

        Returns:
            Contact, standard deviations, correlations if there are any, and misfit. Each of them has one row for each
            press.
        """
        force = np.exp(answers[:, LOG_FORCE])
        outputs = [
            np.concatenate([answers[:, POSITION], force], axis=1),
            np.exp(answers[:, LOG_STD]),
        ]
        if self.n_angle:
            # Each correlation is a weighted sum of the cosines of the eight angles.
            outputs.append(np.cos(answers[:, self.angle_columns]) @ COSINES_TO_CORRELATIONS)
        # The misfit vector follows the angles. Its length is the inverse hyperbolic sine of the misfit over its unit.
        misfit_vector = answers[:, self.angle_columns.stop :]
        compressed_misfit = np.linalg.norm(misfit_vector, axis=1, keepdims=True)
        outputs.append(MISFIT_UNIT * np.sinh(compressed_misfit))
        return tuple(outputs)

    def with_scaled_std(self, position_factor: float, force_factor: float) -> "FoldedNetwork":
        """Return the network with the standard deviations of position and force multiplied by two factors."""
        weight, bias = self.layers.last
        added = np.zeros_like(bias)
        added[LOG_STD] = np.log([position_factor, position_factor, force_factor])
        return replace(self, layers=replace(self.layers, last=Layer(weight, bias + added)))

    def with_angles(self, last: Layer[Array], skip: Array) -> "FoldedNetwork":
        """Return the network with eight additional answers, from whose cosines the correlations are computed.

        Args:
            last: Output layer of these angles: weight, shape (n_hidden, 8), and bias, shape (8,).
            skip: Weights from the input features to these angles, shape (n_electrode, 8).
        """

        def with_columns(values: Array, angle_values: Array) -> Array:
            """Insert the columns of the angles between those of the contact and those of the misfit vector."""
            contact_values, misfit_values = np.split(values, [N_CONTACT_ANSWERS], axis=-1)
            return np.concatenate([contact_values, angle_values, misfit_values], axis=-1)

        output_layer = self.layers.last
        new_output_layer = Layer(
            with_columns(output_layer.weight, last.weight),
            with_columns(output_layer.bias, last.bias),
        )
        layers = replace(self.layers, last=new_output_layer, skip=with_columns(self.layers.skip, skip))
        return replace(self, layers=layers)


def relative_log_std(answers: Array) -> Array:
    """Return the logarithms of the standard deviations of x, y and ln F, shape (n, 3), from answers (n, n_answer).

    The standard deviation of ln F is the standard deviation of F divided by F.
    """
    log_std = answers[:, LOG_STD].copy()
    log_std[:, 2:] -= answers[:, LOG_FORCE]  # the last column belongs to the force
    return np.asarray(log_std)
