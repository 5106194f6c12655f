"""Mains hum, removed by an adaptive notch.

A fixed notch rings after every touch: a step of 850 pC through a notch 1 Hz wide takes a second to settle. So the hum
itself is estimated, a sine of known frequency and slowly changing amplitude and phase in each channel, and subtracted
(Widrow et al., "Adaptive noise cancelling", 1975; normalised least mean squares). It is learned on the *differences* of
consecutive frames, which hum changes all the time and a touch only briefly, and each difference is clipped. Nothing is
delayed.
"""

import cmath
import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.serve.signal_chain.rule import Rule, Setting, TimeConstant

LEAST_TURN = 0.02
"""Smallest squared step of the unit phasor between two frames, dimensionless, from which hum can be learned."""


class HumRule(Rule, frozen=True, kw_only=True):
    """How hum is followed.

    Attributes:
        frequency_Hz: Frequency of the mains, 50 or 60 Hz.
        settle_s: Time constant of learning, s; the notch is 1 / (pi * settle_s) wide.
        limit_pC: Limit of a difference in learning, pC.
    """

    frequency_Hz: Setting = 50.0
    settle_s: TimeConstant = 0.5
    limit_pC: Setting = 5.0


class Hum(NamedTuple):
    """The hum.

    Attributes:
        phasor_pC: Amplitude and phase in each channel, shape (electrodes,), complex, pC.
        turn: Unit phasor of the mains at the frame before.
        raw_pC: Charges of the frame before, shape (electrodes,), pC; None before the first.
    """

    phasor_pC: Complexes
    turn: complex = 1.0 + 0.0j
    raw_pC: Array | None = None

    @classmethod
    def start(cls, electrodes: int) -> "Hum":
        """Before the first frame."""
        return cls(np.zeros(electrodes, dtype=complex))


def remove_hum(rule: HumRule, hum: Hum, raw_pC: Array, t_s: float, dt_s: float) -> tuple[Hum, Array]:
    """The hum after this frame, and the charges without it.

    Args:
        rule: How to follow it.
        hum: After the frame before.
        raw_pC: Shape (electrodes,), pC.
        t_s: The device's clock, s.
        dt_s: Since the frame before, s.
    """
    turn = cmath.exp(2j * math.pi * rule.frequency_Hz * t_s)
    phasor_pC = hum.phasor_pC
    step = turn - hum.turn
    norm = step.real * step.real + step.imag * step.imag
    if hum.raw_pC is not None and norm > LEAST_TURN:
        error_pC = raw_pC - hum.raw_pC - (phasor_pC * step).real
        error_pC = np.minimum(np.maximum(error_pC, -rule.limit_pC), rule.limit_pC)
        phasor_pC = phasor_pC + error_pC * (min(1.0, 2.0 * dt_s / rule.settle_s) / norm * step.conjugate())
    return Hum(phasor_pC, turn, raw_pC), raw_pC - (phasor_pC * turn).real
