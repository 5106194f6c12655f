"""Estimate of the inflow, a slow current into each charge amplifier because of offset, bias and slow warming.

The inflow is estimated from the change of the output in each frame, and only while nothing touches the film. Without
new touch charge, this change consists of noise and of the contribution of the inflow.

Frames of a touch must not change the estimated inflow. Therefore, three rules are applied. Each change is clipped.
During a touch, the correction uses the inflow that was estimated `look_back_s` before the touch. After a release, the
estimate of the inflow pauses for the time `hold_off_s`.
"""

import math

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.structs import Positive
from isocharge.serve.signal_chain.rule import LARGEST, Rule, Setting, TimeConstant


class LeakRule(Rule, frozen=True, kw_only=True):
    """Section `[leak]` of a device file, which describes the leak and the inflow of the amplifiers.

    Attributes:
        tau_s: Time constant of the amplifiers, s, as one number for all electrodes or one number for each electrode. By
            default, the amplifiers have no leak.
        learn: Whether the inflow b is estimated.
        settle_s: Time constant of the estimate, s.
        hold_off_s: Pause of the estimate after a release, s.
        clip_sigmas: Limit to which an innovation is clipped, in standard deviations of an innovation at rest.
        clip_pC: Smallest limit to which an innovation is clipped, pC.
        relax_s: Time constant with which the charge decays to zero out of contact, s.
        look_back_s: Age of the inflow with which a touch begins, s. The inflow may be up to twice as old.
    """

    tau_s: Positive | dict[str, Positive] = LARGEST
    learn: bool = True
    settle_s: TimeConstant = 3.0
    hold_off_s: Setting = 0.5
    clip_sigmas: Setting = 4.0
    clip_pC: Setting = 0.1
    relax_s: TimeConstant = 1.0
    look_back_s: Setting = 0.25


class Inflow:
    """Estimate of the inflow, which is the slow current into each amplifier.

    During a touch, the correction uses the trusted inflow. It is so old that the touch cannot have affected it.

    Attributes:
        pC_per_s: The inflow, shape (n_electrode,), pC/s.
        learned_s: Time over which the inflow was averaged, s. It starts at 1 s, with an inflow of 0 as the prior.
        hold_s: Remaining time of the pause after a release, s.
    """

    def __init__(self, rule: LeakRule, n_electrode: int) -> None:
        """Begin with an inflow of zero.

        Args:
            rule: Settings of the estimate.
            n_electrode: Number of electrodes.
        """
        self._rule = rule
        self.pC_per_s = np.zeros(n_electrode)
        self.learned_s = 1.0
        self.hold_s = 0.0
        self._trusted_pC_per_s = self.pC_per_s  # inflow at least `look_back_s` ago
        self._candidate_pC_per_s = self.pC_per_s  # becomes the trusted inflow when its age is `look_back_s`
        self._candidate_age_s = 0.0

    def pause(self) -> None:
        """Use the trusted inflow during a touch, and for some time after its release."""
        self.pC_per_s = self._trusted_pC_per_s
        self._candidate_pC_per_s = self._trusted_pC_per_s
        self._candidate_age_s = 0.0
        self.hold_s = self._rule.hold_off_s

    def learn(self, surplus_pC: Array, noise_pC: Array, dt_s: float) -> None:
        """Use a frame out of contact to update the inflow.

        The surplus is the part of the new charge that the estimated inflow does not explain. The surplus is divided by
        an averaging time and added to the inflow, so that the inflow follows its mean over this time. Large surpluses
        are clipped, because touches cause large surpluses.

        The beginning of an undetected touch may have changed the latest inflow. During a touch, the older trusted
        inflow is therefore used. After each time interval `look_back_s`, the inflow is stored as the candidate, and the
        previous candidate becomes the trusted inflow.

        Args:
            surplus_pC: New charge minus the contribution of the inflow, shape (n_electrode,), pC.
            noise_pC: Standard deviation of each electrode at rest, shape (n_electrode,), pC.
            dt_s: Time since the previous frame, s.
        """
        rule = self._rule
        # Without a touch, the surplus is the difference of the noise of two frames. The standard deviation of this
        # difference is sqrt(2) times that of one frame.
        limit_pC = np.maximum(rule.clip_pC, rule.clip_sigmas * math.sqrt(2.0) * noise_pC)
        clipped_surplus_pC = np.minimum(np.maximum(surplus_pC, -limit_pC), limit_pC)

        # Until `settle_s` has passed, the surplus is averaged over the time for which the inflow has been learned. The
        # averaging time is at least `dt_s`, so that the corrected inflow explains at most the whole surplus.
        self.learned_s += dt_s
        averaging_s = max(min(rule.settle_s, self.learned_s), dt_s)
        self.pC_per_s = self.pC_per_s + clipped_surplus_pC / averaging_s
        self.hold_s = 0.0

        # Replace the trusted inflow and the candidate if the candidate is old enough.
        self._candidate_age_s += dt_s
        if self._candidate_age_s >= rule.look_back_s:
            self._trusted_pC_per_s = self._candidate_pC_per_s
            self._candidate_pC_per_s = self.pC_per_s
            self._candidate_age_s = 0.0
