"""Removal of mains hum by an adaptive notch filter.

A fixed notch filter rings after every touch. For example, the output of a notch filter with a width of 1 Hz takes a
second to settle after a step of 850 pC. Instead, this module estimates the hum itself, and subtracts the estimated hum
(Widrow and others, "Adaptive noise cancelling", 1975; normalised least mean squares). The hum in each channel is a sine
wave of known frequency, whose amplitude and phase change slowly.

The estimate of the hum is updated with the differences of frames that are close in time, because a touch changes these
differences only briefly. Each difference is clipped. The filter does not delay the signal.
"""

import cmath
import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.stage import Divisor, Rule, Setting, Setup, Stage, SUM_TOLERANCE_s

MIN_SQUARED_STEP = 0.02
"""Smallest squared change of the unit phasor between two frames with which the hum is updated, dimensionless."""


class HumRule(Rule, frozen=True, kw_only=True):
    """Settings of the estimate of hum, from the section `[hum]` of a device file.

    Attributes:
        frequency_Hz: Frequency of the mains, 50 or 60 Hz.
        settle_s: Time constant of the estimate, s. The width of the notch is 1 / (pi * settle_s).
        limit_pC: Limit to which a difference of two frames is clipped, pC.
    """

    frequency_Hz: Divisor = 50.0
    settle_s: Divisor = 0.5
    limit_pC: Setting = 5.0


class Hum(Stage):
    """Subtracts mains hum.

    The hum of a channel is the real part of a product of two complex numbers. The first number is the phasor of the
    channel. The magnitude of the phasor is the amplitude of the hum, and its angle is the phase of the hum. The second
    number is a unit phasor, exp(2 pi i f t), that turns with the mains frequency f. The phasor of the channel is
    estimated from the differences between frames, which contain little of the touch charge. A frame is compared with
    the previous frame. If the unit phasor has hardly changed since the previous frame, an earlier frame is used
    instead.

    The estimate follows the method of normalised least mean squares (Widrow and others 1975). Let z be the change of
    the unit phasor between the two frames. The phasor of the channel is changed by

        gain * error * conjugate(z) / |z|^2,

    where the error is the change of the charge minus the expected change of the hum. With a gain of 1, the updated hum
    would explain the whole error.
    """

    section = "hum"
    rule_class = HumRule

    def __init__(self, setup: Setup) -> None:
        """Begin with an estimate of zero hum."""
        self._rule = setup.device.rule(HumRule) or HumRule()
        # The hum of each channel: the magnitude is its amplitude, and the angle is its phase.
        self._hum_phasor_pC: Complexes = np.zeros(len(setup.electrodes), dtype=complex)
        # The reference is the earlier frame with which the next frame is compared. `reset` begins without its charges.
        self._reference_phasor = 0j  # unit phasor exp(2 pi i f t) of the mains; 0 before the first reference
        self._reference_age_s = 0.0
        self.reset()

    def reset(self) -> None:
        """Learn the hum again, because the clock may have been reset. Compare the next frame with no earlier one."""
        self._reference_pC: Array | None = None  # charges of the frame with which the next frame is compared
        self._learned_s = 0.0  # time over which the hum has been learned

    def step(self, frame: Frame) -> None:
        """Subtract the hum from a frame, and update the estimate of the hum.

        The hum of a channel is the real part of p u. The phasor p contains the amplitude and the phase of the hum. The
        unit phasor u = exp(2 pi i f t) turns with the frequency f of the mains. The frame is compared with an earlier
        frame, the reference. If u has changed by z since then, the charges should have changed by the real part of p z.
        """
        if frame.charge_pC is None:
            return
        rule = self._rule
        raw_pC = frame.charge_pC
        unit_phasor = cmath.exp(2j * math.pi * rule.frequency_Hz * frame.clock_s)  # u
        phasor_step = unit_phasor - self._reference_phasor  # z
        squared_step = abs(phasor_step) ** 2
        self._reference_age_s += frame.dt_s

        # If the unit phasor has hardly changed, the change of the charges contains little hum.
        has_turned = squared_step > MIN_SQUARED_STEP
        if self._reference_pC is not None and has_turned:
            expected_change_pC = (self._hum_phasor_pC * phasor_step).real
            error_pC = raw_pC - self._reference_pC - expected_change_pC
            # Clipping limits the influence of a touch, which may change the charges by more than the hum.
            clipped_error_pC = error_pC.clip(-rule.limit_pC, rule.limit_pC)
            # The estimate averages the errors over `settle_s`. Until this time has passed, it averages them over the
            # time so far, so that the first tare contains little hum. The tolerance avoids a division by 0.
            self._learned_s += self._reference_age_s
            averaging_s = max(min(rule.settle_s, self._learned_s), SUM_TOLERANCE_s)
            # The charges contain only the real part of the product p z. With a gain of 1, a frame therefore corrects
            # only half of the error of the phasor on average. With the factor 2, the time constant is `averaging_s`.
            gain = min(1.0, 2.0 * self._reference_age_s / averaging_s)
            # The smallest change of p for which the real part of p z changes by `error` is error * conj(z) / |z|^2.
            correction_per_error = gain / squared_step * phasor_step.conjugate()
            self._hum_phasor_pC = self._hum_phasor_pC + clipped_error_pC * correction_per_error
        # The unit phasor turns enough within a tenth of a period, except if the frames are nearly whole periods apart.
        is_old = self._reference_age_s > 0.1 / rule.frequency_Hz
        if self._reference_pC is None or has_turned or is_old:
            self._reference_phasor = unit_phasor
            self._reference_pC = raw_pC
            self._reference_age_s = 0.0
        frame.charge_pC = raw_pC - (self._hum_phasor_pC * unit_phasor).real

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings, and the smallest squared step of the phasor."""
        return super().c_settings(setup) | {"min_squared_step": MIN_SQUARED_STEP}
