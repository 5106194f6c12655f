"""The film that explains measured presses: nonlinear least squares with the prior, robust to bad presses.

The parameters minimise

    sum over presses of  min over its contact of |residuals of charges and rig|^2   +   |(p - mean) / std|^2,

by SciPy's trust region; the contacts are eliminated at every step (variable projection, Golub and Pereyra 1973), so
that only the film's parameters are left. A press whose residual is larger than noise can explain is weighted down by
it (Student's t, Lange et al. 1989), so that one bad press does not move the film; what is then still too far
off is left out and named.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from isocharge.common.arrays import Array, Booleans
from isocharge.train.calibration.contacts import (
    AdjustedContacts,
    PressData,
    adjust_contacts,
    projected,
    search_places,
    with_force,
)
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.problem import FilmEstimate

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
    """

    contact: Array
    chi2: Array
    freedom: Array
    bad: Booleans

    @property
    def total(self) -> tuple[float, float]:
        """Sum of squared residuals of the good presses, and their degrees of freedom."""
        return float(self.chi2[~self.bad].sum()), float(self.freedom[~self.bad].sum())


def fit_film(charges: FilmCharges, data: PressData, before: FilmEstimate) -> FilmPosterior:
    """The film that explains presses; `before` is what is known of it without them."""
    keep, freedom = np.ones(len(data), dtype=bool), np.maximum(data.known.sum(axis=1) - 3.0, 0.0)
    film, adjusted = _solve(charges, before, data, keep, before.parameters)
    if len(data) >= FEWEST_TO_JUDGE and _suspicious(adjusted.chi2, freedom):
        keep, start = _good_presses(charges, before, data, film.parameters, adjusted.chi2, freedom)
        film, _ = _solve(charges, before, data[keep], keep[keep], start)
        adjusted = adjust_contacts(charges, film.parameters, data, search_places(charges, film.parameters, data))
    contact = with_force(adjusted.contact)
    return FilmPosterior(film.parameters, film.covariance, contact, adjusted.chi2, freedom, ~keep)


def _suspicious(chi2: Array, freedom: Array) -> bool:
    """Whether a press, or all of them, have larger residuals than noise explains."""
    alone = chi2_distribution.sf(chi2, np.maximum(freedom, 1.0)).min() * len(chi2)
    together = chi2_distribution.sf(chi2.sum(), max(freedom.sum(), 1.0))
    return bool(min(alone, together) < DOUBTFUL)


def _good_presses(
    charges: FilmCharges, before: FilmEstimate, data: PressData, start: Array, chi2: Array, freedom: Array
) -> tuple[Booleans, Array]:
    """Which presses agree with the film that most of them agree on, and that film."""
    weight = np.ones(len(data))
    for _ in range(WEIGHTINGS):
        last, weight = weight, (HEAVY_TAILS + freedom) / (HEAVY_TAILS + chi2)
        if np.abs(weight / last - 1.0).max() < 0.1:
            break
        film, adjusted = _solve(charges, before, data, weight, start)
        start, chi2 = film.parameters, adjusted.chi2
    freedom = np.maximum(freedom, 1.0)
    scatter = np.median(chi2 / np.maximum(chi2_distribution.median(freedom), 0.1))
    keep = chi2 <= chi2_distribution.isf(BAD / len(data), freedom) * max(1.0, scatter)
    return (keep if np.mean(~keep) <= LARGEST_BAD_SHARE else np.ones_like(keep)), start


def _solve(
    charges: FilmCharges, before: FilmEstimate, data: PressData, weight: Array | Booleans, start: Array
) -> tuple[FilmEstimate, AdjustedContacts]:
    """The film that explains weighted presses best, from a start, and the contacts adjusted to it."""
    std, root = charges.prior.std, np.sqrt(weight)
    low, high = (bound / std for bound in charges.prior.bounds)
    of_prior, place = np.linalg.inv(np.linalg.cholesky(before.covariance)), search_places(charges, start, data)
    last: list[tuple[Array, AdjustedContacts]] = []

    def adjusted_at(unit: Array) -> AdjustedContacts:
        if not last or not np.array_equal(last[-1][0], unit):
            begin = last[-1][1].contact if last else place
            last[:] = [(unit.copy(), adjust_contacts(charges, unit * std, data, begin))]
        return last[-1][1]

    def residual(unit: Array) -> Array:
        of_presses = adjusted_at(unit).residual * root[:, None]
        return np.concatenate([of_presses.ravel(), of_prior @ (unit - before.parameters / std)])

    def jacobian(unit: Array) -> Array:
        at = with_force(adjusted_at(unit).contact)
        by_contact = charges.by_contact(unit * std, at)
        of_charge = data.weight[:, :, None] * charges.by_parameter(unit * std, at, by_contact)
        by_parameter = np.concatenate([of_charge, np.zeros((len(data), 3, unit.size))], axis=1)
        rows = projected(by_parameter, data.slopes(by_contact)) * root[:, None, None]
        return np.concatenate([rows.reshape(-1, unit.size), of_prior])

    start = np.clip(start / std, low + MARGIN, high - MARGIN)
    bounds, tolerance = (low, high), {"ftol": TOLERANCE, "xtol": TOLERANCE}
    result = least_squares(residual, start, jacobian, bounds, x_scale=1.0, max_nfev=MOST_STEPS, **tolerance)
    covariance = np.linalg.inv(result.jac.T @ result.jac).astype(float)
    return FilmEstimate(result.x * std, covariance), adjusted_at(result.x)
