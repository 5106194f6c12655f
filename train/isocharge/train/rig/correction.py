"""Smooth correction of the charges of a forward map, fitted to measured presses by generalised least squares.

The correction is a factor on the charge of each electrode. The logarithm of this factor is a sum of the polynomials of
`calibration.discrepancy` in the place and the logarithm of the force. The covariance of the residuals contains the
noise of the charges. The covariance also contains the errors of the measured places and forces, which are converted to
charges with the derivatives of the map. Several sizes of the correction are tried, and the most probable size is used.
If the most probable size is zero, the charges are not corrected.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.simulate import NoiseModel
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, differences
from isocharge.train.calibration.discrepancy import term_count, terms
from isocharge.train.calibration.film_maps import CONTACT_STEPS
from isocharge.train.calibration.hypotheses import Hypothesis, LinearModel, mix_hypotheses

SIZES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Sizes of the correction that are compared, dimensionless.

Large sizes are needed for a sensor that is not calibrated.
"""

MIN_RATIO = 0.5
"""Ratio of the measured charge to that of the map below which the logarithm is continued by its tangent."""

CHUNK_SIZE = 2048
"""Number of presses whose equations are in memory at the same time."""


@dataclass(frozen=True)
class Residuals:
    """Differences between measured presses and a forward map.

    Attributes:
        contact: Measured contacts (x, y, F), shape (n, 3), mm and N.
        log_ratio: ln(measured charge / charge of the map), shape (n, n_electrode); see `_log_ratio`.
        covariance: Covariance of the logarithms by noise and by errors of the contacts, shape
            (n, n_electrode, n_electrode).
    """

    contact: Array
    log_ratio: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.contact)

    def __getitem__(self, rows: Integers | Booleans) -> "Residuals":
        """Return the residuals of some presses."""
        return Residuals(self.contact[rows], self.log_ratio[rows], self.covariance[rows])

    @classmethod
    def of(cls, presses: MeasuredPresses, charge_map: ChargeMap, noise: NoiseModel) -> "Residuals":
        """Compute the residuals of presses whose places, forces and charges are known.

        The covariance of the residuals is the sum of two parts: the noise of the charges, and the errors of the
        measured contacts.

        Args:
            presses: Measured presses without missing values.
            charge_map: Charges as a function of the contact.
            noise: Noise of the charges.
        """
        charge = charge_map.charges(presses.contact)
        log_ratio = _log_ratio(presses.charge_pC / charge)

        # Covariance by errors of the contacts: J diag(std^2) J' for each press n, with J = d ln Q / d(x, y, ln F)
        log_slopes = differences(charge_map.charges, presses.contact, CONTACT_STEPS) / charge[:, :, None]
        contact_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
        contact_covariance = np.einsum("nei,ni,nfi->nef", log_slopes, contact_std**2, log_slopes)

        noise_variance = (noise.sigma(charge) / charge) ** 2
        noise_covariance = noise_variance[:, :, None] * np.eye(charge.shape[1])
        return cls(presses.contact, log_ratio, contact_covariance + noise_covariance)

    def chi2(self, correction: Array) -> Array:
        """Compute chi-squared of each press after a correction: r' C^-1 r with the residuals r and their covariance C.

        Args:
            correction: Change of ln Q by the correction, shape (n, n_electrode).

        Returns:
            Chi-squared of each press, shape (n,).
        """
        residual = (self.log_ratio - correction)[:, :, None]  # column vectors, shape (n, n_electrode, 1)
        weighted_residual = np.linalg.solve(self.covariance, residual)
        return np.asarray((residual * weighted_residual).sum(axis=(1, 2)))


@dataclass(frozen=True)
class Correction:
    """Smooth factors on the charges of a forward map.

    A contact outside the range of the presses has the factors of the nearest press.

    Attributes:
        domain: Places and forces of the presses.
        coefficients: Coefficients of the polynomials, shape (n_term, n_electrode).
        freedom: Effective number of coefficients that the presses determine. The prior determines the other
            coefficients.
    """

    domain: Domain
    coefficients: Array
    freedom: float

    @property
    def is_zero(self) -> bool:
        """Whether the charges are not corrected."""
        return not self.coefficients.any()

    def log_factor(self, contact: Array) -> Array:
        """Return the change of ln Q, shape (n, n_electrode), at contacts (x, y, F), shape (n, 3), mm and N."""
        return np.asarray(terms(contact, self.domain) @ self.coefficients)


def fit_correction(residuals: Residuals) -> Correction:
    """Fit a correction to residuals by generalised least squares.

    The correction is a series of polynomials for each electrode. Several sizes of the correction are compared as
    hypotheses, one of which is no correction.

    Args:
        residuals: Differences between measured presses and a forward map.

    Returns:
        The correction. It is zero if the residuals are most probable without a correction.
    """
    # The domain of the polynomials is the range of the presses.
    x, y, force = residuals.contact.T
    n_electrode = residuals.log_ratio.shape[1]
    radius = float(np.hypot(x, y).max())
    force_range = (float(force.min()), float(force.max()))
    domain = Domain(radius, force_range)
    n_coefficient = term_count() * n_electrode

    def prior_covariance(hypothesis: Hypothesis) -> Array:
        """Return the covariance of the coefficients before the presses. The coefficients are independent."""
        return hypothesis.discrepancy**2 * np.eye(n_coefficient)

    # Average over the hypotheses about the size of the correction, with their probabilities as weights.
    model = _normal_equations(residuals, domain, n_coefficient)
    hypotheses = [Hypothesis(discrepancy=size) for size in SIZES]
    model_without_force_scatter = {0.0: model}
    mixture = mix_hypotheses(model_without_force_scatter, prior_covariance, hypotheses)

    is_best_without_correction = mixture.best.discrepancy == 0.0
    if is_best_without_correction:
        return Correction(domain, np.zeros((term_count(), n_electrode)), 0.0)
    # The effective number of determined coefficients is the trace of the posterior covariance times the information.
    effective_count = float(np.trace(mixture.covariance @ model.normal))
    return Correction(domain, mixture.mean.reshape(term_count(), -1), effective_count)


def _normal_equations(residuals: Residuals, domain: Domain, n_coefficient: int) -> LinearModel:
    """Return the normal equations of all residuals, summed over chunks of presses to limit the memory.

    Args:
        residuals: Differences between measured presses and a forward map.
        domain: Domain of the polynomials.
        n_coefficient: Number of coefficients of the correction.
    """
    normal = np.zeros((n_coefficient, n_coefficient))
    moment = np.zeros(n_coefficient)
    square = 0.0
    for start in range(0, len(residuals), CHUNK_SIZE):
        rows = np.arange(start, min(start + CHUNK_SIZE, len(residuals)))
        chunk = _linearised(residuals[rows], domain)
        normal += chunk.normal
        moment += chunk.moment
        square += chunk.square
    return LinearModel(normal, moment, square)


def _linearised(residuals: Residuals, domain: Domain) -> LinearModel:
    """Return the sum of the squared residuals as a function of the coefficients of the correction.

    A residual is the difference between the correction and the measured ln(Q / expected Q), so it is linear in the
    coefficients. Each residual is whitened with the covariance of its press.

    Args:
        residuals: Residuals of n presses.
        domain: Domain of the polynomials.
    """
    # The whitened residuals have unit covariance. These are the residuals without a correction.
    whitening = np.linalg.inv(np.linalg.cholesky(residuals.covariance))
    whitened_residuals = -(whitening @ residuals.log_ratio[:, :, None])[:, :, 0]

    # Derivatives of residual g of press n with respect to the coefficient of term t for electrode e, shape (n, g, t, e)
    polynomials = terms(residuals.contact, domain)
    derivatives = polynomials[:, None, :, None] * whitening[:, :, None, :]
    n_coefficient = term_count() * residuals.log_ratio.shape[1]
    design = derivatives.reshape(-1, n_coefficient)
    return LinearModel.of(design, whitened_residuals.ravel(), np.zeros(n_coefficient))


def _log_ratio(ratio: Array) -> Array:
    """Return the logarithms of ratios of any sign.

    Below `MIN_RATIO`, where the charges are mostly noise, the tangent of the logarithm is used.
    """
    logarithm = np.log(np.maximum(ratio, MIN_RATIO))
    tangent = np.minimum(ratio / MIN_RATIO - 1.0, 0.0)
    return np.asarray(logarithm + tangent)
