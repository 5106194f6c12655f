"""Least-squares problem of a calibration, whose solution is the film that explains presses best.

The unknowns p minimise the sum of two parts. The first part contains the squared residuals of the charges and of the
rig. The residuals of each press are computed at the contact where the sum of their squares is smallest. The second part
is the prior, |(p - mean) / std|^2.

The problem is solved by SciPy's trust-region method. The contacts are eliminated in every step (variable projection,
Golub and Pereyra 1973), so that only the unknowns of the film remain.
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
    derivatives_with_adjusted_contacts,
    neighbouring_films,
    start_contacts,
    weighted_sum,
    with_force,
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
"""Probability with which a good press has a larger residual than the limit for bad presses."""

TOLERANCE = 1e-4
"""Relative change of the sum of squares, or of the unknowns, at which a fit ends."""

MAX_STEPS = 25
"""Largest number of steps of a fit. A fit that begins at the mean of the prior takes about eight."""

MAX_ROUNDS = 3
"""Largest number of fits. Each fit uses the most probable hypothesis of the previous fit."""

MEAN_OVER_STD = 1.7
"""Mean of an effect that only lowers charges at random, such as a leak, over its standard deviation.

The value is that of a share with a uniform distribution from zero upwards. Presses cannot distinguish the mean of such
an effect from a gain.
"""

MAX_LINEAR_STEP = 0.2
"""Largest step of a parameter, in prior standard deviations, for which the derivatives are not computed again."""

SMALLEST_DERIVATIVE = 1e-12
"""Smallest length by which the derivatives of the residuals with respect to the force are divided."""

BOUND_MARGIN = 1e-3
"""Smallest distance of a start from the bounds, in standard deviations, because the method must start inside them."""


class SolvedFilm(NamedTuple):
    """The film that explains presses best.

    Attributes:
        unknowns: Unknowns of the film, shape (n_unknown,). Parameters are in units of their prior standard deviations.
        contacts: Contacts of the presses, adjusted to the film.
    """

    unknowns: Array
    contacts: AdjustedContacts


class SettledFit(NamedTuple):
    """Result of repeated fits of a film, as `FitProblem.settle` returns it.

    Attributes:
        is_kept: Which presses are kept, shape (n,).
        solved: The film that explains the kept presses best.
        mixture: Estimate of the unknowns, averaged over all hypotheses.
    """

    is_kept: Booleans
    solved: SolvedFilm
    mixture: Mixture


@dataclass(frozen=True)
class FitProblem:
    """Films, and the estimate of their unknowns before the presses.

    Attributes:
        charges: The films.
        mean: Mean of the unknowns before the presses, shape (n_unknown,). Parameters are in units of their prior
            standard deviations.
        covariance: Covariance of the unknowns before the presses without a hypothesis, shape (n_unknown, n_unknown).
    """

    charges: FilmCharges
    mean: Array
    covariance: Array

    @classmethod
    def of(
        cls, charges: FilmCharges, initial: FilmEstimate, *, knows_temperature: bool, friction: float = 0.0
    ) -> "FitProblem":
        """Return the problem of a film, with the mean and the covariance of all unknowns before the presses.

        Unknowns without a prior variance stay at their mean, unless a hypothesis adds a variance.

        Args:
            charges: The films.
            initial: Estimate of the film before the presses. Coefficients that it does not have are zero.
            knows_temperature: Whether the temperatures of the presses are known, so that the nuisances of temperature
                are unknowns.
            friction: Expected coefficient of friction, which is also its standard deviation; 0 for presses without
                friction.
        """
        layout = charges.layout
        mean = np.zeros(layout.count)
        covariance = np.zeros((layout.count, layout.count))

        # The unknowns of the film come first: the parameters, and the coefficients if the estimate has them.
        film_unknowns = slice(0, initial.unknowns.size)
        mean[layout.parameters] = initial.parameters / charges.prior.std
        if initial.coefficients.size:
            mean[layout.coefficients] = initial.coefficients
        covariance[film_unknowns, film_unknowns] = initial.unknown_covariance

        if knows_temperature:
            for nuisance in NUISANCES:
                index = layout.nuisance(nuisance.name)
                covariance[index, index] = nuisance.std_with_temperatures**2
        if knows_temperature and initial.warming is not None:
            change_index = layout.nuisance(PRETENSION_PER_KELVIN.name)
            mean[change_index] = initial.warming.MPa_per_K
            covariance[change_index, change_index] = initial.warming.std**2
            covariance[film_unknowns, change_index] = initial.warming.covariance
            covariance[change_index, film_unknowns] = initial.warming.covariance

        friction_index = layout.nuisance(FRICTION.name)
        mean[friction_index] = friction
        covariance[friction_index, friction_index] = friction**2
        return cls(charges, mean, covariance)

    @property
    def layout(self) -> UnknownLayout:
        """Indices of the unknowns in the vector of unknowns."""
        return self.charges.layout

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the unknowns, each of shape (n_unknown,).

        The bounds of parameters are in units of their prior standard deviations. All other unknowns are unbounded.
        """
        layout = self.layout
        prior = self.charges.prior
        parameter_lower, parameter_upper = prior.bounds
        lower = np.full(layout.count, -np.inf)
        upper = np.full(layout.count, np.inf)
        lower[layout.parameters] = parameter_lower / prior.std
        upper[layout.parameters] = parameter_upper / prior.std
        return lower, upper

    def solve(self, data: PressData, weight: Array | Booleans, start: Array, hypothesis: Hypothesis) -> SolvedFilm:
        """Return the film that explains weighted presses best.

        Args:
            data: The presses.
            weight: Weight of the squared residuals of each press, shape (n,).
            start: Unknowns at which the search begins, shape (n_unknown,).
            hypothesis: Effects that the session may have. Unknowns that the hypothesis excludes stay at their mean.
        """
        data = data.with_force_scatter(hypothesis.force_scatter)
        root_weight = np.sqrt(weight)  # the residuals are multiplied by the root, because their squares are weighted

        # Only unknowns with a variance are active, that is, changed by the fit.
        covariance = self._prior_covariance(hypothesis)
        active = np.diag(covariance) > 0.0
        active_covariance = covariance[np.ix_(active, active)]
        has_coefficients = bool(active[self.layout.coefficients].any())
        lower, upper = (bound[active] for bound in self.bounds)
        # The whitening matrix converts deviations from the prior mean into residuals with the variance 1.
        whitening = np.linalg.inv(np.linalg.cholesky(active_covariance))
        latest: tuple[Array, SolvedFilm] | None = None

        def film_at(active_unknowns: Array) -> SolvedFilm:
            """Return the film with given unknowns, and the contacts that agree best with this film.

            The latest film is stored, because SciPy evaluates the residuals and the derivatives of each film
            separately. The search for the contacts begins at the contacts of the latest film.

            Args:
                active_unknowns: The unknowns that the hypothesis includes, shape (n_active,). The others have their
                    mean.
            """
            nonlocal latest
            start_of_contacts = None
            if latest is not None:
                latest_unknowns, latest_film = latest
                if np.array_equal(latest_unknowns, active_unknowns):
                    return latest_film
                start_of_contacts = latest_film.contacts.contact
            unknowns = self.mean.copy()
            unknowns[active] = active_unknowns
            film = SolvedFilm(unknowns, self.adjusted_contacts(unknowns, data, start_of_contacts))
            latest = (active_unknowns.copy(), film)
            return film

        def residual(active_unknowns: Array) -> Array:
            """Return the residuals of all presses and of the prior, shape (n_residual,)."""
            press_residual = film_at(active_unknowns).contacts.residual * root_weight[:, None]
            prior_residual = whitening @ (active_unknowns - self.mean[active])
            return np.concatenate([press_residual.ravel(), prior_residual])

        def jacobian(active_unknowns: Array) -> Array:
            """Return the derivatives of the residuals of all presses and of the prior, shape (n_residual, n_active)."""
            film = film_at(active_unknowns)
            derivatives = self.derivatives(film, data, with_coefficients=has_coefficients)
            press_rows = derivatives[:, :, active] * root_weight[:, None, None]
            return np.concatenate([press_rows.reshape(-1, active_unknowns.size), whitening])

        start_inside = np.clip(start[active], lower + BOUND_MARGIN, upper - BOUND_MARGIN)
        result = least_squares(
            residual,
            start_inside,
            jacobian,
            bounds=(lower, upper),
            x_scale=1.0,
            ftol=TOLERANCE,
            xtol=TOLERANCE,
            max_nfev=MAX_STEPS,
        )
        return film_at(result.x)

    def settle(
        self,
        data: PressData,
        is_kept: Booleans,
        degrees_of_freedom: Array,
        solved: SolvedFilm,
        hypothesis: Hypothesis,
    ) -> SettledFit:
        """Repeat the fit until the film and the selection of presses no longer change, at most `MAX_ROUNDS` times.

        Each round fits the film with the most probable hypothesis of the previous round. A hypothesis is a combination
        of effects that the parameters of the film do not describe. Presses that were left out before are used again if
        they now agree with the film.

        Args:
            data: All presses.
            is_kept: Which presses are kept at first, shape (n,).
            degrees_of_freedom: Measured numbers beyond three for each press, shape (n,).
            solved: The film at which the first round begins. If the hypothesis has no effects, this film is not fitted
                again for the first round.
            hypothesis: Hypothesis of the first round.

        Returns:
            The presses, the film and the mixture of the last round.
        """
        has_effects = hypothesis != Hypothesis()
        if has_effects:
            solved = self._solve_kept(data, is_kept, solved.unknowns, hypothesis)
        for round_index in range(MAX_ROUNDS):
            mixture = self.mixture(data[is_kept], solved)
            # The estimate is that of a linear model about the solved film, so it must be near this film.
            step = self.mean + mixture.mean - solved.unknowns
            is_step_small = np.abs(step[self.layout.parameters]).max() < MAX_LINEAR_STEP

            # Add the presses that now agree with the film. Without further presses, this search is not necessary.
            is_kept_next = is_kept
            if not is_kept.all():
                is_kept_next = is_kept | self.agrees(data, solved, mixture, degrees_of_freedom)
            is_selection_stable = np.array_equal(is_kept_next, is_kept)

            is_last_round = round_index == MAX_ROUNDS - 1
            if is_last_round or (is_step_small and is_selection_stable):
                break
            is_kept = is_kept_next
            solved = self._solve_kept(data, is_kept, solved.unknowns, mixture.best)
        return SettledFit(is_kept, solved, mixture)

    def _solve_kept(self, data: PressData, is_kept: Booleans, start: Array, hypothesis: Hypothesis) -> SolvedFilm:
        """Fit the film to the presses that are kept, all with the weight 1; see `solve`."""
        kept = data[is_kept]
        return self.solve(kept, np.ones(len(kept)), start, hypothesis)

    def agrees(self, data: PressData, solved: SolvedFilm, mixture: Mixture, degrees_of_freedom: Array) -> Booleans:
        """Return which presses agree with a film, given its uncertainty, shape (n,).

        A press agrees if r' S^-1 r does not exceed a quantile of the chi-squared distribution. Here r are the residuals
        of the press for the estimated unknowns, and S is their covariance by noise and by the uncertainty of the film.

        Args:
            data: The presses. They may include presses that the fit did not use.
            solved: The film at which the residuals are linearised.
            mixture: The estimate of the unknowns.
            degrees_of_freedom: Measured numbers beyond three for each press, shape (n,).
        """
        data = data.with_force_scatter(mixture.best.force_scatter)
        contacts = self.adjusted_contacts(solved.unknowns, data)
        jacobian = self.derivatives(SolvedFilm(solved.unknowns, contacts), data)

        # Residuals r for the estimated unknowns, by the linear model about the solved film.
        step = self.mean + mixture.mean - solved.unknowns
        residual = contacts.residual + jacobian @ step

        # Covariance S of the residuals of each press: measurement noise (1) plus the uncertainty of the film.
        residual_count = jacobian.shape[1]
        covariance = np.eye(residual_count) + jacobian @ mixture.covariance @ jacobian.swapaxes(1, 2)
        weighted_residual = np.linalg.solve(covariance, residual[:, :, None])[:, :, 0]
        chi2 = (residual * weighted_residual).sum(axis=1)
        limit = chi_square.value_exceeded_with(BAD_PROBABILITY / len(data), np.maximum(degrees_of_freedom, 1.0))
        return np.asarray(chi2 <= limit)

    def mixture(self, data: PressData, solved: SolvedFilm) -> Mixture:
        """Estimate the unknowns from presses, averaged over all hypotheses and within the bounds.

        The residuals are linearised about a film that explains the presses.

        Args:
            data: The presses.
            solved: The film that explains the presses, with their contacts on it.

        Returns:
            The mixture of the estimates of all hypotheses. Its mean is the difference from the mean before the presses.
        """
        unknowns = solved.unknowns
        contacts = self.adjusted_contacts(unknowns, data, solved.contacts.contact)
        jacobian = self.derivatives(SolvedFilm(unknowns, contacts), data)
        models_by_scatter = self._models_by_force_scatter(SolvedFilm(unknowns, contacts), data, jacobian)
        mixture = mix_hypotheses(models_by_scatter, self._prior_covariance)
        bounded_unknowns = most_probable_within(self.bounds, self.mean + mixture.mean, mixture.covariance)
        return mixture._replace(mean=bounded_unknowns - self.mean)

    def _models_by_force_scatter(
        self, solved: SolvedFilm, data: PressData, jacobian: Array
    ) -> dict[float, LinearModel]:
        """Return the linear model of the residuals about a film for each scatter of the forces.

        A scatter of the forces is additional noise of each press, in the direction in which the stated force changes
        the residuals of the press.

        Args:
            solved: The film, and the contacts of the presses on it.
            data: The presses.
            jacobian: Derivatives of the residuals with respect to the unknowns, shape (n, n_electrode + 3, n_unknown).

        Returns:
            Linear model for each of `FORCE_SCATTERS`, which are relative standard deviations.
        """
        residual = solved.contacts.residual
        deviation = solved.unknowns - self.mean
        model = LinearModel.of(jacobian.reshape(-1, solved.unknowns.size), residual.ravel(), deviation)

        force_derivative = self._force_derivative(solved.unknowns, data, solved.contacts)
        length = np.linalg.norm(force_derivative, axis=1)
        direction = force_derivative / np.maximum(length, SMALLEST_DERIVATIVE)[:, None]  # unit vectors
        # Jacobian and residual in this direction: sums over the residuals k of each press n, for each unknown u
        jacobian_along = np.einsum("nk,nku->nu", direction, jacobian)
        residual_along = (direction * residual).sum(axis=1)

        models = {}
        for scatter in FORCE_SCATTERS:
            added_variance = (scatter * length) ** 2
            models[scatter] = model.with_added_noise(jacobian_along, residual_along, deviation, added_variance)
        return models

    def adjusted_contacts(self, unknowns: Array, data: PressData, start: Array | None = None) -> AdjustedContacts:
        """Return the contact of each press that agrees best with a film.

        The effects of the nuisances are first subtracted from the charges of the presses.

        Args:
            unknowns: Unknowns of the film, shape (n_unknown,).
            data: The presses.
            start: Contacts (x, y, ln F) at which the search begins, shape (n, 3); by default from the presses.
        """
        film = self._film(unknowns)
        corrected = self._without_nuisances(unknowns, data)
        if start is None:
            start = start_contacts(self.charges, film, corrected)
        return adjust_contacts(self.charges, film, corrected, start)

    def derivatives(self, solved: SolvedFilm, data: PressData, *, with_coefficients: bool = True) -> Array:
        """Return the derivatives of the residuals with respect to the unknowns.

        A change of the unknowns also moves the adjusted contacts. The derivatives include the effect of this movement.

        Args:
            solved: The film, and the contacts of the presses on it.
            data: The presses.
            with_coefficients: Whether to compute the derivatives with respect to the coefficients, which takes time.
                They are zero otherwise.

        Returns:
            Derivatives, shape (n, n_electrode + 3, n_unknown).
        """
        layout = self.layout
        film_unknowns = layout.film if with_coefficients else layout.parameters
        contact = with_force(solved.contacts.contact)

        # Derivatives of the charges on neighbouring films, between which the charges of each press are interpolated.
        films, film_weights = self._neighbouring_films(solved.unknowns, data)
        charge_by_contact = [self.charges.by_contact(film, contact) for film in films]
        charge_by_film = [
            self.charges.by_parameter(film[film_unknowns], contact, by_contact)
            for film, by_contact in zip(films, charge_by_contact, strict=True)
        ]

        # The film changes only the residuals of the charges, the first of each press.
        jacobian = np.zeros((*data.measured.shape, layout.count))
        charge_rows = slice(0, data.charge.shape[1])
        jacobian[:, charge_rows, film_unknowns] = data.weight[:, :, None] * weighted_sum(charge_by_film, film_weights)

        # The nuisances change the charges directly, or they change the pretension, here in MPa.
        pretension = layout.parameter("pretension")
        by_pretension = jacobian[:, :, pretension] / self.charges.prior.std[pretension]
        jacobian[:, :, layout.nuisances] = nuisance_derivatives(data, by_pretension)

        residual_by_contact = data.residual_slopes(weighted_sum(charge_by_contact, film_weights))
        return derivatives_with_adjusted_contacts(jacobian, residual_by_contact)

    def gain_covariance(self, nuisances: dict[str, NuisanceEstimate], force_scatter: float) -> Array:
        """Return the additional covariance of the film's unknowns when the film is used after the session.

        A drift or a scatter of the forces in the session leaves the mean of all gains uncertain, because later presses
        may be affected differently. The additional error is the same for all gains.

        Args:
            nuisances: Estimates of the nuisances of the session by name.
            force_scatter: Relative standard deviation of the forces.

        Returns:
            Covariance, shape (n_film_unknown, n_film_unknown), in units of the prior standard deviations.
        """
        # The errors are independent, so that the root of the sum of their squares is taken.
        gain_std = 0.0
        for nuisance in NUISANCES:
            gain_std = float(np.hypot(gain_std, nuisance.gain_std(nuisances[nuisance.name])))
        gain_std = float(np.hypot(gain_std, MEAN_OVER_STD * force_scatter))

        common_error = np.zeros(self.layout.film_count)
        common_error[self.charges.prior.gains] = gain_std / self.charges.prior.spread.gain
        return np.outer(common_error, common_error)

    def _prior_covariance(self, hypothesis: Hypothesis) -> Array:
        """Return the covariance of the unknowns before the presses for a hypothesis, shape (n_unknown, n_unknown)."""
        return self.covariance + hypothesis.covariance(self.layout)

    def _film(self, unknowns: Array) -> Array:
        """Return the unknowns of the film with parameters in their own units, as `FilmCharges.film` takes them."""
        film = unknowns[self.layout.film].copy()
        film[self.layout.parameters] *= self.charges.prior.std
        return film

    def _without_nuisances(self, unknowns: Array, data: PressData) -> PressData:
        """Return the presses without the effect of the nuisances of the session."""
        return without_nuisances(data, unknowns[self.layout.nuisances])

    def _neighbouring_films(self, unknowns: Array, data: PressData) -> tuple[list[Array], Array]:
        """Return the films between which the presses are interpolated; see `neighbouring_films`."""
        return neighbouring_films(self.charges, self._film(unknowns), self._without_nuisances(unknowns, data))

    def _force_derivative(self, unknowns: Array, data: PressData, contacts: AdjustedContacts) -> Array:
        """Return the derivatives of the residuals with respect to the stated force, shape (n, n_electrode + 3).

        If the stated force changes, the adjusted contacts change, too. The derivatives include this change.

        Args:
            unknowns: Unknowns of the film, shape (n_unknown,).
            data: The presses.
            contacts: The adjusted contacts of the presses on this film.
        """
        contact = with_force(contacts.contact)
        films, film_weights = self._neighbouring_films(unknowns, data)
        charge_by_contact = weighted_sum([self.charges.by_contact(film, contact) for film in films], film_weights)
        residual_by_contact = data.residual_slopes(charge_by_contact)
        # The stated force is treated as one unknown, so the arrays have a last axis of length 1.
        residual_by_force = data.force_derivative()[:, :, None]
        return derivatives_with_adjusted_contacts(residual_by_force, residual_by_contact)[:, :, 0]
