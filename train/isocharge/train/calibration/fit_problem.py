"""Least-squares problem whose solution is the film that explains the presses of a calibration best.

The solution is the vector of unknowns p that minimises the sum of two parts. The first part is the sum of the squared
residuals of all presses. Each measured charge and each coordinate that the rig measured has one residual. The second
part is (p - mean)' C^-1 (p - mean), where mean and C are the prior mean and the prior covariance of the unknowns.

The problem is solved by SciPy's trust-region method. In every step, the contacts of the presses are adjusted to the
film with the unknowns p (variable projection, Golub and Pereyra 1973). Therefore, only p has to be searched for.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from isocharge.common.arrays import Array, Booleans
from isocharge.train.calibration import chi_square
from isocharge.train.calibration.bounded_normal import most_probable_within
from isocharge.train.calibration.contacts import (
    AdjustedContacts,
    adjust_contacts,
    best_adjusted_contacts,
    derivatives_with_adjusted_contacts,
    from_log_contact,
    neighbouring_films,
    weighted_sum,
)
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.hypotheses import (
    FORCE_SCATTERS,
    Hypothesis,
    LinearModel,
    Mixture,
    mix_hypotheses,
)
from isocharge.train.calibration.nuisances import (
    FRICTION,
    NUISANCES,
    PRETENSION_PER_KELVIN,
    NuisanceEstimate,
    nuisance_derivatives,
    without_nuisances,
)
from isocharge.train.calibration.press_data import PressData
from isocharge.train.calibration.problem import FilmEstimate
from isocharge.train.calibration.unknowns import UnknownLayout

BAD_PROBABILITY = 1e-4
"""Probability with which a good press has a larger sum of squared residuals than the limit for bad presses."""

TOLERANCE = 1e-4
"""Relative change of the sum of squares, or of the unknowns, at which a fit ends."""

MAX_STEPS = 25
"""Largest number of steps of a fit. A fit that begins at the mean of the prior takes about eight."""

MAX_ROUNDS = 3
"""Largest number of fits. Each fit uses the most probable hypothesis of the previous fit."""

MEAN_OVER_STD = 1.7
"""Ratio of mean to standard deviation of an effect that only lowers charges at random, such as a leak.

The ratio is that of a uniform distribution that begins at zero. Presses cannot distinguish the mean of such an effect
from a gain.
"""

MAX_LINEAR_STEP = 0.2
"""Largest step of a parameter, in prior standard deviations, for which the derivatives are not computed again."""

SMALLEST_DERIVATIVE = 1e-12
"""Smallest length by which the vector of derivatives of the residuals of a press is divided."""

BOUND_MARGIN = 1e-3
"""Smallest distance from the bounds at which a search begins, in prior standard deviations.

SciPy's method must begin strictly inside the bounds."""


class SolvedFilm(NamedTuple):
    """Film that explains measured presses best, with the contacts of these presses.

    Attributes:
        unknowns: Unknowns of the film, shape (n_unknown,). Parameters are in units of their prior standard deviations.
        contacts: Contacts of the presses, adjusted to the film.
    """

    unknowns: Array
    contacts: AdjustedContacts


class SettledFit(NamedTuple):
    """Film and selection of presses that `FitProblem.settle` finds by repeated fits.

    Attributes:
        is_kept: Whether each press was used in the last fit, shape (n,). The other presses were left out as bad.
        solved: The film that explains the kept presses best, under the hypothesis of the last fit.
        mixture: Estimate of the unknowns, averaged over all hypotheses.
    """

    is_kept: Booleans
    solved: SolvedFilm
    mixture: Mixture


@dataclass(frozen=True)
class FitProblem:
    """Least-squares problem of a calibration: the possible films, and the prior of their unknowns.

    Attributes:
        charge_model: Model of the charges of all films.
        mean: Mean of the unknowns before the presses, shape (n_unknown,). Parameters are in units of their prior
            standard deviations.
        covariance: Covariance of the unknowns before the presses without a hypothesis, shape (n_unknown, n_unknown).
    """

    charge_model: FilmCharges
    mean: Array
    covariance: Array

    @classmethod
    def from_estimate(
        cls, charge_model: FilmCharges, initial: FilmEstimate, *, knows_temperature: bool, friction: float = 0.0
    ) -> "FitProblem":
        """Create the problem from the estimate of a film before the presses.

        An unknown whose prior variance is zero keeps its mean in a fit, unless the hypothesis of the fit adds a
        variance.

        Args:
            charge_model: Model of the charges of all films.
            initial: Estimate of the film before the presses. If it has no coefficients, their mean and variance are
                zero.
            knows_temperature: Whether the temperatures of the presses are known. If they are known, the nuisances that
                describe the effects of temperature get a variance.
            friction: Expected coefficient of friction, which is also its prior standard deviation; 0 for presses
                without friction.
        """
        layout = charge_model.layout
        mean = np.zeros(layout.count)
        covariance = np.zeros((layout.count, layout.count))

        # The first unknowns are those of the film: the parameters, and the coefficients if the estimate has them.
        film_unknowns = slice(0, initial.unknowns.size)
        mean[layout.parameters] = initial.parameters / charge_model.prior.std
        if initial.coefficients.size:
            mean[layout.coefficients] = initial.coefficients
        covariance[film_unknowns, film_unknowns] = initial.unknown_covariance

        # The last unknowns are the nuisances of the session. Most of them get a variance only by a hypothesis.
        if knows_temperature:
            for nuisance in NUISANCES:
                index = layout.nuisance(nuisance.name)
                covariance[index, index] = nuisance.std_with_temperatures**2
        # An earlier calibration may have determined the change of the pretension with temperature.
        if knows_temperature and initial.warming is not None:
            change_index = layout.nuisance(PRETENSION_PER_KELVIN.name)
            mean[change_index] = initial.warming.MPa_per_K
            covariance[change_index, change_index] = initial.warming.std**2
            covariance[film_unknowns, change_index] = initial.warming.covariance
            covariance[change_index, film_unknowns] = initial.warming.covariance

        friction_index = layout.nuisance(FRICTION.name)
        mean[friction_index] = friction
        covariance[friction_index, friction_index] = friction**2
        return cls(charge_model, mean, covariance)

    @property
    def layout(self) -> UnknownLayout:
        """Layout of the vector of unknowns, with the index of each unknown."""
        return self.charge_model.layout

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the unknowns, each of shape (n_unknown,).

        The bounds of parameters are in units of their prior standard deviations. All other unknowns are unbounded.
        """
        layout = self.layout
        prior = self.charge_model.prior
        parameter_lower, parameter_upper = prior.bounds
        lower = np.full(layout.count, -np.inf)
        upper = np.full(layout.count, np.inf)
        lower[layout.parameters] = parameter_lower / prior.std
        upper[layout.parameters] = parameter_upper / prior.std
        return lower, upper

    def solve(self, data: PressData, weight: Array, start: Array, hypothesis: Hypothesis) -> SolvedFilm:
        """Fit the film to weighted presses, assuming a hypothesis.

        Args:
            data: The measured presses.
            weight: Weight of the squared residuals of each press, shape (n,).
            start: Unknowns at which the search begins, shape (n_unknown,).
            hypothesis: Effects that the session may have. Unknowns without a variance under this hypothesis keep their
                mean.

        Returns:
            The film that explains the presses best. If the fit does not end within `MAX_STEPS` steps, the film of the
            last step is returned.
        """
        fit = _FilmFit(self, data, weight, hypothesis)
        lower, upper = (bound[fit.active] for bound in self.bounds)
        # SciPy requires a start strictly inside the bounds.
        start_inside = np.clip(start[fit.active], lower + BOUND_MARGIN, upper - BOUND_MARGIN)
        result = least_squares(
            fit.residual,
            start_inside,
            fit.jacobian,
            bounds=(lower, upper),
            x_scale=1.0,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            max_nfev=MAX_STEPS,
        )
        return fit.film_at(result.x)

    def settle(
        self,
        data: PressData,
        is_kept: Booleans,
        degrees_of_freedom: Array,
        solved: SolvedFilm,
        hypothesis: Hypothesis,
    ) -> SettledFit:
        """Repeat the fit until neither the film nor the selection of presses changes.

        A hypothesis is a combination of effects that the parameters of the film do not describe. Each round fits the
        film under the most probable hypothesis of the previous round, and then averages the estimates under all
        hypotheses. This average is the mixture. A press that was left out as bad is used again in the next round if it
        agrees with the film. There are at most `MAX_ROUNDS` rounds.

        Args:
            data: All presses.
            is_kept: Whether each press is used in the first round, shape (n,).
            degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
            solved: The film at which the first round begins. If the hypothesis has no effects, the first round uses
                this film without another fit.
            hypothesis: Hypothesis of the first round.

        Returns:
            The presses, the film and the mixture of the last round.
        """
        has_effects = hypothesis != Hypothesis()
        if has_effects:
            solved = self._solve_kept(data, is_kept, solved.unknowns, hypothesis)
        for round_index in range(MAX_ROUNDS):
            mixture = self.mixture(data[is_kept], solved)
            # The mixture is computed with derivatives at the solved film. Therefore, it is accurate only if the step
            # from the solved film to the average of the mixture is small.
            step = self.mean + mixture.mean_change - solved.unknowns
            is_step_small = np.abs(step[self.layout.parameters]).max() < MAX_LINEAR_STEP

            # Add the presses that now agree with the film, unless all presses are kept already.
            is_kept_next = is_kept
            if not is_kept.all():
                is_kept_next = is_kept | self.agrees(data, solved, mixture, degrees_of_freedom)
            is_selection_stable = np.array_equal(is_kept_next, is_kept)

            # The returned film and mixture must belong to the same presses, so `is_kept` changes only if another round
            # follows.
            is_last_round = round_index == MAX_ROUNDS - 1
            if is_last_round or (is_step_small and is_selection_stable):
                break
            is_kept = is_kept_next
            solved = self._solve_kept(data, is_kept, solved.unknowns, mixture.best)
        return SettledFit(is_kept, solved, mixture)

    def _solve_kept(self, data: PressData, is_kept: Booleans, start: Array, hypothesis: Hypothesis) -> SolvedFilm:
        """Fit the film to the kept presses, all with the weight 1; see `solve`.

        Args:
            data: All presses.
            is_kept: Whether each press is used, shape (n,).
            start: Unknowns at which the search begins, shape (n_unknown,).
            hypothesis: Effects that the session may have.
        """
        kept_data = data[is_kept]
        return self.solve(kept_data, np.ones(len(kept_data)), start, hypothesis)

    def agrees(self, data: PressData, solved: SolvedFilm, mixture: Mixture, degrees_of_freedom: Array) -> Booleans:
        """Return whether each press agrees with a film within the uncertainty of the film, shape (n,).

        A press agrees if r' S^-1 r does not exceed a quantile of the chi-square distribution. Here r is the vector of
        the residuals of the press for the estimated unknowns, and S is the covariance of r. The covariance S includes
        the noise and the uncertainty of the film.

        Args:
            data: The presses. They may include presses that the fit did not use.
            solved: The film at which the residuals are linearised.
            mixture: The estimate of the unknowns.
            degrees_of_freedom: Number of redundant measurements of each press, shape (n,).
        """
        scattered_data = data.with_force_scatter(mixture.best.force_scatter)
        contacts = self.adjusted_contacts(solved.unknowns, scattered_data)
        jacobian = self.derivatives(SolvedFilm(solved.unknowns, contacts), scattered_data)

        # Residuals r for the estimated unknowns, by a linear approximation about the solved film
        step = self.mean + mixture.mean_change - solved.unknowns
        residual = contacts.residual + jacobian @ step

        # Covariance S of the residuals of each press. The noise contributes the identity matrix, because residuals are
        # in units of their standard deviations.
        residual_count = jacobian.shape[1]
        covariance = np.eye(residual_count) + jacobian @ mixture.covariance @ jacobian.swapaxes(1, 2)

        # r' S^-1 r of each press. The residuals are passed to NumPy as matrices with one column.
        weighted_residual = np.linalg.solve(covariance, residual[:, :, None])[:, :, 0]
        chi2 = (residual * weighted_residual).sum(axis=1)
        positive_degrees = np.maximum(degrees_of_freedom, 1.0)  # the distribution is not defined for zero degrees
        limit = chi_square.value_exceeded_with(BAD_PROBABILITY / len(data), positive_degrees)
        return np.asarray(chi2 <= limit)

    def mixture(self, data: PressData, solved: SolvedFilm) -> Mixture:
        """Estimate the unknowns from presses by averaging over all hypotheses.

        A hypothesis is a combination of effects that the parameters of the film do not describe. The residuals of the
        presses are approximated by linear functions of the unknowns near a solved film. The average is kept within the
        bounds of the unknowns.

        Args:
            data: The measured presses.
            solved: The film that explains the presses best, with the contacts of the presses on this film.

        Returns:
            The average of the estimates under all hypotheses.
        """
        # The fit may have assumed a scatter of the forces. The contacts are adjusted again without this assumption.
        unknowns = solved.unknowns
        contacts = self.adjusted_contacts(unknowns, data, solved.contacts.contact)
        adjusted = SolvedFilm(unknowns, contacts)

        # Linear model of the residuals for each possible scatter of the forces
        jacobian = self.derivatives(adjusted, data)
        models_by_scatter = self._models_by_force_scatter(adjusted, data, jacobian)
        mixture = mix_hypotheses(models_by_scatter, self.prior_covariance)
        bounded_unknowns = most_probable_within(self.bounds, self.mean + mixture.mean_change, mixture.covariance)
        return mixture._replace(mean_change=bounded_unknowns - self.mean)

    def _models_by_force_scatter(
        self, solved: SolvedFilm, data: PressData, jacobian: Array
    ) -> dict[float, LinearModel]:
        """Create a linear model of the residuals for each value in `FORCE_SCATTERS`.

        The value is an assumed random scatter of the stated forces, which adds noise to the vector of the residuals of
        each press. The noise changes the vector only along its derivative with respect to the logarithm of the stated
        force. The standard deviation of the noise is the scatter times the length of this derivative.

        Args:
            solved: The film about which the residuals are linearised, and the contacts of the presses on this film.
            data: The measured presses.
            jacobian: Derivatives of the residuals with respect to the unknowns, shape (n, n_electrode + 3, n_unknown).

        Returns:
            Linear model for each scatter in `FORCE_SCATTERS`. A scatter is a standard deviation relative to the force.
        """
        residual = solved.contacts.residual
        deviation = solved.unknowns - self.mean
        model = LinearModel.from_residuals(jacobian.reshape(-1, solved.unknowns.size), residual.ravel(), deviation)

        # Unit vector of the derivative with respect to the force for each press, shape (n, n_electrode + 3)
        force_derivative = self._force_derivative(solved.unknowns, data, solved.contacts)
        derivative_length = np.linalg.norm(force_derivative, axis=1)
        noise_direction = force_derivative / np.maximum(derivative_length, SMALLEST_DERIVATIVE)[:, None]

        # Components of the Jacobian, shape (n, n_unknown), and of the residuals, shape (n,), along the unit vectors:
        # sums over the residuals k of each press n, for each unknown u
        jacobian_component = np.einsum("nk,nku->nu", noise_direction, jacobian)
        residual_component = (noise_direction * residual).sum(axis=1)

        models = {}
        for scatter in FORCE_SCATTERS:
            noise_variance = (scatter * derivative_length) ** 2
            models[scatter] = model.with_added_noise(jacobian_component, residual_component, deviation, noise_variance)
        return models

    def adjusted_contacts(self, unknowns: Array, data: PressData, start: Array | None = None) -> AdjustedContacts:
        """For each press, find the contact that agrees best with the measurements on a given film.

        The effects of the nuisances are first subtracted from the charges of the presses.

        Args:
            unknowns: Unknowns of the film and nuisances, shape (n_unknown,).
            data: The presses as they were measured.
            start: Contacts (x, y, ln F) at which the search begins, shape (n, 3); if it is None, the search
                has several starts; see `best_adjusted_contacts`.
        """
        film = self._film(unknowns)
        corrected_data = self._without_nuisances(unknowns, data)
        if start is None:
            return best_adjusted_contacts(self.charge_model, film, corrected_data)
        return adjust_contacts(self.charge_model, film, corrected_data, start)

    def derivatives(self, solved: SolvedFilm, data: PressData, *, with_coefficients: bool = True) -> Array:
        """Compute the derivatives of the residuals of presses with respect to the unknowns.

        A change of the unknowns also moves the adjusted contacts, and the derivatives include this movement.

        Args:
            solved: The film, and the contacts of the presses on this film.
            data: The measured presses.
            with_coefficients: Whether to compute the derivatives with respect to the coefficients of the film, which is
                slow. If False, zeros are returned for these derivatives.

        Returns:
            Derivatives, shape (n, n_electrode + 3, n_unknown).
        """
        layout = self.layout
        film_unknowns = layout.film if with_coefficients else layout.parameters
        contact = from_log_contact(solved.contacts.contact)

        # Derivatives of the charges with respect to the contacts (`contact_slopes`) and to the unknowns of the film
        # (`unknown_slopes`). The pretension may differ between the presses. Therefore, the derivatives are computed for
        # films with several pretensions, and are interpolated for each press.
        films, film_weights = self._neighbouring_films(solved.unknowns, data)
        contact_slopes_of_films = [self.charge_model.contact_slopes(film, contact) for film in films]
        unknown_slopes_of_films = [
            self.charge_model.unknown_slopes(film[film_unknowns], contact, contact_slopes)
            for film, contact_slopes in zip(films, contact_slopes_of_films, strict=True)
        ]
        charge_contact_slopes = weighted_sum(contact_slopes_of_films, film_weights)
        charge_unknown_slopes = weighted_sum(unknown_slopes_of_films, film_weights)

        # The unknowns of the film change only the residuals of the charges. They are the first residuals of each press.
        jacobian = np.zeros((*data.measured.shape, layout.count))
        charge_rows = slice(0, data.charge.shape[1])
        jacobian[:, charge_rows, film_unknowns] = data.weight[:, :, None] * charge_unknown_slopes

        # A nuisance changes either the charges or the pretension. The derivative with respect to the pretension is
        # converted from prior standard deviations to MPa.
        pretension = layout.parameter("pretension")
        pretension_derivative = jacobian[:, :, pretension] / self.charge_model.prior.std[pretension]
        jacobian[:, :, layout.nuisances] = nuisance_derivatives(data, pretension_derivative)

        residual_contact_slopes = data.residual_slopes(charge_contact_slopes)
        return derivatives_with_adjusted_contacts(jacobian, residual_contact_slopes)

    def gain_covariance(self, nuisances: dict[str, NuisanceEstimate], force_scatter: float) -> Array:
        """Return the additional covariance of the unknowns of the film for its use after the session.

        If the charges drift or the forces scatter during the session, later contacts may be affected differently.
        Therefore, the mean of all gains remains uncertain. The additional relative error is the same for all gains.

        Args:
            nuisances: Estimates of the nuisances of the session by name.
            force_scatter: Standard deviation of the scatter of the forces, relative to the force.

        Returns:
            Covariance, shape (n_film_unknown, n_film_unknown), in units of the prior standard deviations.
        """
        # The errors by each nuisance and by the scatter are independent, so their variances are added.
        gain_std = 0.0
        for nuisance in NUISANCES:
            gain_std = float(np.hypot(gain_std, nuisance.gain_std(nuisances[nuisance.name])))
        # If the cause of the scatter only lowers charges, its unknown mean has the effect of an error of all gains.
        mean_effect = MEAN_OVER_STD * force_scatter
        gain_std = float(np.hypot(gain_std, mean_effect))

        common_error = np.zeros(self.layout.film_count)
        common_error[self.charge_model.prior.gains] = gain_std / self.charge_model.prior.spread.gain
        return np.outer(common_error, common_error)

    def prior_covariance(self, hypothesis: Hypothesis) -> Array:
        """Return the prior covariance of the unknowns under a hypothesis, shape (n_unknown, n_unknown)."""
        return self.covariance + hypothesis.covariance(self.layout)

    def _film(self, unknowns: Array) -> Array:
        """Return the parameters and coefficients of the film in the units that `FilmCharges.film` expects.

        Args:
            unknowns: All unknowns, with parameters in units of their prior standard deviations, shape (n_unknown,).

        Returns:
            Parameters in their own units, followed by the coefficients, shape (n_film_unknown,).
        """
        film = unknowns[self.layout.film].copy()
        film[self.layout.parameters] *= self.charge_model.prior.std
        return film

    def _without_nuisances(self, unknowns: Array, data: PressData) -> PressData:
        """Subtract the effects of nuisances from presses; see `without_nuisances`."""
        return without_nuisances(data, unknowns[self.layout.nuisances])

    def _neighbouring_films(self, unknowns: Array, data: PressData) -> tuple[list[Array], Array]:
        """Return the films between which the charges of presses are interpolated; see `neighbouring_films`."""
        return neighbouring_films(self.charge_model, self._film(unknowns), self._without_nuisances(unknowns, data))

    def _force_derivative(self, unknowns: Array, data: PressData, contacts: AdjustedContacts) -> Array:
        """Compute the derivatives of the residuals with respect to the logarithm of the stated force.

        A change of the stated force also moves the adjusted contact, and the derivatives include this movement.

        Args:
            unknowns: Unknowns of the film and nuisances, shape (n_unknown,).
            data: The measured presses.
            contacts: The adjusted contacts of the presses on this film.

        Returns:
            Derivatives, shape (n, n_electrode + 3).
        """
        contact = from_log_contact(contacts.contact)
        films, film_weights = self._neighbouring_films(unknowns, data)
        # Derivatives with respect to the contacts, interpolated between films with several pretensions
        contact_slopes_of_films = [self.charge_model.contact_slopes(film, contact) for film in films]
        residual_contact_slopes = data.residual_slopes(weighted_sum(contact_slopes_of_films, film_weights))
        # The stated force is treated as the only unknown. Therefore, an axis of length 1 is added, and then removed.
        residual_force_slopes = data.force_derivative()[:, :, None]
        derivatives = derivatives_with_adjusted_contacts(residual_force_slopes, residual_contact_slopes)
        return derivatives[:, :, 0]


class _FilmFit:
    """Residuals of one fit as functions of the active unknowns, in the form that SciPy expects.

    An unknown is active if it has a variance under the hypothesis of the fit. The fit changes only the active unknowns.
    All other unknowns keep their mean.

    Attributes:
        active: Whether each unknown is active, shape (n_unknown,).
    """

    def __init__(self, problem: FitProblem, data: PressData, weight: Array, hypothesis: Hypothesis) -> None:
        """Prepare a fit: compute all values that do not change from step to step.

        Args:
            problem: The least-squares problem.
            data: The measured presses.
            weight: Weight of the squared residuals of each press, shape (n,).
            hypothesis: Effects that the session may have.
        """
        self._problem = problem
        self._data = data.with_force_scatter(hypothesis.force_scatter)
        self._root_weight = np.sqrt(weight)  # factor on the residuals, whose squares then have the given weight

        # The fit changes only the active unknowns, which are those with a variance under the hypothesis.
        covariance = problem.prior_covariance(hypothesis)
        self.active = np.diag(covariance) > 0.0
        self._has_coefficients = bool(self.active[problem.layout.coefficients].any())
        # The whitening matrix converts deviations from the prior mean into residuals with the variance 1.
        active_covariance = covariance[np.ix_(self.active, self.active)]
        self._whitening = np.linalg.inv(np.linalg.cholesky(active_covariance))
        self._latest: tuple[Array, SolvedFilm] | None = None  # active unknowns and film of the latest evaluation

    def film_at(self, active_unknowns: Array) -> SolvedFilm:
        """Return the film with given unknowns, together with the best contacts of the presses on this film.

        The latest film is stored, because SciPy evaluates the residuals and the derivatives of each film separately.
        The search for the contacts on the next film begins at the contacts on the latest film.

        Args:
            active_unknowns: Values of the active unknowns, shape (n_active,).
        """
        start_contacts_of_search = None  # without a latest film, each search has several starts
        if self._latest is not None:
            latest_unknowns, latest_film = self._latest
            if np.array_equal(latest_unknowns, active_unknowns):
                return latest_film
            start_contacts_of_search = latest_film.contacts.contact
        unknowns = self._problem.mean.copy()
        unknowns[self.active] = active_unknowns
        contacts = self._problem.adjusted_contacts(unknowns, self._data, start_contacts_of_search)
        film = SolvedFilm(unknowns, contacts)
        self._latest = (active_unknowns.copy(), film)  # a copy, because SciPy may change its array
        return film

    def residual(self, active_unknowns: Array) -> Array:
        """Return the weighted residuals of all presses, followed by the residuals of the prior, shape (n_residual,).

        Args:
            active_unknowns: Values of the active unknowns, shape (n_active,).
        """
        press_residual = self.film_at(active_unknowns).contacts.residual * self._root_weight[:, None]
        prior_residual = self._whitening @ (active_unknowns - self._problem.mean[self.active])
        return np.concatenate([press_residual.ravel(), prior_residual])

    def jacobian(self, active_unknowns: Array) -> Array:
        """Return the derivatives of `residual` with respect to the active unknowns, shape (n_residual, n_active).

        Args:
            active_unknowns: Values of the active unknowns, shape (n_active,).
        """
        film = self.film_at(active_unknowns)
        derivatives = self._problem.derivatives(film, self._data, with_coefficients=self._has_coefficients)
        press_rows = derivatives[:, :, self.active] * self._root_weight[:, None, None]
        return np.concatenate([press_rows.reshape(-1, active_unknowns.size), self._whitening])
