"""The film under a rig: calibrated where a network for all films knows its layout, and corrected by the presses."""

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, differences
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.calibration.calibrate import CalibrationResult, calibrate
from isocharge.train.calibration.film_charges import CONTACT_STEPS
from isocharge.train.calibration.problem import CalibrationProblem
from isocharge.train.rig.correction import Correction, Residuals, fit_correction

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

CHANCE = 1e-3
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
        charges: Array = self.forward_map.charges(contact) * np.exp(self.correction.log_factor(contact))
        return charges

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
    scattered = scatter > LARGER and chi2_distribution.sf(total, freedom) < CHANCE
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
