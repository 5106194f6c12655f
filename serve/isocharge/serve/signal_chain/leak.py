"""The leak of a charge amplifier undone.

A charge amplifier is an integrator that forgets, tau = R C. What it puts out, v, is undone step by step,

    q[n] = q[n-1] + i[n] - b dt,        i[n] = v[n] - a v[n-1],        a = exp(-dt / tau),

i the innovation, b the current that leaks in (pC/s): offset, bias and slow warming. b is learned on the innovation and
only out of contact, where all of i is b dt and noise: learned on the output v it would diverge. What a touch adds
before it is noticed must not count, so each innovation counts up to a limit, and a touch begins with the b of a moment
before; after a release learning holds off.

Out of contact the charge relaxes to zero: whatever is left then is error, and so is a slow warming of the film, which
gives every electrode the same charge.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.arrays import Array


@dataclass(frozen=True, slots=True)
class LeakRule:
    """The amplifier, and how its offset is learned.

    Attributes:
        tau_s: Time constant of each channel, shape (electrodes,), s.
        learn: Whether to learn what leaks in.
        settle_s: Time constant of learning, s.
        hold_off_s: No learning for so long after a release, s.
        clip_sigmas: An innovation counts up to so many of its standard deviations at rest,
        clip_pC: but at least up to this, pC.
        relax_s: Time constant with which the charge relaxes to zero out of contact, s.
        look_back_s: A touch begins with what had been learned so long before, s, or up to twice as long.
    """

    tau_s: Array
    learn: bool = True
    settle_s: float = 3.0
    hold_off_s: float = 0.5
    clip_sigmas: float = 4.0
    clip_pC: float = 0.1
    relax_s: float = 1.0
    look_back_s: float = 0.25


class Leak(NamedTuple):
    """What the stage remembers.

    Attributes:
        charge_pC: Touch charge q, shape (electrodes,), pC.
        output_pC: The amplifier's output v of the frame before, above tare, shape (electrodes,), pC.
        inflow_pC_per_s: What leaks in, b, shape (electrodes,), pC/s.
        sure_pC_per_s: b of a moment before, which no touch has spoilt.
        next_pC_per_s: The b that becomes `sure` next.
        next_age_s: How old that is, s.
        learned_s: How long b has been learned, s; it begins as if zero had been found for a second.
        hold_s: How long learning still holds off, s.
    """

    charge_pC: Array
    output_pC: Array
    inflow_pC_per_s: Array
    sure_pC_per_s: Array
    next_pC_per_s: Array
    next_age_s: float = 0.0
    learned_s: float = 1.0
    hold_s: float = 0.0

    @classmethod
    def start(cls, output_pC: Array) -> "Leak":
        """At the first frame after the tare."""
        nothing = np.zeros_like(output_pC)
        return cls(nothing, output_pC, nothing, nothing, nothing)


def undo_leak(rule: LeakRule, leak: Leak, output_pC: Array, noise_pC: Array, dt_s: float, *, contact: bool) -> Leak:
    """What is known after the next frame.

    Args:
        rule: The amplifier.
        leak: After the frame before.
        output_pC: The amplifier's output above tare, shape (electrodes,), pC.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        dt_s: Since the frame before, s.
        contact: Whether something touched in the frame before.
    """
    innovation_pC = output_pC - np.exp(-dt_s / rule.tau_s) * leak.output_pC
    surplus_pC = innovation_pC - leak.inflow_pC_per_s * dt_s
    charge_pC = leak.charge_pC + surplus_pC
    if contact:
        sure = leak.sure_pC_per_s
        return Leak(charge_pC, output_pC, sure, sure, sure, 0.0, leak.learned_s, rule.hold_off_s)
    charge_pC = charge_pC * math.exp(-dt_s / rule.relax_s)
    if leak.hold_s > 0.0 or not rule.learn:
        return leak._replace(charge_pC=charge_pC, output_pC=output_pC, hold_s=leak.hold_s - dt_s)
    return _learn(rule, leak, surplus_pC, noise_pC, dt_s)._replace(charge_pC=charge_pC, output_pC=output_pC)


def _learn(rule: LeakRule, leak: Leak, surplus_pC: Array, noise_pC: Array, dt_s: float) -> Leak:
    """Correct what leaks in by a clipped surplus; let what was learned become sure, one look back after the other."""
    limit_pC = np.maximum(rule.clip_pC, rule.clip_sigmas * math.sqrt(2.0) * noise_pC)
    clipped_pC = np.minimum(np.maximum(surplus_pC, -limit_pC), limit_pC)
    learned_s, age_s = leak.learned_s + dt_s, leak.next_age_s + dt_s
    inflow = leak.inflow_pC_per_s + clipped_pC / max(min(rule.settle_s, learned_s), dt_s)  # no more than all of it
    if age_s < rule.look_back_s:
        return leak._replace(inflow_pC_per_s=inflow, next_age_s=age_s, learned_s=learned_s)
    return Leak(leak.charge_pC, leak.output_pC, inflow, leak.next_pC_per_s, inflow, 0.0, learned_s)
