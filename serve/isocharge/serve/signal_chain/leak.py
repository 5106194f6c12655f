"""Compensation of the leak of a charge amplifier.

A charge amplifier is a leaky integrator with the time constant tau = R C. The touch charge q follows from its output v
frame by frame,

    q[n] = q[n-1] + i[n] - b dt,        i[n] = v[n] - a v[n-1],        a = exp(-dt / tau),

where i is the innovation and b is the inflow (pC/s), the current that flows in because of offset, bias and slow
warming. The inflow is estimated from the innovation, because an estimate from the output v would diverge. The inflow is
estimated only while nothing touches the film. Without new touch charge, the innovation consists of noise and of b dt,
the contribution of the inflow.

Frames of a touch must not change the estimated inflow. Therefore, three rules are applied. Each innovation is clipped.
During a touch, the correction uses the inflow that was estimated `look_back_s` before the touch. After a release, the
estimate of the inflow pauses for the time `hold_off_s`.

While nothing touches the film, any charge is an error or comes from a slow warming of the film. The computed touch
charge therefore decays exponentially to zero.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.rule import Rule, Setting, TimeConstant


class LeakRule(Rule, frozen=True, kw_only=True):
    """Settings for the estimate of the inflow, from the section `[leak]` of a device file.

    Attributes:
        learn: Whether the inflow b is estimated.
        settle_s: Time constant of the estimate, s.
        hold_off_s: Pause of the estimate after a release, s.
        clip_sigmas: Limit to which an innovation is clipped, in standard deviations of an innovation at rest.
        clip_pC: Smallest limit to which an innovation is clipped, pC.
        relax_s: Time constant with which the charge decays to zero out of contact, s.
        look_back_s: Age of the inflow with which a touch begins, s. The inflow may be up to twice as old.
    """

    learn: bool = True
    settle_s: TimeConstant = 3.0
    hold_off_s: Setting = 0.5
    clip_sigmas: Setting = 4.0
    clip_pC: Setting = 0.1
    relax_s: TimeConstant = 1.0
    look_back_s: Setting = 0.25


class Leak(NamedTuple):
    """State of the compensation after a frame.

    Attributes:
        charge_pC: Touch charge q, shape (electrodes,), pC.
        output_pC: Output v above the tare, shape (electrodes,), pC.
        inflow_pC_per_s: Inflow b, shape (electrodes,), pC/s.
        trusted_pC_per_s: Inflow as it was estimated at least `look_back_s` ago, before a touch could affect it.
        candidate_pC_per_s: Inflow that becomes the trusted inflow when its age is `look_back_s`.
        candidate_age_s: Age of the candidate, s.
        learned_s: Time over which the inflow was averaged, s. It starts at 1 s, with an inflow of 0 as the prior.
        hold_s: Remaining time of the pause after a release, s.
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
        """Return the state at the first frame after the tare, in which the touch charge and the inflow are zero."""
        zeros = np.zeros_like(output_pC)
        return cls(zeros, output_pC, zeros, zeros, zeros)


def undo_leak(
    rule: LeakRule, tau_s: Array, leak: Leak, output_pC: Array, noise_pC: Array, dt_s: float, *, contact: bool
) -> Leak:
    """Correct the leak of the amplifiers in the next frame, and return the state with the touch charge of this frame.

    The output v of an amplifier decays with its time constant tau. The innovation i of frame n is the difference
    between the output and the decayed previous output,

        i[n] = v[n] - exp(-dt / tau) v[n-1].

    The innovation consists of the inflow b dt (a slow current into the amplifier), noise and new touch charge. The
    touch charge is therefore q[n] = q[n-1] + i[n] - b dt. Out of contact, the touch charge also decays to zero, and the
    inflow is estimated.

    Args:
        rule: Settings of the estimate of the inflow.
        tau_s: Time constant of each amplifier, shape (electrodes,), s.
        leak: State after the previous frame.
        output_pC: Output of the amplifiers above the tare, shape (electrodes,), pC.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        dt_s: Time since the previous frame, s.
        contact: Whether something touched in the previous frame.
    """
    decayed_output_pC = np.exp(-dt_s / tau_s) * leak.output_pC  # output that would remain without new charge
    innovation_pC = output_pC - decayed_output_pC
    surplus_pC = innovation_pC - leak.inflow_pC_per_s * dt_s  # new touch charge and noise
    charge_pC = leak.charge_pC + surplus_pC
    if contact:
        return state_in_touch(leak, charge_pC, output_pC, rule.hold_off_s)

    # Out of contact, any charge is an error. The charge therefore decays to zero.
    decayed_charge_pC = charge_pC * math.exp(-dt_s / rule.relax_s)
    relaxed_leak = leak._replace(charge_pC=decayed_charge_pC, output_pC=output_pC)

    # The estimate of the inflow pauses for some time after a release.
    is_paused = relaxed_leak.hold_s > 0.0
    if is_paused or not rule.learn:
        return relaxed_leak._replace(hold_s=relaxed_leak.hold_s - dt_s)
    return learn_inflow(rule, relaxed_leak, surplus_pC, noise_pC, dt_s)


def state_in_touch(leak: Leak, charge_pC: Array, output_pC: Array, hold_off_s: float) -> Leak:
    """Return the state of the leak compensation after a frame in contact.

    The inflow is the slow current into each amplifier. During a contact, the inflow is not estimated. Instead, the last
    trusted estimate is used. The trusted estimate is so old that the touch cannot have affected this value.

    Args:
        leak: State after the previous frame.
        charge_pC: Touch charge of this frame, shape (electrodes,), pC.
        output_pC: Output of the amplifiers above the tare, shape (electrodes,), pC.
        hold_off_s: Pause of the estimate after the release, s.
    """
    trusted_pC_per_s = leak.trusted_pC_per_s
    return Leak(
        charge_pC,
        output_pC,
        inflow_pC_per_s=trusted_pC_per_s,
        trusted_pC_per_s=trusted_pC_per_s,
        candidate_pC_per_s=trusted_pC_per_s,
        candidate_age_s=0.0,
        learned_s=leak.learned_s,
        hold_s=hold_off_s,
    )


def learn_inflow(rule: LeakRule, leak: Leak, surplus_pC: Array, noise_pC: Array, dt_s: float) -> Leak:
    """Use a frame out of contact to update the estimated inflow, which is the slow current into each amplifier.

    The surplus is the part of the new charge that the estimated inflow does not explain. The surplus is divided by an
    averaging time and added to the inflow, so that the inflow follows its mean over this time. Large surpluses are
    clipped, because touches cause large surpluses.

    The beginning of an undetected touch may have changed the latest inflow. During a touch, the older trusted inflow is
    therefore used. After each time interval `look_back_s`, the inflow is stored as the candidate, and the previous
    candidate becomes the trusted inflow.

    Args:
        rule: Settings of the estimate of the inflow.
        leak: State of this frame with the inflow of the previous frame.
        surplus_pC: Innovation minus the contribution of the inflow, shape (electrodes,), pC.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        dt_s: Time since the previous frame, s.

    Returns:
        The state with the new inflow, candidate and trusted inflow.
    """
    # Without a touch, the surplus is the difference of the noise of two frames. The standard deviation of this
    # difference is sqrt(2) times that of one frame.
    limit_pC = np.maximum(rule.clip_pC, rule.clip_sigmas * math.sqrt(2.0) * noise_pC)
    clipped_surplus_pC = np.minimum(np.maximum(surplus_pC, -limit_pC), limit_pC)

    # Until `settle_s` has passed, the surplus is averaged over the time for which the inflow has been learned. The
    # averaging time is at least `dt_s`, so that the corrected inflow explains at most the whole surplus.
    learned_s = leak.learned_s + dt_s
    averaging_s = max(min(rule.settle_s, learned_s), dt_s)
    inflow_pC_per_s = leak.inflow_pC_per_s + clipped_surplus_pC / averaging_s

    # Replace the trusted inflow and the candidate if the candidate is old enough.
    trusted_pC_per_s = leak.trusted_pC_per_s
    candidate_pC_per_s = leak.candidate_pC_per_s
    candidate_age_s = leak.candidate_age_s + dt_s
    if candidate_age_s >= rule.look_back_s:
        trusted_pC_per_s = candidate_pC_per_s
        candidate_pC_per_s = inflow_pC_per_s
        candidate_age_s = 0.0
    return Leak(
        leak.charge_pC,
        leak.output_pC,
        inflow_pC_per_s=inflow_pC_per_s,
        trusted_pC_per_s=trusted_pC_per_s,
        candidate_pC_per_s=candidate_pC_per_s,
        candidate_age_s=candidate_age_s,
        learned_s=learned_s,
        hold_s=0.0,
    )
