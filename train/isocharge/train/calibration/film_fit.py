"""Robust estimation of the film that explains measured presses.

`FitProblem` solves the least-squares problem. If the residual of a press is larger than noise explains, the press gets
a lower weight, as for errors with Student's t distribution (Lange et al., 1989). A single bad press therefore does not
change the film. Presses whose residuals are still too large are then left out and reported.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.calibration import chi_square
from isocharge.train.calibration.contacts import with_force
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.fit_problem import BAD_PROBABILITY, FitProblem, SettledFit, SolvedFilm
from isocharge.train.calibration.hypotheses import Hypothesis
from isocharge.train.calibration.nuisances import NUISANCES, PRETENSION_PER_KELVIN, NuisanceEstimate
from isocharge.train.calibration.press_data import PressData
from isocharge.train.calibration.problem import FilmEstimate, Warming
from isocharge.train.calibration.unknowns import UnknownLayout

STUDENT_T_DEGREES = 4.0
"""Degrees of freedom of the Student's t distribution from which the weights of possibly bad presses follow."""

MAX_WEIGHTINGS = 6
"""Largest number of rounds in which the weights are computed."""

WEIGHT_TOLERANCE = 0.1
"""Largest relative change of a weight at which the weighting ends."""

SUSPICIOUS_PROBABILITY = 0.01
"""Probability of the residuals, if all presses are good, below which bad presses are searched for."""

MAX_BAD_SHARE = 0.34
"""Largest fraction of the presses that is left out.

If more presses disagree, all presses are kept, because it is then uncertain which of them are wrong.
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


@dataclass(frozen=True)
class FilmPosterior(FilmEstimate):
    """Estimate of a film from presses.

    Attributes:
        contact: Contacts of the presses adjusted to this film, (x, y, F), shape (n, 3), mm and N.
        chi2: Sum of squared residuals of each press, shape (n,). For a good press it is about `degrees_of_freedom`.
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,); see `_degrees_of_freedom`.
        bad: Which presses were left out, shape (n,).
        nuisances: Estimate of each nuisance of the session, by its name.
        force_scatter: Relative standard deviation of the forces in addition to that of the rig.
        probabilities: Probability of each hypothesis about effects besides the parameters of the film.
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
        """Sum of the squared residuals of all good presses, and the sum of their degrees of freedom."""
        return float(self.chi2[~self.bad].sum()), float(self.degrees_of_freedom[~self.bad].sum())

    @property
    def imperfect(self) -> bool:
        """Whether the film probably has imperfections or a discrepancy that its parameters do not describe."""
        return self._probability_of_any("modes", "discrepancy") > PROBABLE

    def probability(self, effect: str) -> float:
        """Return the probability that the session has an effect; see `Hypothesis.has`."""
        return self._probability_of_any(effect)

    def _probability_of_any(self, *effects: str) -> float:
        """Return the probability that the session has at least one of several effects."""
        return sum(
            probability
            for hypothesis, probability in self.probabilities.items()
            if any(hypothesis.has(effect) for effect in effects)
        )

    def scaled(self, factor: float) -> "FilmPosterior":
        """Return the estimate with all variances multiplied by a factor.

        Args:
            factor: Factor on the variances.
        """
        warming = self.warming
        if warming is not None:
            std = warming.std * float(np.sqrt(factor))
            warming = warming._replace(std=std, covariance=warming.covariance * factor)
        return replace(self, covariance=self.covariance * factor, joint=self.joint * factor, warming=warming)

    def drifted(self, prior: FilmPrior, *, knows_temperature: bool = False) -> FilmEstimate:
        """Return the estimate for a later time; see `FilmEstimate.drifted`.

        If the film probably has neither imperfections nor a discrepancy, the estimate contains only the parameters of
        the film.

        Args:
            prior: Distribution of the films.
            knows_temperature: Whether the temperature at the later time is known.
        """
        if self.imperfect:
            return super().drifted(prior, knows_temperature=knows_temperature)

        # Remove the coefficients of imperfections and discrepancy. The parameters are the first unknowns.
        warming = self.warming
        if warming is not None:
            warming = warming.with_unknowns(len(self.parameters))
        parameters_only = FilmEstimate(self.parameters, self.covariance, warming=warming)
        return parameters_only.drifted(prior, knows_temperature=knows_temperature)


def fit_film(
    charges: FilmCharges,
    data: PressData,
    initial: FilmEstimate,
    at_C: float | None = None,
    *,
    friction: float = 0.0,
) -> FilmPosterior:
    """Estimate the film from presses, and leave out bad presses.

    The film is fitted to all presses first. If some residuals are too large, the presses that agree with each other are
    searched for, and only they are fitted. These fits assume that the parameters of the film explain the presses alone.
    Further fits then consider hypotheses, which are combinations of other effects, such as imperfections of the film.

    Args:
        charges: The films.
        data: The presses.
        initial: Estimate of the film before the presses.
        at_C: Temperature for which the initial estimate and the result hold, degrees Celsius; None if temperatures were
            not measured.
        friction: Expected coefficient of friction of the presses; 0 for presses without friction.
    """
    problem = FitProblem.of(charges, initial, knows_temperature=at_C is not None, friction=friction)
    degrees_of_freedom = _degrees_of_freedom(data)
    every_press = np.ones(len(data), dtype=bool)
    no_effects = Hypothesis()  # the hypothesis that the parameters alone explain the presses

    # Fit all presses, and find the good ones among them if some residuals are too large.
    is_kept = every_press
    solved = problem.solve(data, is_kept, problem.mean, no_effects)
    can_be_judged = len(data) >= MIN_PRESSES_TO_JUDGE
    if can_be_judged and _is_suspicious(solved.contacts.chi2, degrees_of_freedom):
        is_kept, start = _agreeing_presses(problem, data, solved, degrees_of_freedom)
        kept_data = data[is_kept]
        solved = problem.solve(kept_data, np.ones(len(kept_data)), start, no_effects)

    # Repeat the fit with the most probable hypothesis until the film and the selection of presses no longer change.
    settled = problem.settle(data, is_kept, degrees_of_freedom, solved, no_effects)

    # If the film has imperfections, the presses that were left out may be good ones. The film is fitted to all presses
    # if this is more probable than that these presses were recorded wrongly.
    if not settled.is_kept.all():
        unknowns = settled.solved.unknowns
        film_with_all_presses = SolvedFilm(unknowns, problem.adjusted_contacts(unknowns, data))
        mixture_of_all = problem.mixture(data, film_with_all_presses)
        log_evidence_without_mistakes = mixture_of_all.log_evidence
        log_evidence_with_mistakes = settled.mixture.log_evidence + _log_density_of_mistakes(data, ~settled.is_kept)
        if log_evidence_without_mistakes > log_evidence_with_mistakes:
            settled = problem.settle(data, every_press, degrees_of_freedom, settled.solved, mixture_of_all.best)
    return _posterior(problem, data, degrees_of_freedom, settled, at_C)


def refit_film(
    charges: FilmCharges,
    data: PressData,
    initial: FilmEstimate,
    previous: FilmPosterior,
    at_C: float | None = None,
    *,
    friction: float = 0.0,
) -> FilmPosterior:
    """Estimate the film from presses, with a search that begins at an estimate from similar presses.

    The search also begins with the most probable hypothesis of the previous estimate. It takes less time than
    `fit_film`.

    Args:
        charges: The films.
        data: The presses. None of them is left out.
        initial: Estimate of the film before the presses.
        previous: Previous estimate, which explains most of these presses.
        at_C: Temperature for which all estimates hold, degrees Celsius; None if temperatures were not measured.
        friction: Expected coefficient of friction of the presses; 0 for presses without friction.
    """
    problem = FitProblem.of(charges, initial, knows_temperature=at_C is not None, friction=friction)

    # The unknowns of the previous estimate, with its parameters in units of their prior standard deviations
    layout = problem.layout
    start = np.zeros(layout.count)
    start[layout.parameters] = previous.parameters / charges.prior.std
    start[layout.coefficients] = previous.coefficients
    start[layout.nuisances] = [previous.nuisances[nuisance.name].value for nuisance in NUISANCES]

    # A hypothesis is a combination of effects that the parameters of the film do not describe.
    every_press = np.ones(len(data), dtype=bool)
    most_probable = max(previous.probabilities, key=lambda hypothesis: previous.probabilities[hypothesis])
    solved = problem.solve(data, every_press, start, most_probable)

    # With the hypothesis without effects, `settle` begins with the solved film instead of another fit.
    degrees_of_freedom = _degrees_of_freedom(data)
    settled = problem.settle(data, every_press, degrees_of_freedom, solved, Hypothesis())
    return _posterior(problem, data, degrees_of_freedom, settled, at_C)


def _degrees_of_freedom(data: PressData) -> Array:
    """Return the number of redundant measurements of each press, shape (n,).

    Three of the measured charges and coordinates determine the contact. All others are redundant.
    """
    return np.asarray(np.maximum(data.measured.sum(axis=1) - 3.0, 0.0))


def _is_suspicious(chi2: Array, degrees_of_freedom: Array) -> bool:
    """Return whether the residuals of a single press, or of all presses together, are too large to be noise.

    Args:
        chi2: Sum of squared residuals of each press, shape (n,).
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
    """
    press_probability = chi_square.probability_above(chi2, np.maximum(degrees_of_freedom, 1.0))
    # The smallest of n probabilities is multiplied by n, because the worst press is selected among n (Bonferroni).
    worst_press_probability = press_probability.min() * len(chi2)
    total_probability = chi_square.probability_above(chi2.sum(), max(degrees_of_freedom.sum(), 1.0))
    return bool(min(worst_press_probability, total_probability) < SUSPICIOUS_PROBABILITY)


def _agreeing_presses(
    problem: FitProblem, data: PressData, solved: SolvedFilm, degrees_of_freedom: Array
) -> tuple[Booleans, Array]:
    """Find the film with which most presses agree, and the presses that agree with it.

    The film is fitted repeatedly. Presses with large residuals get smaller weights, as for errors with Student's t
    distribution.

    Args:
        problem: The least-squares problem.
        data: The presses.
        solved: The film that explains all presses best.
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).

    Returns:
        Which presses agree with the film, shape (n,), and the unknowns of the film, shape (n_unknown,).
    """
    weight = np.ones(len(data))
    for _ in range(MAX_WEIGHTINGS):
        previous_weight = weight
        weight = (STUDENT_T_DEGREES + degrees_of_freedom) / (STUDENT_T_DEGREES + solved.contacts.chi2)
        if np.abs(weight / previous_weight - 1.0).max() < WEIGHT_TOLERANCE:
            break
        solved = problem.solve(data, weight, solved.unknowns, Hypothesis())
    return _is_good(solved.contacts.chi2, degrees_of_freedom), solved.unknowns


def _is_good(chi2: Array, degrees_of_freedom: Array) -> Booleans:
    """Return which presses agree with a film, shape (n,). If most presses do not agree, all count as good.

    A press agrees if chance explains its residuals with a probability of `BAD_PROBABILITY` or more, corrected for the
    number of presses (Bonferroni).

    Args:
        chi2: Sum of squared residuals of each press, shape (n,).
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
    """
    # The distribution is not defined for zero degrees of freedom. Presses without redundancy have no residuals.
    positive_degrees = np.maximum(degrees_of_freedom, 1.0)
    limit = chi_square.value_exceeded_with(BAD_PROBABILITY / len(chi2), positive_degrees)

    # The residuals of all presses may be larger than expected. The limit is then increased by the same factor.
    expected_median = np.maximum(chi_square.value_exceeded_with(0.5, positive_degrees), 0.1)
    typical_ratio = max(1.0, float(np.median(chi2 / expected_median)))
    is_good = chi2 <= limit * typical_ratio
    if np.mean(~is_good) > MAX_BAD_SHARE:  # no film explains most presses: leave out none of them
        return np.ones_like(is_good)
    return np.asarray(is_good)


def _log_density_of_mistakes(data: PressData, is_mistake: Booleans) -> float:
    """Return the logarithm of the probability density of presses that were recorded wrongly.

    Args:
        data: All presses.
        is_mistake: Which presses were recorded wrongly, shape (n,).
    """
    charge_count = data.has_charge[is_mistake].sum()
    log_density_of_charges = LOG_DENSITY_OF_MISTAKE * charge_count
    log_probability_of_mistakes = is_mistake.sum() * np.log(MISTAKE_PROBABILITY)
    return float(log_density_of_charges + log_probability_of_mistakes)


def _posterior(
    problem: FitProblem, data: PressData, degrees_of_freedom: Array, settled: SettledFit, at_C: float | None
) -> FilmPosterior:
    """Compute the estimate of the film from a fit that has settled.

    Args:
        problem: The least-squares problem.
        data: All presses.
        degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
        settled: The settled fit.
        at_C: Temperature of the film, degrees Celsius; None if temperatures were not measured.
    """
    layout = problem.layout
    mixture = settled.mixture  # average over all hypotheses, as a difference from the mean before the presses
    unknowns = np.clip(problem.mean + mixture.mean, *problem.bounds)

    # Root-mean-square scatter of the forces over the hypotheses
    scatter_variance = sum(
        probability * hypothesis.force_scatter**2 for hypothesis, probability in mixture.probabilities.items()
    )
    force_scatter = float(np.sqrt(scatter_variance))

    # The contacts of the fit are a good start only if they include those of all presses.
    start = settled.solved.contacts.contact if settled.is_kept.all() else None
    contacts = problem.adjusted_contacts(unknowns, data.with_force_scatter(mixture.best.force_scatter), start)

    # The unknowns are those of the film, which are reported with their covariance, and nuisances of the session.
    nuisances = _nuisance_estimates(layout, unknowns, mixture.covariance)
    joint = mixture.covariance[layout.film, layout.film] + problem.gain_covariance(nuisances, force_scatter)
    warming = None
    if at_C is not None:
        change = nuisances[PRETENSION_PER_KELVIN.name]
        change_index = layout.nuisance(PRETENSION_PER_KELVIN.name)
        warming = Warming(change.value, change.std, at_C, mixture.covariance[change_index, layout.film])
    return FilmPosterior(
        parameters=unknowns[layout.parameters] * problem.charges.prior.std,
        covariance=joint[layout.parameters, layout.parameters],
        coefficients=unknowns[layout.coefficients],
        joint=joint,
        warming=warming,
        contact=with_force(contacts.contact),
        chi2=contacts.chi2,
        degrees_of_freedom=degrees_of_freedom,
        bad=~settled.is_kept,
        nuisances=nuisances,
        force_scatter=force_scatter,
        probabilities=mixture.probabilities,
    )


def _nuisance_estimates(layout: UnknownLayout, unknowns: Array, covariance: Array) -> dict[str, NuisanceEstimate]:
    """Return the value and the standard deviation of each nuisance by its name."""
    values = unknowns[layout.nuisances].tolist()
    stds = np.sqrt(np.diag(covariance)[layout.nuisances]).tolist()
    return {
        nuisance.name: NuisanceEstimate(value, std)
        for nuisance, value, std in zip(NUISANCES, values, stds, strict=True)
    }
