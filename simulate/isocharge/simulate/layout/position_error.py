"""Lower limit of the position error of a layout with uncertain nuisance parameters.

The parameters of a press are x, y, ln F and the nuisance parameters. Let the matrix A contain the derivatives of the
charges of all electrodes with respect to the parameters. Let W be the diagonal matrix of the Fisher information that
one reading provides about each charge. Let P be the inverse of the prior covariance of the parameters. The Fisher
information matrix of the parameters is B = A' W A + P. The Cramer-Rao limit of the position is the block of the inverse
of B that belongs to x and y.

A further electrode adds a matrix a a' to B, where a is the row of sqrt(W) A that belongs to this electrode. The formula
of Sherman and Morrison (1950) describes the change of the limit:

    tr_xy (B + a a')^-1 = tr_xy B^-1 - |(B^-1 a)_xy|^2 / (1 + a' B^-1 a).

The symbol tr_xy stands for the sum of the two diagonal elements that belong to x and y.
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
        return position_variance(inverse_information(self.sensitivity(rows)))


def inverse_information(sensitivity: Array) -> Array:
    """Invert the Fisher information that all electrodes and the prior provide about the parameters of each press.

    Args:
        sensitivity: Sensitivities of the electrodes, shape (n_press, n_electrode, 5), dimensionless.

    Returns:
        Covariance of the parameters in units of their prior standard deviations, shape (n_press, 5, 5).
    """
    # In these units, the information of the prior is the identity matrix.
    prior_information = np.eye(sensitivity.shape[2])
    return np.asarray(np.linalg.inv(np.matmul(sensitivity.swapaxes(1, 2), sensitivity) + prior_information))


def position_variance(inverse: Array) -> Array:
    """Compute the squared position error of each press from the covariance of its parameters.

    Args:
        inverse: Result of `inverse_information`, shape (n_press, 5, 5), whose first parameters are x and y.

    Returns:
        Squared errors, shape (n_press,), mm^2.
    """
    return np.asarray(POSITION_PRIOR_STD**2 * (inverse[:, 0, 0] + inverse[:, 1, 1]))


def squared_errors_with_candidates(sensitivity: Array, candidates: Array) -> Array:
    """Compute the squared position errors of a layout to which one candidate electrode is added, for many candidates.

    The sensitivities are the derivatives of the charges in units in which the noise and the priors have the variance 1.
    Let B be the information matrix of the layout, and let the vector a contain the sensitivities of a candidate.
    According to Sherman and Morrison (1950), the sum of the variances of x and y with the candidate is

        tr_xy (B + a a')^-1 = tr_xy B^-1 - |(B^-1 a)_xy|^2 / (1 + a' B^-1 a),

    where tr_xy is the sum of the two diagonal elements that belong to x and y.

    Args:
        sensitivity: Sensitivities of the electrodes of the layout, shape (n_press, n_electrode, 5).
        candidates: Sensitivities of the candidates for the further electrode, shape (n_press, 5, n_candidate).

    Returns:
        Squared position errors, shape (n_press, n_candidate), mm^2.
    """
    inverse = inverse_information(sensitivity)  # B^-1, shape (n_press, 5, 5); the first parameters are x and y
    inverse_times_candidate = inverse @ candidates  # B^-1 a, shape (n_press, 5, n_candidate)
    squared_position_part = (inverse_times_candidate[:, :2] ** 2).sum(axis=1)  # |(B^-1 a)_xy|^2
    quadratic_form = (inverse_times_candidate * candidates).sum(axis=1)  # a' B^-1 a
    reduction = squared_position_part / (1.0 + quadratic_form)

    # The squared error is that of the layout minus the reduction. The reduction is in units of the squared prior
    # standard deviation of the position.
    return np.asarray(position_variance(inverse)[:, None] - POSITION_PRIOR_STD**2 * reduction)
