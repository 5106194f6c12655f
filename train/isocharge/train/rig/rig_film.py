"""The film under a rig: calibrated where a network for all films knows its layout, and corrected by the presses.

The correction is of what calibrated physics cannot explain, and smooth: the logarithms of the charges are corrected by
polynomials in x, y and ln F,

    ln Q_e = ln Q_e(map) + sum c_eijm T_i(x / r) T_j(y / r) T_m(l),    i + j + m <= degree, m <= 2,

by generalised least squares: noise of the charges, and what the rig does not know of place and force, through the map's
slopes. The coefficients have a Gaussian prior about zero, narrower for higher terms, so that the correction fades where
nothing asks for it. Degree and width of the prior are chosen by presses left out in turn (cross-validation); if the
gain is not beyond chance, there is no correction.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2 as chi2_distribution

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import PressError
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate import ForwardMap, NoiseModel
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, differences
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.calibration.calibrate import CalibrationResult, calibrate
from isocharge.train.calibration.film_charges import CONTACT_STEPS
from isocharge.train.calibration.problem import CalibrationProblem

DEGREES = (1, 2, 3, 4, 6)
"""Degrees that are tried."""

FORCE_DEGREE = 2
"""Largest degree in ln F."""

STDS = (0.01, 0.03, 0.1, 0.3)
"""Standard deviations of a constant correction that are tried, in ln Q."""

FADING = 0.5
"""Ratio of the standard deviations of terms of successive degrees: corrections are smooth."""

FOLDS = 5
"""Parts that are left out in turn."""

CHANCE = 2.0
"""Gain over no correction in its own standard errors, below which it is taken for chance."""

CHUNK = 2048
"""Presses whose equations are held at once."""


@dataclass(frozen=True)
class Residuals:
    """What a map leaves unexplained of measured presses.

    Attributes:
        contact: As the rig read them, (x, y, F), shape (n, 3), mm and N.
        log_ratio: ln(measured charge / charge of the map), shape (n, n_electrode).
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
        degree: Largest degree.
        std: Standard deviation of the prior.
        coefficients: Shape (n_term, n_electrode).
        freedom: Effective number of coefficients: the prior holds the others.
    """

    domain: Domain
    degree: int
    std: float
    coefficients: Array
    freedom: float

    @property
    def nothing(self) -> bool:
        """Whether nothing is corrected."""
        return not self.coefficients.any()

    def log_factor(self, contact: Array) -> Array:
        """What is added to ln Q at contacts (x, y, F), shape (n, 3), mm and N: (n, n_electrode)."""
        return np.asarray(_terms(contact, self.domain, self.degree) @ self.coefficients)


def fit_correction(residuals: Residuals, seed: int = 0) -> Correction:
    """The correction that predicts presses left out in turn best; none if that is chance.

    Args:
        residuals: Of at least `FOLDS` presses.
        seed: Of the parts.
    """
    force = residuals.contact[:, 2]
    reach = float(np.hypot(residuals.contact[:, 0], residuals.contact[:, 1]).max())
    domain = Domain(reach, (float(force.min()), float(force.max())))
    part = np.random.default_rng(seed).permutation(np.arange(len(residuals)) % FOLDS)
    without = residuals.chi2(np.zeros_like(residuals.log_ratio))
    tried = [
        (score.sum(), degree, std, score)
        for degree in DEGREES
        for std, score in _scores(residuals, part, domain, degree)
    ]
    _, degree, std, score = min(tried, key=lambda entry: entry[:3])
    gain = without - score
    if gain.mean() <= CHANCE * gain.std() / np.sqrt(len(gain)):
        return Correction(domain, 1, 0.0, np.zeros((len(_degrees(1)), residuals.log_ratio.shape[1])), 0.0)
    normal, moment = _equations(residuals, domain, degree)
    freedom = float(np.trace(cho_solve(cho_factor(normal + _prior(len(moment), degree, std)), normal)))
    return Correction(domain, degree, std, _solve(normal, moment, degree, std), freedom)


def _scores(residuals: Residuals, part: Integers, domain: Domain, degree: int) -> Iterator[tuple[float, Array]]:
    """Squared residuals of the presses, each predicted by the parts that it is not in, for every width of the prior."""
    parts = [_equations(residuals[part == k], domain, degree) for k in range(FOLDS)]
    normal, moment = (sum(entry[k] for entry in parts) for k in range(2))
    terms = _terms(residuals.contact, domain, degree)
    for std in STDS:
        predicted = np.empty_like(residuals.log_ratio)
        for number, (own_normal, own_moment) in enumerate(parts):
            rows = part == number
            predicted[rows] = terms[rows] @ _solve(normal - own_normal, moment - own_moment, degree, std)
        yield std, residuals.chi2(predicted)


def _equations(residuals: Residuals, domain: Domain, degree: int) -> tuple[Array, Array]:
    """Normal matrix and moments: shapes (n_term n_electrode,) twice and once."""
    size = len(_degrees(degree)) * residuals.log_ratio.shape[1]
    normal, moment = np.zeros((size, size)), np.zeros(size)
    for start in range(0, len(residuals), CHUNK):
        rows = slice(start, start + CHUNK)
        terms = _terms(residuals.contact[rows], domain, degree)
        whiten = np.linalg.inv(np.linalg.cholesky(residuals.covariance[rows]))
        design = (terms[:, None, :, None] * whiten[:, :, None, :]).reshape(-1, size)
        normal += design.T @ design
        moment += design.T @ np.einsum("nge,ne->ng", whiten, residuals.log_ratio[rows]).ravel()
    return normal, moment


def _solve(normal: Array, moment: Array, degree: int, std: float) -> Array:
    """Coefficients, shape (n_term, n_electrode)."""
    solution: Array = cho_solve(cho_factor(normal + _prior(len(moment), degree, std)), moment)
    return solution.reshape(len(_degrees(degree)), -1)


def _prior(size: int, degree: int, std: float) -> Array:
    """Inverse covariance of the coefficients, shape (size, size)."""
    widths = std * FADING ** _degrees(degree).sum(axis=1)
    return np.asarray(np.diag(np.repeat(widths**-2.0, size // len(widths))))


def _degrees(degree: int) -> Integers:
    """Degrees of the terms in x, y and ln F, shape (n_term, 3)."""
    grid = np.indices((degree + 1, degree + 1, min(degree, FORCE_DEGREE) + 1)).reshape(3, -1).T
    return np.asarray(grid[grid.sum(axis=1) <= degree])


def _terms(contact: Array, domain: Domain, degree: int) -> Array:
    """Values of the terms, shape (n, n_term); beyond the presses those of the nearest contact among them."""
    low, high = np.log(domain.force_range)
    inward = np.maximum(np.hypot(contact[:, 0], contact[:, 1]), domain.radius)
    log_force = np.clip(np.log(contact[:, 2]), low, high)
    unit = (contact[:, 0] / inward, contact[:, 1] / inward, (2.0 * log_force - low - high) / max(high - low, 0.1))
    values = [chebyshev.chebvander(axis, degree) for axis in unit]
    of = _degrees(degree)
    return np.asarray(values[0][:, of[:, 0]] * values[1][:, of[:, 1]] * values[2][:, of[:, 2]])


_log = logging.getLogger(__name__)

UNEXPLAINED = (0.0, 0.01, 0.03, 0.1)
"""Errors of the physics that are allowed for in turn while a film is calibrated, a share of the charges: what is then
left is the correction's to take."""

EXPLAINED = 2.0
"""Mean squared residual over what noise, rig and the allowed error explain, up to which a calibration is taken."""

CALIBRATED = 250
"""Presses that a film is calibrated on at most: more take time and tell little that the correction does not."""

GROSS = 100.0
"""Squared residual of a press over that of the median press, above which it is left out: ten times as far off."""

SCATTER_CHANCE = 1e-3
"""Chance of a scatter as large as this, below which it is said."""

LARGER = 1.3
"""Scatter over what noise and rig explain, from which on it is said."""


@dataclass(frozen=True)
class RigFilm:
    """A film as its rig shows it: a `ChargeMap`.

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

    @property
    def electrodes(self) -> tuple[str, ...]:
        """See `ChargeMap`."""
        return self.forward_map.electrodes

    def charges(self, contact: Array) -> Array:
        """See `ChargeMap`."""
        return np.asarray(self.forward_map.charges(contact) * np.exp(self.correction.log_factor(contact)))

    def derivatives(self, contact: Array) -> Array:
        """See `ChargeMap`."""
        return differences(self.charges, contact, CONTACT_STEPS)

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
        PressError: If no film, not even with a tenth of error in its charges, explains the presses.
    """
    result = _calibration(presses, problem)
    for caution in result.cautions:
        _log.warning("%s", caution)
    good = np.array([line not in result.bad_lines for line in presses.lines])
    forward_map = problem.charges.forward_map(result.posterior.parameters)
    return replace(corrected_film(presses[good], forward_map, domain, problem.noise), calibration=result)


def _calibration(presses: MeasuredPresses, problem: CalibrationProblem) -> CalibrationResult:
    """With as little allowed error as explains the presses; the first refusal if none does."""
    some, refusals = presses[:: max(1, -(-len(presses) // CALIBRATED))], []
    for share in UNEXPLAINED:
        try:
            result = calibrate(some, replace(problem, map_error=share))
        except PressError as error:
            refusals.append(error)
            continue
        if result.reduced_chi2 <= EXPLAINED or share == UNEXPLAINED[-1]:
            return result
    raise refusals[0]


def corrected_film(presses: MeasuredPresses, forward_map: ForwardMap, domain: Domain, noise: NoiseModel) -> RigFilm:
    """Correct a forward map by presses with known places, forces and charges; it reaches a little beyond them."""
    residuals = residuals_of(presses, forward_map, noise)
    correction = fit_correction(residuals)
    chi2 = residuals.chi2(correction.log_factor(presses.contact))
    gross = chi2 > GROSS * np.median(chi2)
    if gross.any():
        count, lines = gross.sum(), list(presses[gross].lines[:10])
        _log.warning(
            "%d presses are left out, which are nothing like the others (lines %s); look at them", count, lines
        )
        residuals = residuals[~gross]
        correction = fit_correction(residuals)
    total = residuals.chi2(correction.log_factor(residuals.contact)).sum()
    freedom = max(residuals.log_ratio.size - correction.freedom, 1.0)
    scatter = float(np.sqrt(total / freedom))
    scattered = scatter > LARGER and chi2_distribution.sf(total, freedom) < SCATTER_CHANCE
    return RigFilm(forward_map, correction, domain, scatter, bool(scattered))


def residuals_of(presses: MeasuredPresses, charge_map: ChargeMap, noise: NoiseModel) -> Residuals:
    """What a map leaves unexplained, with the covariance by noise of the charges and by the rig."""
    charge = charge_map.charges(presses.contact)
    slopes = differences(lambda contact: np.log(charge_map.charges(contact)), presses.contact, CONTACT_STEPS)
    rig = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std]) ** 2
    of_rig = np.einsum("nei,ni,nfi->nef", slopes, rig, slopes)
    of_noise = (noise.sigma(charge) / charge) ** 2
    covariance = of_rig + of_noise[:, :, None] * np.eye(charge.shape[1])
    return Residuals(presses.contact, np.log(presses.charge_pC / charge), covariance)
