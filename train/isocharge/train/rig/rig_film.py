"""The film under a rig: calibrated where a network for all films knows its layout, and corrected by the presses."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.progress import Warn
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.statistics import rms
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.train.calibration.calibrate import Calibration, calibrate
from isocharge.train.calibration.film_charges import CONTACT_STEPS, charges_of
from isocharge.train.calibration.films_for import SensorFilms
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import sigma_pC
from isocharge.train.rig.correction import Correction, Residuals, fit_correction

UNEXPLAINED = (0.0, 0.01, 0.03, 0.1)
"""Errors of the physics that are allowed for in turn while a film is calibrated, a share of the charges: what is then
left is the correction's to take."""

EXPLAINED = 2.0
"""Mean squared miss over what noise, rig and the allowed error explain, up to which a calibration is taken."""

CALIBRATED = 250
"""Presses that a film is calibrated on at most: more take time and tell little that the correction does not."""

GROSS = 100.0
"""Squared miss of a press over that of the median press, above which it is left out: ten times as far off."""

CHANCE = 1e-3
"""Chance of a scatter as large as this, below which it is said."""

LARGER = 1.3
"""Scatter over what noise and rig explain, from which on it is said."""


@dataclass(frozen=True)
class RigFilm:
    """A film as its rig shows it.

    Attributes:
        forward_map: Of the calibrated film, or of the sensor as described.
        correction: What the presses ask for beyond it.
        calibration: The film's parameters; None if the sensor was taken as described.
        domain: Where contacts are known.
        scatter: Root-mean-square miss of the corrected presses over what noise and rig explain.
        scattered: Whether that is more than chance.
    """

    forward_map: ForwardMap
    correction: Correction
    calibration: Calibration | None
    domain: ContactDomain
    scatter: float
    scattered: bool

    @property
    def sensor(self) -> Sensor:
        """The sensor: calibrated, or as described."""
        return self.forward_map.sensor

    def charge_pC(self, contact: Array) -> Array:
        """Charges of contacts (x_mm, y_mm, force_N), shape (n, 3), within the domain: (n, n_electrode)."""
        charge: Array = charges_of(self.forward_map, contact) * np.exp(self.correction.log_factor(contact))
        return charge

    def correction_percent(self, contact: Array) -> float:
        """Root mean square of the correction at contacts (n, 3), percent of the charges."""
        return 100.0 * rms(self.correction.log_factor(contact))


def calibrated_film(presses: MeasuredPresses, films: SensorFilms, domain: ContactDomain, warn: Warn) -> RigFilm:
    """Calibrate a film on presses, and correct what that leaves.

    Args:
        presses: With known places, forces and charges.
        films: The network for all films of the layout, whose forward maps are taken.
        domain: Where the model shall know contacts; within that of the films.
        warn: Called with what calibration says about the presses.

    Raises:
        PressError: If no film, not even with a tenth of error in its charges, explains the presses.
    """
    calibration = _calibration(presses, films)
    for caution in calibration.cautions:
        warn(caution)
    forward_map = calibration.scene.charges.forward_map(calibration.posterior.parameters)
    good = np.array([line not in calibration.bad_lines for line in presses.lines])
    film = corrected_film(presses[good], forward_map, domain, films.films.noise, warn)
    return replace(film, calibration=calibration)


def _calibration(presses: MeasuredPresses, films: SensorFilms) -> Calibration:
    """With as little allowed error as explains the presses; the first refusal if none does."""
    every = max(1, -(-len(presses) // CALIBRATED))
    presses = presses[::every]
    refusal: PressError | None = None
    for share in UNEXPLAINED:
        noise = films.scene.noise
        allowed = NoiseModel(noise.name, noise.white, float(np.hypot(noise.gain, share)))
        try:
            scene = replace(films.scene, noise=allowed)
            calibration = calibrate(presses, scene, films.described, warn=lambda _: None)
        except PressError as error:
            refusal = refusal or error
            continue
        if calibration.reduced_chi2 <= EXPLAINED or share == UNEXPLAINED[-1]:
            return calibration
    assert refusal is not None
    raise refusal


def corrected_film(
    presses: MeasuredPresses, forward_map: ForwardMap, domain: ContactDomain, noise: NoiseModel, warn: Warn
) -> RigFilm:
    """Correct a forward map by presses with known places, forces and charges; it reaches a little beyond them."""
    residuals = residuals_of(presses, forward_map, noise)
    correction = fit_correction(residuals)
    chi2 = residuals.chi2(correction.log_factor(presses.contact))
    gross = chi2 > GROSS * np.median(chi2)
    if gross.any():
        lines = [presses.lines[row] for row in np.flatnonzero(gross)[:10]]
        warn(f"{gross.sum()} presses are left out, which are nothing like the others (lines {lines}); look at them")
        residuals = residuals[np.flatnonzero(~gross)]
        correction = fit_correction(residuals)
    return RigFilm(forward_map, correction, None, domain, *_scatter(residuals, correction))


def _scatter(residuals: Residuals, correction: Correction) -> tuple[float, bool]:
    """Root-mean-square miss over what noise and rig explain, and whether it is beyond chance."""
    total = residuals.chi2(correction.log_factor(residuals.contact)).sum()
    freedom = max(residuals.log_ratio.size - correction.freedom, 1.0)
    scatter = float(np.sqrt(total / freedom))
    return scatter, bool(scatter > LARGER and chi2_distribution.sf(total, freedom) < CHANCE)


def residuals_of(presses: MeasuredPresses, forward_map: ForwardMap, noise: NoiseModel) -> Residuals:
    """What a map leaves unexplained, with the covariance by noise of the charges and by the rig."""
    charge = charges_of(forward_map, presses.contact)
    slopes = _slopes(lambda contact: np.log(charges_of(forward_map, contact)), presses.contact)
    rig = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std]) ** 2
    of_rig = np.einsum("nei,ni,nfi->nef", slopes, rig, slopes)
    of_noise = (sigma_pC(noise, charge) / charge) ** 2
    covariance = of_rig + of_noise[:, :, None] * np.eye(charge.shape[1])
    return Residuals(presses.contact, np.log(presses.charge_pC / charge), covariance)


def _slopes(values: Callable[[Array], Array], contact: Array) -> Array:
    """Derivatives by x and y (1/mm) and by ln F, by central differences: shape (n, n_electrode, 3)."""
    columns = []
    for axis, step in enumerate(CONTACT_STEPS):
        ahead, behind = contact.copy(), contact.copy()
        if axis == 2:
            ahead[:, 2], behind[:, 2] = contact[:, 2] * np.exp(step), contact[:, 2] * np.exp(-step)
        else:
            ahead[:, axis], behind[:, axis] = contact[:, axis] + step, contact[:, axis] - step
        columns.append((values(ahead) - values(behind)) / (2.0 * step))
    return np.stack(columns, axis=2)
