"""From measured presses to the film they were made on, with what it leaves uncertain."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.progress import Warn
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.train.calibration.contact_error import ContactError, ContactSensitivity
from isocharge.train.calibration.contacts import RigData
from isocharge.train.calibration.diagnosis import check_before, explain, find_mistakes, outside, without
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_fit import FilmPosterior, fit_film
from isocharge.train.calibration.quantities import Quantity, in_words, quantities
from isocharge.train.data.domain import ContactDomain

UNEXPLAINED = 1e-6
"""Chance of misses as large as these, below which no film explains the presses..."""

FAR_OFF = 9.0
"""...if the mean squared miss is also above this: three times the noise."""

UNCERTAIN = 0.01
"""Chance of misses as large as these, below which the errors are given larger by their ratio."""

STRAINED = 1e-7
"""Chance of a film as far from the described one as this, below which the presses are taken for wrongly written."""

ODD = 1e-3
"""The same, below which presses are tried as what they may be by mistake."""

FEW = 3
"""Fewer presses than this leave large errors: said, not refused."""

CLOSE_MM = 1.0
"""Presses that all lie within this distance of each other cannot tell places: said."""

DRIFT = {"pretension": 0.35, "d31": 0.25, "d32": 0.25, "gain": 0.2}
"""What may have changed since an earlier calibration, in standard deviations of the prior: creep of the pretension by
0.3 MPa, ageing of the coefficients by 5 %, gains by 1 %; everything else by `REMOUNTED`."""

REMOUNTED = 0.05
"""See `DRIFT`."""


@dataclass(frozen=True)
class CalibrationScene:
    """What a calibration is about.

    Attributes:
        charges: The films that the sensor may be, and their charges.
        domain: Where contacts shall be right.
        noise: Of the charges.
    """

    charges: FilmCharges
    domain: ContactDomain
    noise: NoiseModel


@dataclass(frozen=True)
class EarlierFilm:
    """What is known of a film before the presses.

    Attributes:
        parameters: Shape (n_parameter,).
        covariance: Of the parameters over their prior standard deviations, shape (n_parameter, n_parameter).
    """

    parameters: Array
    covariance: Array


@dataclass(frozen=True)
class Calibration:
    """A film as presses show it.

    Attributes:
        scene: What was asked.
        presses: The presses that were fitted.
        posterior: Best parameters, covariance, misses.
        before: What was known before the presses.
        cautions: What the user should know, a sentence each.
    """

    scene: CalibrationScene
    presses: MeasuredPresses
    posterior: FilmPosterior
    before: EarlierFilm
    cautions: tuple[str, ...]

    @property
    def film(self) -> tuple[Sensor, Circle]:
        """The calibrated sensor and probe."""
        return self.scene.charges.prior.film(self.posterior.parameters)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """What is known of the film, by name, beside what its description alone says."""
        described = np.eye(len(self.scene.charges.prior.names))
        return quantities(self.scene.charges.prior, self.posterior.parameters, self.posterior.covariance, described)

    @cached_property
    def sensitivity(self) -> ContactSensitivity:
        """How contacts answer to noise and to a wrong film, at the calibrated film."""
        return ContactSensitivity.at(self.scene.charges, self.posterior.parameters, self.scene.domain, self.scene.noise)

    @cached_property
    def left(self) -> ContactError:
        """The error of contacts that is left by not knowing the film."""
        return self.sensitivity.left(self.posterior.covariance)

    @cached_property
    def left_before(self) -> ContactError:
        """The same before the presses."""
        return self.sensitivity.left(self.before.covariance)

    @property
    def reduced_chi2(self) -> float:
        """Mean squared miss of the fitted presses over what noise and rig explain; about one."""
        good = ~self.posterior.bad
        freedom = self.posterior.freedom[good].sum()
        return float(self.posterior.chi2[good].sum() / freedom) if freedom > 0.0 else np.nan

    @property
    def bad_lines(self) -> tuple[int, ...]:
        """Lines of the presses that were left out because they fit no film that the others fit."""
        return tuple(self.presses.lines[row] for row in np.flatnonzero(self.posterior.bad))

    @property
    def words(self) -> tuple[str, ...]:
        """The result in sentences."""
        noise = self.sensitivity.of_noise()
        return (
            f"Not knowing the film leaves {self.left.position_mm:.2g} mm and {self.left.force_percent:.2g} % of the "
            f"force (root mean square); before these presses it was {self.left_before.position_mm:.2g} mm and "
            f"{self.left_before.force_percent:.2g} %. Noise alone leaves {noise.position_mm:.2g} mm and "
            f"{noise.force_percent:.2g} %.",
            *in_words(self.quantities),
            *self.cautions,
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON: parameters with their errors and correlations, quantities, errors left, presses left out."""
        prior, covariance = self.scene.charges.prior, self.posterior.covariance
        std = np.sqrt(np.diag(covariance))
        noise = self.sensitivity.of_noise()
        return {
            "format_version": 1,
            "sensor": prior.sensor.name,
            "probe": prior.probe.notation,
            "presses": len(self.presses),
            "left_out_lines": list(self.bad_lines),
            "reduced_chi2": self.reduced_chi2,
            "error_left": _error(self.left),
            "error_left_before": _error(self.left_before),
            "error_of_noise": _error(noise),
            "quantities": {name: quantity.to_dict() for name, quantity in self.quantities.items()},
            "parameters": {
                name: {"value": float(value), "std": float(error)}
                for name, value, error in zip(prior.names, self.posterior.parameters, std * prior.std, strict=True)
            },
            "correlations": np.round(covariance / np.outer(std, std), 6).tolist(),
            "words": list(self.words),
        }


def _error(error: ContactError) -> dict[str, float]:
    return {"position_mm": error.position_mm, "force_percent": error.force_percent}


def calibrate(
    presses: MeasuredPresses,
    scene: CalibrationScene,
    earlier: EarlierFilm | None = None,
    *,
    warn: Warn = warnings.warn,
) -> Calibration:
    """The film on which presses were made.

    Args:
        presses: With place and force, or one of them; uncertain as they say.
        scene: The films that it may be.
        earlier: An earlier calibration of the same film, loosened by what may have drifted; the prior if absent.
        warn: Called with sentences that the user should read; they are in the result, too.

    Raises:
        PressError: If the presses cannot be what they say, or no film explains them; with the reason where it is found.
    """
    charges, cautions = scene.charges, []
    check_before(presses, charges)
    far = outside(presses, charges)
    if far.mean() > 0.5:
        raise explain(presses, charges, np.inf) if len(presses) > 1 else _too_far(presses, far, charges)
    if far.any():
        cautions.append(_too_far(presses, far, charges).args[0] + "; left out")
        presses = without(presses, far)
    before = earlier or EarlierFilm(charges.prior.mean, np.eye(len(charges.prior.names)))
    data = RigData.of(
        presses.contact, presses.charge_pC, presses.position_std_mm, presses.force_std, scene.noise, charges
    )
    posterior = fit_film(charges, data, before.parameters, before.covariance)
    _refuse_unexplained(presses, charges, posterior, before)
    posterior, scattered = _with_real_scatter(posterior)
    cautions += [*scattered, *_cautions(presses, posterior)]
    for caution in cautions:
        warn(caution)
    return Calibration(scene, presses, posterior, before, tuple(cautions))


def _too_far(presses: MeasuredPresses, far: np.ndarray, charges: FilmCharges) -> PressError:
    low, high = charges.force_range_N
    lines = [presses.lines[row] for row in np.flatnonzero(far)]
    return PressError(
        f"{_lines(lines)}: a calibration takes presses within {charges.radius_mm:.3g} mm of the centre and of "
        f"{low:.2g} to {high:.2g} N"
    )


def _lines(lines: list[int]) -> str:
    listed = ", ".join(map(str, lines[:10]))
    return f"{'line' if len(lines) == 1 else 'lines'} {listed}{', ...' if len(lines) > 10 else ''}"


def _refuse_unexplained(
    presses: MeasuredPresses, charges: FilmCharges, posterior: FilmPosterior, before: EarlierFilm
) -> None:
    good = ~posterior.bad
    freedom, total = posterior.freedom[good].sum(), posterior.chi2[good].sum()
    deviation = (posterior.parameters - before.parameters) / charges.prior.std
    strain = float(deviation @ np.linalg.solve(before.covariance, deviation))
    unexplained = freedom > 0.0 and total / freedom > FAR_OFF and chi2_distribution.sf(total, freedom) < UNEXPLAINED
    chance = chi2_distribution.sf(strain, deviation.size)
    suspicious = posterior.bad.any() or chance < ODD  # a few presses written wrongly may still find a strange film
    odd = suspicious and bool(find_mistakes(presses, charges))
    if unexplained or chance < STRAINED or odd:
        raise explain(presses, charges, float(np.sqrt(max(total / max(freedom, 1.0), strain / deviation.size))))


def _with_real_scatter(posterior: FilmPosterior) -> tuple[FilmPosterior, list[str]]:
    """Larger errors where the presses scatter by more than noise and rig are said to (Birge 1932)."""
    good = ~posterior.bad
    freedom, total = posterior.freedom[good].sum(), posterior.chi2[good].sum()
    if not freedom or chi2_distribution.sf(total, freedom) >= UNCERTAIN:
        return posterior, []
    ratio = float(np.sqrt(total / freedom))
    caution = (
        f"the presses scatter {ratio:.2g} times as much as noise and rig are said to; the errors are given larger by "
        "this factor: are places and forces as certain as assumed?"
    )
    return FilmPosterior(**(vars(posterior) | {"covariance": posterior.covariance * ratio**2})), [caution]


def _cautions(presses: MeasuredPresses, posterior: FilmPosterior) -> list[str]:
    cautions = []
    if posterior.bad.any():
        lines = [presses.lines[row] for row in np.flatnonzero(posterior.bad)]
        cautions.append(f"{_lines(lines)}: left out, since no film fits them and all others; look at them again")
    good = presses[np.flatnonzero(~posterior.bad)]
    if len(good) < FEW:
        cautions.append(f"only {len(good)} press{'es' if len(good) > 1 else ''}: three or more tell far more")
    places = good.contact[np.isfinite(good.contact[:, 0]), :2]
    if len(places) > 1 and np.ptp(places, axis=0).max() < CLOSE_MM:
        cautions.append(
            f"all presses lie within {np.ptp(places, axis=0).max():.2g} mm of each other: they cannot tell where the "
            "electrodes are, nor how the film answers elsewhere; press at places spread over the working area"
        )
    if not len(places):
        cautions.append(
            "no place is known: positions will be right only up to the shift and the turn of the electrodes themselves"
        )
    return cautions


def loosened(scene: CalibrationScene, parameters: Array, covariance: Array) -> EarlierFilm:
    """An earlier calibration as the prior of the next one: with what may have drifted since (`DRIFT`)."""
    names = scene.charges.prior.names
    drift = np.array([DRIFT.get(name.partition(" ")[0], REMOUNTED) for name in names])
    low, high = scene.charges.prior.bounds
    return EarlierFilm(np.clip(parameters, low, high), covariance + np.diag(drift**2))
