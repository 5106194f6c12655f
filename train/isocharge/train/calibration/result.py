"""Result of a calibration: the estimate of the film, the network of this film, and the summary for the user."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.common.statistics import rms
from isocharge.simulate import Circle, Sensor, SideForceMap
from isocharge.train.calibration.contact_error import ContactError, ContactSensitivity, next_presses
from isocharge.train.calibration.cross_validation import HeldOutAnswers, cross_validate
from isocharge.train.calibration.film_fit import PROBABLE, FilmPosterior
from isocharge.train.calibration.hypotheses import Hypothesis
from isocharge.train.calibration.nuisances import FRICTION, NUISANCES, NuisanceEstimate, film_warming_sentences
from isocharge.train.calibration.press_data import PressData, no_presses
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate
from isocharge.train.calibration.quantities import Quantity, quantities, summarise
from isocharge.train.calibration.side_forces import SideForces, solve_side_forces, with_friction
from isocharge.train.films.films_model import AddedCovariance
from isocharge.train.training.fitted import Fitted

PLANNED_PRESSES = 30
"""Number of planned further presses whose benefit the summary states if the film has a discrepancy."""

VISIBLE_TRACE = 2.0
"""Ratio of the width of a trace to its standard deviation above which the summary names the trace."""


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration, with the estimate of the film and with values that follow from this estimate.

    Attributes:
        problem: The calibration problem, which defines the possible films.
        presses: The presses of the calibration, including those that were left out as bad.
        posterior: Estimate of the film from the presses.
        cautions: Warnings for the user, each as one string.
        move_description: Words that describe how an earlier calibration was moved to another temperature without
            presses; empty for a calibration by presses.
        side_force_map: Effect of side forces on the charges of the film. None if the presses have no friction and no
            side force of later contacts was declared.
    """

    problem: CalibrationProblem
    presses: MeasuredPresses
    posterior: FilmPosterior
    cautions: tuple[str, ...] = ()
    move_description: str = ""
    side_force_map: SideForceMap | None = None

    @cached_property
    def film(self) -> tuple[Sensor, Circle]:
        """The calibrated sensor and probe."""
        return self.problem.prior.film(self.posterior.parameters)

    @cached_property
    def quantities(self) -> Mapping[str, Quantity]:
        """Quantities of the film by name, each with its standard deviations before and after the presses."""
        return quantities(self.problem.prior, self.problem.before, self.posterior)

    @cached_property
    def sensitivity(self) -> ContactSensitivity:
        """Linearised effects that noise and errors in the unknowns of the film have on estimated contacts."""
        return ContactSensitivity.for_film(self.problem, self.posterior.unknowns)

    @cached_property
    def film_error(self) -> ContactError:
        """Contact errors that are caused by the remaining uncertainty of the film."""
        return self.sensitivity.contact_error(self.posterior.joint)

    @cached_property
    def film_error_before(self) -> ContactError:
        """Contact errors that the uncertainty of the film caused before the calibration.

        If the film was moved to another temperature, these are the errors before the move.
        """
        before = self.problem.before
        unknown_count = len(self.posterior.joint)
        # The earlier estimate may have only the first of the unknowns. The other unknowns are zero, without variance.
        estimated = slice(0, len(before.unknowns))
        covariance = np.zeros((unknown_count, unknown_count))
        covariance[estimated, estimated] = before.unknown_covariance
        if not self.move_description:
            return self.sensitivity.contact_error(covariance)

        # The sensitivity of the film before the move differs from that of the moved film, so it is computed again.
        unknowns = np.zeros(unknown_count)
        unknowns[estimated] = before.unknowns
        return ContactSensitivity.for_film(self.problem, unknowns).contact_error(covariance)

    @property
    def fitted(self) -> Fitted:
        """The network of the calibrated film, in the form that `evaluate` and `release` expect.

        The standard deviations that the network reports include the uncertainty of the film. If there are enough
        presses, the errors of the network are measured by cross-validation; see `held_out`.
        """
        fitted = self.fitted_film(self.posterior.parameters, release=True)
        if self.held_out is None:
            return fitted
        return replace(fitted, test=self.held_out.presses, cross_validated=self.held_out.answers)

    @cached_property
    def held_out(self) -> HeldOutAnswers | None:
        """Contacts that were estimated by cross-validation; see `cross_validate`.

        The value is None if there are too few presses, or if the film was moved to another temperature without presses.
        The contacts are computed at the first access. This computation takes about as long as the calibration.
        """
        if self.move_description:
            return None
        warming = self.posterior.warming
        at_C = None if warming is None else warming.at_C

        def network_of(film: FilmPosterior) -> Fitted:
            """Return a network for a film that was fitted to some of the presses."""
            return self._network_of(film.unknowns, film.joint)

        # If a side force is declared only for later contacts, the presses themselves have no friction.
        data = PressData.from_presses(self.presses, self.problem.noise, self.problem.charges.domain)
        has_friction = self.problem.friction > 0.0
        if self.side_force_map is not None and has_friction:
            friction = self.posterior.nuisances[FRICTION.name].value
            data = with_friction(data, self.problem.charges, self.side_force_map, self.posterior.contact, friction)
        return cross_validate(self.problem, self.presses, data, self.posterior, network_of, at_C)

    @cached_property
    def side_forces(self) -> SideForces | None:
        """Side forces that later contacts may have, or None if no side forces are expected."""
        if self.side_force_map is None:
            return None
        return SideForces(
            self.side_force_map,
            self.problem.domain,
            self.posterior.nuisances[FRICTION.name],
            self.problem.side_force,
        )

    def charge_factor(self, unknowns: Array, contact: Array) -> Array:
        """Compute the factors by which imperfections, the discrepancy and friction multiply the charges of a film.

        Args:
            unknowns: Parameters and coefficients of a film that is similar to the calibrated film.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Factors, shape (n, n_electrode), dimensionless. The factors include half of the friction of the presses; see
            `SideForces`.
        """
        factor = self.problem.charges.factor(unknowns, contact)
        if self.side_forces is None:
            return factor
        return factor * self.side_forces.charge_factor(contact)

    def fitted_film(self, parameters: Array, *, release: bool = False) -> Fitted:
        """Return a network for a film with other parameters.

        The film has the coefficients and the uncertainty of the calibrated film.

        Args:
            parameters: Parameters of the film, shape (n_parameter,).
            release: Whether the network will be released; see `CalibrationProblem.fitted`.
        """
        unknowns = np.concatenate([parameters, self.posterior.coefficients])
        return self._network_of(unknowns, self.posterior.joint, release=release)

    def _network_of(self, unknowns: Array, covariance: Array, *, release: bool = False) -> Fitted:
        """Return a network for a film that is similar to the calibrated film.

        The covariances that the network reports include two effects: the uncertainty of the film, and side forces. Both
        effects are linearised at the calibrated film.

        Args:
            unknowns: Unknowns of the film, shape (n_unknown,).
            covariance: Covariance of the unknowns, shape (n_unknown, n_unknown).
            release: Whether the network will be released; see `CalibrationProblem.fitted`.
        """
        contact_covariance = self.sensitivity.contact_covariance(covariance)
        if self.side_forces is not None:
            contact_covariance = contact_covariance + self.side_forces.contact_covariance(self.sensitivity)
        added_covariance = AddedCovariance(self.sensitivity.contact, contact_covariance)
        parameters = unknowns[self.problem.charges.layout.parameters]
        factor = partial(self.charge_factor, unknowns)
        return self.problem.fitted(parameters, added_covariance, factor, release=release)

    @property
    def reduced_chi2(self) -> float:
        """Sum of the squared residuals of the fitted presses, divided by the degrees of freedom.

        The ratio is about 1 if the stated errors of the presses are correct. The ratio is NaN if no measurement is
        redundant.
        """
        chi2, degrees_of_freedom = self.posterior.total
        if degrees_of_freedom == 0.0:
            return np.nan
        return chi2 / degrees_of_freedom

    @property
    def bad_lines(self) -> tuple[int, ...]:
        """Line numbers of presses that were left out because they do not agree with the other presses."""
        return self.presses[self.posterior.bad].lines

    @cached_property
    def summary(self) -> tuple[str, ...]:
        """Sentences that describe the result for the user.

        The sentences are computed only once, because the planning of further presses is slow.
        """
        error_after = self.film_error
        error_before = self.film_error_before
        noise_error = self.sensitivity.noise_error

        # The errors are compared with those before the presses, or before the film was moved to another temperature.
        event = "it was moved" if self.move_description else "these presses"
        film_errors = (
            f"The uncertainty of the film causes errors of {error_after.position_mm:.2g} mm and "
            f"{error_after.force_percent:.2g} % "
            f"of the force (root mean square); before {event} they were "
            f"{error_before.position_mm:.2g} mm and {error_before.force_percent:.2g} %. Noise alone causes "
            f"{noise_error.position_mm:.2g} mm and {noise_error.force_percent:.2g} %."
        )
        film_quantities = summarise(self.quantities)
        if self.move_description:
            film_quantities = (f"The film was {self.move_description}, without presses.",)
        rig_errors = (
            "Errors of the load cell, and of the origin and the axes of the stage, affect every answer in addition to "
            "these errors."
        )
        return (
            film_errors,
            *self._held_out_sentences(),
            *film_quantities,
            *self._temperature_sentences(),
            *film_warming_sentences(self.posterior.nuisances),
            *self._side_force_sentences(),
            rig_errors,
            *self._discrepancy_sentences(),
            *self.cautions,
        )

    def _held_out_sentences(self) -> Iterator[str]:
        """Yield a sentence about the errors on held-out presses, if a cross-validation was possible."""
        if self.held_out is None:
            return
        held_out_errors = self.held_out.errors
        yield (
            f"On {len(self.held_out.presses)} presses, calibrations without a fifth of the positions have errors of "
            f"{held_out_errors['position_rms_mm']:.2g} mm and {held_out_errors['force_rms_percent']:.2g} % at these "
            "positions (root mean square, including the errors of the measured positions and forces)."
        )

    def _temperature_sentences(self) -> Iterator[str]:
        """If temperatures were measured, yield a sentence on how the pretension changes with temperature."""
        warming = self.posterior.warming
        if warming is None:
            return
        if not warming.identified:
            yield (
                f"The presses were made at about {warming.at_C:.1f} C; presses over a wider range of temperatures "
                "would determine how the pretension changes with the temperature."
            )
            return
        yield (
            f"The pretension changes by {warming.MPa_per_K:.3g} +- {warming.std:.2g} MPa per kelvin. The result holds "
            f"at {warming.at_C:.1f} C; --from with --temperature computes the film at another temperature."
        )

    def _side_force_sentences(self) -> Iterator[str]:
        """Yield sentences about the friction of the presses, and about the side forces of later contacts."""
        if self.side_forces is None:
            return
        error = ContactError.from_covariance(self.side_forces.contact_covariance(self.sensitivity))
        if self.problem.friction > 0.0:
            friction = self.side_forces.friction
            yield (
                f"The coefficient of friction of the tip is {friction.value:.2g} +- {friction.std:.2g}. The model "
                "answers for half of this friction, because later contacts may have it or not."
            )
        if self.problem.side_force > 0.0:
            yield (
                f"The standard deviations of the model include a side force of {self.problem.side_force:g} times the "
                "force in any direction."
            )
        yield (
            f"These side forces cause errors of {error.position_mm:.2g} mm and {error.force_percent:.2g} % of the "
            "force (root mean square)."
        )

    def _discrepancy_sentences(self) -> Iterator[str]:
        """Yield sentences about the discrepancy and the benefit of further presses.

        Nothing is yielded if the film probably has neither imperfections nor a discrepancy.
        """
        if not self.posterior.imperfect:
            return
        factor = self.problem.charges.factor(self.posterior.unknowns, self.sensitivity.contact)
        discrepancy_percent = 100.0 * rms(np.log(factor))

        # Each planned press states the error that is expected after this press and all earlier ones.
        plan = next_presses(self.problem, PLANNED_PRESSES, self.posterior)
        error_after_plan_mm = plan[-1].position_mm
        places = ", ".join(f"{press.force_N:.2f} N at ({press.x_mm:g}, {press.y_mm:g}) mm" for press in plan[:3])
        yield (
            f"The charges of this film differ from those of its parameters by {discrepancy_percent:.2g} % (root mean "
            f"square), smoothly over the film. The remaining error is {self.film_error.position_mm:.2g} mm. "
            f"{PLANNED_PRESSES} more presses would reduce it to {error_after_plan_mm:.2g} mm. The first of them are "
            f"{places}; --next lists more."
        )
        if self.posterior.probability("traces") > PROBABLE:
            widths = self.problem.charges.trace_widths(self.posterior.unknowns, self.posterior.joint)
            visible_widths = [
                f"{name} {width:.2g} mm" for name, (width, std) in widths.items() if width > VISIBLE_TRACE * std
            ]
            yield (
                "Most of this difference is charge that electrodes collect outside their pads, like traces to the rim "
                f"of this width: {', '.join(visible_widths)}. If the sensor file describes the traces, the error is "
                "smaller."
            )


def film_without_presses(problem: CalibrationProblem, film: FilmEstimate, move_description: str) -> CalibrationResult:
    """Create a calibration result without presses from an estimate of a film.

    Args:
        problem: The calibration problem.
        film: The estimate of the film.
        move_description: Words that describe how an earlier calibration was moved to another temperature.
    """
    layout = problem.charges.layout
    # The estimate may have only the first of the unknowns. The other unknowns are zero, with a variance of zero.
    joint = np.zeros((layout.film_count, layout.film_count))
    estimated = slice(0, len(film.unknowns))
    joint[estimated, estimated] = film.unknown_covariance
    has_coefficients = film.coefficients.size > 0
    # A film with coefficients counts as imperfect, so its only hypothesis includes modes.
    hypothesis = Hypothesis(modes=1.0 if has_coefficients else 0.0)
    warming = film.warming
    if warming is not None:
        warming = warming.with_unknowns(layout.film_count)
    posterior = FilmPosterior(
        parameters=film.parameters,
        covariance=film.covariance,
        coefficients=film.coefficients if has_coefficients else np.zeros(layout.coefficient_count),
        joint=joint,
        warming=warming,
        contact=np.empty((0, 3)),
        chi2=np.empty(0),
        degrees_of_freedom=np.empty(0),
        bad=np.empty(0, dtype=bool),
        nuisances={nuisance.name: NuisanceEstimate(0.0, 0.0) for nuisance in NUISANCES},
        force_scatter=0.0,
        probabilities={hypothesis: 1.0},
    )
    side_force_map = None
    if problem.side_force > 0.0:
        side_force_map = solve_side_forces(problem.charges, film.parameters)
    empty_presses = no_presses(problem.electrodes)
    return CalibrationResult(
        problem, empty_presses, posterior, move_description=move_description, side_force_map=side_force_map
    )
