"""From measured presses to the film they were made on, with what it leaves uncertain."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy  # loads a part when it is used
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.simulate import Circle, Sensor
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.calibration.contact_error import ContactError, ContactSensitivity, next_presses
from isocharge.train.calibration.diagnosis import check_channels, check_places, explain, find_mistakes, misfit, outside
from isocharge.train.calibration.film_fit import MISTAKEN, PROBABLE, FilmPosterior, fit_film
from isocharge.train.calibration.hypotheses import Hypothesis
from isocharge.train.calibration.nuisances import NUISANCES, NuisanceEstimate
from isocharge.train.calibration.press_data import PressData, temperatures
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate
from isocharge.train.calibration.quantities import Quantity, quantities, summarise
from isocharge.train.training.fitted import Fitted

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

MISLED = 8.0
"""Misfit of presses as they are written, as `misfit` gives it, above which mistakes are looked for before a fit."""

FEW = 3
"""With so few presses a wrong one cannot be seen: said, not refused."""

EDGE = 0.1
"""Standard deviations before the presses from its bound, within which a parameter counts as held by it: said."""

MORE = 30
"""Presses of which it is said what they would reach, where a film has what no parameter describes."""

SEEN = 2.0
"""Standard deviations of a trace's width from which on it is named."""

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
        moved: How an earlier calibration was moved to another temperature, without presses; empty with presses.
    """

    problem: CalibrationProblem
    presses: MeasuredPresses
    posterior: FilmPosterior
    cautions: tuple[str, ...] = ()
    moved: str = ""

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
        return ContactSensitivity.at(self.problem, self.posterior.unknowns)

    @cached_property
    def left(self) -> ContactError:
        """The error of contacts that is left by not knowing the film."""
        return self.sensitivity.left(self.posterior.joint)

    @cached_property
    def left_before(self) -> ContactError:
        """The same before the presses, or before it was moved."""
        before, covariance = self.problem.before, np.zeros_like(self.posterior.joint)
        known = len(before.unknowns)
        covariance[:known, :known] = before.unknown_covariance
        if not self.moved:
            return self.sensitivity.left(covariance)
        unknowns = np.pad(before.unknowns, (0, len(covariance) - known))
        return ContactSensitivity.at(self.problem, unknowns).left(covariance)

    @property
    def fitted(self) -> Fitted:
        """The network of this film, for `evaluate` and `release`; what the film leaves is in its deviations."""
        return self.fitted_film(self.posterior.parameters, release=True)

    def fitted_film(self, parameters: Array, *, release: bool = False) -> Fitted:
        """The network of a film near it, of these parameters; all else that is known of this film holds for it."""
        left = self.sensitivity.contact, np.einsum("nii->ni", self.sensitivity.covariance(self.posterior.joint))
        return self.problem.fitted(parameters, left, self._factor, release=release)

    @cached_property
    def _factor(self) -> Callable[[Array], Array]:
        """What the film has besides its parameters; the answers are remembered, for its networks ask the same."""
        known: dict[bytes, Array] = {}

        def factor(contact: Array) -> Array:
            keys = [row.tobytes() for row in contact]
            if new := [number for number, key in enumerate(keys) if key not in known]:
                factors = self.problem.charges.factor(self.posterior.unknowns, contact[new])
                known.update(zip([keys[number] for number in new], factors, strict=True))
            return np.stack([known[key] for key in keys])

        return factor

    @property
    def reduced_chi2(self) -> float:
        """Mean squared residual of the fitted presses over what noise and rig explain; about one."""
        chi2, freedom = self.posterior.total
        return chi2 / freedom if freedom > 0.0 else np.nan

    @property
    def bad_lines(self) -> tuple[int, ...]:
        """Lines of the presses that were left out because they fit no film that the others fit."""
        return self.presses[self.posterior.bad].lines

    @cached_property
    def summary(self) -> tuple[str, ...]:
        """The result in sentences; they are computed once, since they contain a plan of further presses."""
        noise, left, before = self.sensitivity.of_noise, self.left, self.left_before
        when = "it was moved" if self.moved else "these presses"
        return (
            f"Not knowing the film leaves {left.position_mm:.2g} mm and {left.force_percent:.2g} % of the "
            f"force (root mean square); before {when} it was {before.position_mm:.2g} mm and "
            f"{before.force_percent:.2g} %. Noise alone leaves {noise.position_mm:.2g} mm and "
            f"{noise.force_percent:.2g} %.",
            *((f"The film was {self.moved}, without presses.",) if self.moved else summarise(self.quantities)),
            *self._of_temperature,
            "Forces are as right as the load cell, and places as the origin and the axes of the stage: an error of "
            "theirs is in every answer, beside these.",
            *self._unexplained,
            *self.cautions,
        )

    @property
    def _of_temperature(self) -> Iterator[str]:
        """What a kelvin does to the film, if that is known."""
        if (known := self.posterior.warming) is None:
            return
        if not known.identified:
            yield f"The presses were made at {known.at_C:.1f} C; over more degrees they would tell what a kelvin does."
        else:
            yield (
                f"A kelvin more changes the pretension by {known.MPa_per_K:.3g} +- {known.std:.2g} MPa. This is the "
                f"film at {known.at_C:.1f} C; --from with --temperature gives it at another."
            )

    @property
    def _unexplained(self) -> Iterator[str]:
        """What no parameter describes, and what more presses would do about it."""
        if not self.posterior.imperfect:
            return
        contact = self.sensitivity.contact
        share = 100.0 * rms(np.log(self.problem.charges.factor(self.posterior.unknowns, contact)))
        more = next_presses(self.problem, MORE, self.posterior)
        places = ", ".join(f"{press.force_N:.2f} N at ({press.x_mm:g}, {press.y_mm:g}) mm" for press in more[:3])
        yield (
            f"Beyond these parameters, the charges of this film differ by {share:.2g} % (root mean square), "
            f"smoothly over the film: {self.left.position_mm:.2g} mm are left now. {MORE} more presses would reach "
            f"{more[-1].position_mm:.2g} mm, the first of them {places}; --next lists more."
        )
        if self.posterior.probability("traces") > PROBABLE:
            widths = self.problem.charges.trace_widths(self.posterior.unknowns, self.posterior.joint)
            seen = [f"{name} {width:.2g} mm" for name, (width, std) in widths.items() if width > SEEN * std]
            yield (
                f"Most of it is that electrodes collect beyond their pads, as traces to the rim of this width would: "
                f"{', '.join(seen)}. Described in the sensor file, they leave less."
            )


def calibrate(presses: MeasuredPresses, problem: CalibrationProblem) -> CalibrationResult:
    """The film on which presses were made.

    Args:
        presses: In the order in which they were made. With place and force, or one of them; presses without both tell
            how a film has changed since an earlier calibration, if it has more than three electrodes. Uncertain as
            they say.
        problem: The films that it may be.

    Raises:
        PressError: If the presses cannot be what they say, or no film explains them; with the reason where it is found.
    """
    presses = presses.of_electrodes(problem.electrodes, problem.sensor.name)
    check_places(presses, problem.prior.sensor.film.radius)
    check_channels(presses, problem.charges)
    _check_enough_known(presses, problem)
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
    if misfit(presses, problem.charges) > MISLED and find_mistakes(presses, problem.charges):
        raise explain(presses, problem.charges, np.nan)
    at_C = float(temperatures(presses).mean()) if presses.knows_temperature else None
    if at_C is not None:
        problem = replace(problem, earlier=problem.before.at_temperature(at_C, problem.prior))
    data = PressData.of(presses, problem.noise, problem.charges.domain)
    with threadpool_limits(1):  # many small matrices: a second thread only waits
        posterior = fit_film(problem.charges, data, problem.before, at_C)
    _refuse_unexplained(presses, problem, posterior)
    chi2, freedom = posterior.total
    if freedom and scipy.stats.chi2.sf(chi2, freedom) < UNCERTAIN:  # larger errors, by Birge's ratio (1932)
        posterior = posterior.scaled(chi2 / freedom)
        cautions.append(
            f"the presses scatter {np.sqrt(chi2 / freedom):.2g} times as much as noise and rig are said to; the errors "
            "are given larger by this factor: are places and forces as certain as assumed?"
        )
    posterior = _with_unseen_mistakes(posterior, problem.before)
    return CalibrationResult(problem, presses, posterior, (*cautions, *_cautions(presses, problem, posterior)))


def film_without_presses(problem: CalibrationProblem, film: FilmEstimate, moved: str) -> CalibrationResult:
    """Return an estimate of a film as a calibration result without presses.

    Args:
        problem: The calibration.
        film: The estimate.
        moved: How an earlier calibration was moved to another temperature, for people.
    """
    layout = problem.charges.layout
    joint = np.zeros((layout.film_count, layout.film_count))
    estimated = slice(0, len(film.unknowns))
    joint[estimated, estimated] = film.unknown_covariance
    has_coefficients = film.coefficients.size > 0
    posterior = FilmPosterior(
        parameters=film.parameters,
        covariance=film.covariance,
        coefficients=film.coefficients if has_coefficients else np.zeros(layout.coefficient_count),
        joint=joint,
        warming=film.warming and film.warming.with_unknowns(layout.film_count),
        contact=np.empty((0, 3)),
        chi2=np.empty(0),
        freedom=np.empty(0),
        bad=np.empty(0, dtype=bool),
        nuisances={nuisance.name: NuisanceEstimate(0.0, 0.0) for nuisance in NUISANCES},
        scatter=0.0,
        weights={Hypothesis(modes=float(has_coefficients)): 1.0},
    )
    return CalibrationResult(problem, no_presses(problem.electrodes), posterior, moved=moved)


def no_presses(electrodes: tuple[str, ...]) -> MeasuredPresses:
    """What was measured before the first press."""
    none = np.empty(0)
    return MeasuredPresses(np.empty((0, 3)), np.empty((0, len(electrodes))), none, none, electrodes, ())


def _check_enough_known(presses: MeasuredPresses, problem: CalibrationProblem) -> None:
    """Refuse presses without place and force where charges alone tell nothing of the film."""
    if np.isnan(presses.contact).all() and len(problem.electrodes) <= 3:
        raise PressError(
            f"{len(presses)} presses of unknown place and force: three charges are used up by x, y and force, so they "
            "tell nothing of the film; give the place or the force of a press (four electrodes would have one charge "
            "to spare)"
        )


def _lines(presses: MeasuredPresses) -> str:
    listed = ", ".join(map(str, presses.lines[:10]))
    return f"{'line' if len(presses) == 1 else 'lines'} {listed}{', ...' if len(presses) > 10 else ''}"


def _refuse_unexplained(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> None:
    chi2, freedom = posterior.total
    deviation = (posterior.parameters - problem.before.parameters) / problem.prior.std
    strain = float(deviation @ np.linalg.solve(problem.before.covariance, deviation))
    unexplained = freedom > 0.0 and chi2 / freedom > FAR_OFF and scipy.stats.chi2.sf(chi2, freedom) < UNEXPLAINED
    chance = scipy.stats.chi2.sf(strain, deviation.size)
    strange = posterior.imperfect or posterior.bad.any() or chance < ODD
    odd = strange and bool(find_mistakes(presses, problem.charges))  # a few wrong presses may find a strange film
    if unexplained or chance < STRAINED or odd:
        worst = max(chi2 / max(freedom, 1.0), strain / deviation.size)
        raise explain(presses, problem.charges, float(np.sqrt(worst)))


def _with_unseen_mistakes(posterior: FilmPosterior, before: FilmEstimate) -> FilmPosterior:
    """Allow for wrong presses that so few cannot show: with their chance, no more is known than before."""
    good, left_out = int((~posterior.bad).sum()), int(posterior.bad.sum())
    chance = MISTAKEN * (good if good <= FEW else 0) + min(left_out / (good * good), 0.5)
    joint, of_before, count = (1.0 - chance) * posterior.joint, before.unknown_covariance, len(before.unknowns)
    joint[:count, :count] += chance * of_before
    warming, n = posterior.warming, len(before.parameters)
    warming = warming and warming._replace(covariance=(1.0 - chance) * warming.covariance)
    return replace(posterior, joint=joint, covariance=joint[:n, :n], warming=warming)


def _cautions(presses: MeasuredPresses, problem: CalibrationProblem, posterior: FilmPosterior) -> Iterator[str]:
    if posterior.bad.any():
        lines = _lines(presses[posterior.bad])
        yield f"{lines}: left out, since no film fits them and all others; look at them again"
    good = presses[~posterior.bad]
    if len(good) <= FEW:
        yield (
            f"only {len(good)} press{'es' if len(good) > 1 else ''}: a wrong one among so few cannot be seen, and the "
            "errors allow for it; more than three tell far more"
        )
    for nuisance in NUISANCES:
        if posterior.probability(nuisance.name) > PROBABLE:
            yield nuisance.caution(posterior.nuisances[nuisance.name])
    if posterior.probability("scatter") > PROBABLE:
        yield (
            f"forces scatter {100.0 * posterior.scatter:.2g} % about those of the charges, over what they are said to: "
            "are both read at the same moment, or does charge leak in between? What lowers charges at random lowers "
            "them on average as well: the errors allow for as much"
        )
    prior, parameters = problem.prior, posterior.parameters
    low, high = prior.bounds
    held = (parameters < low + EDGE * prior.std) & (low < 0.0) | (parameters > high - EDGE * prior.std)
    if held.any():
        yield (
            f"as far from their description as a film may be: {', '.join(np.array(prior.names)[held])}; the errors may "
            "be larger than is said. Are the sensor file, and the origin and axes of the stage, those of this film?"
        )
    places = good.contact[np.isfinite(good.contact[:, 0]), :2]
    if len(places) > 1 and np.ptp(places, axis=0).max() < CLOSE_MM:
        yield (
            f"all presses lie within {np.ptp(places, axis=0).max():.2g} mm of each other: they cannot tell where the "
            "electrodes are, nor how the film answers elsewhere; press at places spread over the working area"
        )
    if not len(places):
        yield (
            "no place is known: positions will be right only up to the shift and the turn of the electrodes "
            "themselves, and if the charges are in the right columns"
        )
