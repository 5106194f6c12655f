"""Estimator of a film: the most probable unknowns, given measured presses and a Gaussian prior distribution.

The unknowns of the film and the contacts of the presses are found together by nonlinear least squares (Gauss-Newton). A
contact may be known exactly, known with an error, or unknown. The contacts are eliminated in every step (variable
projection, Golub and Pereyra 1973). During the search, presses that do not agree with the others get a lower weight,
according to Student's t distribution (Lange and others, 1989). The final estimate leaves out the presses that do not
agree with the others.

Some facts are not known beforehand: how uneven the film is, how large its discrepancy is, how large the errors of the
presses are, and whether the session has a drift, offsets of the charges, or an offset of the forces. Each combination
of assumptions about these facts is a hypothesis. The evidence of a hypothesis follows from the linearised problem
(MacKay 1992), and the final estimate is the mean of the estimates under all hypotheses, weighted by their evidence.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import compress, groupby, product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve
from scipy.special import chdtrc, chdtri, softmax

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.contact_domain import with_log_force
from isocharge.serve.model.robust_estimate import ModelValues, RobustPoint, RobustProblem
from isocharge.simulate import NoiseModel
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import SESSION, FilmEstimate, Prior
from isocharge.train.calibration.press_data import Linearised, PressData, PressErrors, in_domain, model_values

BAD_PROBABILITY = 1e-5
"""A press is left out if the probability of residuals as large as its own is below this number."""

MAX_RESIDUAL = 3.0
"""Root mean square residual above which no film explains the presses, in standard deviations of the noise."""

MAX_BAD_SHARE = 0.3
"""Largest share of presses that may disagree with the others. With a larger share, no film explains the presses."""

FEW_PRESSES = 3
"""Largest number of presses that counts as few. Among a few presses, a bad press cannot be recognised."""

IMPERFECTION_SCALES = (((0.1, 0.1), 0.1), ((1.0, 0.1), 0.2), ((1.0, 1.0), 0.6), ((2.5, 2.5), 0.1))
"""Sizes of the uneven tension and of the other imperfections, with their prior probabilities.

The sizes are relative to the prior standard deviations. In the second case, only the uneven tension is large.
"""

DISCREPANCY_SIZES = ((0.001, 0.7), (0.005, 0.2), (0.02, 0.1))
"""Sizes of the discrepancy, relative to the charge, with their prior probabilities."""

FORCE_SCATTERS = (
    ((0.0, 0.0), 0.76),
    ((0.01, 0.0), 0.09),
    ((0.03, 0.0), 0.09),
    ((0.0, 0.03), 0.03),
    ((0.0, 0.12), 0.03),
)
"""Random errors of the forces in addition to the stated errors, with their prior probabilities.

The first number is `PressErrors.force_scatter`, which is relative to each force. The second number is
`PressErrors.constant_force_scatter`, which is the same for all forces.
"""

POSITION_RATIOS = ((1.0, 0.8), (3.0, 0.1), (8.0, 0.1))
"""Ratios of the real to the stated errors of the positions, with their prior probabilities."""

NOISE_RATIOS = ((0.3, 0.02), (1.0, 0.34), *((2.0 ** (step / 2), 0.08) for step in range(1, 9)))
"""Ratios of the noise of the charges to the noise of a frame from a good amplifier, with their prior probabilities.

A ratio above 1 only increases the noise that is proportional to the charge. The smallest ratio applies to presses whose
charges are averages of about ten frames.
"""

MIN_WEIGHT = 1e-6
"""Weight of a hypothesis below which its estimate is neglected."""

MAX_SEARCHES = 5
"""Largest number of searches that assume errors other than the stated errors."""


@dataclass(frozen=True)
class Hypothesis:
    """One combination of the sizes that are not known beforehand.

    Attributes:
        imperfections: Sizes of the uneven tension and of the other imperfections, relative to their prior standard
            deviations.
        discrepancy: Size of the discrepancy, relative to the charge.
        session_std: Prior standard deviation of each unknown of the session, shape (n_session,).
        errors: Errors of the presses.
        probability: Prior probability.
    """

    imperfections: tuple[float, float]
    discrepancy: float
    session_std: tuple[float, ...]
    errors: PressErrors
    probability: float

    @property
    def sizes(self) -> Array:
        """Size of each part of the prior covariance in the order of `Prior.parts`, shape (4 + n_session,)."""
        return np.array([1.0, *self.imperfections, self.discrepancy, *self.session_std])


def hypotheses(noise: NoiseModel) -> Iterator[Hypothesis]:
    """Yield all hypotheses about presses: all combinations of the sizes that are not known beforehand.

    The sizes are independent, so the probability of a hypothesis is the product of the probabilities of its sizes.
    Hypotheses with the same errors of the presses follow one another, because these errors change most slowly.

    Args:
        noise: Noise of a frame from a good amplifier.
    """
    noises = [  # only ratios below 1 change the white noise, see `NOISE_RATIOS`
        (replace(noise, white=min(ratio, 1.0) * noise.white, gain=ratio * noise.gain), probability)
        for ratio, probability in NOISE_RATIOS
    ]
    session_stds = [session_property.stds for session_property in SESSION]
    # Each list contains the sizes of one kind as pairs (size, probability). A combination has one pair of each list.
    lists = (noises, POSITION_RATIOS, FORCE_SCATTERS, IMPERFECTION_SCALES, DISCREPANCY_SIZES, *session_stds)
    for combination in product(*lists):  # from one combination to the next, the last lists change fastest
        sizes, probabilities = zip(*combination, strict=True)
        press_noise, position_ratio, force_scatters, imperfection_sizes, discrepancy, *session_std = sizes
        errors = PressErrors(press_noise, position_ratio, *force_scatters)  # relative scatter, constant scatter
        yield Hypothesis(imperfection_sizes, discrepancy, tuple(session_std), errors, float(np.prod(probabilities)))


SEARCH_SIZES = np.array([1.0, 1.0, 1.0, 0.01, *(session_property.stds[-1][0] for session_property in SESSION)])
"""Sizes of the parts of the prior covariance, used in the search for the most probable unknowns.

No size is zero, so that all unknowns can differ from their means.
"""


@dataclass(frozen=True)
class Estimation:
    """Result of the estimator.

    Attributes:
        charges: The solved film, whose charges and derivatives were used to estimate the unknowns.
        film: The estimate, averaged over the hypotheses.
        contact: Most probable contacts (x, y, F), shape (n, 3), mm and N.
        is_bad: Whether each press was left out, shape (n,).
        press_chi2: Sum of the squared residuals of each press, divided by its number of redundant measurements, shape
            (n,); NaN for a press without redundant measurements.
        chi2: Sum of squared residuals under the most probable hypothesis. The sum contains the residuals of the prior
            distribution, and of all presses that were not left out.
        redundancy: Number of redundant measurements of the presses that were not left out, but at least 1.
        hypothesis: The most probable hypothesis.
    """

    charges: FilmCharges
    film: FilmEstimate
    contact: Array
    is_bad: Booleans
    press_chi2: Array
    chi2: float
    redundancy: float
    hypothesis: Hypothesis

    @property
    def residual(self) -> float:
        """Root mean square residual, in standard deviations of the most probable hypothesis, dimensionless."""
        return float(np.sqrt(self.chi2 / self.redundancy))

    @property
    def is_improbable(self) -> bool:
        """Whether the residuals are too large to be random errors under the most probable hypothesis."""
        return bool(self.chi2 > chdtri(self.redundancy, BAD_PROBABILITY))

    @property
    def is_unexplained(self) -> bool:
        """Whether the residuals are too large for any film, or too many presses do not agree with the others."""
        return (self.is_improbable and self.residual > MAX_RESIDUAL) or self.is_bad.mean() > MAX_BAD_SHARE


def estimate(charges: FilmCharges, data: PressData, prior: Prior, previous: Estimation | None = None) -> Estimation:
    """Estimate a film from presses, with the derivatives of one solved film.

    Each search assumes standard deviations of the errors of the presses. The first search assumes the stated ones. Each
    further search assumes those of the most probable hypothesis of the previous search, until none changes. If the
    first search finds a bad press, the second search assumes larger errors, because the stated ones may be too small.

    Args:
        charges: Charges of a solved film and of similar films.
        data: The presses with their stated errors, and with the noise of a frame from a good amplifier.
        prior: Prior distribution of the unknowns.
        previous: Estimate at which the search begins; None to begin at the prior mean and the measured contacts.
    """
    all_hypotheses = list(hypotheses(data.noise))
    assumed_errors = PressErrors(data.noise)  # the stated errors, without further errors
    estimation = _estimate_with_errors(charges, data, assumed_errors, prior, all_hypotheses, previous)
    next_errors = estimation.hypothesis.errors
    if estimation.is_bad.any():
        # Assume the errors of the last hypothesis, which are the largest, but only the middle size of the errors of the
        # positions. With the largest size, a press at a wrong place would not be recognised.
        middle_ratio, _ = POSITION_RATIOS[len(POSITION_RATIOS) // 2]  # (ratio, prior probability)
        next_errors = all_hypotheses[-1].errors._replace(position_ratio=middle_ratio)
    for _ in range(MAX_SEARCHES):
        if next_errors == assumed_errors:
            break
        assumed_errors = next_errors
        estimation = _estimate_with_errors(charges, data, assumed_errors, prior, all_hypotheses, estimation)
        next_errors = estimation.hypothesis.errors
    return estimation


def _estimate_with_errors(
    charges: FilmCharges,
    stated: PressData,
    assumed_errors: PressErrors,
    prior: Prior,
    all_hypotheses: list[Hypothesis],
    previous: Estimation | None,
) -> Estimation:
    """Search for the film and for bad presses with assumed errors, and estimate the film under all hypotheses.

    Args:
        charges: Charges of a solved film and of similar films.
        stated: The presses with their stated errors.
        assumed_errors: Errors of the presses that the search assumes.
        prior: Prior distribution of the unknowns.
        all_hypotheses: The hypotheses.
        previous: Estimate at which the search begins; None to begin at the prior mean and the measured contacts.
    """
    assumed = stated.with_errors(assumed_errors)  # the same presses with the assumed errors
    found = _probable_point(charges, assumed, prior, previous)  # its state is the vector of the unknowns
    is_bad = _find_bad_presses(assumed.redundancy, found.chi2)  # from the squared residuals of each press
    is_used = ~is_bad

    # Linearise the charges at the unknowns and contacts that were found, and average over the hypotheses.
    average = _average_estimates(
        charges, stated[is_used], assumed[is_used], prior, all_hypotheses, found.state, found.contacts[is_used]
    )

    # Compute the residuals of all presses, also of the bad ones, whose contacts remain those that were found.
    log_contact = found.contacts.copy()
    log_contact[is_used] = average.log_contact
    model = model_values(charges, prior.layout, assumed.time, average.unknowns, log_contact)
    residual, _ = Linearised.of(model, assumed, log_contact).eliminated()  # what no change of the contacts can reduce
    chi2_of_press = (residual**2).sum(axis=1)
    # Divide by the number of redundant measurements. A press without redundant measurements has no residual.
    chi2_per_measurement = chi2_of_press / np.maximum(assumed.redundancy, 1)
    best = average.weight.argmax()  # index of the most probable hypothesis
    return Estimation(
        charges=charges,
        film=FilmEstimate(prior.layout, average.unknowns, average.covariance, average.noise),
        contact=in_domain(log_contact, charges.domain),
        is_bad=is_bad,
        press_chi2=np.where(assumed.redundancy > 0, chi2_per_measurement, np.nan),
        chi2=float(average.chi2[best]),
        redundancy=float(max(assumed.redundancy[is_used].sum(), 1)),
        hypothesis=average.hypotheses[best],
    )


def _find_bad_presses(redundancy: Integers, chi2: Array) -> Booleans:
    """Return whether each press is to be left out, because its residuals are improbably large, shape (n,).

    If most presses seem to be bad, the assumed film is wrong rather than the presses. Among a few presses, a bad press
    cannot be recognised. In both cases, no press counts as bad.

    Args:
        redundancy: Number of redundant measurements of each press, shape (n,).
        chi2: Sum of the squared residuals of each press, shape (n,).
    """
    is_improbable = (redundancy > 0) & (chdtrc(redundancy, chi2) < BAD_PROBABILITY)
    can_be_bad = is_improbable.mean() <= 0.5 and len(chi2) > FEW_PRESSES
    return np.asarray(is_improbable & can_be_bad)


def _probable_point(charges: FilmCharges, data: PressData, prior: Prior, previous: Estimation | None) -> RobustPoint:
    """Search for the most probable unknowns and contacts (x, y, ln F), with low weights for presses that may be bad.

    Args:
        charges: Charges of a solved film and of similar films.
        data: The presses with the assumed errors.
        prior: Prior distribution of the unknowns.
        previous: Estimate at which the search begins; None to begin at the prior mean and the measured contacts.
    """
    # The search needs finite numbers, so the largest number replaces the infinite variance of an unknown charge.
    charge_variance = np.nan_to_num(data.charge_std**2)  # shape (n, n_electrode)
    charge_covariance = charge_variance[:, None] * np.eye(charge_variance.shape[1])  # one diagonal matrix per press
    problem = RobustProblem(  # its state is the vector of the unknowns
        lambda contacts, state: model_values(charges, prior.layout, data.time, state, contacts),
        data.charge,  # measured charges
        charge_covariance,
        prior.mean,  # of the unknowns, as the next line
        prior.covariance(SEARCH_SIZES),  # with sizes that let all unknowns differ from the means
        measured_contacts=data.contact,
        contact_std=data.contact_std,
    )
    start_unknowns = prior.mean
    start_contact = data.contact
    if previous is not None:
        start_unknowns = previous.film.values
        start_contact = with_log_force(previous.contact)
    return problem.estimate(start_unknowns, start_contact, state_bounds=prior.bounds)


class _Average(NamedTuple):
    """Average of the estimates under several hypotheses.

    Attributes:
        hypotheses: Hypotheses whose weight is not negligible.
        weight: Weight of each hypothesis in `hypotheses`, proportional to its evidence, shape (n_hypothesis,).
        chi2: Smallest sum of squared residuals under each hypothesis in `hypotheses`, shape (n_hypothesis,).
        unknowns: Weighted mean of the unknowns, shape (n_unknown,), within their bounds.
        covariance: Covariance of the unknowns, shape (n_unknown, n_unknown).
        log_contact: Contacts (x, y, ln F) that agree best with the mean unknowns, shape (n, 3).
        noise: Root mean square of the noise. It is at least the stated noise of one frame, even if the charges are
            averages of several frames.
    """

    hypotheses: list[Hypothesis]
    weight: Array
    chi2: Array
    unknowns: Array
    covariance: Array
    log_contact: Array
    noise: NoiseModel


def _average_estimates(
    charges: FilmCharges,
    stated: PressData,
    assumed: PressData,
    prior: Prior,
    all_hypotheses: list[Hypothesis],
    start_unknowns: Array,
    start_contact: Array,
) -> _Average:
    """Estimate the unknowns under each hypothesis, and average the estimates with weights.

    The weight of a hypothesis is its evidence, divided by the sum of the evidence of all hypotheses. Hypotheses with a
    weight below `MIN_WEIGHT` are left out. A hypothesis states errors of presses and sizes of the parts of the prior.

    Args:
        charges: Charges of a solved film and of similar films.
        stated: The presses with their stated errors, which each hypothesis replaces by its own errors.
        assumed: The same presses with the errors that the search has assumed, for the changes of the contacts.
        prior: Prior distribution of the unknowns.
        all_hypotheses: The hypotheses. Those with the same errors of the presses follow one another.
        start_unknowns: Unknowns at which the charges are linearised, shape (n_unknown,).
        start_contact: Contacts (x, y, ln F) at which the charges are linearised, shape (n, 3).
    """
    # Compare the hypotheses. Neighbours in the list with the same errors of the presses share one linearised problem.
    model = model_values(charges, prior.layout, assumed.time, start_unknowns, start_contact)
    groups = [
        _HypothesisGroup.of(model, stated.with_errors(errors), start_contact, start_unknowns, prior, list(group))
        for errors, group in groupby(all_hypotheses, lambda hypothesis: hypothesis.errors)
    ]
    all_chi2, log_evidence = np.concatenate([group.chi2_and_log_evidence() for group in groups], axis=1)
    all_weights = softmax(log_evidence)
    all_weights[all_weights < MIN_WEIGHT] = 0.0
    all_weights /= all_weights.sum()
    is_probable = all_weights > 0.0
    weight = all_weights[is_probable]
    probable = list(compress(all_hypotheses, is_probable))

    # Average the means of the unknowns under the probable hypotheses.
    group_ends = np.cumsum([len(group.hypotheses) for group in groups])
    weights_of_groups = np.split(all_weights, group_ends[:-1])  # no split at the end of the last group
    posteriors = [group.posterior(weights) for group, weights in zip(groups, weights_of_groups, strict=True)]
    means = np.concatenate([mean for mean, _ in posteriors])
    mean = weight @ means

    # The covariance of the average is the mean prior covariance, minus the mean reduction by the presses, plus the
    # covariance of the means of the hypotheses. The mean prior covariance has the mean squared sizes of its parts.
    mean_squared_sizes = weight @ np.array([hypothesis.sizes**2 for hypothesis in probable])
    covariance = prior.covariance(np.sqrt(mean_squared_sizes))
    covariance -= sum(weighted_reduction for _, weighted_reduction in posteriors)
    covariance += np.cov(means, rowvar=False, ddof=0, aweights=weight)
    contact_change = Linearised.of(model, assumed, start_contact).contact_change(mean - start_unknowns)
    gains = np.maximum([hypothesis.errors.noise.gain for hypothesis in probable], stated.noise.gain)  # at least stated
    return _Average(
        hypotheses=probable,
        weight=weight,
        chi2=all_chi2[is_probable],
        unknowns=np.clip(mean, *prior.bounds),
        covariance=covariance,
        log_contact=start_contact + contact_change,
        noise=NoiseModel("presses", stated.noise.white, float(np.sqrt(weight @ gains**2))),  # root mean square gain
    )


@dataclass(frozen=True)
class _HypothesisGroup:
    """Hypotheses with the same errors of the presses, and the linearised residuals of the presses with these errors.

    Let r be the residuals at the prior means, from which the effect of the contacts is eliminated. The covariance of r
    is S = 1 + J P J'. The matrix J contains the derivatives of r with respect to the unknowns. The prior covariance P
    of the unknowns is a sum of parts. Each part is multiplied by the square of a size that depends on the hypothesis.

    Attributes:
        hypotheses: The hypotheses.
        prior: Prior distribution of the unknowns.
        residual: Components of the residuals r in a basis of all changes that the unknowns can cause, shape (m,).
        jacobian: Derivatives J, shape (m, n_unknown).
        parts: J P J' for each part of the prior covariance, shape (n_part, m, m).
        other_chi2: Sum of the squares of the components of the residuals that the unknowns do not change.
        log_volume: Part of the logarithm of the evidence that is the same for all hypotheses of the group. This part
            contains the standard deviations of the measurements, and the volume of the contacts that agree with them.
    """

    hypotheses: list[Hypothesis]
    prior: Prior
    residual: Array
    jacobian: Array
    parts: Array
    other_chi2: float
    log_volume: float

    @classmethod
    def of(
        cls, model: ModelValues, data: PressData, contact: Array, unknowns: Array, prior: Prior, group: list[Hypothesis]
    ) -> "_HypothesisGroup":
        """Linearise the residuals, and eliminate the contacts from them, so that they only depend on the unknowns.

        The residuals are then projected onto the column space of their Jacobian (QR factorisation), which has fewer
        dimensions. The unknowns do not change the other components of the residuals, so that the sum of the squares of
        these components is the same under all hypotheses.

        Args:
            model: Charges for the given unknowns and their derivatives, as returned by `model_values`.
            data: The presses with the errors that the hypotheses of the group assume.
            contact: Contacts (x, y, ln F), shape (n, 3).
            unknowns: Unknowns at which the residuals are linearised, shape (n_unknown,).
            prior: Prior distribution of the unknowns.
            group: The hypotheses of the group.
        """
        linearised = Linearised.of(model, data, contact)
        press_residual, press_jacobian = linearised.eliminated()  # (n, n_electrode) and (n, n_electrode, n_unknown)
        is_changed = press_jacobian.any(axis=2)  # by any unknown; False for a coordinate that was not measured
        basis, projected_jacobian = np.linalg.qr(press_jacobian[is_changed])  # (..., m) and (m, n_unknown)
        projected_residual = basis.T @ press_residual[is_changed]
        # The density of a measurement contains the inverse of its standard deviation as a factor.
        log_density = -np.log(data.measured_std[np.isfinite(data.measured_std)]).sum()
        return cls(
            hypotheses=group,
            prior=prior,
            residual=projected_residual - projected_jacobian @ (unknowns - prior.mean),  # moved to the prior means
            jacobian=projected_jacobian,
            parts=projected_jacobian @ prior.parts @ projected_jacobian.T,  # for each part of the prior covariance
            other_chi2=float((press_residual**2).sum() - projected_residual @ projected_residual),  # the other parts
            log_volume=float(linearised.log_contact_volume + log_density),
        )

    def chi2_and_log_evidence(self) -> tuple[Array, Array]:
        """Compute the smallest sum of squared residuals and the logarithm of the evidence for each hypothesis.

        Under a hypothesis, the residuals r are normally distributed with the covariance S. The evidence is the
        probability density of the residuals, multiplied by the prior probability of the hypothesis.

        Returns:
            Smallest sum of the squared residuals of the presses and of the prior distribution, over all values of the
            unknowns, and logarithm of the evidence. Both have the shape (n_hypothesis,).
        """
        factors = np.linalg.cholesky(self._covariance(self._squared_sizes))  # of S, shape (n_hypothesis, m, m)
        solutions = [cho_solve((factor, True), self.residual, check_finite=False) for factor in factors]  # S^-1 r
        # `other_chi2` and `log_volume` are the terms that are the same for all hypotheses of the group.
        chi2 = self.other_chi2 + np.array(solutions) @ self.residual  # the second term is r' S^-1 r
        log_determinant = 2.0 * np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)  # of S
        log_density = self.log_volume - 0.5 * (chi2 + log_determinant)  # without the constant that all groups share
        log_prior_probability = np.log([hypothesis.probability for hypothesis in self.hypotheses])
        return chi2, log_density + log_prior_probability

    def posterior(self, hypothesis_weights: Array) -> tuple[Array, Array]:
        """Estimate the unknowns under each of the n hypotheses whose weight is positive.

        The estimate under a hypothesis is a normal distribution. Its mean is the prior mean minus P J' S^-1 r, where P
        is the prior covariance, J are the derivatives of the residuals r, and S is the covariance of r. Its covariance
        is P - P J' S^-1 J P: the prior covariance minus a reduction, which the presses cause.

        Args:
            hypothesis_weights: Weight of each hypothesis, shape (n_hypothesis,).

        Returns:
            Means of the unknowns under the n hypotheses, shape (n, n_unknown), and the weighted sum of the reductions
            of the covariance under these hypotheses, shape (n_unknown, n_unknown).
        """
        is_used = hypothesis_weights > 0.0
        squared_sizes = self._squared_sizes[is_used]  # P is the sum of these times its parts; shape (n, n_part)
        residual_covariance = self._covariance(squared_sizes)  # S, shape (n, m, m)
        jacobian_by_part = self.jacobian @ self.prior.parts  # J times each part of P, shape (n_part, m, n_unknown)
        cross_covariance = np.tensordot(squared_sizes, jacobian_by_part, 1)  # J P, shape (n, m, n_unknown)
        gain = np.linalg.solve(residual_covariance, cross_covariance)  # S^-1 J P, shape (n, m, n_unknown)
        means = self.prior.mean - self.residual @ gain
        # Multiply (J P)' by S^-1 J P. The product is summed over the hypotheses (axis 0) and the residuals (axis 1).
        weighted_gain = hypothesis_weights[is_used, None, None] * gain
        weighted_reduction = np.tensordot(cross_covariance, weighted_gain, axes=((0, 1), (0, 1)))
        return means, weighted_reduction

    @property
    def _squared_sizes(self) -> Array:
        """Squared sizes of the parts of the prior covariance, shape (n_hypothesis, n_part)."""
        return np.array([hypothesis.sizes**2 for hypothesis in self.hypotheses])

    def _covariance(self, squared_sizes: Array) -> Array:
        """Compute the covariances S of the residuals, shape (n, m, m), for squared sizes of shape (n, n_part)."""
        return np.eye(self.residual.size) + np.tensordot(squared_sizes, self.parts, 1)
