"""Correction of the memory of the film (creep, thermoelastic step and warmth) and of the leak of the amplifiers.

If the touch charge q changes suddenly, the charge of the film changes by the same amount times

    h(t) = 1 - creep log10(t / 1 s) + thermoelastic exp(-t / warmth_s).

where t is the time since the change. The creep of the film is proportional to the logarithm of time, and is zero one
second after the change. Stretching cools the film. The pyroelectric charge of this cooling disappears when the film has
returned to the temperature of the air. The logarithm is approximated by a Prony series, which is a sum of exponentials
with one time constant in each decade. The ripple of the Prony series is 2 % of `creep`. The charge of the film is then

    y[n] = h(0) q[n] - sum_j w_j r_j[n] + d[n],     r_j[n] = e r_j[n-1] + (1 - e) q[n-1],     e = exp(-dt / tau_j)

where y is the output of the amplifier after the correction of the leak (`isocharge.serve.signal_chain.leak`), r_j is
the touch charge smoothed with the time constant tau_j, and d is the warmth, the pyroelectric charge of each electrode.
In each frame, this equation is solved for the touch charge q. The slope of the warmth d decays with the time constant
warmth_s, because the film follows the temperature of the air with this time constant. The state consists of the
smoothed touch charges r_j, the warmth d, the slope of the warmth, and the touch charge q. Multiplication by a matrix
advances the state from one frame to the next.

While nothing touches the film, the touch charge q is 0, and the equation gives the warmth d. A fading-memory filter
estimates the warmth and the slope of the warmth (Brookner 1998, chapter 1). During a touch, the warmth and its slope
are predicted from their values at the time `look_back_s` before the touch.

After a release, a charge remains if the settings `creep` and `thermoelastic` have errors. From the remaining charge, a
Kalman filter estimates a scale factor for `creep` and a scale factor for `thermoelastic`. The variance of the remaining
charge includes the possible change of the warmth since the beginning of the touch.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta

from isocharge.common.arrays import Array
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.inflow import Inflow, LeakRule, LeakSection
from isocharge.serve.signal_chain.memory_state import (
    CHARGE_ROW,
    INITIAL_PROPAGATION,
    SCALE_RESPONSE,
    SLOPE_ROW,
    WARMTH_ROW,
    WARMTH_ROWS,
    Film,
    ScaleVariances,
    state_propagation,
)
from isocharge.serve.signal_chain.rule import Rule, Share, TimeConstant
from isocharge.serve.signal_chain.stage import OffsetStage, Setup, WarmingChange

LEARN_S = 5.0
"""Time after a release in which the scale factors of the film are updated, s."""

MAX_CREEP = 0.2
"""Upper bound of the creep in a decade. With a larger creep, a charge would vanish within some days."""

RELEASE_S = 0.1
"""Time after the detection of a release until the finger has left the film, s.

The charges during this time are not warmth.
"""

WARMTH_CHANGE_PC = 1.0
"""Standard deviation of the change of the warmth of an electrode in one second, pC."""

CREEP_LAW_DEVIATION = 0.05
"""Relative deviation of real creep from the logarithmic law."""

OUTLIER_SIGMAS = 4.0
"""Largest charge after a release that errors of creep explain, in standard deviations.

A larger charge is assumed to come from a hand that warms the film.
"""

CALM_PC_PER_S = 2.0
"""Slope of the warmth above which the inflow of the amplifiers is not updated, pC/s.

The charge of warmth is temporary, and must not be mistaken for inflow.
"""

MIN_STEP_S = 1e-9
"""Smallest divisor if the filter divides by the time between two frames, s."""

MIN_CREEP_PC = 1e-9
"""Predicted charge of creep and step below which the scale factors are not updated after a release, pC."""


class MemoryRule(Rule, frozen=True, kw_only=True):
    """Settings for the memory of the film, from the section `[memory]` of a device file.

    Attributes:
        creep: Share of a charge that is lost in each decade of time.
        thermoelastic: Share by which the charges of a touch are larger at first, before the film has returned to the
            temperature of the air.
        warmth_s: Time constant with which the film follows the temperature of the air, s.
        known: Relative standard deviation of `creep` and `thermoelastic`. A larger value increases the reported
            standard deviations of contacts.
        settle_s: Time constant with which warmth is estimated out of contact, s.
    """

    creep: Annotated[float, Meta(ge=0.0, lt=MAX_CREEP)] = 0.0
    thermoelastic: Share = 0.0
    warmth_s: TimeConstant = 2.5
    known: Share = 0.2
    settle_s: TimeConstant = 0.1


class RemainingCharge(NamedTuple):
    """Charge that remains on the film after a release, reduced to one number.

    The remaining charge is a measurement of the errors of the settings for creep and for the thermoelastic step. Creep
    is the slow decrease of the charge of a held press. The thermoelastic step is an additional charge at the beginning
    of a press.

    The charges of all electrodes form a vector, which is projected onto the direction of the predicted charges. The
    predicted charge of an electrode is the sum of the charges of creep and of the thermoelastic step.

    Attributes:
        creep_pC: Projection of the predicted charge of creep.
        step_pC: Projection of the predicted charge of the thermoelastic step.
        charge_pC: Projection of the remaining charge minus its prediction.
        variance_pC2: Variance of the remaining charge due to warmth and to deviations from the law of creep.
    """

    creep_pC: float
    step_pC: float
    charge_pC: float
    variance_pC2: float


class Memory(OffsetStage):
    """Corrects creep, the thermoelastic step, the warmth of the film and the leak of the amplifiers together.

    During a touch, only the touch charge is computed, and the rest of the state is predicted. Out of contact, the
    warmth and its slope, the inflow of the amplifiers, and the scale factors of the film are updated.
    """

    section = "memory"
    rule_class = MemoryRule

    def __init__(self, setup: Setup) -> None:
        """Store the settings. The state begins at the first frame after the tare."""
        super().__init__(setup)
        self._rule = setup.rule(MemoryRule) or MemoryRule()
        leak = setup.rule(LeakSection)
        self._tau_s = None if leak is None else setup.for_each_electrode("leak.tau_s", leak.tau_s)
        self._leak_rule: LeakRule = leak or LeakRule()
        self._zero_pC = np.zeros(len(setup.electrodes))
        self.reset()

    def reset(self) -> None:
        """Discard the state. A new state begins at the first frame after the next tare."""
        rule = self._rule
        self._previous: Frame | None = None
        self._output_pC = self._zero_pC  # output of the amplifiers above the tare
        self._charge_pC = self._zero_pC  # touch charge q
        self._film_pC = self._zero_pC  # charge y of the film
        self._inflow = Inflow(self._leak_rule, len(self._zero_pC))
        scale_variance = rule.known**2  # `known` is a relative standard deviation
        variances = ScaleVariances(creep=scale_variance, step=scale_variance, covariance=0.0)
        self._film = Film.with_memory(rule.creep, rule.thermoelastic, variances)

        # The state, shape (rows, n_electrode): r_j, pC; d, pC; the slope of d, pC/s; and q, pC, which is 0 out of
        # contact.
        self._rows_pC = np.zeros((len(INITIAL_PROPAGATION), len(self._zero_pC)))
        self._unseen_s = 0.0  # time for which d could not be observed
        # Remaining time in which the scale factors are updated. While this time is above `LEARN_S`, something touches
        # the film or is leaving the film.
        self._learn_s = 0.0
        self._trust_present_warmth()

    def _trust_present_warmth(self) -> None:
        """Use the present d and its slope as the values before the next touch, and after the present touch."""
        warmth_and_slope = self._rows_pC[WARMTH_ROWS]
        self._trusted_pC = warmth_and_slope  # at least `look_back_s` old, before a touch could affect them
        self._candidate_pC = warmth_and_slope  # become the trusted values when their age is `look_back_s`
        self._expected_pC = warmth_and_slope  # after the release, predicted from the values before the touch
        self._trusted_s = 0.0
        self._candidate_s = 0.0

    @property
    def _is_recently_touched(self) -> bool:
        """Whether something touches the film, or a touch has just ended."""
        return self._learn_s > LEARN_S

    def step(self, frame: Frame) -> None:
        """Replace the output of the amplifiers by the touch charge.

        The values that the detection of touches needs are also written into the frame.

        Args:
            frame: The frame, which is changed in place. Its charges are the output above the tare.
        """
        output_pC = frame.charge_pC
        if output_pC is None:
            return
        if self._previous is None:  # without warmth and memory, the output is the response to a step
            self._film_pC = output_pC
            self._charge_pC = output_pC / self._film.step_response
        else:
            frame.is_base_held = self._is_recently_touched  # a finger may still be leaving the film
            self._correct(output_pC, frame, is_touched=self._previous.is_contact)
        self._previous = frame
        self._output_pC = output_pC
        # Out of contact, the estimate of the warmth absorbs the charge. A frame leaves the share exp(-2 dt / settle_s)
        # of the charge, so the time constant is half of `settle_s`.
        frame.base_relax_s = 0.5 * self._rule.settle_s
        self._report(frame)

    def _report(self, frame: Frame) -> None:
        """Write the touch charge, and the relative standard deviation that all touch charges share, into a frame."""
        frame.charge_pC = self._charge_pC
        frame.charge_scale_std = self._charge_scale_std()

    def _correct(self, output_pC: Array, frame: Frame, *, is_touched: bool) -> None:
        """Compute the touch charge of a frame, and update the state.

        Args:
            output_pC: Output of the amplifiers above the tare, shape (n_electrode,), pC.
            frame: The frame.
            is_touched: Whether something touched in the previous frame.
        """
        film = self._film
        dt_s = frame.dt_s

        # The surplus is the charge that the film has added since the previous frame. If the amplifiers leak, the output
        # also changes because of the leak and the inflow.
        if self._tau_s is None:
            surplus_pC = output_pC - self._output_pC
            self._film_pC = output_pC
        else:
            decayed_output_pC = np.exp(-dt_s / self._tau_s) * self._output_pC
            surplus_pC = output_pC - decayed_output_pC - self._inflow.pC_per_s * dt_s
            self._film_pC = self._film_pC + surplus_pC

        # Predict the state, in which the touch charge is still 0, and solve the equation of the film for it.
        propagation = state_propagation(self._rule.warmth_s, dt_s)
        previous_rows_pC = self._rows_pC
        self._rows_pC = propagation.dot(previous_rows_pC)
        residual_pC = self._film_pC - film.response.dot(self._rows_pC)
        self._charge_pC = residual_pC / film.step_response
        self._unseen_s += dt_s
        if is_touched or self._is_recently_touched:
            self._rows_pC[CHARGE_ROW] = self._charge_pC
            self._trust_present_warmth()
            self._inflow.pause()
            # After the release, wait for `RELEASE_S`, then learn for `LEARN_S`.
            self._learn_s = LEARN_S + RELEASE_S if is_touched else self._learn_s - dt_s
            return

        # Out of contact, the warmth and the inflow are updated. The slope and the inflow pause after a release.
        is_paused = self._inflow.hold_s > 0.0
        self._observe_warmth(residual_pC, dt_s, is_slope_updated=not is_paused)
        if is_paused:
            self._inflow.hold_s -= dt_s
        elif self._tau_s is not None and self._leak_rule.learn and self._is_inflow_observable():
            # The part of the surplus that creep and the thermoelastic step explain is not inflow.
            change_pC = self._rows_pC - previous_rows_pC
            recovery_pC = film.response.dot(change_pC) - change_pC[WARMTH_ROW]
            self._inflow.learn(surplus_pC - recovery_pC, frame.noise_pC, dt_s)

        # For some time after a release, the scale factors of the film are updated.
        self._trusted_s += dt_s
        self._candidate_s += dt_s
        if self._learn_s > 0.0:
            self._learn_s -= dt_s
            self._expected_pC = propagation[WARMTH_ROWS, WARMTH_ROWS].dot(self._expected_pC)
            if self._inflow.hold_s <= 0.0:
                self._learn_film(dt_s)

        # The candidate becomes the trusted warmth if it is old enough.
        if self._candidate_s >= self._leak_rule.look_back_s:
            self._trusted_pC = self._candidate_pC
            self._trusted_s = self._candidate_s
            self._candidate_pC = self._rows_pC[WARMTH_ROWS]
            self._candidate_s = 0.0

    def _observe_warmth(self, residual_pC: Array, dt_s: float, *, is_slope_updated: bool) -> None:
        """Use a frame out of contact to update the warmth, which is the charge due to a change of the temperature.

        The residual is the part of the charge of the film that the predicted state does not explain. Out of contact,
        the warmth explains the whole residual. A fading-memory filter (Brookner 1998, chapter 1) updates the warmth and
        its slope:

            warmth += (1 - f^2) residual,    slope += (1 - f)^2 residual / dt,    f = exp(-dt / settle_s).

        Args:
            residual_pC: Charge of the film minus its prediction, shape (n_electrode,), pC.
            dt_s: Time since the previous frame, s.
            is_slope_updated: Whether the slope is updated, too.
        """
        fading = math.exp(-dt_s / self._rule.settle_s)
        self._rows_pC[WARMTH_ROW] += (1.0 - fading * fading) * residual_pC
        if is_slope_updated:
            slope_gain_per_s = (1.0 - fading) ** 2 / max(dt_s, MIN_STEP_S)  # no division by zero
            self._rows_pC[SLOPE_ROW] += slope_gain_per_s * residual_pC

    def _is_inflow_observable(self) -> bool:
        """Return whether the inflow may be updated with a frame out of contact.

        A fast change of the warmth could be mistaken for inflow. The inflow is nevertheless updated until it has been
        averaged over `settle_s` for the first time.
        """
        is_first_average = self._inflow.learned_s < self._leak_rule.settle_s
        steepest_pC_per_s = max(map(abs, self._rows_pC[SLOPE_ROW].tolist()))
        return is_first_average or steepest_pC_per_s < CALM_PC_PER_S

    def _remaining_charge(self, creep_pC: Array, step_pC: Array) -> RemainingCharge | None:
        """After a release, project the remaining charges onto the direction of the predicted charges.

        Args:
            creep_pC: Predicted charge of creep, shape (n_electrode,), pC.
            step_pC: Predicted charge of the thermoelastic step, shape (n_electrode,), pC.

        Returns:
            The measurement; None if the predicted charges are too small to define a direction.
        """
        predicted_pC = creep_pC + step_pC
        norm_pC = math.sqrt(float(predicted_pC @ predicted_pC))
        if norm_pC < MIN_CREEP_PC:
            return None

        # The remaining charge was estimated as warmth. Subtract the warmth that the values before the touch predict.
        expected_warmth_pC, _expected_slope = self._expected_pC
        remaining_pC = self._rows_pC[WARMTH_ROW] - expected_warmth_pC

        # The warmth may have changed during the touch, when it could not be observed. Its variance grows with this
        # time.
        warmth_variance_pC2 = WARMTH_CHANGE_PC**2 * len(predicted_pC) * self._unseen_s
        creep_law_variance_pC2 = (CREEP_LAW_DEVIATION * norm_pC) ** 2
        return RemainingCharge(
            creep_pC=float(creep_pC @ predicted_pC) / norm_pC,
            step_pC=float(step_pC @ predicted_pC) / norm_pC,
            charge_pC=float(remaining_pC @ predicted_pC) / norm_pC,
            variance_pC2=warmth_variance_pC2 + creep_law_variance_pC2,
        )

    def _learn_film(self, dt_s: float) -> None:
        """Update the scale factors of creep and thermoelastic step with the charge that remains after a release.

        The measurement is the difference between this charge and its prediction, reduced to one number. The model of
        the difference has two terms: the predicted charge of creep and the predicted charge of the step, each
        multiplied by the error of its scale factor. A Kalman filter updates the two scale factors with the measurement.
        The charge that the updated scale factors explain is subtracted from the warmth, to which this charge was
        attributed before. If errors of creep and step cannot explain the remaining charge, the film is not updated
        until the next release.

        All frames in the time `LEARN_S` after a release together count as one measurement. The variance of each frame
        is therefore multiplied by the number of these frames.

        Args:
            dt_s: Time since the previous frame, s.
        """
        # Predict the charges that creep and step leave, shape (n_electrode,), and compare them with the remaining
        # charge.
        film = self._film
        unit_creep_pC, unit_step_pC = SCALE_RESPONSE.dot(self._rows_pC)  # charges of a film with creep = step = 1
        creep_pC = film.creep * unit_creep_pC
        step_pC = film.thermoelastic * unit_step_pC
        measurement = self._remaining_charge(creep_pC, step_pC)
        if measurement is None:
            return

        # Covariance of each scale factor with the measurement, and variance of the measurement due to both scale
        # factors. A measurement that is too large for these variances comes from something else, such as a warm hand.
        variances = film.variances
        creep_covariance = variances.creep * measurement.creep_pC + variances.covariance * measurement.step_pC
        step_covariance = variances.covariance * measurement.creep_pC + variances.step * measurement.step_pC
        prior_variance_pC2 = measurement.creep_pC * creep_covariance + measurement.step_pC * step_covariance
        is_explained = measurement.charge_pC**2 <= OUTLIER_SIGMAS**2 * (prior_variance_pC2 + measurement.variance_pC2)
        if not is_explained:
            self._learn_s = 0.0  # no further update after this release
            return

        # Kalman update of the scale factors and of their variances. The scale factors are relative to the present
        # properties of the film, so they are 1 before the update.
        total_variance_pC2 = prior_variance_pC2 + measurement.variance_pC2 * LEARN_S / max(dt_s, MIN_STEP_S)
        creep_scale = 1.0 + creep_covariance / total_variance_pC2 * measurement.charge_pC
        step_scale = 1.0 + step_covariance / total_variance_pC2 * measurement.charge_pC
        updated_variances = ScaleVariances(
            creep=variances.creep - creep_covariance**2 / total_variance_pC2,
            step=variances.step - step_covariance**2 / total_variance_pC2,
            covariance=variances.covariance - creep_covariance * step_covariance / total_variance_pC2,
        )

        # The updated scale factors explain a part of the charge that was attributed to the warmth.
        self._rows_pC[WARMTH_ROW] -= (creep_scale - 1.0) * creep_pC + (step_scale - 1.0) * step_pC
        self._film = Film.with_memory(film.creep * creep_scale, film.thermoelastic * step_scale, updated_variances)

    def begin_touch(self, frame: Frame) -> None:
        """Replace the warmth in this frame by a prediction from its values before the touch.

        The warmth is the charge of each electrode due to a change of temperature. The touch may have changed the latest
        estimate of the warmth before the touch was detected. The warmth is therefore predicted from the trusted
        estimate, whose age is at least `look_back_s`. The touch charge is then computed again.

        Args:
            frame: The first frame of the touch. Its touch charge is computed again.
        """
        film = self._film
        age_s = self._trusted_s
        rows_pC = self._rows_pC.copy()  # the present rows may also be the candidate

        # Advance the trusted warmth and its slope by their age. The matrix advances all rows of the state.
        propagation = state_propagation(self._rule.warmth_s, age_s)
        rows_pC[WARMTH_ROWS] = propagation[WARMTH_ROWS, WARMTH_ROWS].dot(self._trusted_pC)

        # The touch charge explains the part of the film's charge that the other rows do not explain.
        rows_pC[CHARGE_ROW] = 0.0  # leave the touch charge out of the product below
        self._charge_pC = (self._film_pC - film.response.dot(rows_pC)) / film.step_response
        rows_pC[CHARGE_ROW] = self._charge_pC
        self._rows_pC = rows_pC

        # The warmth is only observed out of contact. Shortly after a previous touch, it has not been observed since
        # that touch began.
        self._unseen_s = max(self._unseen_s, age_s) if self._is_recently_touched else age_s
        self._learn_s = LEARN_S + RELEASE_S  # after the release, wait for `RELEASE_S`, then learn for `LEARN_S`
        self._report(frame)

    def add_warming(self, change: WarmingChange) -> None:
        """Assign a part of the touch charge to the warmth.

        The charge of the film is h q + d, plus terms that depend only on earlier touch charges. Here h is the response
        to a step, q is the touch charge and d is the warmth. The charge of the film stays the same if the touch charge
        is decreased by c and the warmth is increased by h c.
        """
        step_response = self._film.step_response
        self._charge_pC = self._charge_pC - change.charge_pC
        self._rows_pC = self._rows_pC.copy()  # the present rows may also be the trusted warmth
        self._rows_pC[WARMTH_ROW] += step_response * change.charge_pC
        self._rows_pC[SLOPE_ROW] += step_response * change.rate_pC_per_s
        self._rows_pC[CHARGE_ROW] = self._charge_pC

        # The variance of the remaining charge grows with the time for which the warmth could not be observed. With an
        # infinite time, the remaining charge has no influence.
        if not change.is_learned:
            self._unseen_s = math.inf

    def _charge_scale_std(self) -> float:
        """Return the relative standard deviation that is common to all touch charges, dimensionless.

        Creep and the thermoelastic step each have an uncertain scale factor. An error of a scale factor changes the
        touch charge in proportion to the charge of creep or of the step. Let c and s be these two charges, relative to
        the touch charge. The relative variance of the touch charge is
        c^2 var(creep) + s^2 var(step) + 2 c s cov(creep, step).

        Without a touch, the result is 0.
        """
        film = self._film
        total_rows_pC = self._rows_pC.sum(axis=1)  # summed over the electrodes, shape (rows,)
        touch_pC = float(total_rows_pC[CHARGE_ROW])
        if touch_pC <= 0.0:
            return 0.0
        unit_creep_pC, unit_step_pC = SCALE_RESPONSE.dot(total_rows_pC).tolist()  # of a film with creep = step = 1
        creep_share = film.creep * unit_creep_pC / touch_pC
        step_share = film.thermoelastic * unit_step_pC / touch_pC
        variances = film.variances
        variance = (
            creep_share * creep_share * variances.creep
            + step_share * step_share * variances.step
            + 2.0 * creep_share * step_share * variances.covariance
        )
        return math.sqrt(max(variance, 0.0))  # rounding errors may make a small variance negative
