"""Lower limit of the position error of a layout with uncertain nuisance parameters.

The parameters of a press are x, y, ln F and the nuisance parameters. Let the matrix A contain the derivatives of the
charges of all electrodes with respect to the parameters. Let W be the diagonal matrix of the Fisher information that
one reading provides about each charge. Let P be the inverse of the prior covariance of the parameters. The Fisher
information matrix of the parameters is B = A' W A + P. The Cramer-Rao limit of the position is the block of the inverse
of B that belongs to x and y.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.layout.case import Nuisances
from isocharge.simulate.measuring_chain.noise import NoiseModel

POSITION_PRIOR_STD = 50.0
"""Prior standard deviation of x and of y, mm.

This prior keeps the errors finite where the charges provide no information.
"""

LOG_FORCE_PRIOR_STD = 10.0
"""Prior standard deviation of ln F, where F is the force, dimensionless."""


@dataclass(frozen=True)
class ErrorModel:
    """Model that computes position errors from the rows of a `ChargeTable`.

    Attributes:
        noise: Noise of the readings, which includes the uncertainty of the gains.
        prior_std: Prior standard deviations of x and y (mm), ln F (dimensionless), the probe radius (mm) and the
            pretension (MPa), shape (5,).
    """

    noise: NoiseModel
    prior_std: Array

    @classmethod
    def of(cls, noise: NoiseModel, nuisances: Nuisances) -> "ErrorModel":
        """Create the error model for given noise and given nuisances.

        Args:
            noise: Noise of the readings.
            nuisances: Standard deviations of the nuisances. The uncertainty of the gain is added to the noise.
        """
        gain = float(np.hypot(noise.gain, nuisances.gain))
        prior_std = [
            POSITION_PRIOR_STD,
            POSITION_PRIOR_STD,
            LOG_FORCE_PRIOR_STD,
            nuisances.probe_radius,
            nuisances.pretension,
        ]
        return cls(replace(noise, gain=gain), np.array(prior_std))

    def sensitivity(self, rows: Array) -> Array:
        """Compute dimensionless derivatives of the charges with respect to the parameters of a press.

        Each derivative is multiplied by the prior standard deviation of its parameter, and by the square root of the
        Fisher information that a reading provides about the charge. In these units, the variances of the parameters and
        of the noise are 1. The parameters are x, y, ln F, the probe radius and the pretension.

        Args:
            rows: Rows of a charge table, which contain a charge and its derivatives, shape (..., 6).

        Returns:
            Sensitivities, shape (..., 5), dimensionless.
        """
        charge = rows[..., 0]
        slopes = rows[..., 1:]
        return np.asarray(slopes * self.prior_std * np.sqrt(self.noise.information(charge))[..., None])

    def squared_errors(self, rows: Array) -> Array:
        """Compute the squared position error of each press.

        Args:
            rows: Rows of a charge table, shape (n_press, n_electrode, 6).

        Returns:
            Squared errors, shape (n_press,), mm^2.
        """
        # In the units of the sensitivities, the information of the prior is the identity matrix.
        sensitivity = self.sensitivity(rows)
        information = np.matmul(sensitivity.swapaxes(1, 2), sensitivity) + np.eye(sensitivity.shape[2])
        covariance = np.linalg.inv(information)  # in units of the prior standard deviations
        return np.asarray(POSITION_PRIOR_STD**2 * (covariance[:, 0, 0] + covariance[:, 1, 1]))  # x and y
