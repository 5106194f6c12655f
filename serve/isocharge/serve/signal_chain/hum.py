"""Removal of mains hum by an adaptive notch filter.

A fixed notch filter rings after every touch. For example, the output of a notch filter with a width of 1 Hz takes a
second to settle after a step of 850 pC. Instead, this module estimates the hum itself, and subtracts the estimated hum
(Widrow and others, "Adaptive noise cancelling", 1975; normalised least mean squares). The hum in each channel is a sine
wave of known frequency, whose amplitude and phase change slowly.

The estimate of the hum is updated with the differences of consecutive frames, because a touch changes these differences
only briefly. Each difference is clipped. The filter does not delay the signal.
"""

import cmath
import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.serve.signal_chain.rule import Rule, Setting, TimeConstant

MIN_SQUARED_STEP = 0.02
"""Smallest squared change of the unit phasor between two frames for an update of the hum, dimensionless."""


class HumRule(Rule, frozen=True, kw_only=True):
    """Settings of the estimate of hum, from the section `[hum]` of a device file.

    Attributes:
        frequency_Hz: Frequency of the mains, 50 or 60 Hz.
        settle_s: Time constant of the estimate, s. The width of the notch is 1 / (pi * settle_s).
        limit_pC: Limit to which a difference of two frames is clipped, pC.
    """

    frequency_Hz: Setting = 50.0
    settle_s: TimeConstant = 0.5
    limit_pC: Setting = 5.0


class Hum(NamedTuple):
    """State of the estimate after a frame.

    Attributes:
        phasor_pC: Amplitude and phase in each channel, shape (electrodes,), complex, pC.
        unit_phasor: Phasor of magnitude 1 that turns with the mains frequency, at this frame.
        raw_pC: Charges of this frame, shape (electrodes,), pC; None before the first frame.
    """

    phasor_pC: Complexes
    unit_phasor: complex = 1.0 + 0.0j
    raw_pC: Array | None = None

    @classmethod
    def start(cls, electrodes: int) -> "Hum":
        """Return the state before the first frame, in which the hum is zero."""
        return cls(np.zeros(electrodes, dtype=complex))


def remove_hum(rule: HumRule, hum: Hum, raw_pC: Array, t_s: float, dt_s: float) -> tuple[Hum, Array]:
    """Subtract the hum from a frame, and update the estimate of the hum.

    The hum of a channel is the real part of a product of two complex numbers. The first number is the phasor of the
    channel. The magnitude of the phasor is the amplitude of the hum, and its angle is the phase of the hum. The second
    number is a unit phasor, exp(2 pi i f t), that turns with the mains frequency f. The phasor of the channel is
    estimated from the differences between consecutive frames, which contain little of the touch charge.

    The estimate follows the method of normalised least mean squares (Widrow and others 1975). Let z be the change of
    the unit phasor between two frames. In each frame, the phasor of the channel is changed by

        gain * error * conjugate(z) / |z|^2,

    where the error is the change of the charge minus the expected change of the hum. With a gain of 1, the updated hum
    would explain the whole error.

    Args:
        rule: Settings of the estimate of hum.
        hum: State of the estimate after the previous frame.
        raw_pC: Charges of the frame, shape (electrodes,), pC.
        t_s: Time on the clock of the device, s.
        dt_s: Time since the previous frame, s.

    Returns:
        The state after this frame, and the charges without hum, shape (electrodes,), pC.
    """
    unit_phasor = cmath.exp(2j * math.pi * rule.frequency_Hz * t_s)
    phasor_step = unit_phasor - hum.unit_phasor
    squared_step = phasor_step.real * phasor_step.real + phasor_step.imag * phasor_step.imag
    channel_phasor_pC = hum.phasor_pC

    # The estimate needs a previous frame. If the unit phasor has hardly changed, the change contains little hum.
    if hum.raw_pC is not None and squared_step > MIN_SQUARED_STEP:
        expected_change_pC = (channel_phasor_pC * phasor_step).real
        error_pC = raw_pC - hum.raw_pC - expected_change_pC
        # Clipping limits the influence of a touch, which may change the charges by more than the hum.
        clipped_error_pC = np.minimum(np.maximum(error_pC, -rule.limit_pC), rule.limit_pC)
        # The charges contain only the real part of the product. With a gain of 1, a frame therefore corrects only half
        # of the error of the phasor on average. With the factor 2, the time constant of the estimate is `settle_s`.
        gain = min(1.0, 2.0 * dt_s / rule.settle_s)
        correction_per_error = gain / squared_step * phasor_step.conjugate()
        channel_phasor_pC = channel_phasor_pC + clipped_error_pC * correction_per_error
    hum_pC = (channel_phasor_pC * unit_phasor).real
    return Hum(channel_phasor_pC, unit_phasor, raw_pC), raw_pC - hum_pC
