"""Robust estimation of a film from measured presses.

The least-squares problem is solved by `FitProblem`. If noise alone cannot explain the residuals of a press, the press
gets a smaller weight, as for errors with Student's t distribution (Lange et al., 1989). Therefore, a single bad press
hardly changes the estimated film. If the residuals of a press remain too large, the press is left out and reported.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.calibration import chi_square
from isocharge.train.calibration.contacts import from_log_contact
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.fit_problem import BAD_PROBABILITY, FitProblem, SettledFit, SolvedFilm
from isocharge.train.calibration.hypotheses import Hypothesis
from isocharge.train.calibration.nuisances import NUISANCES, PRETENSION_PER_KELVIN, NuisanceEstimate
from isocharge.train.calibration.press_data import PressData
from isocharge.train.calibration.problem import FilmEstimate, Warming
from isocharge.train.calibration.unknowns import UnknownLayout

STUDENT_T_DEGREES = 4.0
"""Degrees of freedom of the Student's t distribution from which the weights of presses are computed."""

MAX_WEIGHTINGS = 6
"""Largest number of rounds in which the weights of the presses are computed."""

WEIGHT_TOLERANCE = 0.1
"""Largest relative change of all weights at which no further round of weighting is needed."""

SUSPICIOUS_PROBABILITY = 0.01
"""Probability of the residuals, assuming that all presses are good, below which bad presses are searched for."""

MAX_BAD_SHARE = 0.34
"""Largest fraction of the presses that may be left out.

If more presses disagree with the film, all presses are kept, because it is then uncertain which of them are wrong.
"""

MIN_PRESSES_TO_JUDGE = 4
"""Smallest number of presses among which bad presses can be recognised."""

MISTAKE_PROBABILITY = 0.01
"""Probability that a press is recorded wrongly."""

LOG_DENSITY_OF_MISTAKE = -3.0
"""Logarithm of the probability density of each charge of a press that is recorded wrongly, in units of the noise.

The charge may then be wrong by up to twenty standard deviations.
"""

PROBABLE = 0.5
"""Probability above which an effect is reported."""

NEGLIGIBLE_COEFFICIENT = 1e-3
"""Largest magnitude of the coefficients of modes or of traces that is rounded to zero in the estimate of a film.

Modes and traces with smaller coefficients change the charges by less than 1e-4 of their value. If the coefficients are
zero, the slow computation of the effects of modes and traces is not needed."""


@dataclass(frozen=True)
class FilmPosterior(FilmEstimate):
    """Estimate of a film from presses, with residuals of these presses.

    Attributes:
        contact: Contacts (x, y, F) of the presses, adjusted to this film, shape (n, 3), mm and N.
        chi2: Sum of squared residuals of each press, shape (n,). For a good press it is about `degrees_of_freedom`.
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,); see `_degrees_of_freedom`.
        bad: Whether each press was left out as bad, shape (n,).
        nuisances: Estimate of each nuisance of the session, by the name of the nuisance.
        force_scatter: Standard deviation of the forces in addition to that of the rig, relative to the force.
        probabilities: Probability of each hypothesis about effects that the parameters of the film do not describe.
    """

    contact: Array = field(kw_only=True)
    chi2: Array = field(kw_only=True)
    degrees_of_freedom: Array = field(kw_only=True)
    bad: Booleans = field(kw_only=True)
    nuisances: dict[str, NuisanceEstimate] = field(kw_only=True)
    force_scatter: float = field(kw_only=True)
    probabilities: dict[Hypothesis, float] = field(kw_only=True)

    @property
    def total(self) -> tuple[float, float]:
        """Sums of the squared residuals and of the degrees of freedom, over all presses that were not left out."""
        return float(self.chi2[~self.bad].sum()), float(self.degrees_of_freedom[~self.bad].sum())

    @property
    def imperfect(self) -> bool:
        """Whether the film probably has imperfections or a discrepancy."""
        return self._probability_of_any("modes", "discrepancy") > PROBABLE

    def probability(self, effect: str) -> float:
        """Return the probability that the session has a given effect.

        Args:
            effect: Name of the effect, as in `Hypothesis.has`.
        """
        return self._probability_of_any(effect)

    def _probability_of_any(self, *effects: str) -> float:
        """Return the probability that the session has at least one of the given effects.

        Args:
            effects: Names of the effects, as in `Hypothesis.has`.
        """
        return sum(
            probability
            for hypothesis, probability in self.probabilities.items()
            if any(hypothesis.has(effect) for effect in effects)
        )

    def scaled(self, variance_factor: float) -> "FilmPosterior":
        """Return a copy of the estimate in which all variances are multiplied by a factor.

        Args:
            variance_factor: Factor on all variances and covariances.
        """
        warming = self.warming
        if warming is not None:
            std = warming.std * float(np.sqrt(variance_factor))
            warming = warming._replace(std=std, covariance=warming.covariance * variance_factor)
        return replace(
            self, covariance=self.covariance * variance_factor, joint=self.joint * variance_factor, warming=warming
        )

    def drifted(self, prior: FilmPrior, *, knows_temperature: bool = False) -> FilmEstimate:
        """Return the estimate of the film for a later time; see `FilmEstimate.drifted`.

        If the film probably has neither imperfections nor a discrepancy, the returned estimate contains only the
        parameters of the film, without coefficients.

        Args:
            prior: Distribution of the films.
            knows_temperature: Whether the temperature at the later time is known.
        """
        if self.imperfect:
            return super().drifted(prior, knows_temperature=knows_temperature)

        # Remove the coefficients of imperfections and discrepancy. The parameters are the first unknowns.
        warming = self.warming
        if warming is not None:
            warming = warming.with_unknowns(len(self.parameters))  # keeps the covariances with the parameters only
        parameters_only = FilmEstimate(self.parameters, self.covariance, warming=warming)
        return parameters_only.drifted(prior, knows_temperature=knows_temperature)


def fit_film(
    charge_model: FilmCharges,
    data: PressData,
    initial: FilmEstimate,
    at_C: float | None = None,
    *,
    friction: float = 0.0,
) -> FilmPosterior:
    """Estimate a film from presses, and leave out presses that were probably recorded wrongly.

    First, the film is fitted to all presses. If some residuals are too large, the film is fitted again, but only to
    presses that agree with each other. These two fits assume that the parameters of the film explain the presses.
    Further fits also consider hypotheses. A hypothesis is a combination of other effects, such as imperfections of the
    film.

    Args:
        charge_model: Model of the charges of all films.
        data: The measured presses.
        initial: Estimate of the film before the presses.
        at_C: Temperature of the film in the initial estimate and in the result, degrees Celsius; None if temperatures
            were not measured.
        friction: Expected coefficient of friction of the presses; 0 for presses without friction.
    """
    problem = FitProblem.from_estimate(charge_model, initial, knows_temperature=at_C is not None, friction=friction)
    degrees_of_freedom = _degrees_of_freedom(data)
    every_press = np.ones(len(data), dtype=bool)
    no_effects = Hypothesis()  # the hypothesis that the parameters alone explain the presses

    # Fit all presses with the weight 1. If some residuals are too large, find and fit the presses that agree.
    is_kept = every_press
    solved = problem.solve(data, np.ones(len(data)), problem.mean, no_effects)
    can_be_judged = len(data) >= MIN_PRESSES_TO_JUDGE
    if can_be_judged and _is_suspicious(solved.contacts.chi2, degrees_of_freedom):
        is_kept, start = _agreeing_presses(problem, data, solved, degrees_of_freedom)
        kept_data = data[is_kept]
        solved = problem.solve(kept_data, np.ones(len(kept_data)), start, no_effects)

    # Repeat the fit with the most probable hypothesis until neither the film nor the selection of presses changes.
    settled = problem.settle(data, is_kept, degrees_of_freedom, solved, no_effects)

    # Presses that were left out as wrong may be good if the film has imperfections.
    if not settled.is_kept.all():
        settled = _refit_if_all_good(problem, data, degrees_of_freedom, settled)
    return _posterior(problem, data, degrees_of_freedom, settled, at_C)


def _refit_if_all_good(
    problem: FitProblem, data: PressData, degrees_of_freedom: Array, settled: SettledFit
) -> SettledFit:
    """Fit a film to all presses if all presses are probably good; otherwise, return the given fit.

    Some presses were left out of the given fit. Two explanations of these presses are compared: they were recorded
    wrongly, or all presses are good and the film has imperfections. The evidence of an explanation is the probability
    density of all presses if the explanation is true, times the prior probability of the mistakes.

    Args:
        problem: The least-squares problem.
        data: All presses.
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
        settled: The given fit, in which some presses were left out.
    """
    unknowns = settled.solved.unknowns
    film_with_all_presses = SolvedFilm(unknowns, problem.adjusted_contacts(unknowns, data))
    mixture_of_all = problem.mixture(data, film_with_all_presses)  # average over all hypotheses
    log_evidence_without_mistakes = mixture_of_all.log_evidence
    log_evidence_with_mistakes = settled.mixture.log_evidence + _log_density_of_mistakes(data, ~settled.is_kept)
    if log_evidence_without_mistakes <= log_evidence_with_mistakes:
        return settled
    every_press = np.ones(len(data), dtype=bool)
    return problem.settle(data, every_press, degrees_of_freedom, settled.solved, mixture_of_all.best)


def refit_film(
    charge_model: FilmCharges,
    data: PressData,
    initial: FilmEstimate,
    previous: FilmPosterior,
    at_C: float | None = None,
    *,
    friction: float = 0.0,
) -> FilmPosterior:
    """Estimate a film from presses, beginning the search at a previous estimate from similar presses.

    The first fit assumes the most probable hypothesis of the previous estimate. This function takes less time than
    `fit_film`.

    Args:
        charge_model: Model of the charges of all films.
        data: The presses. No press is left out.
        initial: Estimate of the film before the presses.
        previous: Previous estimate of the film, from similar presses.
        at_C: Temperature of the film in all these estimates, degrees Celsius; None if temperatures were not measured.
        friction: Expected coefficient of friction of the presses; 0 for presses without friction.
    """
    problem = FitProblem.from_estimate(charge_model, initial, knows_temperature=at_C is not None, friction=friction)

    # The unknowns of the previous estimate, with its parameters in units of their prior standard deviations
    layout = problem.layout
    start = np.zeros(layout.count)
    start[layout.parameters] = previous.parameters / charge_model.prior.std
    start[layout.coefficients] = previous.coefficients
    start[layout.nuisances] = [previous.nuisances[nuisance.name].value for nuisance in NUISANCES]

    # A hypothesis is a combination of effects that the parameters of the film do not describe.
    most_probable = max(previous.probabilities, key=lambda hypothesis: previous.probabilities[hypothesis])
    solved = problem.solve(data, np.ones(len(data)), start, most_probable)

    # If `settle` is given a hypothesis with effects, it begins with another fit. This fit was made above already.
    # Therefore, `settle` is given the hypothesis without effects, and begins at the solved film.
    every_press = np.ones(len(data), dtype=bool)
    degrees_of_freedom = _degrees_of_freedom(data)
    settled = problem.settle(data, every_press, degrees_of_freedom, solved, Hypothesis())
    return _posterior(problem, data, degrees_of_freedom, settled, at_C)


def _degrees_of_freedom(data: PressData) -> Array:
    """Return the number of redundant measurements in each press, shape (n,).

    Three of the measured charges and coordinates determine the contact of a press. All further measurements are
    redundant.

    Args:
        data: The measured presses.
    """
    return np.asarray(np.maximum(data.measured.sum(axis=1) - 3.0, 0.0))


def _is_suspicious(chi2: Array, degrees_of_freedom: Array) -> bool:
    """Return whether residuals are too large to be noise, either in a single press or in all presses together.

    Args:
        chi2: Sum of squared residuals of each press, shape (n,).
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
    """
    # The distribution is not defined for zero degrees of freedom. Presses without redundancy have almost no residuals.
    press_probability = chi_square.probability_above(chi2, np.maximum(degrees_of_freedom, 1.0))
    # The smallest of n probabilities is multiplied by n, because the worst press is selected among n (Bonferroni).
    worst_press_probability = press_probability.min() * len(chi2)
    total_probability = chi_square.probability_above(chi2.sum(), max(degrees_of_freedom.sum(), 1.0))
    return bool(min(worst_press_probability, total_probability) < SUSPICIOUS_PROBABILITY)


def _agreeing_presses(
    problem: FitProblem, data: PressData, solved: SolvedFilm, degrees_of_freedom: Array
) -> tuple[Booleans, Array]:
    """Find a film with which most presses agree, and find the presses that agree with it.

    The film is fitted repeatedly. Before each fit, presses with large residuals get smaller weights, as for errors with
    Student's t distribution (Lange et al., 1989). The fits end if the weights hardly change, or after `MAX_WEIGHTINGS`
    fits.

    Args:
        problem: The least-squares problem.
        data: The measured presses.
        solved: The film from a fit to all presses with equal weights.
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).

    Returns:
        Whether each press agrees with the film, shape (n,), and the unknowns of the film, shape (n_unknown,).
    """
    weight = np.ones(len(data))
    for _ in range(MAX_WEIGHTINGS):
        previous_weight = weight
        # A press with the expected residuals (chi2 equal to its degrees of freedom) has the weight 1.
        weight = (STUDENT_T_DEGREES + degrees_of_freedom) / (STUDENT_T_DEGREES + solved.contacts.chi2)
        if np.abs(weight / previous_weight - 1.0).max() < WEIGHT_TOLERANCE:
            break
        solved = problem.solve(data, weight, solved.unknowns, Hypothesis())
    return _agrees_with_film(solved.contacts.chi2, degrees_of_freedom), solved.unknowns


def _agrees_with_film(chi2: Array, degrees_of_freedom: Array) -> Booleans:
    """Return whether each press agrees with a film, shape (n,).

    A press agrees if the sum of its squared residuals does not exceed a limit. The probability that a good press
    exceeds the limit is `BAD_PROBABILITY` divided by the number of presses (Bonferroni correction). The limit is
    increased if most presses have larger residuals than expected. If more than `MAX_BAD_SHARE` of the presses exceed
    the limit, the function returns True for all presses.

    Args:
        chi2: Sum of squared residuals of each press, shape (n,).
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
    """
    # The distribution is not defined for zero degrees of freedom. Presses without redundancy have almost no residuals.
    positive_degrees = np.maximum(degrees_of_freedom, 1.0)
    limit = chi_square.value_exceeded_with(BAD_PROBABILITY / len(chi2), positive_degrees)

    # If most presses have larger residuals than expected, for example because the noise is larger than stated, the
    # limits of all presses are multiplied by the typical ratio of measured to expected sums.
    expected_median = chi_square.value_exceeded_with(0.5, positive_degrees)
    typical_ratio = max(1.0, float(np.median(chi2 / expected_median)))
    agrees = chi2 <= limit * typical_ratio
    if np.mean(~agrees) > MAX_BAD_SHARE:  # it is uncertain which presses are wrong, so none is left out
        return np.ones_like(agrees)
    return np.asarray(agrees)


def _log_density_of_mistakes(data: PressData, is_mistake: Booleans) -> float:
    """Return the logarithm of the probability density of presses that were recorded wrongly.

    The density is multiplied by the prior probability that these presses are recorded wrongly.

    Args:
        data: All presses.
        is_mistake: Whether each press is assumed to be recorded wrongly, shape (n,).
    """
    charge_count = data.has_charge[is_mistake].sum()
    log_density_of_charges = LOG_DENSITY_OF_MISTAKE * charge_count
    log_probability_of_mistakes = is_mistake.sum() * np.log(MISTAKE_PROBABILITY)
    return float(log_density_of_charges + log_probability_of_mistakes)


def _posterior(
    problem: FitProblem, data: PressData, degrees_of_freedom: Array, settled: SettledFit, at_C: float | None
) -> FilmPosterior:
    """Create the estimate of a film from the result of the last fit.

    Args:
        problem: The least-squares problem.
        data: All presses.
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
        settled: Result of `FitProblem.settle`.
        at_C: Temperature of the film, degrees Celsius; None if temperatures were not measured.
    """
    layout = problem.layout
    # A hypothesis is a combination of effects besides the parameters. The mixture is the average of the estimates under
    # all hypotheses. The sum is clipped, because rounding may lead slightly beyond the bounds.
    mixture = settled.mixture
    mean_unknowns = np.clip(problem.mean + mixture.mean_change, *problem.bounds)
    unknowns = _without_negligible_coefficients(layout, mean_unknowns)

    # Root-mean-square scatter of the forces over all hypotheses, weighted by their probabilities
    scatter_variance = sum(
        probability * hypothesis.force_scatter**2 for hypothesis, probability in mixture.probabilities.items()
    )
    force_scatter = float(np.sqrt(scatter_variance))

    # The contacts of all presses are adjusted to the estimated film. The search can begin at the contacts of the last
    # fit only if no press was left out of this fit.
    start = settled.solved.contacts.contact if settled.is_kept.all() else None
    contacts = problem.adjusted_contacts(unknowns, data.with_force_scatter(mixture.best.force_scatter), start)

    # The unknowns of the film come first, followed by the nuisances of the session. The estimate contains the joint
    # covariance of the unknowns of the film, but only the standard deviations of the nuisances.
    nuisances = _nuisance_estimates(layout, unknowns, mixture.covariance)
    joint = mixture.covariance[layout.film, layout.film] + problem.gain_covariance(nuisances, force_scatter)

    # One nuisance, the change of the pretension per kelvin, is a property of the film. The estimate also contains its
    # covariances with the unknowns of the film.
    warming = None
    if at_C is not None:
        change = nuisances[PRETENSION_PER_KELVIN.name]
        change_index = layout.nuisance(PRETENSION_PER_KELVIN.name)
        warming = Warming(change.value, change.std, at_C, mixture.covariance[change_index, layout.film])
    return FilmPosterior(
        parameters=unknowns[layout.parameters] * problem.charge_model.prior.std,
        covariance=joint[layout.parameters, layout.parameters],
        coefficients=unknowns[layout.coefficients],
        joint=joint,
        warming=warming,
        contact=from_log_contact(contacts.contact),
        chi2=contacts.chi2,
        degrees_of_freedom=degrees_of_freedom,
        bad=~settled.is_kept,
        nuisances=nuisances,
        force_scatter=force_scatter,
        probabilities=mixture.probabilities,
    )


def _without_negligible_coefficients(layout: UnknownLayout, unknowns: Array) -> Array:
    """Return a copy of estimated unknowns in which negligible coefficients of modes and traces are zero.

    The average over the hypotheses is almost never exactly zero, because each hypothesis with modes or traces has a
    small probability. The coefficients of modes are replaced by zeros only if no magnitude of them exceeds
    `NEGLIGIBLE_COEFFICIENT`. The coefficients of traces are treated in the same way.

    Args:
        layout: Layout of the unknowns.
        unknowns: Estimated unknowns, shape (n_unknown,).
    """
    rounded_unknowns = unknowns.copy()
    for coefficients in (layout.modes, layout.traces):
        largest_magnitude = np.abs(unknowns[coefficients]).max(initial=0.0)
        if largest_magnitude <= NEGLIGIBLE_COEFFICIENT:
            rounded_unknowns[coefficients] = 0.0
    return rounded_unknowns


def _nuisance_estimates(layout: UnknownLayout, unknowns: Array, covariance: Array) -> dict[str, NuisanceEstimate]:
    """Return the estimated value and standard deviation of each nuisance, by the name of the nuisance.

    Args:
        layout: Layout of the unknowns.
        unknowns: Estimated unknowns, shape (n_unknown,).
        covariance: Covariance of the unknowns, shape (n_unknown, n_unknown).
    """
    values = unknowns[layout.nuisances].tolist()
    stds = np.sqrt(np.diag(covariance)[layout.nuisances]).tolist()
    return {
        nuisance.name: NuisanceEstimate(value, std)
        for nuisance, value, std in zip(NUISANCES, values, stds, strict=True)
    }
