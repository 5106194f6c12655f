"""The film under a rig: calibrated where a network for all films knows its layout, and corrected by the presses.

The correction is of what calibrated physics cannot explain, and smooth: the discrepancy of `calibration.discrepancy`,
fitted to all presses at once by generalised least squares: noise of the charges, and what the rig does not know of
place and force, through the map's slopes. If the presses give it no size, there is no correction.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.serve.prediction.measured_presses import MeasuredPresses, row_words
from isocharge.simulate import ForwardMap, NoiseModel
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, differences
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.calibration.calibrate import CalibrationResult, calibrate
from isocharge.train.calibration.discrepancy import term_count, terms
from isocharge.train.calibration.film_charges import CONTACT_STEPS
from isocharge.train.calibration.hypotheses import Hypothesis, Linearised, weigh
from isocharge.train.calibration.problem import CalibrationProblem

SIZES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Sizes that are weighed, dimensionless: a sensor that is not calibrated may be far off."""

LEAST_RATIO = 0.5
"""Measured charge over that of the map, below which its logarithm goes on straight."""

CHUNK = 2048
"""Presses whose equations are held at once."""


@dataclass(frozen=True)
class Residuals:
    """What a map leaves unexplained of measured presses.

    Attributes:
        contact: As the rig read them, (x, y, F), shape (n, 3), mm and N.
        log_ratio: ln(measured charge / charge of the map), shape (n, n_electrode); see `_log_ratio`.
        covariance: Of the log ratios by noise and rig, shape (n, n_electrode, n_electrode).
    """

    contact: Array
    log_ratio: Array
    covariance: Array

    def __len__(self) -> int:
        return len(self.contact)

    def __getitem__(self, rows: Integers | Booleans) -> "Residuals":
        return Residuals(self.contact[rows], self.log_ratio[rows], self.covariance[rows])

    def chi2(self, correction: Array) -> Array:
        """Squares of what a correction (n, n_electrode) leaves, over its covariance, shape (n,)."""
        left = (self.log_ratio - correction)[:, :, None]
        return np.asarray((left * np.linalg.solve(self.covariance, left)).sum(axis=(1, 2)))


@dataclass(frozen=True)
class Correction:
    """Factors on charges, beyond the presses as at the nearest of them.

    Attributes:
        domain: Distances and forces of the presses.
        coefficients: Shape (n_term, n_electrode).
        freedom: Effective number of coefficients: the prior holds the others.
    """

    domain: Domain
    coefficients: Array
    freedom: float

    @property
    def nothing(self) -> bool:
        """Whether nothing is corrected."""
        return not self.coefficients.any()

    def log_factor(self, contact: Array) -> Array:
        """What is added to ln Q at contacts (x, y, F), shape (n, 3), mm and N: (n, n_electrode)."""
        return np.asarray(terms(contact, self.domain) @ self.coefficients)


def fit_correction(residuals: Residuals) -> Correction:
    """The correction that residuals ask for; none if they are most probable without."""
    force, n_electrode = residuals.contact[:, 2], residuals.log_ratio.shape[1]
    reach = float(np.hypot(residuals.contact[:, 0], residuals.contact[:, 1]).max())
    domain, size = Domain(reach, (float(force.min()), float(force.max()))), term_count() * n_electrode
    linearised = Linearised(np.zeros((size, size)), np.zeros(size), 0.0)
    for start in range(0, len(residuals), CHUNK):
        some = residuals[np.arange(start, min(start + CHUNK, len(residuals)))]
        whiten = np.linalg.inv(np.linalg.cholesky(some.covariance))
        design = (terms(some.contact, domain)[:, None, :, None] * whiten[:, :, None, :]).reshape(-1, size)
        left = -np.einsum("nge,ne->ng", whiten, some.log_ratio).ravel()
        own = Linearised.of(design, left, np.zeros(size))
        linearised = Linearised(
            linearised.normal + own.normal, linearised.moment + own.moment, linearised.square + own.square
        )
    tried = [Hypothesis(size=each) for each in SIZES]
    mixture = weigh({0.0: linearised}, lambda hypothesis: hypothesis.size**2 * np.eye(size), tried)
    if mixture.best.size == 0.0:
        return Correction(domain, np.zeros((term_count(), n_electrode)), 0.0)
    freedom = float(np.einsum("pq,qp->", mixture.covariance, linearised.normal))
    return Correction(domain, mixture.mean.reshape(term_count(), -1), freedom)


_log = logging.getLogger(__name__)

CALIBRATED = 250
"""Presses that a film is calibrated on at most: more take time and tell little that the correction does not."""

GROSS = 100.0
"""Squared residual of a press over that of the median press, above which it is left out: ten times as far off."""

GROSS_ROUNDS = 3
"""Fits without such presses, at most: one of them may hide that others are good."""

SCATTER_CHANCE = 1e-3
"""Chance of a scatter as large as this, below which it is said."""

LARGER = 1.3
"""Scatter over what noise and rig explain, from which on it is said."""


@dataclass(frozen=True)
class RigFilm:
    """A film as its rig shows it.

    Attributes:
        forward_map: Of the calibrated film, or of the sensor as described.
        correction: What the presses ask for beyond it.
        domain: Where contacts are known.
        scatter: Root-mean-square residual of the corrected presses over what noise and rig explain.
        scattered: Whether that is more than chance.
        calibration: The film's parameters; None if the sensor was taken as described.
    """

    forward_map: ForwardMap
    correction: Correction
    domain: Domain
    scatter: float
    scattered: bool
    calibration: CalibrationResult | None = None

    def charges(self, contact: Array) -> Array:
        """Charges of contacts (x, y, F), shape (n, 3), mm and N: (n, n_electrode), pC."""
        return np.asarray(self.forward_map.charges(contact) * np.exp(self.correction.log_factor(contact)))

    def correction_percent(self, contact: Array) -> float:
        """Root mean square of the correction at contacts (n, 3), percent of the charges."""
        return 100.0 * rms(self.correction.log_factor(contact))


def calibrated_film(presses: MeasuredPresses, problem: CalibrationProblem, domain: Domain) -> RigFilm:
    """Calibrate a film on presses, and correct what that leaves.

    Args:
        presses: With known places, forces and charges.
        problem: The films.
        domain: Where the model shall know contacts; within that of the films.

    Raises:
        PressError: If no film explains the presses.
    """
    result = calibrate(presses[:: max(1, -(-len(presses) // CALIBRATED))], problem)
    for caution in result.cautions:
        _log.warning("%s", caution)
    good = np.array([line not in result.bad_lines for line in presses.lines])
    forward_map = problem.charges.forward_map(result.posterior.parameters)
    return replace(corrected_film(presses[good], forward_map, domain, problem.noise), calibration=result)


def corrected_film(presses: MeasuredPresses, forward_map: ForwardMap, domain: Domain, noise: NoiseModel) -> RigFilm:
    """Correct a forward map by presses with known places, forces and charges; it reaches a little beyond them."""
    residuals = residuals_of(presses, forward_map, noise)
    correction, gross = fit_correction(residuals), np.zeros(len(residuals), dtype=bool)
    for _ in range(GROSS_ROUNDS):
        chi2 = residuals.chi2(correction.log_factor(presses.contact))
        last, gross = gross, chi2 > GROSS * np.median(chi2)
        if np.array_equal(gross, last):
            break
        correction = fit_correction(residuals[~gross])
    if gross.any():
        left_out = presses[gross]
        words = row_words(left_out.lines, left_out.row_noun)
        _log.warning("presses are left out, which are nothing like the others: %s; look at them", words)
        residuals = residuals[~gross]
    total = residuals.chi2(correction.log_factor(residuals.contact)).sum()
    freedom = max(residuals.log_ratio.size - correction.freedom, 1.0)
    scatter = float(np.sqrt(total / freedom))
    scattered = scatter > LARGER and scipy.stats.chi2.sf(total, freedom) < SCATTER_CHANCE
    return RigFilm(forward_map, correction, domain, scatter, bool(scattered))


def residuals_of(presses: MeasuredPresses, charge_map: ChargeMap, noise: NoiseModel) -> Residuals:
    """What a map leaves unexplained, with the covariance by noise of the charges and by the rig."""
    charge = charge_map.charges(presses.contact)
    slopes = differences(charge_map.charges, presses.contact, CONTACT_STEPS) / charge[:, :, None]
    rig = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std]) ** 2
    of_rig = np.einsum("nei,ni,nfi->nef", slopes, rig, slopes)
    of_noise = (noise.sigma(charge) / charge) ** 2
    covariance = of_rig + of_noise[:, :, None] * np.eye(charge.shape[1])
    return Residuals(presses.contact, _log_ratio(presses.charge_pC / charge), covariance)


def _log_ratio(ratio: Array) -> Array:
    """ln of ratios of any sign: below `LEAST_RATIO`, where a charge is mostly noise, the tangent."""
    return np.asarray(np.log(np.maximum(ratio, LEAST_RATIO)) + np.minimum(ratio / LEAST_RATIO - 1.0, 0.0))
