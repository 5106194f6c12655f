"""Hypotheses about effects that the parameters of a film do not describe, and probabilities of these hypotheses.

A film may have imperfections (modes), a discrepancy, and traces that are missing in the sensor file. A session may have
nuisances, such as an offset of the charges. The stated forces may also scatter. A hypothesis is a combination of such
effects. Traces are considered only together with modes and a discrepancy.

The probability of a hypothesis follows from its evidence, which is the probability density of the presses under the
hypothesis (MacKay 1992). The evidence is computed from a linear model of the residuals with Gaussian noise. The
estimate of the film is the average of the estimates under all hypotheses. The weights are the probabilities of the
hypotheses.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

MODE_SIZES = {0.0: 0.5, 1.0: 0.5}
"""Considered sizes of the modes, relative to typical films, each with its prior probability."""

DISCREPANCY_SIZES = {0.0: 0.5, 0.003: 0.1, 0.01: 0.15, 0.03: 0.15, 0.1: 0.1}
"""Considered relative sizes of the discrepancy of the charges, each with its prior probability."""

TRACES_PROBABILITY = 0.01
"""Prior probability that the film has traces that collect charge and are missing in the sensor file."""

FORCE_SCATTERS = {0.0: 0.95, 0.03: 0.03, 0.1: 0.02}
"""Considered standard deviations of an additional scatter of the forces, each with its prior probability.

The standard deviations are relative to the force. They are added in quadrature to the standard deviation of the rig."""

NEGLIGIBLE_PROBABILITY = 1e-7
"""Probability up to which a hypothesis is ignored in the average over the hypotheses."""


@dataclass(frozen=True)
class Hypothesis:
    """A combination of effects that the parameters of the film do not describe.

    Attributes:
        modes: Size of the modes of imperfections, relative to typical films, dimensionless.
        discrepancy: Relative size of the discrepancy of the charges, dimensionless.
        nuisance_stds: Standard deviation of each nuisance before the presses, in the unit of the nuisance and in the
            order of `NUISANCES`. The variance that a nuisance gets from known temperatures is not included.
        force_scatter: Standard deviation of the forces in addition to that of the rig, relative to the force.
        prior_probability: Probability of the hypothesis before the presses.
        traces: Size of the traces that the sensor file does not describe, relative to typical films, dimensionless.
    """

    modes: float = 0.0
    discrepancy: float = 0.0
    nuisance_stds: tuple[float, ...] = (0.0,) * len(NUISANCES)
    force_scatter: float = 0.0
    prior_probability: float = 1.0
    traces: float = 0.0

    def covariance(self, layout: UnknownLayout) -> Array:
        """Return the prior covariance that the hypothesis adds to the unknowns.

        Args:
            layout: Layout of the unknowns.

        Returns:
            Covariance, shape (n_unknown, n_unknown). The entries of the parameters of the film are zero, because a
            hypothesis describes only other effects.
        """
        # Modes, traces and nuisances are independent, so their part of the matrix is diagonal.
        variance = np.zeros(layout.count)
        variance[layout.modes] = self.modes**2
        variance[layout.traces] = self.traces**2
        variance[layout.nuisances] = np.square(self.nuisance_stds)
        covariance = np.diag(variance)

        # The coefficients of one term for different electrodes are correlated, because a part of the discrepancy is
        # common to all electrodes. Different terms are independent. Therefore, the covariance of all coefficients is
        # block diagonal, with the same block for each term.
        electrode_count = len(layout.electrode_names)
        electrode_covariance = np.eye(electrode_count) + COMMON**2
        term_covariance = np.kron(np.eye(term_count()), electrode_covariance)
        covariance[layout.terms, layout.terms] = self.discrepancy**2 * term_covariance
        return covariance

    def has(self, effect: str) -> bool:
        """Return whether a given effect has a size above zero in this hypothesis.

        Args:
            effect: "modes", "discrepancy", "traces", "force_scatter", or the name of a nuisance.
        """
        nuisance_names = [nuisance.name for nuisance in NUISANCES]
        size_of_effect = dict(zip(nuisance_names, self.nuisance_stds, strict=True))
        size_of_effect["modes"] = self.modes
        size_of_effect["discrepancy"] = self.discrepancy
        size_of_effect["traces"] = self.traces
        size_of_effect["force_scatter"] = self.force_scatter
        return size_of_effect[effect] > 0.0


def hypotheses() -> Iterator[Hypothesis]:
    """Yield all hypotheses that a calibration considers by default (generator).

    The first hypotheses are the combinations of modes, discrepancy, nuisances and force scatter. A hypothesis with
    modes always includes a discrepancy. The modes are computed only to first order, so they never explain the charges
    completely. The last hypotheses combine traces with modes and with each size of the discrepancy except zero.
    """
    # Each effect has several possible sizes. A combination contains one pair (size, probability) for each effect.
    nuisance_stds_and_probabilities = [nuisance.probabilities for nuisance in NUISANCES]
    combinations = product(
        MODE_SIZES.items(), DISCREPANCY_SIZES.items(), *nuisance_stds_and_probabilities, FORCE_SCATTERS.items()
    )
    for combination in combinations:
        sizes = [size for size, _ in combination]
        probabilities = [probability for _, probability in combination]
        modes, discrepancy, *nuisance_stds, force_scatter = sizes  # in the order of the arguments of `product`
        if modes > 0.0 and discrepancy == 0.0:
            continue
        yield Hypothesis(
            modes=modes,
            discrepancy=discrepancy,
            nuisance_stds=tuple(nuisance_stds),
            force_scatter=force_scatter,
            prior_probability=math.prod(probabilities),  # the effects are independent
        )

    # Hypotheses with traces. Modes and traces have the size 1, which is the size in typical films.
    for discrepancy, probability in DISCREPANCY_SIZES.items():
        if discrepancy > 0.0:
            yield Hypothesis(
                modes=1.0,
                discrepancy=discrepancy,
                prior_probability=TRACES_PROBABILITY * probability,
                traces=1.0,
            )


class LinearModel(NamedTuple):
    """Normal equations of a linear model of the residuals of presses.

    Let u be the deviation of the unknowns from their mean before the presses. In the linear model, the sum of squared
    residuals is u' normal u + 2 moment' u + square.

    Attributes:
        normal: Matrix of the normal equations, shape (n_unknown, n_unknown).
        moment: Half the gradient of the sum of squares at u = 0, shape (n_unknown,).
        square: Sum of squares at u = 0. If noise was added to the model, this value also includes the logarithm of the
            determinant of the covariance of the residuals.
    """

    normal: Array
    moment: Array
    square: float

    @classmethod
    def from_residuals(cls, jacobian: Array, residual: Array, deviation: Array) -> "LinearModel":
        """Create the linear model of residuals from their values and derivatives at one point.

        Args:
            jacobian: Derivatives of the residuals with respect to the unknowns, shape (n, n_unknown).
            residual: Residuals in units of their standard deviations, shape (n,).
            deviation: Difference of the unknowns at this point from their mean before the presses, shape (n_unknown,).
        """
        residual_at_mean = residual - jacobian @ deviation
        return cls(
            normal=jacobian.T @ jacobian,
            moment=jacobian.T @ residual_at_mean,
            square=float(residual_at_mean @ residual_at_mean),
        )

    def with_added_noise(
        self, jacobian: Array, residual: Array, deviation: Array, noise_variance: Array
    ) -> "LinearModel":
        """Return a model whose residuals have additional noise along several orthogonal directions.

        Before the noise is added, the squared residual along each direction has the weight 1. If noise with the
        variance v is added along the direction, this weight decreases to 1 / (1 + v).

        Args:
            jacobian: Derivatives of the components of the residuals along the directions, shape (n_direction,
                n_unknown).
            residual: Components of the residuals along the directions, shape (n_direction,).
            deviation: Difference of the unknowns from their mean before the presses, as in `from_residuals`, shape
                (n_unknown,).
            noise_variance: Variance of the additional noise along each direction, shape (n_direction,).
        """
        # The weight decreases by the share v / (1 + v). A residual that is multiplied by the square root of this share
        # contributes the share to the sum of squares, which is then subtracted.
        root_share = np.sqrt(noise_variance / (1.0 + noise_variance))
        removed_part = LinearModel.from_residuals(root_share[:, None] * jacobian, root_share * residual, deviation)
        log_determinant = float(np.log1p(noise_variance).sum())
        return LinearModel(
            normal=self.normal - removed_part.normal,
            moment=self.moment - removed_part.moment,
            square=self.square - removed_part.square + log_determinant,
        )

    def log_evidence(self, prior_covariance: Array) -> float:
        """Return the logarithm of the evidence without a constant term.

        The evidence is the probability density of the presses for a given prior covariance.

        Args:
            prior_covariance: Covariance of the unknowns before the presses, shape (n_unknown, n_unknown).
        """
        # The part of the sum of squares that the unknowns explain is subtracted. The determinant is that of the
        # precision, and the product of the diagonal of its Cholesky factor is the root of this determinant.
        solution = self._solve(prior_covariance)
        explained_square = solution.moment @ solution.step
        half_log_determinant = np.log(np.diag(solution.precision_factor)).sum()
        return float(-0.5 * (self.square - explained_square) - half_log_determinant)

    def posterior(self, prior_covariance: Array) -> tuple[Array, Array]:
        """Return the change of the mean of the unknowns by the presses, and the covariance after the presses.

        Args:
            prior_covariance: Covariance of the unknowns before the presses, shape (n_unknown, n_unknown).

        Returns:
            Change of the mean by the presses, shape (n_unknown,), and covariance after the presses, shape (n_unknown,
            n_unknown). The mean of unknowns without a variance before the presses does not change.
        """
        # Only the active unknowns, which have a variance before the presses, are solved for. They are L s. Here L L' is
        # their covariance before the presses, and s are scaled unknowns, whose covariance is the identity matrix.
        solution = self._solve(prior_covariance)
        prior_root = solution.prior_root  # L
        active = solution.active

        # The presses change the mean of s by minus the step of the solution.
        mean_change = np.zeros(len(active))
        mean_change[active] = -prior_root @ solution.step

        # After the presses, s has the covariance P^-1, where P is the precision. The active unknowns then have the
        # covariance L P^-1 L'. The argument True states that the Cholesky factor of P is a lower triangular matrix.
        covariance = np.zeros_like(prior_covariance)
        inverse_precision_times_root = cho_solve((solution.precision_factor, True), prior_root.T)  # P^-1 L'
        covariance[np.ix_(active, active)] = prior_root @ inverse_precision_times_root
        return mean_change, covariance

    def _solve(self, prior_covariance: Array) -> "_Solution":
        """Solve the normal equations for the unknowns that have a variance before the presses.

        Args:
            prior_covariance: Covariance of the unknowns before the presses, shape (n_unknown, n_unknown).
        """
        active = np.diag(prior_covariance) > 0.0
        active_block = np.ix_(active, active)  # rows and columns of the active unknowns
        prior_root = np.asarray(np.linalg.cholesky(prior_covariance[active_block]), np.float64)

        # The active unknowns are L s with the prior root L. Before the presses, the covariance of the scaled unknowns s
        # is the identity matrix. Their precision after the presses (the inverse of the covariance) is 1 + L' N L, where
        # N is the matrix of the normal equations.
        precision = np.eye(len(prior_root)) + prior_root.T @ self.normal[active_block] @ prior_root
        precision_factor = np.asarray(np.linalg.cholesky(precision), np.float64)
        moment = prior_root.T @ self.moment[active]  # half the gradient of the sum of squares with respect to s
        step = cho_solve((precision_factor, True), moment)
        return _Solution(active, prior_root, precision_factor, moment, step)


class _Solution(NamedTuple):
    """Solution of the normal equations for scaled unknowns.

    The active unknowns are those that have a variance before the presses. The active unknowns equal the prior root
    times the scaled unknowns. The covariance of the scaled unknowns before the presses is the identity matrix.

    Attributes:
        active: Whether each unknown is active, shape (n_unknown,).
        prior_root: Cholesky factor of the covariance of the active unknowns before the presses, shape (n_active,
            n_active).
        precision_factor: Cholesky factor of the precision, which is the inverse of the covariance of the scaled
            unknowns after the presses, shape (n_active, n_active).
        moment: Half the gradient of the sum of squares with respect to the scaled unknowns, shape (n_active,).
        step: Inverse of the precision times `moment`, shape (n_active,). The presses change the mean of the scaled
            unknowns by minus this step.
    """

    active: Booleans
    prior_root: Array
    precision_factor: Array
    moment: Array
    step: Array


class Mixture(NamedTuple):
    """Estimate of the unknowns, averaged over all hypotheses.

    Attributes:
        mean_change: Change of the mean of the unknowns by the presses, shape (n_unknown,).
        covariance: Covariance of the unknowns after the presses, shape (n_unknown, n_unknown).
        probabilities: Probability of each hypothesis after the presses.
        log_evidence: Logarithm of the evidence of all hypotheses together, up to a constant.
    """

    mean_change: Array
    covariance: Array
    probabilities: dict[Hypothesis, float]
    log_evidence: float

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return max(self.probabilities, key=lambda hypothesis: self.probabilities[hypothesis])


def mix_hypotheses(
    models: Mapping[float, LinearModel],
    prior_covariance_of: Callable[[Hypothesis], Array],
    considered: Iterable[Hypothesis] | None = None,
) -> Mixture:
    """Compute the probability of each hypothesis, and average the estimates of the unknowns over the hypotheses.

    Hypotheses with a probability of at most `NEGLIGIBLE_PROBABILITY` are omitted from the average. The probabilities of
    the other hypotheses are not increased, although their sum is slightly below 1.

    Args:
        models: Linear model of the residuals for each value of `Hypothesis.force_scatter`.
        prior_covariance_of: Function that returns the covariance of the unknowns before the presses for a hypothesis.
        considered: The hypotheses to consider; by default those that `hypotheses` yields.
    """
    all_hypotheses = list(considered or hypotheses())
    log_weights = []  # logarithms of evidence times prior probability
    for hypothesis in all_hypotheses:
        model = models[hypothesis.force_scatter]
        log_hypothesis_evidence = model.log_evidence(prior_covariance_of(hypothesis))
        log_weights.append(log_hypothesis_evidence + np.log(hypothesis.prior_probability))
    log_evidence = float(logsumexp(log_weights))  # of all hypotheses together
    probabilities = np.exp(np.array(log_weights) - log_evidence)

    # Estimates under the hypotheses that are not negligible
    relevant_rows = np.flatnonzero(probabilities > NEGLIGIBLE_PROBABILITY)
    mean_changes = []
    covariances = []
    for index in relevant_rows:
        hypothesis = all_hypotheses[index]
        model = models[hypothesis.force_scatter]
        mean_change_of_hypothesis, covariance_of_hypothesis = model.posterior(prior_covariance_of(hypothesis))
        mean_changes.append(mean_change_of_hypothesis)
        covariances.append(covariance_of_hypothesis)

    mean_change, covariance = _mixture_moments(probabilities[relevant_rows], mean_changes, covariances)
    probability_of_hypothesis = dict(zip(all_hypotheses, probabilities.tolist(), strict=True))
    return Mixture(mean_change, covariance, probability_of_hypothesis, log_evidence)


def _mixture_moments(probabilities: Array, means: Sequence[Array], covariances: Sequence[Array]) -> tuple[Array, Array]:
    """Return the mean and the covariance of a mixture of normal distributions.

    The covariance of the mixture is the mean of the covariances plus the covariance of the means (law of total
    covariance).

    Args:
        probabilities: Probability of each distribution, shape (n_distribution,).
        means: Mean of each distribution, each of shape (n_unknown,).
        covariances: Covariance of each distribution, each of shape (n_unknown, n_unknown).
    """
    mean = np.einsum("h,hu->u", probabilities, means)  # sum over the distributions h
    covariance = np.zeros((len(mean), len(mean)))
    for probability, component_mean, component_covariance in zip(probabilities, means, covariances, strict=True):
        difference = component_mean - mean
        covariance += probability * (component_covariance + np.outer(difference, difference))
    return mean, covariance
