"""Compensation for the leak of charge amplifiers, and integration of currents from boards without charge amplifiers.

A charge amplifier is a leaky integrator with the time constant tau = R C. The touch charge q follows from its output v
frame by frame,

    q[n] = q[n-1] + i[n] - b dt,        i[n] = (v[n] - a v[n-1]) 2 / (1 + a),        a = exp(-dt / tau),

where i is the innovation and b is the inflow (pC/s). The inflow is a slow current into the amplifier, which is caused
by offset, bias and slow warming. On average, the share (1 + a) / 2 of a charge that arrives between two frames remains.
The inflow is estimated from the innovation, because an estimate from the output v would diverge.

A board that sends currents sends the innovation itself, i[n] = v[n]. The charge of such a board is the sum of the
currents. If the device file states a leak, the sum decays with the time constant tau, q[n] = a q[n-1] + i[n] - b dt.

While nothing touches the film, any charge is an error or comes from a slow warming of the film. The computed touch
charge therefore decays exponentially to zero.

Frames of a touch must not change the estimated inflow. Therefore, three rules are applied. Each innovation is clipped.
During a touch, the correction uses the inflow that was estimated `look_back_s` before the touch. After a release, the
estimate of the inflow pauses for the time `hold_off_s`.

After a gap in the frames, the time at which a charge has arrived is unknown. The innovation of a charge that arrived at
the beginning of the gap is i (1 + 1/a) / 2. If the gap may have falsified the charge of a touch, all frames of the
touch have the flag `gap`.
"""

import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.structs import Positive
from isocharge.serve.flags import GAP
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.stage import LARGEST, Divisor, Rule, Setting, Setup, Stage, SUM_TOLERANCE_s


class LeakRule(Rule, frozen=True, kw_only=True):
    """Section `[leak]` of a device file, which describes the leak and the inflow of the amplifiers.

    Attributes:
        tau_s: Time constant of the amplifiers, s, as one number for all electrodes or one number for each electrode. By
            default, the amplifiers have no leak.
        learn: Whether the inflow b is estimated.
        settle_s: Time constant of the estimate, s.
        hold_off_s: Pause of the estimate after a release, s.
        clip_sigmas: Limit to which an innovation is clipped, in standard deviations of an innovation at rest.
        clip_pC: Lower bound of the limit to which an innovation is clipped, pC.
        relax_s: Time constant with which the charge decays to zero out of contact, s.
        look_back_s: Smallest age of the inflow that is used during a touch, s. The same time is the length of the
            interval over which this inflow is averaged.
    """

    tau_s: Positive | dict[str, Positive] = LARGEST
    learn: bool = True
    settle_s: Divisor = 3.0
    hold_off_s: Setting = 0.5
    clip_sigmas: Setting = 4.0
    clip_pC: Setting = 0.1
    relax_s: Divisor = 1.0
    look_back_s: Setting = 0.25


class Inflow:
    """Estimate of the inflow, which is the slow current into each amplifier.

    During a touch, the correction uses the trusted inflow, an earlier estimate that the touch cannot have affected.

    Attributes:
        pC_per_s: The inflow, shape (n_electrode,), pC/s.
        learned_s: Time over which the inflow was averaged, s. For a board that sends charges, this time starts at 1 s,
            with an inflow of 0 as the prior.
        hold_s: Remaining time of the pause after a release, s.
    """

    def __init__(self, rule: LeakRule, n_electrode: int) -> None:
        """Begin with an inflow of zero.

        The inflow is the slow current that flows into each amplifier without a touch, pC/s.

        Args:
            rule: Settings of the estimate.
            n_electrode: Number of electrodes.
        """
        self._rule = rule
        # During a touch, the trusted inflow is used. It is the mean of an interval that had ended `look_back_s` or more
        # before the touch was detected, so that the touch cannot have changed it.
        self._trusted_pC_per_s = np.zeros(n_electrode)
        self.pause()  # sets the present inflow to the trusted one, and begins the first interval
        self.learned_s = 1.0  # time over which the inflow was averaged, as if it had been zero for one second
        self.hold_s = 0.0  # remaining time in which the inflow is not learned; `pause` has set it for a release

    def pause(self) -> None:
        """Use the trusted inflow during a touch, and do not learn for the time `hold_off_s` after its release.

        The inflow is the slow current into each amplifier, pC/s. Each frame of a touch calls this method. The latest
        estimates may contain a part of the touch charge. They are therefore replaced by the trusted inflow, which is
        older than the touch.
        """
        self.pC_per_s = self._trusted_pC_per_s
        self._candidate_pC_per_s = self._trusted_pC_per_s  # becomes the trusted inflow when its age is `look_back_s`
        self._candidate_age_s = 0.0
        self._interval_inflows_pC_per_s = [self.pC_per_s]  # in the present interval; their mean is the next candidate
        self.hold_s = self._rule.hold_off_s  # remaining time of the pause

    def learn(self, surplus_pC: Array, noise_pC: Array, dt_s: float) -> None:
        """Use a frame out of contact to update the inflow (`pC_per_s`), the slow current into each amplifier.

        The surplus is the part of the new charge that the estimated inflow does not explain. The surplus is divided by
        an averaging time and added to the inflow, so that the estimate becomes the mean current over this time. Large
        surpluses are clipped, because touches cause large surpluses.

        A touch is detected some time after its beginning, and falsifies the estimated inflow until then. During a
        touch, an older inflow, the trusted inflow, is therefore used. After each time interval `look_back_s`, the
        candidate becomes the trusted inflow, and the mean inflow of the interval becomes the candidate. The mean has
        less noise than the latest inflow, which contains the whole noise of the latest frame.

        Args:
            surplus_pC: New charge minus the contribution of the inflow, shape (n_electrode,), pC.
            noise_pC: Standard deviation of the charge of each electrode at rest, shape (n_electrode,), pC.
            dt_s: Time since the previous frame, s.
        """
        rule = self._rule
        # Without a touch, the surplus is the difference of the noise of two frames. The standard deviation of this
        # difference is sqrt(2) times the standard deviation of one frame.
        limit_pC = np.maximum(rule.clip_pC, rule.clip_sigmas * math.sqrt(2.0) * noise_pC)
        clipped_surplus_pC = surplus_pC.clip(-limit_pC, limit_pC)

        # Until `settle_s` has passed, the surplus is averaged over the time for which the inflow has been learned. The
        # averaging time is at least `dt_s`, so that the corrected inflow explains at most the whole surplus.
        self.learned_s += dt_s
        averaging_s = max(min(rule.settle_s, self.learned_s), dt_s)
        if averaging_s > 0.0:  # frames may have come within one count of a slow clock
            self.pC_per_s = self.pC_per_s + clipped_surplus_pC / averaging_s

        # Replace the trusted inflow and the candidate if the candidate is old enough. The tolerance allows for the
        # rounding errors of the summed times.
        self._interval_inflows_pC_per_s.append(self.pC_per_s)
        self._candidate_age_s += dt_s
        if self._candidate_age_s >= rule.look_back_s - SUM_TOLERANCE_s:
            self._trusted_pC_per_s = self._candidate_pC_per_s
            self._candidate_pC_per_s = np.mean(self._interval_inflows_pC_per_s, axis=0)
            self._candidate_age_s = 0.0
            self._interval_inflows_pC_per_s = [self.pC_per_s]


class Leak(Stage):
    """Corrects the leak of the charge amplifiers, and estimates their inflow."""

    section = "leak"
    rule_class = LeakRule
    front_end = "charge"

    def __init__(self, setup: Setup) -> None:
        """Store the settings. The state begins at the first frame after the tare."""
        self._rule = setup.device.rule(LeakRule) or LeakRule()
        self._tau_s = setup.for_each_electrode("leak.tau_s", self._rule.tau_s)
        self.reset()

    def reset(self) -> None:
        """Discard the state. A new state begins at the first frame after the next tare."""
        self._previous: Frame | None = None
        # Output of the amplifiers in the previous frame. The tare has been subtracted, so its mean at rest is 0.
        self._output_pC = np.zeros(len(self._tau_s))
        self._charge_pC = np.zeros(len(self._tau_s))  # touch charge
        self._is_falsified = False  # whether a gap may have falsified the charge of this touch
        self._inflow = Inflow(self._rule, len(self._tau_s))

    def step(self, frame: Frame) -> None:
        """Replace the output of the amplifiers by the touch charge.

        If missing frames may have falsified the touch charge, the frame gets the flag `gap`. The frame also gets
        `base_relax_s`, the time constant with which the touch detection forgets charges that belong to no touch.
        """
        output_pC = frame.charge_pC
        if output_pC is None:
            return
        self._advance(frame, self._previous or frame, output_pC)  # updates `_charge_pC` and `_is_falsified`
        if self._is_falsified:
            frame.flags.append(GAP)
        self._previous = frame
        self._output_pC = output_pC  # the next frame is compared with this output
        frame.charge_pC = self._charge_pC
        frame.base_relax_s = self._rule.relax_s

    def _advance(self, frame: Frame, previous: Frame, output_pC: Array) -> None:
        """Add the charge that is new since the previous frame to the touch charge (`_charge_pC`).

        The new charge is i - b dt. The innovation i is the change of the output that the leak does not explain. The
        inflow b is a slow current into the amplifiers, pC/s, and dt is the time since the previous frame. The share
        a = exp(-dt / tau) of a charge remains after the leak of this time.

        Out of contact, the touch charge should be zero, so it decays to zero. Except during a pause after a release,
        the inflow is then learned from the new charge. If frames are missing during a touch, the touch may have ended
        meanwhile, or its charge may have become wrong (`_is_falsified`).

        Args:
            frame: The frame.
            previous: The previous frame with charges. For the first frame with charges, the frame itself.
            output_pC: Output of the amplifiers above the tare, shape (n_electrode,), pC.
        """
        dt_s = frame.dt_s
        # A later stage has found that warming, and not a touch, has caused this part of the charge.
        self._charge_pC = self._charge_pC - previous.warming_pC

        # Compute the charge that is new since the previous frame.
        decay = np.exp(-dt_s / self._tau_s)  # a, the share of a charge that the leak leaves
        innovation_pC = self._innovation_pC(output_pC, decay)  # i
        surplus_pC = innovation_pC - self._inflow.pC_per_s * dt_s  # i - b dt: new touch charge and noise

        # Out of contact, let the touch charge decay, and learn the inflow unless it is paused. `hold_s` is the rest of
        # the pause. The tolerance allows for the rounding errors of the summed times.
        if previous.is_contact:
            self._inflow.pause()
        else:
            self._is_falsified = False
            self._charge_pC = self._charge_pC * math.exp(-dt_s / self._rule.relax_s)
            if self._inflow.hold_s > SUM_TOLERANCE_s or not self._rule.learn:
                self._inflow.hold_s -= dt_s
            else:
                self._inflow.learn(surplus_pC, frame.noise_pC, dt_s)

        # After a gap, check whether the touch has ended, or its charge is wrong.
        has_gap = dt_s > 1.5 * previous.dt_s  # frames are missing or were invalid
        if has_gap and previous.is_contact and self._has_ended_in_gap(frame, surplus_pC):
            self._is_falsified = False
            surplus_pC = -self._charge_pC  # so that no touch charge remains
            has_gap = False  # so that the gap is not checked for a wrong charge
        self._charge_pC = self._charge_pC + surplus_pC
        if has_gap:
            # The surplus is right if the charge arrived evenly in the gap. A charge that arrived at the beginning of
            # the gap is larger by the factor (1 + 1/a) / 2, which is 1 + (1/a - 1) / 2. `_inverse_decay` returns 1/a,
            # limited so that a long gap causes no overflow.
            largest_error_pC = np.abs(surplus_pC) * (self._inverse_decay(frame) - 1.0) / 2.0
            if self._is_large(largest_error_pC, frame):
                self._is_falsified = True

    def _innovation_pC(self, output_pC: Array, decay: Array) -> Array:
        """Return the change of the output that the leak does not explain, shape (n_electrode,), pC.

        Args:
            output_pC: Output of the amplifiers above the tare, shape (n_electrode,), pC.
            decay: Share of a charge that the leak leaves until this frame, shape (n_electrode,), dimensionless.
        """
        return (output_pC - decay * self._output_pC) * 2.0 / (1.0 + decay)

    def _inverse_decay(self, frame: Frame) -> Array:
        """Return 1/a, the ratio of a charge before the leak of one frame to the charge after it, shape (n_electrode,).

        The ratio is limited to avoid an overflow.
        """
        return np.exp(np.minimum(frame.dt_s / self._tau_s, 60.0))

    def _has_ended_in_gap(self, frame: Frame, surplus_pC: Array) -> bool:
        """Return whether a touch has ended while frames were missing.

        When a touch ends, a charge arrives that cancels the charge of the touch. The time of arrival is unknown. If the
        cancelling charge arrived earlier, a larger part of this charge has leaked, so the charge must have been larger
        to cause the present output. The cancelling charge is therefore largest if it arrived at the beginning of the
        gap. If even this largest charge does not cancel the touch charge, the touch has not ended.

        Of a charge that arrived at the beginning of the gap, the leak leaves the share a. Of a charge that arrived
        evenly in the gap, the leak leaves the share (1 + a) / 2. For the same output, the first charge is therefore
        (1 + a) / (2 a) = (1 + 1/a) / 2 times the second.

        Args:
            frame: The frame after the gap.
            surplus_pC: New touch charge, if it arrived evenly in the gap, shape (n_electrode,), pC.
        """
        inverse_decay = self._inverse_decay(frame)  # 1/a
        sign = np.sign(self._charge_pC)  # of the charge before the gap
        # The output may differ from zero by four standard deviations of the noise, or by 5 % of the charge, because the
        # time constant and the inflow have errors.
        margin_pC = np.maximum(4.0 * frame.noise_pC, 0.05 * np.abs(self._charge_pC))
        # Touch charge that remains if the new charge arrived at the beginning of the gap. It is a charge before the
        # leak of the gap, but the margin is a charge after this leak. The margin is therefore multiplied by 1/a.
        remaining_pC = self._charge_pC + surplus_pC * (1.0 + inverse_decay) / 2.0
        return bool((sign * remaining_pC <= inverse_decay * margin_pC).all())

    def _is_large(self, error_pC: Array, frame: Frame) -> bool:
        """Return whether an error of the touch charge exceeds both the noise and 1 % of the touch charge.

        Args:
            error_pC: Largest error because of a gap, shape (n_electrode,), pC.
            frame: The frame after the gap.
        """
        limit_pC = np.maximum(frame.noise_pC, 0.01 * np.abs(self._charge_pC))
        return bool((error_pC > limit_pC).any())

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings, with a time constant for each electrode."""
        settings = super().c_settings(setup)
        if settings:
            settings["tau_s"] = setup.for_each_electrode("leak.tau_s", settings["tau_s"])
        return settings


class Integrator(Leak):
    """Integrates the currents of a board to charges, and estimates the offset of the currents.

    Because the integral leaks, an error of the offset adds only a limited charge during a touch. Without a section
    `[leak]`, the integral has no leak.
    """

    section = ""
    is_required = True
    front_end = "current"

    def reset(self) -> None:
        """Discard the integral of the currents, the estimated inflow, and the mean sampling interval.

        The inflow is the offset of the currents, which is subtracted from each current before it is added.
        """
        super().reset()  # also creates a new `_inflow`, which is zero
        # The tare has already subtracted an offset. This offset is the mean of only a few currents, so it has an error,
        # which would add up in the integral. The inflow learns this error from the first frames. `learned_s` is the
        # time over which the inflow was averaged. With 0 s, the initial inflow of zero has no weight in the average.
        self._inflow.learned_s = 0.0
        self._previous_current_pC = np.zeros(len(self._tau_s))  # current of the previous valid frame
        self._elapsed_s = 0.0  # time over which the mean sampling interval is computed
        self._interval_count = 1  # number of sampling intervals in this time, plus 1 to avoid a division by 0
        self._touch_intervals = 0  # sampling intervals of the present touch; 0 at rest

    def step(self, frame: Frame) -> None:
        """Replace the currents by the charges, and the noise of the currents by the noise of the charges.

        The charges are the sum of the currents minus the inflow, the estimated offset of the currents. A current is
        stated as its charge in one sampling interval, pC. The touch gets the flag `gap` if currents of missing frames
        may have caused an error that exceeds both the noise and 1 % of the charge.
        """
        self._elapsed_s += frame.dt_s
        self._interval_count += frame.intervals
        missing_count = 0 if self._previous is None else frame.intervals - 1
        current_pC = frame.charge_pC
        if current_pC is None:
            return
        is_touched = self._previous is not None and self._previous.is_contact
        self._touch_intervals = self._touch_intervals + frame.intervals if is_touched else 0

        # Add the assumed charges of the missing frames. The current of a missing frame is assumed to be the mean of the
        # currents before and after the gap. If this mean is so small that it may be only noise, the current is assumed
        # to be the inflow instead. The mean would otherwise multiply the noise by the number of missing frames.
        interval_s = max(self._elapsed_s / self._interval_count, SUM_TOLERANCE_s)  # mean sampling interval
        inflow_pC = self._inflow.pC_per_s * interval_s
        mean_current_pC = (current_pC + self._previous_current_pC) / 2.0
        may_be_noise = np.abs(mean_current_pC) <= 3.0 * frame.noise_pC
        missing_pC = missing_count * np.where(may_be_noise, inflow_pC, mean_current_pC)
        frame.charge_pC = current_pC + missing_pC
        if frame.intervals == 0:  # a copy of the previous frame, or a late frame that has counted as missing
            frame.charge_pC = np.zeros_like(current_pC)
        super().step(frame)  # adds `charge_pC` to the integral, and replaces it by the integral

        # If the missing currents lie between the currents before and after the gap, each differs from their mean by at
        # most half of their difference.
        error_pC = missing_count * np.abs(current_pC - self._previous_current_pC) / 2.0
        self._previous_current_pC = current_pC

        # The ratios are variances of the charges, divided by the variance of one current. At rest, the charges decay
        # with the time constant `relax_s`. The variance of a sum of independent currents with the sampling interval dt
        # is then relax_s / (2 dt) times that of one current. In a touch of n currents, the charges do not decay, and
        # each current adds its variance. The inflow is the mean of the currents in the time T before the touch. Its
        # error adds n^2 dt / T times the variance of one current.
        rest_variance_ratio = max(1.0, 0.5 * self._rule.relax_s / interval_s)
        averaging_s = max(min(self._rule.settle_s, self._inflow.learned_s), interval_s)  # T
        touch_variance_ratio = self._touch_intervals + self._touch_intervals**2 * interval_s / averaging_s
        frame.noise_pC = frame.noise_pC * math.sqrt(rest_variance_ratio + touch_variance_ratio)
        if self._is_large(error_pC, frame):  # compared with the noise and with the touch charge
            self._is_falsified = True  # so that the later frames of the touch get the flag, too
            frame.flags.append(GAP)

    def _innovation_pC(self, output_pC: Array, decay: Array) -> Array:
        """Return the charge that has arrived, minus the charge that has leaked, shape (n_electrode,), pC."""
        return output_pC - (1.0 - decay) * self._charge_pC
