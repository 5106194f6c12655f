"""Lower limit of the position error of a layout, with nuisance parameters.

Let A = d(charge) / d(x, y, ln F, nuisances) be the derivatives for all electrodes. Let W be the diagonal matrix of the
Fisher information that one reading provides about its charge, and P the inverse of the prior covariance. The Fisher
information matrix of all parameters is B = A' W A + P. The Cramer-Rao limit of the position, with marginalised
nuisances, is the block of the inverse of B that belongs to x and y. A further electrode adds a matrix a a' to B, where
a is the row of sqrt(W) A that belongs to this electrode. The limit then changes according to Sherman and Morrison
(1950):

    tr_xy (B + a a')^-1 = tr_xy B^-1 - |(B^-1 a)_xy|^2 / (1 + a' B^-1 a).
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.layout.case import Nuisances
from isocharge.simulate.measuring_chain.noise import NoiseModel

POSITION_PRIOR_STD = 50.0
"""Prior standard deviation of x and of y, mm. It keeps the errors finite where the charges provide no information."""

LOG_FORCE_PRIOR_STD = 10.0
"""Prior standard deviation of ln F, dimensionless."""


@dataclass(frozen=True)
class ErrorModel:
    """Model that computes position errors from the rows of a `ChargeTable`.

    Attributes:
        noise: Noise of the readings, including the uncertainty of the gains.
        prior_std: Prior standard deviations of x and y (mm), ln F, probe radius (mm) and pretension (MPa), shape (5,).
    """

    noise: NoiseModel
    prior_std: Array

    @classmethod
    def of(cls, noise: NoiseModel, nuisances: Nuisances) -> "ErrorModel":
        """Create the error model of readings with a noise and with nuisances.

        Args:
            noise: Noise of the readings.
            nuisances: Standard deviations of the nuisances. The gain is combined with the gain of the noise.
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
        """Compute the derivatives of the charges in units in which the noise and the priors have the variance 1.

        This is sqrt(information of a reading) * d(charge) / d(parameter) * prior standard deviation of the parameter.
        The parameters are x, y, ln F, the probe radius and the pretension.

        Args:
            rows: Rows of a charge table: the charge and its derivatives, shape (..., 6).

        Returns:
            Sensitivities, dimensionless, shape (..., 5).
        """
        charge = rows[..., 0]
        slopes = rows[..., 1:]
        return np.asarray(slopes * self.prior_std * np.sqrt(self.noise.information(charge))[..., None])

    def squared(self, rows: Array) -> Array:
        """Compute the squared position error of each press, shape (n_press,), mm^2.

        Args:
            rows: Rows of a charge table, shape (n_press, n_electrode, 6).
        """
        return position_variance(inverse_information(self.sensitivity(rows)))


def inverse_information(sensitivity: Array) -> Array:
    """Invert the information of all electrodes and the prior.

    Args:
        sensitivity: Sensitivities, shape (n_press, n_electrode, 5).

    Returns:
        Covariance in units of the prior standard deviations, shape (n_press, 5, 5).
    """
    prior_information = np.eye(sensitivity.shape[2])
    return np.asarray(np.linalg.inv(np.matmul(sensitivity.swapaxes(1, 2), sensitivity) + prior_information))


def position_variance(inverse: Array) -> Array:
    """Compute the squared position error, shape (n_press,), mm^2, from the result of `inverse_information`."""
    return np.asarray(POSITION_PRIOR_STD**2 * (inverse[:, 0, 0] + inverse[:, 1, 1]))


def with_one_more(sensitivity: Array, candidates: Array) -> Array:
    """Compute the squared position errors of a layout with one further electrode, for many candidates.

    Let B be the information matrix of the layout, and a the sensitivities of a candidate. According to Sherman and
    Morrison (1950), the candidate changes the sum of the variances of x and y to

        tr_xy (B + a a')^-1 = tr_xy B^-1 - |(B^-1 a)_xy|^2 / (1 + a' B^-1 a).

    Args:
        sensitivity: Sensitivities of the electrodes of the layout, shape (n_press, n_electrode, 5).
        candidates: Sensitivities of the candidates, shape (n_press, 5, n_candidate).

    Returns:
        Squared position errors, shape (n_press, n_candidate), mm^2.
    """
    inverse = inverse_information(sensitivity)  # B^-1, shape (n_press, 5, 5), in the order (x, y, ...)
    inverse_times_candidate = inverse @ candidates  # B^-1 a, shape (n_press, 5, n_candidate)
    squared_position_part = (inverse_times_candidate[:, :2] ** 2).sum(axis=1)  # |(B^-1 a)_xy|^2
    quadratic_form = (inverse_times_candidate * candidates).sum(axis=1)  # a' B^-1 a
    reduction = squared_position_part / (1.0 + quadratic_form)
    # The matrices are in units of the prior standard deviations.
    return np.asarray(position_variance(inverse)[:, None] - POSITION_PRIOR_STD**2 * reduction)
