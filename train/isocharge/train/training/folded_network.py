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
