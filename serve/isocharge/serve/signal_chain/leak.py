"""The leak of a charge amplifier undone.

A charge amplifier is a leaky integrator with the time constant tau = R C. The touch charge q follows from its output v
frame by frame,

    q[n] = q[n-1] + i[n] - b dt,        i[n] = v[n] - a v[n-1],        a = exp(-dt / tau),

where i is the innovation and b the current that leaks in (pC/s): offset, bias and slow warming. b is learned on the
innovation, and only out of contact, where i is nothing but b dt and noise; learned on the output v it would diverge.
The first frames of a touch must not change b: each innovation is clipped, a touch begins with the b of `look_back_s`
before, and after a release learning waits for `hold_off_s`.

Out of contact the charge relaxes to zero, because any charge then is an error or a slow warming of the film, which
gives every electrode the same charge.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.rule import Rule, Setting, TimeConstant


class LeakRule(Rule, frozen=True, kw_only=True):
    """How the offset of the amplifiers is learned.

    Attributes:
        learn: Whether to learn the inflow b.
        settle_s: Time constant of learning, s.
        hold_off_s: Pause of learning after a release, s.
        clip_sigmas: Limit of an innovation in learning, in its standard deviations at rest.
        clip_pC: Smallest value of that limit, pC.
        relax_s: Time constant with which the charge relaxes to zero out of contact, s.
        look_back_s: Age of the inflow with which a touch begins, s; it may be up to twice as old.
    """

    learn: bool = True
    settle_s: TimeConstant = 3.0
    hold_off_s: Setting = 0.5
    clip_sigmas: Setting = 4.0
    clip_pC: Setting = 0.1
    relax_s: TimeConstant = 1.0
    look_back_s: Setting = 0.25


class Leak(NamedTuple):
    """What the stage remembers.

    Attributes:
        charge_pC: Touch charge q, shape (electrodes,), pC.
        output_pC: Output v of the frame before, above tare, shape (electrodes,), pC.
        inflow_pC_per_s: Inflow b, shape (electrodes,), pC/s.
        trusted_pC_per_s: Inflow as learned at least `look_back_s` ago, before the touch could affect it.
        candidate_pC_per_s: Inflow that becomes the trusted one when it is `look_back_s` old.
        candidate_age_s: Its age, s.
        learned_s: Effective averaging time of b so far, s; starts at 1 s with b = 0 as the prior.
        hold_s: Time for which learning still pauses, s.
    """

    charge_pC: Array
    output_pC: Array
    inflow_pC_per_s: Array
    trusted_pC_per_s: Array
    candidate_pC_per_s: Array
    candidate_age_s: float = 0.0
    learned_s: float = 1.0
    hold_s: float = 0.0

    @classmethod
    def start(cls, output_pC: Array) -> "Leak":
        """At the first frame after the tare."""
        nothing = np.zeros_like(output_pC)
        return cls(nothing, output_pC, nothing, nothing, nothing)


def undo_leak(
    rule: LeakRule, tau_s: Array, leak: Leak, output_pC: Array, noise_pC: Array, dt_s: float, *, contact: bool
) -> Leak:
    """Charge and inflow after the next frame.

    Args:
        rule: How the inflow is learned.
        tau_s: Time constant of each amplifier, shape (electrodes,), s.
        leak: After the frame before.
        output_pC: The amplifier's output above tare, shape (electrodes,), pC.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        dt_s: Since the frame before, s.
        contact: Whether something touched in the frame before.
    """
    innovation_pC = output_pC - np.exp(-dt_s / tau_s) * leak.output_pC
    surplus_pC = innovation_pC - leak.inflow_pC_per_s * dt_s
    charge_pC = leak.charge_pC + surplus_pC
    if contact:
        trusted = leak.trusted_pC_per_s
        return Leak(charge_pC, output_pC, trusted, trusted, trusted, 0.0, leak.learned_s, rule.hold_off_s)
    leak = Leak(charge_pC * math.exp(-dt_s / rule.relax_s), output_pC, *leak[2:])
    if leak.hold_s > 0.0 or not rule.learn:
        return leak._replace(hold_s=leak.hold_s - dt_s)
    return learn_inflow(rule, leak, surplus_pC, noise_pC, dt_s)


def learn_inflow(rule: LeakRule, leak: Leak, surplus_pC: Array, noise_pC: Array, dt_s: float) -> Leak:
    """Correct the inflow by the clipped surplus; every `look_back_s` the candidate becomes the trusted inflow."""
    limit_pC = np.maximum(rule.clip_pC, rule.clip_sigmas * math.sqrt(2.0) * noise_pC)
    clipped_pC = np.minimum(np.maximum(surplus_pC, -limit_pC), limit_pC)
    learned_s, age_s = leak.learned_s + dt_s, leak.candidate_age_s + dt_s
    inflow = leak.inflow_pC_per_s + clipped_pC / max(min(rule.settle_s, learned_s), dt_s)  # at most the whole surplus
    trusted, candidate = leak.trusted_pC_per_s, leak.candidate_pC_per_s
    if age_s >= rule.look_back_s:
        trusted, candidate, age_s = candidate, inflow, 0.0
    return Leak(leak.charge_pC, leak.output_pC, inflow, trusted, candidate, age_s, learned_s)
