"""Hypotheses of what a session had besides a film of the prior, weighed by how well each predicts the presses.

A film may have modes of imperfections, a discrepancy of some size and traces that are not described. A session may have
nuisances, and forces that scatter. Every combination is a hypothesis, and so are traces in a session without any of
these. The presses weigh them by the evidence of a linear Gaussian model (MacKay 1992), and the estimate is the mixture.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.special import logsumexp

from isocharge.common.arrays import Array, Booleans
from isocharge.train.calibration.discrepancy import COMMON, term_count
from isocharge.train.calibration.nuisances import NUISANCES
from isocharge.train.calibration.unknowns import UnknownLayout

IMPERFECT = {0.0: 0.5, 1.0: 0.5}
"""Sizes of the modes of imperfections that are weighed, with what each is believed to beforehand."""

SIZES = {0.0: 0.5, 0.003: 0.1, 0.01: 0.15, 0.03: 0.15, 0.1: 0.1}
"""Sizes s that are weighed, dimensionless, with what each is believed to beforehand."""

TRACED = 0.01
"""Probability beforehand of traces that collect and are not described."""

SCATTERS = {0.0: 0.95, 0.03: 0.03, 0.1: 0.02}
"""The same for the standard deviation of a press's force about the one that its charges show, a share, over what the
rig is said to have."""


NO_WEIGHT = 1e-7
"""Largest probability of a hypothesis whose answer does not count."""


@dataclass(frozen=True)
class Hypothesis:
    """What a session may have had besides a film of the prior.

    Attributes:
        modes: Size of the modes of imperfections over what films have, dimensionless.
        size: Size of the discrepancy, dimensionless.
        nuisance_stds: Standard deviation of each nuisance before the presses, in its unit, in the order of `NUISANCES`;
            without one that temperatures bring along.
        scatter: Standard deviation of the stated forces besides that of the rig, a share.
        belief: Probability before the presses.
        traces: Size of the traces that are not described over what films have, dimensionless.
    """

    modes: float = 0.0
    size: float = 0.0
    nuisance_stds: tuple[float, ...] = (0.0,) * len(NUISANCES)
    scatter: float = 0.0
    belief: float = 1.0
    traces: float = 0.0

    def covariance(self, layout: UnknownLayout) -> Array:
        """Return what the hypothesis adds to the covariance of the unknowns, shape (n_unknown, n_unknown)."""
        electrode_count = len(layout.electrode_names)
        electrode_covariance = np.eye(electrode_count) + COMMON**2
        variance = np.zeros(layout.count)
        variance[layout.modes] = self.modes**2
        variance[layout.traces] = self.traces**2
        variance[layout.nuisances] = np.square(self.nuisance_stds)
        covariance = np.diag(variance)
        covariance[layout.terms, layout.terms] = self.size**2 * np.kron(np.eye(term_count()), electrode_covariance)
        return covariance

    def has(self, cause: str) -> bool:
        """Return whether the session has a cause: "modes", "size", "traces", "scatter", or the name of a nuisance."""
        names = [nuisance.name for nuisance in NUISANCES]
        sizes = dict(zip(names, self.nuisance_stds, strict=True))
        sizes.update(modes=self.modes, size=self.size, traces=self.traces, scatter=self.scatter)
        return sizes[cause] > 0.0


def hypotheses() -> Iterator[Hypothesis]:
    """Yield all hypotheses that are weighed."""
    nuisance_probabilities = [nuisance.probabilities for nuisance in NUISANCES]
    for chosen in product(IMPERFECT.items(), SIZES.items(), *nuisance_probabilities, SCATTERS.items()):
        modes_size, terms_size, *nuisance_stds, scatter_std = [std for std, _ in chosen]
        if modes_size > 0.0 and terms_size == 0.0:
            continue  # the modes are computed to first order, so that they never explain everything
        yield Hypothesis(
            modes=modes_size,
            size=terms_size,
            nuisance_stds=tuple(nuisance_stds),
            scatter=scatter_std,
            belief=math.prod(probability for _, probability in chosen),
        )
    for size_of_terms, belief in SIZES.items():
        if size_of_terms > 0.0:
            yield Hypothesis(modes=1.0, size=size_of_terms, belief=TRACED * belief, traces=1.0)


class Linearised(NamedTuple):
    """Residuals of presses about a film, linear in the unknowns: |r|^2 = square + 2 moment u + u normal u.

    The logarithm of the determinant of the residuals' covariance is part of the square.

    Attributes:
        normal: Shape (n_unknown, n_unknown).
        moment: Shape (n_unknown,).
        square: Value at the mean of the unknowns before the presses, u = 0.
    """

    normal: Array
    moment: Array
    square: float

    @classmethod
    def of(cls, jacobian: Array, residual: Array, at: Array) -> "Linearised":
        """Return the expansion of a residual with its derivatives at unknowns that differ by `at` from their mean."""
        residual_at_mean = residual - jacobian @ at
        return cls(
            normal=jacobian.T @ jacobian,
            moment=jacobian.T @ residual_at_mean,
            square=float(residual_at_mean @ residual_at_mean),
        )

    def less(self, jacobian: Array, residual: Array, at: Array, variance: Array) -> "Linearised":
        """Return the expansion for residuals that have more noise, along directions at right angles to each other.

        Args:
            jacobian: Derivatives along each direction, shape (n, n_unknown).
            residual: Residual along each direction, shape (n,).
            at: Unknowns less their mean, as in `of`, shape (n_unknown,).
            variance: Variance of the noise that comes in along each direction, over the residual's, shape (n,).
        """
        share = np.sqrt(variance / (1.0 + variance))
        removed = Linearised.of(share[:, None] * jacobian, share * residual, at)
        log_determinant = float(np.log1p(variance).sum())
        return Linearised(
            normal=self.normal - removed.normal,
            moment=self.moment - removed.moment,
            square=self.square - removed.square + log_determinant,
        )

    def evidence(self, covariance: Array) -> float:
        """Return the logarithm of the evidence for a covariance of the unknowns before the presses."""
        solved = self._solve(covariance)
        reduction = solved.pull @ solved.step
        return float(-0.5 * (self.square - reduction) - np.log(np.diag(solved.factor)).sum())

    def given(self, covariance: Array) -> tuple[Array, Array]:
        """Return mean and covariance of the unknowns after the presses, for a covariance before them."""
        solved = self._solve(covariance)
        active = solved.active
        mean = np.zeros(len(active))
        mean[active] = -solved.root @ solved.step
        posterior_covariance = np.zeros_like(covariance)
        posterior_covariance[np.ix_(active, active)] = solved.root @ cho_solve((solved.factor, True), solved.root.T)
        return mean, posterior_covariance

    def _solve(self, covariance: Array) -> "_Solution":
        """Solve the normal equations of the unknowns that have a variance before the presses."""
        active = np.diag(covariance) > 0.0
        active_block = np.ix_(active, active)
        root = np.asarray(np.linalg.cholesky(covariance[active_block]), np.float64)
        posterior_precision = np.eye(len(root)) + root.T @ self.normal[active_block] @ root
        factor = np.asarray(np.linalg.cholesky(posterior_precision), np.float64)
        pull = root.T @ self.moment[active]
        return _Solution(active, root, factor, pull, step=cho_solve((factor, True), pull))


class _Solution(NamedTuple):
    """Solved normal equations of the unknowns in units of the root of their covariance.

    Attributes:
        active: Which unknowns have a variance before the presses, shape (n_unknown,).
        root: Cholesky factor of their covariance before the presses.
        factor: Cholesky factor of their precision after the presses.
        pull: Moment of the residuals in these units.
        step: The precision's inverse times the pull.
    """

    active: Booleans
    root: Array
    factor: Array
    pull: Array
    step: Array


class Mixture(NamedTuple):
    """Estimate of the unknowns over all hypotheses.

    Attributes:
        mean: Mean less the mean before the presses, shape (n_unknown,).
        covariance: Covariance, shape (n_unknown, n_unknown).
        weights: Probability of each hypothesis.
        evidence: Logarithm of the presses' probability density, over that of presses without any residual.
    """

    mean: Array
    covariance: Array
    weights: dict[Hypothesis, float]
    evidence: float

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return max(self.weights, key=lambda hypothesis: self.weights[hypothesis])


def weigh(
    linearised: Mapping[float, Linearised],
    prior_covariance: Callable[[Hypothesis], Array],
    tried: Iterable[Hypothesis] | None = None,
) -> Mixture:
    """Return the mixture of hypotheses.

    Args:
        linearised: The expansion of the presses' residuals by the scatter of their forces.
        prior_covariance: Function that returns the covariance of the unknowns before the presses by a hypothesis.
        tried: The hypotheses; all if absent.
    """
    tried = list(tried or hypotheses())
    log_weights = np.array(
        [linearised[each.scatter].evidence(prior_covariance(each)) + np.log(each.belief) for each in tried]
    )
    evidence = float(logsumexp(log_weights))
    weights = np.exp(log_weights - evidence)
    counted = np.flatnonzero(weights > NO_WEIGHT)
    answers = [linearised[tried[i].scatter].given(prior_covariance(tried[i])) for i in counted]
    mean = np.einsum("h,hp->p", weights[counted], [answer_mean for answer_mean, _ in answers])
    covariance = sum(
        weight * (answer_covariance + np.outer(answer_mean - mean, answer_mean - mean))
        for weight, (answer_mean, answer_covariance) in zip(weights[counted], answers, strict=True)
    )
    return Mixture(mean, np.asarray(covariance), dict(zip(tried, weights.tolist(), strict=True)), evidence)
