"""The film that explains measured presses: nonlinear least squares with the prior, robust to bad presses.

The parameters minimise

    sum over presses of  min over its contact of |residuals of charges and rig|^2   +   |(p - mean) / std|^2,

by SciPy's trust region; the contacts are eliminated at every step (variable projection, Golub and Pereyra 1973), so
that only the film's parameters are left. A press whose residual is larger than noise can explain is weighted down by
it (Student's t, Lange et al. 1989), so that one bad press does not move the film; what is then still too far
off is left out and named.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import scipy  # loads a part when it is used
from scipy.optimize import least_squares

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior
from isocharge.train.calibration.contacts import (
    AdjustedContacts,
    adjust_contacts,
    films_of,
    projected,
    search_places,
    sum_over,
    with_force,
)
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.hypotheses import SCATTERS, Hypothesis, Linearised, Mixture, weigh
from isocharge.train.calibration.press_data import NUISANCES, PressData
from isocharge.train.calibration.problem import PER_KELVIN, FilmEstimate, Warming

HEAVY_TAILS = 4.0
"""Degrees of freedom of Student's t by which presses are weighted while bad ones may be among them."""

WEIGHTINGS = 6
"""Rounds of weighting at most."""

BAD = 1e-4
"""Chance that a good press has a larger residual than the one that is called bad, dimensionless."""

DOUBTFUL = 0.01
"""Chance that good presses have larger residuals than these, below which bad ones are looked for."""

LARGEST_BAD_SHARE = 0.34
"""Largest share of presses that may be called bad; beyond it, it is the rest that is wrong."""

FEWEST_TO_JUDGE = 4
"""Fewer presses than this cannot say which of them is bad."""

TOLERANCE = 1e-4
"""Relative change of the sum of squares, or of the parameters, at which a fit ends."""

MOST_STEPS = 25
"""Steps of a fit at most; from the prior's mean it takes eight."""

ROUNDS = 3
"""Fits with the most probable hypothesis of the one before, at most."""

MISTAKEN, SURPRISE = 0.01, -3.0
"""Chance that a press is written wrongly, and the logarithm of the density of each of its charges then, in units of the
noise: anything up to twenty times as far off."""

PROBABLE = 0.5
"""Probability above which something is said to be."""

ONE_SIDED = 1.7
"""Mean of what makes forces scatter, over its standard deviation, as of a share that is uniform from none upwards: what
lowers charges at random, a leak, lowers all of them on average, which presses cannot tell from a gain."""

LINEAR = 0.2
"""Largest step of a parameter, in standard deviations of its prior, for which derivatives are not taken again."""

TINY = 1e-12
"""Derivative of a residual by the force that counts as none."""

MARGIN = 1e-3
"""Distance of a start from the bounds, in standard deviations: the trust region begins inside."""


@dataclass(frozen=True)
class FilmPosterior(FilmEstimate):
    """What presses say of a film.

    Attributes:
        contact: The presses' contacts adjusted to this film, (x, y, F), shape (n, 3), mm and N.
        chi2: Sum of squared residuals of each press, shape (n,); about `freedom` for good ones.
        freedom: Measured numbers beyond three for each press, shape (n,).
        bad: Which presses were left out, shape (n,).
        offset_pC: Common offset of the charges and its standard deviation, pC.
        drift: Drift of the charges from the first press to the last and its standard deviation, a share.
        scatter: Standard deviation of the forces over what they are said to have, a share.
        weights: Probability of each hypothesis of what there is besides a film of the prior.
    """

    contact: Array = field(kw_only=True)
    chi2: Array = field(kw_only=True)
    freedom: Array = field(kw_only=True)
    bad: Booleans = field(kw_only=True)
    offset_pC: tuple[float, float] = field(kw_only=True)
    drift: tuple[float, float] = field(kw_only=True)
    scatter: float = field(kw_only=True)
    weights: dict[Hypothesis, float] = field(kw_only=True)

    @property
    def total(self) -> tuple[float, float]:
        """Sum of squared residuals of the good presses, and their degrees of freedom."""
        return float(self.chi2[~self.bad].sum()), float(self.freedom[~self.bad].sum())

    def scaled(self, factor: float) -> "FilmPosterior":
        """With all variances larger by a factor."""
        warming = self.warming and self.warming._replace(
            std=self.warming.std * float(np.sqrt(factor)), covariance=self.warming.covariance * factor
        )
        return replace(self, covariance=self.covariance * factor, joint=self.joint * factor, warming=warming)

    @property
    def imperfect(self) -> bool:
        """Whether the film probably has what its parameters do not describe."""
        return sum(weight for each, weight in self.weights.items() if each.modes or each.size) > PROBABLE

    def drifted(self, prior: FilmPrior, *, knows_temperature: bool = False) -> FilmEstimate:
        """See `FilmEstimate`; what the film has besides its parameters is known only if it probably has something."""
        if self.imperfect:
            return super().drifted(prior, knows_temperature=knows_temperature)
        warming = self.warming and self.warming.of_unknowns(len(self.parameters))
        known = FilmEstimate(self.parameters, self.covariance, warming=warming)
        return known.drifted(prior, knows_temperature=knows_temperature)

    def probability(self, what: str) -> float:
        """Of the hypotheses with a "size", an "offset", a "drift" or a "scatter"."""
        return sum(weight for hypothesis, weight in self.weights.items() if getattr(hypothesis, what) > 0.0)


def fit_film(charges: FilmCharges, data: PressData, before: FilmEstimate, at_C: float | None = None) -> FilmPosterior:
    """The film that explains presses; `before` is what is known of it without them.

    Args:
        charges: The films.
        data: The presses.
        before: What is known beforehand.
        at_C: Temperature of the film before and after, degrees Celsius, if it is known.
    """
    problem = _Fit.of(charges, before, knows_temperature=at_C is not None)
    keep, freedom = np.ones(len(data), dtype=bool), np.maximum(data.known.sum(axis=1) - 3.0, 0.0)
    solved = problem.solve(data, keep, problem.mean, Hypothesis())
    if len(data) >= FEWEST_TO_JUDGE and _suspicious(solved.contacts.chi2, freedom):
        keep, start = _good_presses(problem, data, solved, freedom)
        solved = problem.solve(data[keep], keep[keep], start, Hypothesis())
    known = problem.settle(data, keep, freedom, solved, Hypothesis())
    if not known.keep.all():  # or is it that the film has what no parameter describes?
        rest = ~known.keep
        surprise = SURPRISE * data.known[rest, :-3].sum() + rest.sum() * np.log(MISTAKEN)
        contacts = problem.adjusted(known.solved.unit, data)
        everything = problem.weigh(data, _Solved(known.solved.unit, contacts))
        if everything.evidence > known.mixture.evidence + surprise:
            known = problem.settle(data, np.ones_like(keep), freedom, known.solved, everything.best)
    keep, mixture = known.keep, known.mixture
    unit = np.clip(problem.mean + mixture.mean, *problem.bounds)
    begin = known.solved.contacts.contact if keep.all() else None
    scatter = float(np.sqrt(sum(weight * each.scatter**2 for each, weight in mixture.weights.items())))
    contacts, n = problem.adjusted(unit, data.scattered(mixture.best.scatter), begin), len(before.parameters)
    nuisances = zip(unit[-NUISANCES:].tolist(), np.sqrt(np.diag(mixture.covariance)[-NUISANCES:]).tolist(), strict=True)
    per_kelvin, offset, drift = nuisances
    drifting = np.zeros(len(unit) - NUISANCES)  # nobody knows what the drift was when the film is used
    drifting[len(SHARED) : n] = np.hypot(np.hypot(*drift) / np.sqrt(12.0), ONE_SIDED * scatter)
    drifting /= charges.prior.spread.gain
    joint = mixture.covariance[:-NUISANCES, :-NUISANCES] + np.outer(drifting, drifting)
    return FilmPosterior(
        parameters=unit[:n] * charges.prior.std,
        covariance=joint[:n, :n],
        coefficients=unit[n:-NUISANCES],
        joint=joint,
        warming=None if at_C is None else Warming(*per_kelvin, at_C, mixture.covariance[-NUISANCES, :-NUISANCES]),
        contact=with_force(contacts.contact),
        chi2=contacts.chi2,
        freedom=freedom,
        bad=~keep,
        offset_pC=offset,
        drift=drift,
        scatter=scatter,
        weights=mixture.weights,
    )


def _suspicious(chi2: Array, freedom: Array) -> bool:
    """Whether a press, or all of them, have larger residuals than noise explains."""
    alone = scipy.stats.chi2.sf(chi2, np.maximum(freedom, 1.0)).min() * len(chi2)
    together = scipy.stats.chi2.sf(chi2.sum(), max(freedom.sum(), 1.0))
    return bool(min(alone, together) < DOUBTFUL)


class _Solved(NamedTuple):
    """A film that explains presses best: its unknowns in units of their scales, and the contacts adjusted to it."""

    unit: Array
    contacts: AdjustedContacts


class _Known(NamedTuple):
    """What is known from the presses that are kept."""

    keep: Booleans
    solved: _Solved
    mixture: Mixture


def _good_presses(problem: "_Fit", data: PressData, solved: _Solved, freedom: Array) -> tuple[Booleans, Array]:
    """Which presses agree with the film that most of them agree on, and that film."""
    weight, (start, adjusted) = np.ones(len(data)), solved
    for _ in range(WEIGHTINGS):
        last, weight = weight, (HEAVY_TAILS + freedom) / (HEAVY_TAILS + adjusted.chi2)
        if np.abs(weight / last - 1.0).max() < 0.1:
            break
        start, adjusted = problem.solve(data, weight, start, Hypothesis())
    freedom = np.maximum(freedom, 1.0)
    scatter = np.median(adjusted.chi2 / np.maximum(scipy.stats.chi2.median(freedom), 0.1))
    keep = adjusted.chi2 <= scipy.stats.chi2.isf(BAD / len(data), freedom) * max(1.0, scatter)
    return (keep if np.mean(~keep) <= LARGEST_BAD_SHARE else np.ones_like(keep)), start


def _within(bounds: tuple[Array, Array], unit: Array, covariance: Array) -> Array:
    """The most probable unknowns within bounds, of a normal distribution: what one gives up, the others make good."""
    for _ in unit:
        beyond = unit - np.clip(unit, *bounds)
        far = int(np.abs(beyond).argmax())
        if abs(beyond[far]) < 1e-9:
            break
        along = covariance[:, far] / covariance[far, far]
        unit, covariance = unit - beyond[far] * along, covariance - np.outer(along, covariance[far])
    return np.clip(unit, *bounds)


@dataclass(frozen=True)
class _Fit:
    """Films, and what is known before the presses.

    The unknowns are parameters over their prior standard deviations, coefficients, offset and drift.

    Attributes:
        charges: The films.
        mean: Of the unknowns before the presses, shape (n_unknown,).
        covariance: Of the unknowns before the presses without a hypothesis, shape (n_unknown, n_unknown).
    """

    charges: FilmCharges
    mean: Array
    covariance: Array

    @classmethod
    def of(cls, charges: FilmCharges, before: FilmEstimate, *, knows_temperature: bool) -> "_Fit":
        """The coefficients are zero, if nothing is known of them; temperature counts if it is known."""
        n, known = len(before.parameters), before.unknowns.size
        size = n + charges.n_coefficient + NUISANCES
        mean, covariance = np.zeros(size), np.zeros((size, size))
        mean[:known] = np.concatenate([before.parameters / charges.prior.std, before.coefficients])
        covariance[:known, :known] = before.of_unknowns
        if knows_temperature and (warming := before.warming):
            mean[-NUISANCES], covariance[-NUISANCES, -NUISANCES] = warming.MPa_per_K, warming.std**2
            covariance[:known, -NUISANCES] = covariance[-NUISANCES, :known] = warming.covariance
        elif knows_temperature:
            covariance[-NUISANCES, -NUISANCES] = PER_KELVIN**2
        return cls(charges, mean, covariance)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Of the unknowns, each of shape (n_unknown,)."""
        prior, free = self.charges.prior, np.full(self.mean.size - len(self.charges.prior.names), np.inf)
        low, high = (bound / prior.std for bound in prior.bounds)
        return np.concatenate([low, -free]), np.concatenate([high, free])

    def _before(self, hypothesis: Hypothesis) -> Array:
        """Covariance of the unknowns before the presses."""
        prior = self.charges.prior
        counts = len(prior.names), len(self.charges.modes), len(prior.sensor.electrodes)
        return self.covariance + hypothesis.covariance(*counts)

    def _film(self, unit: Array) -> Array:
        n = len(self.charges.prior.names)
        return np.concatenate([unit[:n] * self.charges.prior.std, unit[n:-NUISANCES]])

    def adjusted(self, unit: Array, data: PressData, start: Array | None = None) -> AdjustedContacts:
        """The contacts that fit best on a film, searched for from a start."""
        film, data = self._film(unit), data.without(unit[-NUISANCES:])
        begin = search_places(self.charges, film, data) if start is None else start
        return adjust_contacts(self.charges, film, data, begin)

    def slopes(self, unit: Array, data: PressData, contacts: AdjustedContacts, *, coefficients: bool = True) -> Array:
        """Derivatives of the residuals by the unknowns once the contacts follow, (n, n_electrode + 3, n_unknown).

        Those by `coefficients` take time; they are zero if they are not wanted.
        """
        at, n = with_force(contacts.contact), len(self.charges.prior.names)
        films, shares = self._films(unit, data)
        parts = [self.charges.by_contact(film, at) for film in films]
        by_contact, wanted = sum_over(parts, shares), None if coefficients else n
        by_film = sum_over(
            [self.charges.by_parameter(film[:wanted], at, part) for film, part in zip(films, parts, strict=True)],
            shares,
        )
        by_unknown = np.zeros((*data.known.shape, unit.size))
        by_unknown[:, :-3, : by_film.shape[2]] = data.weight[:, :, None] * by_film
        by_unknown[:, :, -NUISANCES] = by_unknown[:, :, 0] * data.warmer[:, None] / self.charges.prior.std[0]
        by_unknown[:, :, 1 - NUISANCES :] = data.by_nuisance()
        return projected(by_unknown, data.slopes(by_contact))

    def _films(self, unit: Array, data: PressData) -> tuple[list[Array], Array]:
        """As `films_of`, of presses as they were made."""
        return films_of(self.charges, self._film(unit), data.without(unit[-NUISANCES:]))

    def solve(self, data: PressData, weight: Array | Booleans, start: Array, hypothesis: Hypothesis) -> _Solved:
        """The film that explains weighted presses best, from a start; what a hypothesis excludes stays."""
        data = data.scattered(hypothesis.scatter)
        covariance, root = self._before(hypothesis), np.sqrt(weight)
        active = np.diag(covariance) > 0.0
        coefficients = bool(active[len(self.charges.prior.names) : -NUISANCES].any())
        of_prior = np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(active, active)]))
        low, high = (bound[active] for bound in self.bounds)
        last: list[tuple[Array, _Solved]] = []

        def solved_at(some: Array) -> _Solved:
            if not last or not np.array_equal(last[-1][0], some):
                unit = self.mean.copy()
                unit[active] = some
                contacts = self.adjusted(unit, data, last[-1][1].contacts.contact if last else None)
                last[:] = [(some.copy(), _Solved(unit, contacts))]
            return last[-1][1]

        def residual(some: Array) -> Array:
            of_presses = solved_at(some).contacts.residual * root[:, None]
            return np.concatenate([of_presses.ravel(), of_prior @ (some - self.mean[active])])

        def jacobian(some: Array) -> Array:
            unit, contacts = solved_at(some)
            rows = self.slopes(unit, data, contacts, coefficients=coefficients)[:, :, active] * root[:, None, None]
            return np.concatenate([rows.reshape(-1, some.size), of_prior])

        begin = np.clip(start[active], low + MARGIN, high - MARGIN)
        tolerance = {"ftol": TOLERANCE, "xtol": TOLERANCE, "max_nfev": MOST_STEPS}
        return solved_at(least_squares(residual, begin, jacobian, (low, high), x_scale=1.0, **tolerance).x)

    def settle(
        self, data: PressData, keep: Booleans, freedom: Array, solved: _Solved, hypothesis: Hypothesis
    ) -> "_Known":
        """Solve and weigh until neither the film nor the presses that fit it change."""
        if hypothesis != Hypothesis():
            solved = self.solve(data[keep], keep[keep], solved.unit, hypothesis)
        for last in range(ROUNDS)[::-1]:
            mixture = self.weigh(data[keep], solved)
            step, readmitted = self.mean + mixture.mean - solved.unit, keep
            if not keep.all():
                readmitted = keep | self.fits(data, solved, mixture, freedom)
            if last == 0 or (
                np.abs(step[: len(self.charges.prior.names)]).max() < LINEAR and (keep == readmitted).all()
            ):
                break
            keep = readmitted
            solved = self.solve(data[keep], keep[keep], solved.unit, mixture.best)
        return _Known(keep, solved, mixture)

    def fits(self, data: PressData, solved: _Solved, mixture: Mixture, freedom: Array) -> Booleans:
        """Which presses are as a film predicts them, with all that is uncertain of it, shape (n,)."""
        data = data.scattered(mixture.best.scatter)
        contacts = self.adjusted(solved.unit, data)
        rows = self.slopes(solved.unit, data, contacts)
        residual = contacts.residual + rows @ (self.mean + mixture.mean - solved.unit)
        expected = np.eye(rows.shape[1]) + rows @ mixture.covariance @ rows.swapaxes(1, 2)
        chi2 = np.einsum("nk,nk->n", residual, np.linalg.solve(expected, residual[:, :, None])[:, :, 0])
        return np.asarray(chi2 <= scipy.stats.chi2.isf(BAD / len(data), np.maximum(freedom, 1.0)))

    def weigh(self, data: PressData, solved: _Solved) -> Mixture:
        """What the presses say of the unknowns, and of the hypotheses."""
        unit = solved.unit
        contacts = self.adjusted(unit, data, solved.contacts.contact)
        jacobian = self.slopes(unit, data, contacts)
        (films, shares), at = self._films(unit, data), with_force(contacts.contact)
        by_contact = sum_over([self.charges.by_contact(film, at) for film in films], shares)
        by_force = projected(data.by_force()[:, :, None], data.slopes(by_contact))[:, :, 0]
        size = np.linalg.norm(by_force, axis=1)
        direction = by_force / np.maximum(size, TINY)[:, None]
        along = np.einsum("nk,nku->nu", direction, jacobian), (direction * contacts.residual).sum(axis=1)
        off = unit - self.mean
        good = Linearised.of(jacobian.reshape(-1, unit.size), contacts.residual.ravel(), off)
        mixture = weigh({each: good.less(*along, off, (each * size) ** 2) for each in SCATTERS}, self._before)
        within = _within(self.bounds, self.mean + mixture.mean, mixture.covariance)
        return mixture._replace(mean=within - self.mean)
