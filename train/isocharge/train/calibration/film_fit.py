"""The film that explains measured presses: nonlinear least squares with the prior, robust to bad presses.

The parameters minimise

    sum over presses of  min over its contact of |residuals of charges and rig|^2   +   |(p - mean) / std|^2,

by SciPy's trust region. The contacts are eliminated at every step (variable projection, Golub and Pereyra 1973), so
that only the film's parameters remain. A press whose residual is larger than noise can explain gets a lower weight
(Student's t, Lange et al. 1989), so that one bad press does not move the film. Presses that are then still too far off
are left out and named.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy  # loads a part when it is used
from scipy.optimize import least_squares

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.calibration.contacts import (
    AdjustedContacts,
    adjust_contacts,
    neighbouring_films,
    projected,
    search_places,
    weighted_sum,
    with_force,
)
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.hypotheses import SCATTERS, Hypothesis, Linearised, Mixture, weigh
from isocharge.train.calibration.nuisances import (
    NUISANCES,
    PRETENSION_PER_KELVIN,
    NuisanceEstimate,
    nuisance_derivatives,
    without_nuisances,
)
from isocharge.train.calibration.press_data import PressData
from isocharge.train.calibration.problem import FilmEstimate, Warming
from isocharge.train.calibration.unknowns import UnknownLayout

HEAVY_TAILS = 4.0
"""Degrees of freedom of Student's t by which presses are weighted while bad ones may be among them."""

MAX_WEIGHTINGS = 6
"""Rounds of weighting at most."""

BAD_PROBABILITY = 1e-4
"""Chance that a good press has a larger residual than the one that is called bad, dimensionless."""

SUSPICIOUS_PROBABILITY = 0.01
"""Chance that good presses have larger residuals than these, below which bad ones are looked for."""

LARGEST_BAD_SHARE = 0.34
"""Largest share of presses that may be called bad; beyond it, it is the rest that is wrong."""

FEWEST_TO_JUDGE = 4
"""Fewer presses than this cannot say which of them is bad."""

TOLERANCE = 1e-4
"""Relative change of the sum of squares, or of the parameters, at which a fit ends."""

MAX_STEPS = 25
"""Steps of a fit at most; from the prior's mean it takes eight."""

MAX_ROUNDS = 3
"""Fits with the most probable hypothesis of the one before, at most."""

MISTAKEN = 0.01
"""Probability that a press is written wrongly."""

LOG_DENSITY_OF_MISTAKE = -3.0
"""Logarithm of the density of each charge of a press that is written wrongly, in units of the noise: anything up to
twenty times as far off."""

PROBABLE = 0.5
"""Probability above which something is said to be."""

ONE_SIDED = 1.7
"""Mean of what makes forces scatter, over its standard deviation, as of a share that is uniform from none upwards: what
lowers charges at random, a leak, lowers all of them on average, which presses cannot tell from a gain."""

LARGEST_LINEAR_STEP = 0.2
"""Largest step of a parameter, in standard deviations of its prior, for which derivatives are not taken again."""

TINY = 1e-12
"""Derivative of a residual by the force that counts as none."""

MARGIN = 1e-3
"""Distance of a start from the bounds, in standard deviations: the trust region begins inside."""


@dataclass(frozen=True)
class FilmPosterior(FilmEstimate):
    """Estimate of a film from presses.

    Attributes:
        contact: Contacts of the presses adjusted to this film, (x, y, F), shape (n, 3), mm and N.
        chi2: Sum of squared residuals of each press, shape (n,); about `freedom` for good ones.
        freedom: Measured numbers beyond three for each press, shape (n,).
        bad: Which presses were left out, shape (n,).
        nuisances: Estimate of each nuisance of the session, by its name.
        scatter: Standard deviation of the forces besides that of the rig, a share.
        weights: Probability of each hypothesis of what there is besides a film of the prior.
    """

    contact: Array = field(kw_only=True)
    chi2: Array = field(kw_only=True)
    freedom: Array = field(kw_only=True)
    bad: Booleans = field(kw_only=True)
    nuisances: dict[str, NuisanceEstimate] = field(kw_only=True)
    scatter: float = field(kw_only=True)
    weights: dict[Hypothesis, float] = field(kw_only=True)

    @property
    def total(self) -> tuple[float, float]:
        """Sum of squared residuals of the good presses, and their degrees of freedom."""
        return float(self.chi2[~self.bad].sum()), float(self.freedom[~self.bad].sum())

    def scaled(self, factor: float) -> "FilmPosterior":
        """Return the estimate with all variances larger by a factor."""
        warming = self.warming
        if warming is not None:
            std = warming.std * float(np.sqrt(factor))
            warming = warming._replace(std=std, covariance=warming.covariance * factor)
        return replace(self, covariance=self.covariance * factor, joint=self.joint * factor, warming=warming)

    @property
    def imperfect(self) -> bool:
        """Whether the film probably has what its parameters do not describe."""
        return sum(weight for each, weight in self.weights.items() if each.modes or each.size) > PROBABLE

    def drifted(self, prior: FilmPrior, *, knows_temperature: bool = False) -> FilmEstimate:
        """Return the estimate after the film may have drifted; see `FilmEstimate`.

        Coefficients are part of it only if the film probably has some.
        """
        if self.imperfect:
            return super().drifted(prior, knows_temperature=knows_temperature)
        warming = self.warming and self.warming.with_unknowns(len(self.parameters))
        estimate = FilmEstimate(self.parameters, self.covariance, warming=warming)
        return estimate.drifted(prior, knows_temperature=knows_temperature)

    def probability(self, cause: str) -> float:
        """Return the probability that the session has a cause; see `Hypothesis.has`."""
        return sum(weight for hypothesis, weight in self.weights.items() if hypothesis.has(cause))


def fit_film(charges: FilmCharges, data: PressData, before: FilmEstimate, at_C: float | None = None) -> FilmPosterior:
    """Return the film that explains presses.

    Args:
        charges: The films.
        data: The presses.
        before: Estimate of the film before the presses.
        at_C: Temperature of the film before and after, degrees Celsius; None if temperatures were not measured.
    """
    problem = _FitProblem.of(charges, before, knows_temperature=at_C is not None)
    freedom = np.maximum(data.measured.sum(axis=1) - 3.0, 0.0)
    every_press = np.ones(len(data), dtype=bool)
    keep = every_press
    solved = problem.solve(data, keep, problem.mean, Hypothesis())
    if len(data) >= FEWEST_TO_JUDGE and _is_suspicious(solved.contacts.chi2, freedom):
        keep, start = _good_presses(problem, data, solved, freedom)
        solved = problem.solve(data[keep], keep[keep], start, Hypothesis())
    settled = problem.settle(data, keep, freedom, solved, Hypothesis())
    if not settled.keep.all():  # perhaps the presses are right, and the film has what no parameter describes
        left_out = ~settled.keep
        log_density = LOG_DENSITY_OF_MISTAKE * data.has_charge[left_out].sum() + left_out.sum() * np.log(MISTAKEN)
        contacts = problem.adjusted(settled.solved.unit, data)
        of_all = problem.weigh(data, _SolvedFilm(settled.solved.unit, contacts))
        if of_all.evidence > settled.mixture.evidence + log_density:
            settled = problem.settle(data, every_press, freedom, settled.solved, of_all.best)
    return _posterior(problem, data, freedom, settled, at_C)


def refit_film(
    charges: FilmCharges, data: PressData, before: FilmEstimate, near: FilmPosterior, at_C: float | None = None
) -> FilmPosterior:
    """Return the film that explains presses, if it is close to a film that is known.

    The search begins at the known film and its most probable hypothesis, so it takes less time than `fit_film`.

    Args:
        charges: The films.
        data: The presses. None of them is left out.
        before: Estimate of the film before the presses.
        near: The known film, which explains most of these presses.
        at_C: Temperature of the film before and after, degrees Celsius; None if temperatures were not measured.
    """
    problem = _FitProblem.of(charges, before, knows_temperature=at_C is not None)
    freedom = np.maximum(data.measured.sum(axis=1) - 3.0, 0.0)
    every_press = np.ones(len(data), dtype=bool)
    hypothesis = max(near.weights, key=lambda each: near.weights[each])
    solved = problem.solve(data, every_press, problem.unit_of(near), hypothesis)
    settled = problem.settle(data, every_press, freedom, solved, Hypothesis())
    return _posterior(problem, data, freedom, settled, at_C)


def _posterior(
    problem: "_FitProblem", data: PressData, freedom: Array, settled: "_SettledFit", at_C: float | None
) -> FilmPosterior:
    """Return the posterior of a fit that has settled."""
    layout = problem.layout
    prior = problem.charges.prior
    mixture = settled.mixture
    unit = np.clip(problem.mean + mixture.mean, *problem.bounds)
    scatter = float(np.sqrt(sum(weight * each.scatter**2 for each, weight in mixture.weights.items())))
    start = settled.solved.contacts.contact if settled.keep.all() else None
    contacts = problem.adjusted(unit, data.with_force_scatter(mixture.best.scatter), start)
    nuisances = _nuisance_estimates(layout, unit, mixture.covariance)
    joint = mixture.covariance[layout.film, layout.film] + problem.gain_covariance(nuisances, scatter)
    warming = None
    if at_C is not None:
        change = nuisances[PRETENSION_PER_KELVIN.name]
        row = layout.nuisance(PRETENSION_PER_KELVIN.name)
        warming = Warming(change.value, change.std, at_C, mixture.covariance[row, layout.film])
    return FilmPosterior(
        parameters=unit[layout.parameters] * prior.std,
        covariance=joint[layout.parameters, layout.parameters],
        coefficients=unit[layout.coefficients],
        joint=joint,
        warming=warming,
        contact=with_force(contacts.contact),
        chi2=contacts.chi2,
        freedom=freedom,
        bad=~settled.keep,
        nuisances=nuisances,
        scatter=scatter,
        weights=mixture.weights,
    )


def _nuisance_estimates(layout: UnknownLayout, unit: Array, covariance: Array) -> dict[str, NuisanceEstimate]:
    """Return value and standard deviation of each nuisance, by its name."""
    values = unit[layout.nuisances].tolist()
    stds = np.sqrt(np.diag(covariance)[layout.nuisances]).tolist()
    return {
        nuisance.name: NuisanceEstimate(value, std)
        for nuisance, value, std in zip(NUISANCES, values, stds, strict=True)
    }


def _is_suspicious(chi2: Array, freedom: Array) -> bool:
    """Return whether a press, or all of them together, have larger residuals than noise explains."""
    worst_press = scipy.stats.chi2.sf(chi2, np.maximum(freedom, 1.0)).min() * len(chi2)
    all_presses = scipy.stats.chi2.sf(chi2.sum(), max(freedom.sum(), 1.0))
    return bool(min(worst_press, all_presses) < SUSPICIOUS_PROBABILITY)


class _SolvedFilm(NamedTuple):
    """The film that explains presses best.

    Attributes:
        unit: Its unknowns, parameters over their prior standard deviations, shape (n_unknown,).
        contacts: The contacts adjusted to it.
    """

    unit: Array
    contacts: AdjustedContacts


class _SettledFit(NamedTuple):
    """A fit in which neither the film nor the presses that fit it change any more.

    Attributes:
        keep: Which presses are kept, shape (n,).
        solved: The film.
        mixture: The estimate over all hypotheses.
    """

    keep: Booleans
    solved: _SolvedFilm
    mixture: Mixture


def _good_presses(
    problem: "_FitProblem", data: PressData, solved: _SolvedFilm, freedom: Array
) -> tuple[Booleans, Array]:
    """Return which presses agree with the film that most of them agree on, and that film."""
    weight = np.ones(len(data))
    for _ in range(MAX_WEIGHTINGS):
        last_weight = weight
        weight = (HEAVY_TAILS + freedom) / (HEAVY_TAILS + solved.contacts.chi2)
        if np.abs(weight / last_weight - 1.0).max() < 0.1:
            break
        solved = problem.solve(data, weight, solved.unit, Hypothesis())
    chi2 = solved.contacts.chi2
    freedom = np.maximum(freedom, 1.0)
    scatter = np.median(chi2 / np.maximum(scipy.stats.chi2.median(freedom), 0.1))
    keep = chi2 <= scipy.stats.chi2.isf(BAD_PROBABILITY / len(data), freedom) * max(1.0, scatter)
    if np.mean(~keep) > LARGEST_BAD_SHARE:
        keep = np.ones_like(keep)
    return keep, solved.unit


def _within_bounds(bounds: tuple[Array, Array], unit: Array, covariance: Array) -> Array:
    """Return the most probable unknowns within bounds, of a normal distribution.

    The unknown that is farthest beyond its bound is moved onto it, and the others follow by their correlation.
    """
    for _ in unit:
        beyond = unit - np.clip(unit, *bounds)
        farthest = int(np.abs(beyond).argmax())
        if abs(beyond[farthest]) < 1e-9:
            break
        regression = covariance[:, farthest] / covariance[farthest, farthest]
        unit = unit - beyond[farthest] * regression
        covariance = covariance - np.outer(regression, covariance[farthest])
    return np.clip(unit, *bounds)


@dataclass(frozen=True)
class _FitProblem:
    """Films, and what is known before the presses.

    Attributes:
        charges: The films.
        mean: Mean of the unknowns before the presses, shape (n_unknown,); parameters over their prior standard
            deviations.
        covariance: Covariance of the unknowns before the presses without a hypothesis, shape (n_unknown, n_unknown).
    """

    charges: FilmCharges
    mean: Array
    covariance: Array

    @classmethod
    def of(cls, charges: FilmCharges, before: FilmEstimate, *, knows_temperature: bool) -> "_FitProblem":
        """Return the problem of a film with this estimate before the presses.

        Coefficients that the estimate does not have are zero. Nuisances of temperature count if it is known.
        """
        layout = charges.layout
        mean = np.zeros(layout.count)
        covariance = np.zeros((layout.count, layout.count))
        mean[layout.parameters] = before.parameters / charges.prior.std
        if before.coefficients.size:
            mean[layout.coefficients] = before.coefficients
        estimated = slice(0, before.unknowns.size)
        covariance[estimated, estimated] = before.unknown_covariance
        if knows_temperature:
            for nuisance in NUISANCES:
                place = layout.nuisance(nuisance.name)
                covariance[place, place] = nuisance.std_with_temperatures**2
        if knows_temperature and before.warming is not None:
            place = layout.nuisance(PRETENSION_PER_KELVIN.name)
            mean[place] = before.warming.MPa_per_K
            covariance[place, place] = before.warming.std**2
            covariance[estimated, place] = before.warming.covariance
            covariance[place, estimated] = before.warming.covariance
        return cls(charges, mean, covariance)

    @property
    def layout(self) -> UnknownLayout:
        """Places of the unknowns."""
        return self.charges.layout

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds of the unknowns, each of shape (n_unknown,); only parameters have some."""
        lower = np.full(self.layout.count, -np.inf)
        upper = np.full(self.layout.count, np.inf)
        parameter_lower, parameter_upper = self.charges.prior.bounds
        lower[self.layout.parameters] = parameter_lower / self.charges.prior.std
        upper[self.layout.parameters] = parameter_upper / self.charges.prior.std
        return lower, upper

    def _prior_covariance(self, hypothesis: Hypothesis) -> Array:
        """Return the covariance of the unknowns before the presses."""
        return self.covariance + hypothesis.covariance(self.layout)

    def unit_of(self, posterior: FilmPosterior) -> Array:
        """Return the unknowns of a film, parameters over their prior standard deviations, shape (n_unknown,)."""
        unit = np.zeros(self.layout.count)
        unit[self.layout.parameters] = posterior.parameters / self.charges.prior.std
        unit[self.layout.coefficients] = posterior.coefficients
        unit[self.layout.nuisances] = [posterior.nuisances[nuisance.name].value for nuisance in NUISANCES]
        return unit

    def _film(self, unit: Array) -> Array:
        """Return the unknowns of the film, as `FilmCharges.film` takes them."""
        film = unit[self.layout.film].copy()
        film[self.layout.parameters] *= self.charges.prior.std
        return film

    def _without_nuisances(self, unit: Array, data: PressData) -> PressData:
        """Return the presses without the session's nuisances."""
        return without_nuisances(data, unit[self.layout.nuisances])

    def gain_covariance(self, nuisances: dict[str, NuisanceEstimate], scatter: float) -> Array:
        """Return what a session adds to the covariance of parameters and coefficients when the film is used later.

        What a drift or a scatter of the forces did to the presses of this session is not known of later presses. It
        acts on all gains alike.
        """
        std = 0.0
        for nuisance in NUISANCES:
            std = float(np.hypot(std, nuisance.gain_std(nuisances[nuisance.name])))
        std = float(np.hypot(std, ONE_SIDED * scatter))
        direction = np.zeros(self.layout.film_count)
        direction[self.charges.prior.gains] = std / self.charges.prior.spread.gain
        return np.outer(direction, direction)

    def adjusted(self, unit: Array, data: PressData, start: Array | None = None) -> AdjustedContacts:
        """Return the contacts that fit best on a film, searched for from a start."""
        film = self._film(unit)
        data = self._without_nuisances(unit, data)
        start = search_places(self.charges, film, data) if start is None else start
        return adjust_contacts(self.charges, film, data, start)

    def slopes(self, unit: Array, data: PressData, contacts: AdjustedContacts, *, coefficients: bool = True) -> Array:
        """Return the derivatives of the residuals by the unknowns once the contacts follow them.

        Args:
            unit: The unknowns, shape (n_unknown,).
            data: The presses.
            contacts: Their contacts on this film.
            coefficients: Whether to compute the derivatives by coefficients, which takes time; they are zero otherwise.

        Returns:
            Shape (n, n_electrode + 3, n_unknown).
        """
        layout = self.layout
        contact = with_force(contacts.contact)
        films, shares = self._neighbouring_films(unit, data)
        by_contact = [self.charges.by_contact(film, contact) for film in films]
        wanted = layout.film if coefficients else layout.parameters
        film_jacobian = weighted_sum(
            [
                self.charges.by_parameter(film[wanted], contact, slopes)
                for film, slopes in zip(films, by_contact, strict=True)
            ],
            shares,
        )
        jacobian = np.zeros((*data.measured.shape, unit.size))
        charge_rows = slice(0, data.charge.shape[1])
        jacobian[:, charge_rows, wanted] = data.weight[:, :, None] * film_jacobian
        pretension = layout.parameter("pretension")
        pretension_derivative = jacobian[:, :, pretension] / self.charges.prior.std[pretension]
        jacobian[:, :, layout.nuisances] = nuisance_derivatives(data, pretension_derivative)
        return projected(jacobian, data.residual_slopes(weighted_sum(by_contact, shares)))

    def _neighbouring_films(self, unit: Array, data: PressData) -> tuple[list[Array], Array]:
        """Return the films between which the presses were made; see `neighbouring_films`."""
        return neighbouring_films(self.charges, self._film(unit), self._without_nuisances(unit, data))

    def solve(self, data: PressData, weight: Array | Booleans, start: Array, hypothesis: Hypothesis) -> _SolvedFilm:
        """Return the film that explains weighted presses best.

        Args:
            data: The presses.
            weight: Weight of each press, shape (n,).
            start: Unknowns from which the search begins.
            hypothesis: What the session may have; unknowns that the hypothesis excludes stay at their mean.
        """
        data = data.with_force_scatter(hypothesis.scatter)
        covariance = self._prior_covariance(hypothesis)
        root_weight = np.sqrt(weight)
        active = np.diag(covariance) > 0.0
        has_coefficients = bool(active[self.layout.coefficients].any())
        whiten_prior = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(active, active)]))
        lower, upper = (bound[active] for bound in self.bounds)
        last: list[tuple[Array, _SolvedFilm]] = []

        def solved_at(active_unknowns: Array) -> _SolvedFilm:
            """Return the film with these unknowns; the last one is kept, since SciPy asks for it twice."""
            if not last or not np.array_equal(last[0][0], active_unknowns):
                unit = self.mean.copy()
                unit[active] = active_unknowns
                start_contacts = last[0][1].contacts.contact if last else None
                contacts = self.adjusted(unit, data, start_contacts)
                last[:] = [(active_unknowns.copy(), _SolvedFilm(unit, contacts))]
            return last[0][1]

        def residual(active_unknowns: Array) -> Array:
            press_residual = solved_at(active_unknowns).contacts.residual * root_weight[:, None]
            prior_residual = whiten_prior @ (active_unknowns - self.mean[active])
            return np.concatenate([press_residual.ravel(), prior_residual])

        def jacobian(active_unknowns: Array) -> Array:
            unit, contacts = solved_at(active_unknowns)
            slopes = self.slopes(unit, data, contacts, coefficients=has_coefficients)
            press_rows = slopes[:, :, active] * root_weight[:, None, None]
            return np.concatenate([press_rows.reshape(-1, active_unknowns.size), whiten_prior])

        result = least_squares(
            residual,
            np.clip(start[active], lower + MARGIN, upper - MARGIN),
            jacobian,
            (lower, upper),
            x_scale=1.0,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            max_nfev=MAX_STEPS,
        )
        return solved_at(result.x)

    def settle(
        self, data: PressData, keep: Booleans, freedom: Array, solved: _SolvedFilm, hypothesis: Hypothesis
    ) -> _SettledFit:
        """Solve and weigh until neither the film nor the presses that fit it change."""
        if hypothesis != Hypothesis():
            solved = self.solve(data[keep], keep[keep], solved.unit, hypothesis)
        for remaining_rounds in reversed(range(MAX_ROUNDS)):
            mixture = self.weigh(data[keep], solved)
            step = self.mean + mixture.mean - solved.unit
            readmitted = keep
            if not keep.all():
                readmitted = keep | self.fits(data, solved, mixture, freedom)
            is_linear = np.abs(step[self.layout.parameters]).max() < LARGEST_LINEAR_STEP
            if remaining_rounds == 0 or (is_linear and (keep == readmitted).all()):
                break
            keep = readmitted
            solved = self.solve(data[keep], keep[keep], solved.unit, mixture.best)
        return _SettledFit(keep, solved, mixture)

    def fits(self, data: PressData, solved: _SolvedFilm, mixture: Mixture, freedom: Array) -> Booleans:
        """Return which presses are as a film predicts them, with all uncertainty of the film, shape (n,)."""
        data = data.with_force_scatter(mixture.best.scatter)
        contacts = self.adjusted(solved.unit, data)
        jacobian = self.slopes(solved.unit, data, contacts)
        residual = contacts.residual + jacobian @ (self.mean + mixture.mean - solved.unit)
        covariance = np.eye(jacobian.shape[1]) + jacobian @ mixture.covariance @ jacobian.swapaxes(1, 2)
        chi2 = np.einsum("nk,nk->n", residual, np.linalg.solve(covariance, residual[:, :, None])[:, :, 0])
        limit = scipy.stats.chi2.isf(BAD_PROBABILITY / len(data), np.maximum(freedom, 1.0))
        return np.asarray(chi2 <= limit)

    def weigh(self, data: PressData, solved: _SolvedFilm) -> Mixture:
        """Return the estimate of the unknowns from the presses, over all hypotheses."""
        unit = solved.unit
        contacts = self.adjusted(unit, data, solved.contacts.contact)
        jacobian = self.slopes(unit, data, contacts)
        films, shares = self._neighbouring_films(unit, data)
        contact = with_force(contacts.contact)
        by_contact = weighted_sum([self.charges.by_contact(film, contact) for film in films], shares)
        force_slopes = projected(data.force_derivative()[:, :, None], data.residual_slopes(by_contact))[:, :, 0]
        size = np.linalg.norm(force_slopes, axis=1)
        direction = force_slopes / np.maximum(size, TINY)[:, None]
        jacobian_along = np.einsum("nk,nku->nu", direction, jacobian)
        residual_along = (direction * contacts.residual).sum(axis=1)
        from_mean = unit - self.mean
        without_scatter = Linearised.of(jacobian.reshape(-1, unit.size), contacts.residual.ravel(), from_mean)
        linearised = {
            scatter: without_scatter.less(jacobian_along, residual_along, from_mean, (scatter * size) ** 2)
            for scatter in SCATTERS
        }
        mixture = weigh(linearised, self._prior_covariance)
        bounded = _within_bounds(self.bounds, self.mean + mixture.mean, mixture.covariance)
        return mixture._replace(mean=bounded - self.mean)
