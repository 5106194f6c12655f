"""From measured presses to the film they were made on, with what it leaves uncertain."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from isocharge.common.errors import PressError
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate import Circle, Sensor
from isocharge.train.calibration.contact_error import ContactError, ContactSensitivity
from isocharge.train.calibration.contacts import PressData
from isocharge.train.calibration.diagnosis import check_before, explain, find_mistakes, outside
from isocharge.train.calibration.film_fit import FilmPosterior, fit_film
from isocharge.train.calibration.problem import CalibrationProblem
from isocharge.train.calibration.quantities import Quantity, quantities, summarise
from isocharge.train.training.fit import Fitted

UNEXPLAINED = 1e-6
"""Chance of residuals as large as these, below which no film explains the presses..."""

FAR_OFF = 9.0
"""...if the mean squared residual is also above this: three times the noise."""

UNCERTAIN = 0.01
"""Chance of residuals as large as these, below which the errors are given larger by their ratio."""

STRAINED = 1e-7
"""Chance of a film as far from the described one as this, below which the presses are taken for wrongly written."""

ODD = 1e-3
"""The same, below which presses are tried as what they may be by mistake."""

FEW = 3
"""Fewer presses than this leave large errors: said, not refused."""

CLOSE_MM = 1.0
"""Presses that all lie within this distance of each other do not identify places: said."""


@dataclass(frozen=True)
class CalibrationResult:
    """A film as presses show it.

    Attributes:
        problem: What was asked.
        presses: The presses that were fitted.
        posterior: Best parameters, covariance, residuals.
        cautions: What the user should know, a sentence each.
    """

    problem: CalibrationProblem
    presses: MeasuredPresses
    posterior: FilmPosterior
    cautions: tuple[str, ...]

    @cached_property
    def film(self) -> tuple[Sensor, Circle]:
        """The calibrated sensor and probe."""
        return self.problem.prior.film(self.posterior.parameters)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """What is known of the film, by name, beside what its description alone says."""
        return quantities(self.problem.prior, self.posterior)

    @cached_property
    def sensitivity(self) -> ContactSensitivity:
        """How contacts answer to noise and to a wrong film, at the calibrated film."""
        return ContactSensitivity.at(self.problem, self.posterior.parameters)

    @cached_property
    def left(self) -> ContactError:
        """The error of contacts that is left by not knowing the film."""
        return self.sensitivity.left(self.posterior.covariance)

    @cached_property
    def left_before(self) -> ContactError:
        """The same before the presses."""
        return self.sensitivity.left(self.problem.before.covariance)

    @property
    def fitted(self) -> Fitted:
        """The network of this film, for `evaluate` and `release`; what the film leaves is in its deviations."""
        left, noise = self.left, self.sensitivity.of_noise
        widen = (
            float(np.hypot(1.0, left.position_mm / noise.position_mm)),
            float(np.hypot(1.0, left.force_percent / noise.force_percent)),
        )
        return self.problem.films.film(self.posterior.parameters, widen=widen)

    @property
    def reduced_chi2(self) -> float:
        """Mean squared residual of the fitted presses over what noise and rig explain; about one."""
        chi2, freedom = self.posterior.total
        return chi2 / freedom if freedom > 0.0 else np.nan

    @property
    def bad_lines(self) -> tuple[int, ...]:
        """Lines of the presses that were left out because they fit no film that the others fit."""
        return self.presses[self.posterior.bad].lines

    @property
    def summary(self) -> tuple[str, ...]:
        """The result in sentences."""
        noise, left, before = self.sensitivity.of_noise, self.left, self.left_before
        return (
            f"Not knowing the film leaves {left.position_mm:.2g} mm and {left.force_percent:.2g} % of the "
            f"force (root mean square); before these presses it was {before.position_mm:.2g} mm and "
            f"{before.force_percent:.2g} %. Noise alone leaves {noise.position_mm:.2g} mm and "
            f"{noise.force_percent:.2g} %.",
            *summarise(self.quantities),
            *self.cautions,
        )


def calibrate(presses: MeasuredPresses, problem: CalibrationProblem) -> CalibrationResult:
    """The film on which presses were made.

    Args:
        presses: With place and force, or one of them; uncertain as they say.
        problem: The films that it may be.

    Raises:
        PressError: If the presses cannot be what they say, or no film explains them; with the reason where it is found.
    """
    presses = presses.of_electrodes(problem.electrodes, problem.sensor.name)
    check_before(presses, problem.charges)
    far, cautions = outside(presses.contact, problem.charges.domain), []
    if far.any():
        low, high = problem.charges.domain.force_range
        too_far = (
            f"{_lines(presses[far])}: a calibration takes presses within {problem.charges.domain.radius:.3g} mm of the "
            f"centre and of {low:.2g} to {high:.2g} N"
        )
        if far.mean() > 0.5:
            raise explain(presses, problem.charges, np.inf) if len(presses) > 1 else PressError(too_far)
        cautions.append(f"{too_far}; left out")
        presses = presses[~far]
    posterior = fit_film(problem.charges, PressData.of(presses, problem.noise, problem.charges), problem.before)
    _refuse_unexplained(presses, problem, posterior)
    chi2, freedom = posterior.total
    if freedom and chi2_distribution.sf(chi2, freedom) < UNCERTAIN:  # larger errors, by Birge's ratio (1932)
        posterior = replace(posterior, covariance=posterior.covariance * (chi2 / freedom))
        cautions.append(
            f"the presses scatter {np.sqrt(chi2 / freedom):.2g} times as much as noise and rig are said to; the errors "
            "are given larger by this factor: are places and forces as certain as assumed?"
        )
    return CalibrationResult(problem, presses, posterior, (*cautions, *_cautions(presses, posterior)))


def _lines(presses: MeasuredPresses) -> str:
    listed = ", ".join(map(str, presses.lines[:10]))
    return f"{'line' if len(presses) == 1 else 'lines'} {listed}{', ...' if len(presses) > 10 else ''}"


def _refuse_unexplained(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> None:
    chi2, freedom = posterior.total
    deviation = (posterior.parameters - problem.before.parameters) / problem.prior.std
    strain = float(deviation @ np.linalg.solve(problem.before.covariance, deviation))
    unexplained = freedom > 0.0 and chi2 / freedom > FAR_OFF and chi2_distribution.sf(chi2, freedom) < UNEXPLAINED
    chance = chi2_distribution.sf(strain, deviation.size)
    suspicious = posterior.bad.any() or chance < ODD  # a few presses written wrongly may still find a strange film
    odd = suspicious and bool(find_mistakes(presses, problem.charges))
    if unexplained or chance < STRAINED or odd:
        worst = max(chi2 / max(freedom, 1.0), strain / deviation.size)
        raise explain(presses, problem.charges, float(np.sqrt(worst)))


def _cautions(presses: MeasuredPresses, posterior: FilmPosterior) -> Iterator[str]:
    if posterior.bad.any():
        lines = _lines(presses[posterior.bad])
        yield f"{lines}: left out, since no film fits them and all others; look at them again"
    good = presses[~posterior.bad]
    if len(good) < FEW:
        yield f"only {len(good)} press{'es' if len(good) > 1 else ''}: three or more tell far more"
    places = good.contact[np.isfinite(good.contact[:, 0]), :2]
    if len(places) > 1 and np.ptp(places, axis=0).max() < CLOSE_MM:
        yield (
            f"all presses lie within {np.ptp(places, axis=0).max():.2g} mm of each other: they cannot tell where the "
            "electrodes are, nor how the film answers elsewhere; press at places spread over the working area"
        )
    if not len(places):
        yield (
            "no place is known: positions will be right only up to the shift and the turn of the electrodes themselves"
        )
