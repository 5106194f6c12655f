"""Hypotheses of what a session had besides a film of the prior, and the mixture of what they say."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_solve
from scipy.special import logsumexp

from isocharge.common.arrays import Array, Booleans
from isocharge.train.calibration.discrepancy import COMMON, TRACE_ANGLES, term_count

IMPERFECT = {0.0: 0.5, 1.0: 0.5}
"""Sizes of the modes of imperfections that are weighed, with what each is believed to beforehand."""

SIZES = {0.0: 0.5, 0.003: 0.1, 0.01: 0.15, 0.03: 0.15, 0.1: 0.1}
"""Sizes s that are weighed, dimensionless, with what each is believed to beforehand."""

TRACED = 0.01
"""Probability beforehand of traces that collect and are not described."""

OFFSETS_PC = {0.0: 0.9, 30.0: 0.1}
"""The same for the standard deviation of a common offset of all charges, pC."""

DRIFTS = {0.0: 0.95, 0.15: 0.05}
"""The same for the standard deviation of a drift of all charges from the first press to the last, a share."""

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
        size: Of the discrepancy, dimensionless.
        offset: Standard deviation of a common offset of the charges, pC.
        drift: Standard deviation of a drift of the charges, a share.
        scatter: Standard deviation of stated forces besides what they are said to have, a share.
        belief: Probability before the presses.
        traces: Size of the traces that are not described over what films have, dimensionless.
    """

    modes: float = 0.0
    size: float = 0.0
    offset: float = 0.0
    drift: float = 0.0
    scatter: float = 0.0
    belief: float = 1.0
    traces: float = 0.0

    def covariance(self, n_parameter: int, n_mode: int, n_electrode: int) -> Array:
        """What it adds to the covariance of parameters, coefficients and `NUISANCES`, (n_unknown, n_unknown)."""
        together = np.eye(n_electrode) + COMMON**2
        of_terms = self.size**2 * np.kron(np.eye(term_count()), together)
        known, of_modes = np.zeros((n_parameter, n_parameter)), self.modes**2 * np.eye(n_mode)
        of_traces = self.traces**2 * np.eye(n_electrode * len(TRACE_ANGLES))
        return np.asarray(block_diag(known, of_modes, of_traces, of_terms, 0.0, self.offset**2, self.drift**2))


def hypotheses() -> Iterator[Hypothesis]:
    """All that are weighed."""
    for (modes, a), (size, b), (offset, c), (drift, d), (scatter, e) in product(
        IMPERFECT.items(), SIZES.items(), OFFSETS_PC.items(), DRIFTS.items(), SCATTERS.items()
    ):
        if modes == 0.0 or size > 0.0:  # to first order modes are never the whole
            yield Hypothesis(modes, size, offset, drift, scatter, a * b * c * d * e)
    for size, belief in SIZES.items():
        if size > 0.0:
            yield Hypothesis(modes=1.0, size=size, belief=TRACED * belief, traces=1.0)


class Linearised(NamedTuple):
    """Residuals of presses about a film, linear in the unknowns: |r|^2 = square + 2 moment u + u normal u.

    The logarithm of the determinant of the residuals' covariance is part of the square.

    Attributes:
        normal: Shape (n_unknown, n_unknown).
        moment: Shape (n_unknown,).
        square: At the mean of the unknowns before the presses, u = 0.
    """

    normal: Array
    moment: Array
    square: float

    @classmethod
    def of(cls, jacobian: Array, residual: Array, at: Array) -> "Linearised":
        """From a residual and its derivatives at unknowns that differ by `at` from their mean."""
        at_mean = residual - jacobian @ at
        return cls(jacobian.T @ jacobian, jacobian.T @ at_mean, float(at_mean @ at_mean))

    def less(self, jacobian: Array, residual: Array, at: Array, variance: Array) -> "Linearised":
        """With residuals that have more noise, along directions at right angles to each other.

        Args:
            jacobian: Derivatives along each direction, shape (n, n_unknown).
            residual: Along each, shape (n,).
            at: As in `of`, shape (n_unknown,).
            variance: Of the noise that comes in along each, over the residual's, shape (n,).
        """
        share = np.sqrt(variance / (1.0 + variance))
        own = Linearised.of(share[:, None] * jacobian, share * residual, at)
        square = self.square - own.square + float(np.log1p(variance).sum())
        return Linearised(self.normal - own.normal, self.moment - own.moment, square)

    def evidence(self, covariance: Array) -> float:
        """Logarithm of the evidence for a covariance of the unknowns before the presses."""
        _, _, factor, (pull, step) = self._solved(covariance)
        return float(-0.5 * (self.square - pull @ step) - np.log(np.diag(factor)).sum())

    def given(self, covariance: Array) -> tuple[Array, Array]:
        """Mean and covariance of the unknowns, for a covariance before the presses."""
        active, root, factor, (_, step) = self._solved(covariance)
        mean, after = np.zeros(len(active)), np.zeros_like(covariance)
        mean[active], after[np.ix_(active, active)] = -root @ step, root @ cho_solve((factor, True), root.T)
        return mean, after

    def _solved(self, covariance: Array) -> tuple[Booleans, Array, Array, tuple[Array, Array]]:
        """Which unknowns are not known before, the root of their covariance, that of 1 + root' normal root, and the
        moment as root' moment, before and after a division by this."""
        active = np.diag(covariance) > 0.0
        wide = np.ix_(active, active)
        root = np.asarray(np.linalg.cholesky(covariance[wide]), np.float64)
        factor = np.asarray(np.linalg.cholesky(np.eye(len(root)) + root.T @ self.normal[wide] @ root), np.float64)
        pull = root.T @ self.moment[active]
        return active, root, factor, (pull, cho_solve((factor, True), pull))


class Mixture(NamedTuple):
    """What is known of the unknowns over all hypotheses.

    Attributes:
        mean: Over the mean before the presses, shape (n_unknown,).
        covariance: Shape (n_unknown, n_unknown).
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
    before: Callable[[Hypothesis], Array],
    tried: Iterable[Hypothesis] | None = None,
) -> Mixture:
    """Weigh hypotheses, all if absent.

    Args:
        linearised: The presses, by the scatter of their forces.
        before: The covariance of the unknowns before the presses by a hypothesis.
        tried: The hypotheses.
    """
    tried = list(tried or hypotheses())
    logs = np.array([linearised[each.scatter].evidence(before(each)) + np.log(each.belief) for each in tried])
    evidence = float(logsumexp(logs))
    weight = np.exp(logs - evidence)
    counting = np.flatnonzero(weight > NO_WEIGHT)
    answers = [linearised[tried[i].scatter].given(before(tried[i])) for i in counting]
    mean = np.einsum("h,hp->p", weight[counting], [answer[0] for answer in answers])
    covariance = sum(
        share * (own + np.outer(centre - mean, centre - mean))
        for share, (centre, own) in zip(weight[counting], answers, strict=True)
    )
    return Mixture(mean, np.asarray(covariance), dict(zip(tried, weight.tolist(), strict=True)), evidence)
