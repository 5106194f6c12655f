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
from isocharge.serve.signal_chain.leak import Leak, LeakRule, learn_inflow, state_in_touch
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


class Memory(NamedTuple):
    """State of the compensation after a frame.

    Attributes:
        film: Properties of the film.
        leak: Touch charge, output and inflow of the amplifiers.
        film_pC: Charge y of the film, shape (electrodes,), pC.
        rows_pC: The state, shape (rows, electrodes): r_j, pC; d, pC; the slope of d, pC/s; and q, pC, which is 0 out of
            contact.
        trusted_pC: d and its slope at least `look_back_s` ago, before a touch could affect them, shape (2, electrodes).
        candidate_pC: d and its slope that become the trusted values when their age is `look_back_s`.
        expected_pC: d and its slope after the release, as predicted from their values before the touch.
        trusted_s: Age of the trusted values, s.
        candidate_s: Age of the candidate, s.
        unseen_s: Time for which d could not be observed, s.
        learn_s: Remaining time in which the scale factors are updated, s. While this time is above `LEARN_S`, something
            touches the film or is leaving the film.
    """

    film: Film
    leak: Leak
    film_pC: Array
    rows_pC: Array
    trusted_pC: Array
    candidate_pC: Array
    expected_pC: Array
    trusted_s: float = 0.0
    candidate_s: float = 0.0
    unseen_s: float = 0.0
    learn_s: float = 0.0

    @property
    def is_recently_touched(self) -> bool:
        """Whether something touches the film, or a touch has just ended."""
        return self.learn_s > LEARN_S

    @classmethod
    def start(cls, rule: MemoryRule, output_pC: Array) -> "Memory":
        """Return the state at the first frame after the tare, without warmth and without a memory of earlier presses.

        The warmth is the charge of each electrode due to a change of temperature.

        Args:
            rule: Memory of the film.
            output_pC: Output of the amplifiers above the tare, shape (electrodes,), pC.
        """
        rows_pC = np.zeros((len(INITIAL_PROPAGATION), output_pC.size))  # shape (rows, electrodes)
        scale_variance = rule.known**2  # `known` is a relative standard deviation
        variances = ScaleVariances(creep=scale_variance, step=scale_variance, covariance=0.0)
        film = Film.with_memory(rule.creep, rule.thermoelastic, variances)
        # Without warmth and memory, the output is the touch charge multiplied by the response to a step.
        leak = Leak.start(output_pC)._replace(charge_pC=output_pC / film.step_response)
        warmth_and_slope = rows_pC[WARMTH_ROWS]  # 0
        return cls(
            film,
            leak,
            film_pC=output_pC,
            rows_pC=rows_pC,
            trusted_pC=warmth_and_slope,
            candidate_pC=warmth_and_slope,
            expected_pC=warmth_and_slope,
        )


def undo_memory(
    rule: MemoryRule,
    leak_rule: LeakRule,
    tau_s: Array | None,
    memory: Memory,
    output_pC: Array,
    noise_pC: Array,
    dt_s: float,
    *,
    contact: bool,
) -> Memory:
    """Compute the touch charge of the next frame, and return the state after this frame.

    The touch charge is the field `leak.charge_pC` of the returned state. During a touch, the other parts of the state
    are only predicted. Out of contact, the warmth and its slope, the inflow of the amplifiers, and the scale factors of
    the film are updated.

    Args:
        rule: Memory of the film.
        leak_rule: Settings of the estimate of the inflow. `look_back_s` and `hold_off_s` also apply to the estimate of
            the warmth.
        tau_s: Time constant of each amplifier, shape (electrodes,), s; None if charges do not leak.
        memory: State after the previous frame.
        output_pC: Output of the amplifiers above the tare, shape (electrodes,), pC.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        dt_s: Time since the previous frame, s.
        contact: Whether something touched in the previous frame.
    """
    film = memory.film
    leak = memory.leak

    # The surplus is the charge that the film has added since the previous frame. If the amplifiers leak, the output
    # also changes because of the leak and the inflow.
    if tau_s is None:
        surplus_pC = output_pC - leak.output_pC
        film_pC = output_pC
    else:
        decayed_output_pC = np.exp(-dt_s / tau_s) * leak.output_pC
        surplus_pC = output_pC - decayed_output_pC - leak.inflow_pC_per_s * dt_s
        film_pC = memory.film_pC + surplus_pC

    # Predict the state, in which the touch charge is still 0, and solve the equation of the film for the touch charge.
    propagation = state_propagation(rule.warmth_s, dt_s)
    rows_pC = propagation.dot(memory.rows_pC)
    residual_pC = film_pC - film.response.dot(rows_pC)
    charge_pC = residual_pC / film.step_response
    unseen_s = memory.unseen_s + dt_s
    if contact or memory.is_recently_touched:
        rows_pC[CHARGE_ROW] = charge_pC
        warmth_and_slope = rows_pC[WARMTH_ROWS]
        learn_s = memory.learn_s - dt_s
        if contact:  # after the release, wait for `RELEASE_S`, then learn for `LEARN_S`
            learn_s = LEARN_S + RELEASE_S
        return Memory(
            film,
            state_in_touch(leak, charge_pC, output_pC, leak_rule.hold_off_s),
            film_pC,
            rows_pC,
            trusted_pC=warmth_and_slope,
            candidate_pC=warmth_and_slope,
            expected_pC=warmth_and_slope,
            unseen_s=unseen_s,
            learn_s=learn_s,
        )

    # Out of contact, the warmth and the inflow are updated. The slope and the inflow pause after a release.
    is_paused = leak.hold_s > 0.0
    rows_pC = _observe_warmth(rule, rows_pC, residual_pC, dt_s, is_slope_updated=not is_paused)
    leak = leak._replace(charge_pC=charge_pC, output_pC=output_pC)
    if is_paused:
        leak = leak._replace(hold_s=leak.hold_s - dt_s)
    elif tau_s is not None and leak_rule.learn and _is_inflow_observable(leak_rule, leak, rows_pC):
        # The part of the surplus that creep and the thermoelastic step explain is not inflow.
        change_pC = rows_pC - memory.rows_pC
        recovery_pC = film.response.dot(change_pC) - change_pC[WARMTH_ROW]
        leak = learn_inflow(leak_rule, leak, surplus_pC - recovery_pC, noise_pC, dt_s)

    # For some time after a release, the scale factors of the film are updated.
    learn_s = memory.learn_s
    expected_pC = memory.expected_pC
    is_learning = learn_s > 0.0
    if is_learning:
        learn_s -= dt_s
        expected_pC = propagation[WARMTH_ROWS, WARMTH_ROWS].dot(expected_pC)
    next_memory = Memory(
        film,
        leak,
        film_pC,
        rows_pC,
        trusted_pC=memory.trusted_pC,
        candidate_pC=memory.candidate_pC,
        expected_pC=expected_pC,
        trusted_s=memory.trusted_s + dt_s,
        candidate_s=memory.candidate_s + dt_s,
        unseen_s=unseen_s,
        learn_s=learn_s,
    )
    if is_learning and leak.hold_s <= 0.0:
        next_memory = _learn_film(next_memory, dt_s)
    return _replace_trusted_warmth(next_memory, leak_rule.look_back_s)


def _observe_warmth(
    rule: MemoryRule, rows_pC: Array, residual_pC: Array, dt_s: float, *, is_slope_updated: bool
) -> Array:
    """Use a frame out of contact to update the warmth, which is the charge due to a change of the temperature.

    The residual is the part of the charge of the film that the predicted state does not explain. Out of contact, the
    warmth explains the whole residual. A fading-memory filter (Brookner 1998, chapter 1) updates the warmth and its
    slope:

        warmth += (1 - f^2) residual,    slope += (1 - f)^2 residual / dt,    f = exp(-dt / settle_s).

    Args:
        rule: Memory of the film, with the time constant `settle_s` of the filter.
        rows_pC: Predicted state, shape (rows, electrodes). One row is the warmth, pC, and one row is its slope, pC/s.
        residual_pC: Charge of the film minus its prediction, shape (electrodes,), pC.
        dt_s: Time since the previous frame, s.
        is_slope_updated: Whether the slope is updated, too.

    Returns:
        The updated state, shape (rows, electrodes).
    """
    fading = math.exp(-dt_s / rule.settle_s)
    warmth_gain = 1.0 - fading * fading
    updated_rows_pC = rows_pC.copy()
    updated_rows_pC[WARMTH_ROW] += warmth_gain * residual_pC
    if is_slope_updated:
        slope_gain_per_s = (1.0 - fading) ** 2 / max(dt_s, MIN_STEP_S)  # no division by zero
        updated_rows_pC[SLOPE_ROW] += slope_gain_per_s * residual_pC
    return updated_rows_pC


def _is_inflow_observable(rule: LeakRule, leak: Leak, rows_pC: Array) -> bool:
    """Return whether the inflow may be updated with a frame out of contact.

    A fast change of the warmth could be mistaken for inflow. The inflow is nevertheless updated until it has been
    averaged over `settle_s` for the first time.

    Args:
        rule: Settings of the estimate of the inflow, with the averaging time `settle_s`.
        leak: State of the leak compensation.
        rows_pC: State of the film's memory, shape (rows, electrodes). One row is the slope of the warmth, pC/s.
    """
    is_first_average = leak.learned_s < rule.settle_s
    steepest_pC_per_s = max(map(abs, rows_pC[SLOPE_ROW].tolist()))
    return is_first_average or steepest_pC_per_s < CALM_PC_PER_S


def _replace_trusted_warmth(memory: Memory, look_back_s: float) -> Memory:
    """Replace the trusted warmth by its candidate if the candidate is old enough, and return the resulting state.

    The trusted warmth is the estimate from which the warmth during a touch is predicted. It is so old that the touch
    cannot have affected it. The present warmth becomes the next candidate. If the candidate is not old enough, the
    state is returned unchanged.

    Args:
        memory: State of this frame.
        look_back_s: Age at which the candidate becomes the trusted warmth, s.
    """
    if memory.candidate_s < look_back_s:
        return memory
    return memory._replace(
        trusted_pC=memory.candidate_pC,
        trusted_s=memory.candidate_s,
        candidate_pC=memory.rows_pC[WARMTH_ROWS],
        candidate_s=0.0,
    )


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


def _remaining_charge(memory: Memory, creep_pC: Array, step_pC: Array) -> RemainingCharge | None:
    """After a release, project the remaining charges onto the direction of the predicted charges.

    After a release, a part of the charge of the film remains because of creep and the thermoelastic step. The charges
    of all electrodes form a vector. The sum of the predicted charges of creep and thermoelastic step defines the
    direction. The projection onto this direction reduces each vector to one number.

    Args:
        memory: State of this frame.
        creep_pC: Predicted charge of creep, shape (electrodes,), pC.
        step_pC: Predicted charge of the thermoelastic step, shape (electrodes,), pC.

    Returns:
        The measurement; None if the predicted charges are too small to define a direction.
    """
    predicted_pC = creep_pC + step_pC
    norm_pC = math.sqrt(float(predicted_pC @ predicted_pC))
    if norm_pC < MIN_CREEP_PC:
        return None

    # The remaining charge was estimated as warmth. Subtract the warmth that the values before the touch predict.
    expected_warmth_pC, _expected_slope = memory.expected_pC
    remaining_pC = memory.rows_pC[WARMTH_ROW] - expected_warmth_pC

    # The warmth may have changed during the touch, when it could not be observed. Its variance grows with this time.
    electrode_count = len(predicted_pC)
    warmth_variance_pC2 = WARMTH_CHANGE_PC**2 * electrode_count * memory.unseen_s
    creep_law_variance_pC2 = (CREEP_LAW_DEVIATION * norm_pC) ** 2
    return RemainingCharge(
        creep_pC=float(creep_pC @ predicted_pC) / norm_pC,
        step_pC=float(step_pC @ predicted_pC) / norm_pC,
        charge_pC=float(remaining_pC @ predicted_pC) / norm_pC,
        variance_pC2=warmth_variance_pC2 + creep_law_variance_pC2,
    )


def _learn_film(memory: Memory, dt_s: float) -> Memory:
    """Update the scale factors of creep and thermoelastic step with the charge that remains after a release.

    Creep (slow decrease of the charge of a held press) and the thermoelastic step (additional charge at the beginning
    of a press) leave a charge on the film after the release. The measurement is the difference between this charge and
    its prediction, reduced to one number. The model of the difference has two terms: the predicted charge of creep and
    the predicted charge of the step, each multiplied by the error of its scale factor. A Kalman filter updates the two
    scale factors with the measurement. The charge that the updated scale factors explain is subtracted from the warmth,
    to which this charge was attributed before.

    All frames in the time `LEARN_S` after a release together count as one measurement. The variance of each frame is
    therefore multiplied by the number of these frames.

    Args:
        memory: State of this frame.
        dt_s: Time since the previous frame, s.

    Returns:
        The state with the updated film. If errors of creep and step cannot explain the remaining charge, the film is
        not updated until the next release.
    """
    # Predict the charges that creep and step leave, shape (electrodes,), and compare them with the remaining charge.
    film = memory.film
    unit_creep_pC, unit_step_pC = SCALE_RESPONSE.dot(memory.rows_pC)  # charges of a film with creep = 1 and step = 1
    creep_pC = film.creep * unit_creep_pC
    step_pC = film.thermoelastic * unit_step_pC
    measurement = _remaining_charge(memory, creep_pC, step_pC)
    if measurement is None:
        return memory

    # Covariance of each scale factor with the measurement, and variance of the measurement due to both scale factors.
    # A measurement that is too large for these variances comes from something else, such as a warm hand.
    variances = film.variances
    creep_covariance = variances.creep * measurement.creep_pC + variances.covariance * measurement.step_pC
    step_covariance = variances.covariance * measurement.creep_pC + variances.step * measurement.step_pC
    prior_variance_pC2 = measurement.creep_pC * creep_covariance + measurement.step_pC * step_covariance
    is_explained = measurement.charge_pC**2 <= OUTLIER_SIGMAS**2 * (prior_variance_pC2 + measurement.variance_pC2)
    if not is_explained:
        return memory._replace(learn_s=0.0)  # no further update after this release

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
    rows_pC = memory.rows_pC.copy()
    rows_pC[WARMTH_ROW] -= (creep_scale - 1.0) * creep_pC + (step_scale - 1.0) * step_pC
    updated_film = Film.with_memory(film.creep * creep_scale, film.thermoelastic * step_scale, updated_variances)
    return memory._replace(film=updated_film, rows_pC=rows_pC)


def begin_touch(rule: MemoryRule, memory: Memory) -> Memory:
    """Return the state at the first frame of a touch.

    The rows of the state are the creep terms, the thermoelastic term, the warmth, the slope of the warmth, and the
    touch charge. The charge of the film is the sum of the rows, each multiplied by its response.

    The warmth is the charge of each electrode due to a change of temperature. The touch may have changed the latest
    estimate of the warmth before the touch was detected. The warmth is therefore predicted from the trusted estimate,
    whose age is at least `look_back_s`. The touch charge is then computed again.

    Args:
        rule: Memory of the film.
        memory: State of this frame, in which the touch is not yet taken into account.
    """
    film = memory.film
    age_s = memory.trusted_s
    rows_pC = memory.rows_pC.copy()  # the state, shape (rows, electrodes)

    # Advance the trusted warmth and its slope by their age. The matrix advances all rows of the state.
    propagation = state_propagation(rule.warmth_s, age_s)
    warmth_propagation = propagation[WARMTH_ROWS, WARMTH_ROWS]
    rows_pC[WARMTH_ROWS] = warmth_propagation.dot(memory.trusted_pC)

    # The touch charge explains the part of the film's charge that the other rows do not explain.
    rows_pC[CHARGE_ROW] = 0.0  # leave the touch charge out of the product below
    charge_pC = (memory.film_pC - film.response.dot(rows_pC)) / film.step_response
    rows_pC[CHARGE_ROW] = charge_pC

    # The warmth is only observed out of contact. Shortly after a previous touch, it has not been observed since that
    # touch began.
    unseen_s = age_s
    if memory.is_recently_touched:
        unseen_s = max(memory.unseen_s, age_s)
    return memory._replace(
        leak=memory.leak._replace(charge_pC=charge_pC),
        rows_pC=rows_pC,
        unseen_s=unseen_s,
        learn_s=LEARN_S + RELEASE_S,  # after the release, wait for `RELEASE_S`, then learn for `LEARN_S`
    )


def add_warmth(
    memory: Memory, change_pC: Array | float, rate_pC_per_s: Array | float, *, is_learned: bool = True
) -> Memory:
    """Assign a part of the touch charge to the warmth, and return the resulting state.

    The charge of the film is h q + d, plus terms that depend only on earlier touch charges. Here h is the response to a
    step, q is the touch charge and d is the warmth, the charge due to a change of temperature. The charge of the film
    stays the same if the touch charge is decreased by c and the warmth is increased by h c.

    Args:
        memory: The state.
        change_pC: Part c of the touch charge, shape (electrodes,), pC.
        rate_pC_per_s: Change of the slope of the warmth, shape (electrodes,), pC/s.
        is_learned: Whether the charge that remains after this touch may be used to update the scale factors of creep
            and thermoelastic step. Set it to False if the warmth is uncertain.
    """
    step_response = memory.film.step_response
    charge_pC = memory.leak.charge_pC - change_pC
    rows_pC = memory.rows_pC.copy()
    rows_pC[WARMTH_ROW] += step_response * change_pC
    rows_pC[SLOPE_ROW] += step_response * rate_pC_per_s
    rows_pC[CHARGE_ROW] = charge_pC

    # The variance of the remaining charge grows with the time for which the warmth could not be observed. With an
    # infinite time, the remaining charge has no influence.
    unseen_s = memory.unseen_s if is_learned else math.inf
    return memory._replace(leak=memory.leak._replace(charge_pC=charge_pC), rows_pC=rows_pC, unseen_s=unseen_s)


def charge_scale_std(memory: Memory) -> float:
    """Return the relative standard deviation that is common to all touch charges, dimensionless.

    Creep (slow decrease of the charge of a held press) and the thermoelastic step (additional charge at the beginning
    of a press) each have an uncertain scale factor. An error of a scale factor changes the touch charge in proportion
    to the charge of creep or of the step. Let c and s be these two charges, relative to the touch charge. The relative
    variance of the touch charge is c^2 var(creep) + s^2 var(step) + 2 c s cov(creep, step).

    Without a touch, the result is 0.

    Args:
        memory: State after a frame.
    """
    film = memory.film
    total_rows_pC = memory.rows_pC.sum(axis=1)  # summed over the electrodes, shape (rows,)
    touch_pC = float(total_rows_pC[CHARGE_ROW])
    if touch_pC <= 0.0:
        return 0.0
    unit_creep_pC, unit_step_pC = SCALE_RESPONSE.dot(total_rows_pC).tolist()  # charges of a film with creep = step = 1
    creep_share = film.creep * unit_creep_pC / touch_pC
    step_share = film.thermoelastic * unit_step_pC / touch_pC
    variances = film.variances
    variance = (
        creep_share * creep_share * variances.creep
        + step_share * step_share * variances.step
        + 2.0 * creep_share * step_share * variances.covariance
    )
    return math.sqrt(max(variance, 0.0))  # rounding errors may make a small variance negative
