"""Removal of mains hum by an adaptive notch filter.

A fixed notch filter rings after every touch. For example, a step of 850 pC through a notch of 1 Hz takes a second to
settle. Therefore the hum itself is estimated and subtracted (Widrow et al., "Adaptive noise cancelling", 1975;
normalised least mean squares). The hum in each channel is a sine wave of known frequency. Its amplitude and its phase
change slowly.

The estimate is updated with the differences of consecutive frames, because a touch changes these differences only
briefly. Each difference is clipped. The filter does not delay the signal.
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
    """Settings of the estimate of hum; the section `[hum]` of a device file.

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
        turn: Unit phasor of the mains at this frame.
        raw_pC: Charges of this frame, shape (electrodes,), pC; None before the first frame.
    """

    phasor_pC: Complexes
    turn: complex = 1.0 + 0.0j
    raw_pC: Array | None = None

    @classmethod
    def start(cls, electrodes: int) -> "Hum":
        """Return the state before the first frame."""
        return cls(np.zeros(electrodes, dtype=complex))


def remove_hum(rule: HumRule, hum: Hum, raw_pC: Array, t_s: float, dt_s: float) -> tuple[Hum, Array]:
    """Subtract the hum from a frame, and update the estimate.

    The hum of a channel is the real part of a product of two complex numbers. The first is the phasor of the channel,
    which has the amplitude and the phase of the hum. The second is a unit phasor that turns with the mains frequency.
    The phasor of the channel is estimated from the differences between consecutive frames, which contain little of the
    touch charge.

    Args:
        rule: Settings of the estimate of hum.
        hum: State after the previous frame.
        raw_pC: Charges of the frame, shape (electrodes,), pC.
        t_s: Time on the clock of the device, s.
        dt_s: Time since the previous frame, s.

    Returns:
        The state after this frame, and the charges without hum, shape (electrodes,), pC.
    """
    turn = cmath.exp(2j * math.pi * rule.frequency_Hz * t_s)  # the unit phasor at this frame
    turn_step = turn - hum.turn
    squared_step = turn_step.real * turn_step.real + turn_step.imag * turn_step.imag
    phasor_pC = hum.phasor_pC
    if hum.raw_pC is not None and squared_step > MIN_SQUARED_STEP:
        # One step of normalised least mean squares: compare the change of the charges with the change of the hum.
        expected_change_pC = (phasor_pC * turn_step).real
        error_pC = raw_pC - hum.raw_pC - expected_change_pC
        clipped_pC = np.minimum(np.maximum(error_pC, -rule.limit_pC), rule.limit_pC)
        gain = min(1.0, 2.0 * dt_s / rule.settle_s)
        phasor_pC = phasor_pC + clipped_pC * (gain / squared_step * turn_step.conjugate())
    hum_pC = (phasor_pC * turn).real
    return Hum(phasor_pC, turn, raw_pC), raw_pC - hum_pC
