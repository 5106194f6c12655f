"""The film that explains measured presses: nonlinear least squares with the prior, robust to bad presses.

The parameters minimise

    sum over presses of  min over its contact of |misses of charges and rig|^2   +   |(p - mean) / std|^2,

by SciPy's trust region; the contacts are eliminated at every step (variable projection, Golub and Pereyra 1973), so
that only the film's parameters are left. A press that misses by more than noise can explain is weighted down by its own
miss (Student's t, Lange et al. 1989), so that one bad press does not move the film; what is then still too far
off is left out and named.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from isocharge.common.arrays import Array, Booleans
from isocharge.train.calibration.contacts import AdjustedContacts, RigData, adjust_contacts, search_places, with_slopes
from isocharge.train.calibration.film_charges import FilmCharges

HEAVY_TAILS = 4.0
"""Degrees of freedom of Student's t by which presses are weighted while bad ones may be among them."""

WEIGHTINGS = 6
"""Rounds of weighting at most."""

BAD = 1e-4
"""Chance that a good press misses by more than the one that is called bad, dimensionless."""

DOUBTFUL = 0.01
"""Chance that good presses miss by more than these, below which bad ones are looked for."""

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
class FilmPosterior:
    """What presses say of a film: mean and covariance of a Gaussian about the best parameters.

    Attributes:
        parameters: The best, shape (n_parameter,), as `FilmPrior` has them.
        covariance: Of the parameters over their prior standard deviations, shape (n_parameter, n_parameter).
        contact: The presses' contacts adjusted to this film, (x_mm, y_mm, force_N), shape (n, 3).
        chi2: Sum of squared misses of each press, shape (n,); about `freedom` for good ones.
        freedom: Measured numbers beyond three for each press, shape (n,).
        bad: Which presses were left out, shape (n,).
        evaluations: Calls of the residual function.
    """

    parameters: Array
    covariance: Array
    contact: Array
    chi2: Array
    freedom: Array
    bad: Booleans
    evaluations: int


def fit_film(
    charges: FilmCharges, data: RigData, mean: Array | None = None, covariance: Array | None = None
) -> FilmPosterior:
    """The film that explains presses.

    Args:
        charges: The films.
        data: The presses.
        mean: Of the prior, shape (n_parameter,); that of `charges.prior` if absent, an earlier calibration otherwise.
        covariance: Of the prior, of parameters over their prior standard deviations; the identity if absent.
    """
    prior = charges.prior
    problem = _Problem(charges, prior.mean if mean is None else mean, _root_information(covariance, len(prior.names)))
    freedom = np.maximum(data.known.sum(axis=1) - 3.0, 0.0)
    best, adjusted, evaluations = problem.solve(data, np.ones(len(data)), problem.mean)
    keep = np.ones(len(data), dtype=bool)
    if len(data) >= FEWEST_TO_JUDGE and _suspicious(adjusted.chi2, freedom):
        keep, start, used = _good_presses(problem, data, best, adjusted.chi2, freedom)
        best, _, again = problem.solve(data[keep], np.ones(int(keep.sum())), start)
        adjusted = adjust_contacts(charges, best, data, search_places(charges, best, data))
        evaluations += used + again
    jacobian = problem.jacobian(best, data[keep], np.ones(int(keep.sum())))
    inverse: Array = np.linalg.inv(jacobian.T @ jacobian).astype(float)
    return FilmPosterior(
        parameters=best,
        covariance=inverse,
        contact=np.column_stack([adjusted.contact[:, :2], np.exp(adjusted.contact[:, 2])]),
        chi2=adjusted.chi2,
        freedom=freedom,
        bad=~keep,
        evaluations=evaluations,
    )


def _suspicious(chi2: Array, freedom: Array) -> bool:
    """Whether a press, or all of them, miss by more than noise explains."""
    alone = chi2_distribution.sf(chi2, np.maximum(freedom, 1.0)).min() * len(chi2)
    together = chi2_distribution.sf(chi2.sum(), max(freedom.sum(), 1.0))
    return bool(min(alone, together) < DOUBTFUL)


def _good_presses(
    problem: "_Problem", data: RigData, start: Array, chi2: Array, freedom: Array
) -> tuple[Booleans, Array, int]:
    """Which presses agree with the film that most of them agree on, that film, and the evaluations it took."""
    weight, evaluations = np.ones(len(data)), 0
    for _ in range(WEIGHTINGS):
        before, weight = weight, (HEAVY_TAILS + freedom) / (HEAVY_TAILS + chi2)
        if np.abs(weight / before - 1.0).max() < 0.1:
            break
        start, adjusted, used = problem.solve(data, weight, start)
        chi2, evaluations = adjusted.chi2, evaluations + used
    limit = chi2_distribution.isf(BAD / len(data), np.maximum(freedom, 1.0))
    keep = chi2 <= limit * _scatter(chi2, freedom)
    if np.mean(~keep) > LARGEST_BAD_SHARE:
        keep[:] = True
    return keep, start, evaluations


def _scatter(chi2: Array, freedom: Array) -> float:
    """Variance of the misses over that of the noise, from the middle of the presses; at least one."""
    spread = np.median(chi2 / np.maximum(chi2_distribution.median(np.maximum(freedom, 1.0)), 0.1))
    return max(1.0, float(spread))


def _root_information(covariance: Array | None, count: int) -> Array:
    """Matrix L with L' L the inverse of a covariance, shape (count, count)."""
    if covariance is None:
        return np.eye(count)
    root: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return root


@dataclass
class _Problem:
    """Least squares over the parameters, with the last contacts at hand."""

    charges: FilmCharges
    mean: Array
    root: Array

    def solve(self, data: RigData, weight: Array, start: Array) -> tuple[Array, AdjustedContacts, int]:
        """The best parameters from a start, the contacts adjusted to them, and the number of evaluations."""
        prior = self.charges.prior
        low, high = (bound / prior.std for bound in prior.bounds)
        place = search_places(self.charges, start, data)
        last: list[tuple[Array, AdjustedContacts]] = []

        def adjusted_at(unit: Array) -> AdjustedContacts:
            if not last or not np.array_equal(last[-1][0], unit):
                begin = last[-1][1] if last else place
                last[:] = [(unit.copy(), adjust_contacts(self.charges, unit * prior.std, data, begin))]
            return last[-1][1]

        def residual(unit: Array) -> Array:
            misses = adjusted_at(unit).residual * np.sqrt(weight)[:, None]
            return np.concatenate([misses.ravel(), self.root @ (unit - self.mean / prior.std)])

        def jacobian(unit: Array) -> Array:
            return self.jacobian(unit * prior.std, data, weight, adjusted_at(unit))

        result = least_squares(
            residual,
            np.clip(start / prior.std, low + MARGIN, high - MARGIN),
            jac=jacobian,
            bounds=(low, high),
            x_scale=1.0,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            max_nfev=MOST_STEPS,
        )
        return result.x * prior.std, adjusted_at(result.x), int(result.nfev)

    def jacobian(
        self, parameters: Array, data: RigData, weight: Array, adjusted: AdjustedContacts | None = None
    ) -> Array:
        """Derivatives of the residual by the parameters over their prior standard deviations."""
        charges = self.charges
        if adjusted is None:
            adjusted = adjust_contacts(charges, parameters, data, search_places(charges, parameters, data))
        at = np.column_stack([adjusted.contact[:, :2], np.exp(adjusted.contact[:, 2])])
        by_contact = charges.by_contact(charges.forward_map(parameters), at)
        by_charge = data.weight[:, :, None] * charges.by_parameter(parameters, at, by_contact)
        by_parameter = np.concatenate([by_charge, np.zeros((len(data), 3, parameters.size))], axis=1)
        rows = with_slopes(adjusted, data, by_contact).projected(by_parameter) * np.sqrt(weight)[:, None, None]
        return np.concatenate([rows.reshape(-1, parameters.size), self.root])
