"""Smooth correction of the charges of a forward map, fitted to measured presses by generalised least squares.

The correction is a factor on the charge of each electrode. The logarithm of the factor is a sum of polynomials, which
`calibration.discrepancy` defines. The variables of the polynomials are the place and the logarithm of the force. The
covariance of the residuals contains the noise of the charges, and the errors of the measured places and forces. The
derivatives of the map convert errors of places and forces into errors of charges. Several sizes of the correction are
tried, and the corrections are averaged with the probabilities of the sizes as weights. If the most probable size is
zero, the charges are not corrected.
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
"""Ratio of the measured charge to the charge of the map below which the logarithm is replaced by its tangent."""

CHUNK_SIZE = 2048
"""Largest number of presses whose equations are in memory at the same time."""


@dataclass(frozen=True)
class Residuals:
    """Differences between measured presses and a forward map.

    Attributes:
        contact: Measured contacts (x, y, F), shape (n, 3), mm and N.
        log_ratio: ln(measured charge / charge of the map), shape (n, n_electrode); see `_log_ratio`.
        covariance: Covariance of the logarithms that is caused by noise and by errors of the contacts, shape (n,
            n_electrode, n_electrode).
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

        A residual is ln(measured charge / charge of the map). The covariance of the residuals is the sum of two parts.
        One part is caused by the noise of the charges, and the other part by the errors of the measured contacts.

        Args:
            presses: Measured presses without missing values.
            charge_map: Charges as a function of the contact.
            noise: Noise of the charges.
        """
        map_charge = charge_map.charges(presses.contact)
        log_ratio = _log_ratio(presses.charge_pC / map_charge)

        # Covariance by errors of the contacts: J diag(std^2) J' for each press n, with J = d ln Q / d(x, y, ln F). The
        # relative standard deviation of the force is the standard deviation of ln F. The indices of `einsum` are the
        # press n, the electrodes e and f, and the coordinate i of the contact.
        charge_slopes = differences(charge_map.charges, presses.contact, CONTACT_STEPS)
        log_slopes = charge_slopes / map_charge[:, :, None]
        contact_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
        contact_covariance = np.einsum("nei,ni,nfi->nef", log_slopes, contact_std**2, log_slopes)

        # The noise of the electrodes is independent, so its covariance is diagonal. The variance of ln Q is
        # (sigma / Q)^2.
        noise_variance = (noise.sigma(map_charge) / map_charge) ** 2
        n_electrode = map_charge.shape[1]
        noise_covariance = noise_variance[:, :, None] * np.eye(n_electrode)
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
    """Smooth correction of a forward map: factors by which the charges are multiplied.

    A contact outside the range of the presses has the factors of the nearest contact in this range.

    Attributes:
        domain: Places and forces of the presses.
        coefficients: Coefficients of the polynomials, shape (n_term, n_electrode).
        effective_count: Effective number of coefficients that the presses determine. The prior determines the other
            coefficients.
    """

    domain: Domain
    coefficients: Array
    effective_count: float

    @property
    def is_zero(self) -> bool:
        """Whether the charges are not corrected."""
        return not self.coefficients.any()

    def log_factor(self, contact: Array) -> Array:
        """Return the logarithms of the factors, shape (n, n_electrode).

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
        """
        return np.asarray(terms(contact, self.domain) @ self.coefficients)


def fit_correction(residuals: Residuals) -> Correction:
    """Fit a correction of the charges to residuals by generalised least squares.

    The correction multiplies the charge of each electrode by a factor. The logarithm of the factor is a sum of
    polynomials of the contact. The expected size of their coefficients is not known, so several sizes are tried. Each
    size is a hypothesis: the coefficients are normally distributed with this standard deviation. With the size zero,
    there is no correction. The fitted coefficients are averaged over the hypotheses, with the probabilities of the
    hypotheses as weights.

    Args:
        residuals: Differences between measured presses and a forward map.

    Returns:
        The correction. It is zero if the most probable size is zero.
    """
    # The domain of the polynomials is the range of the presses.
    x, y, force = residuals.contact.T
    radius = float(np.hypot(x, y).max())
    force_range = (float(force.min()), float(force.max()))
    domain = Domain(radius, force_range)

    n_term = term_count()
    n_electrode = residuals.log_ratio.shape[1]
    n_coefficient = n_term * n_electrode

    def prior_covariance(hypothesis: Hypothesis) -> Array:
        """Return the prior covariance of the coefficients, which are independent of each other."""
        return hypothesis.discrepancy**2 * np.eye(n_coefficient)

    # Fit the coefficients under each hypothesis, and average them. The attribute `discrepancy` is the size.
    model = _normal_equations(residuals, domain, n_coefficient)
    models_by_force_scatter = {0.0: model}  # none of the hypotheses has an additional scatter of the forces
    hypotheses = [Hypothesis(discrepancy=size) for size in SIZES]
    mixture = mix_hypotheses(models_by_force_scatter, prior_covariance, hypotheses)

    # If the most probable size is zero, the charges are not corrected. Otherwise, the averaged coefficients are used.
    most_probable_size = mixture.best.discrepancy
    if most_probable_size == 0.0:
        return Correction(domain, coefficients=np.zeros((n_term, n_electrode)), effective_count=0.0)
    # The mean before the presses is zero, so the change of the mean is the estimate.
    coefficients = mixture.mean_change.reshape(n_term, n_electrode)
    # The residuals determine some of the coefficients, and the prior determines the others. The effective number of
    # coefficients that the residuals determine is the trace of the posterior covariance times the normal matrix.
    effective_count = float(np.trace(mixture.covariance @ model.normal))
    return Correction(domain, coefficients, effective_count)


def _normal_equations(residuals: Residuals, domain: Domain, n_coefficient: int) -> LinearModel:
    """Express the sum of the squared residuals of all presses as a quadratic function of the coefficients.

    The presses are processed in chunks, which limits the memory.

    Args:
        residuals: Differences between measured presses and a forward map.
        domain: Domain of the polynomials.
        n_coefficient: Number of coefficients of the correction.

    Returns:
        The matrix and the right-hand side of the normal equations, and the sum of squares without a correction.
    """
    normal = np.zeros((n_coefficient, n_coefficient))
    moment = np.zeros(n_coefficient)
    square = 0.0
    for start in range(0, len(residuals), CHUNK_SIZE):
        rows = np.arange(start, min(start + CHUNK_SIZE, len(residuals)))
        chunk_model = _linear_model(residuals[rows], domain)
        normal += chunk_model.normal
        moment += chunk_model.moment
        square += chunk_model.square
    return LinearModel(normal, moment, square)


def _linear_model(residuals: Residuals, domain: Domain) -> LinearModel:
    """Express the sum of the squared residuals as a quadratic function of the coefficients of a correction.

    Let P be the values of the polynomials at a press, c the coefficients, and l the measured ln(Q / charge of the map).
    The residuals P c - l of the electrodes are correlated. They are multiplied by a whitening matrix W, so that their
    covariance becomes the unit matrix. W is the inverse of the Cholesky factor of the covariance. The whitened
    residuals W (P c - l) are linear in c, so the sum of their squares is quadratic in c.

    Args:
        residuals: Residuals of n presses.
        domain: Domain of the polynomials.

    Returns:
        The matrix and the right-hand side of the normal equations, and the sum of squares without a correction.
    """
    whitening = np.linalg.inv(np.linalg.cholesky(residuals.covariance))  # shape (n, n_electrode, n_electrode)
    log_ratio_column = residuals.log_ratio[:, :, None]
    uncorrected_residuals = -(whitening @ log_ratio_column)[:, :, 0]  # residuals with c = 0, shape (n, n_electrode)

    # Derivatives of residual g of press n with respect to the coefficient of term t for electrode e, shape (n, g, t, e)
    polynomials = terms(residuals.contact, domain)
    derivatives = polynomials[:, None, :, None] * whitening[:, :, None, :]
    n_coefficient = term_count() * residuals.log_ratio.shape[1]
    design = derivatives.reshape(-1, n_coefficient)
    deviation_from_prior_mean = np.zeros(n_coefficient)  # the prior mean of the coefficients is c = 0
    return LinearModel.from_residuals(design, uncorrected_residuals.ravel(), deviation_from_prior_mean)


def _log_ratio(ratio: Array) -> Array:
    """Compute the logarithms of ratios, also for ratios that are zero or negative.

    Below the ratio `MIN_RATIO`, where the charges are mostly noise, the logarithm is replaced by its tangent.
    """
    logarithm = np.log(np.maximum(ratio, MIN_RATIO))
    tangent = np.minimum(ratio / MIN_RATIO - 1.0, 0.0)
    return np.asarray(logarithm + tangent)
