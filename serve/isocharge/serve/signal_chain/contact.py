"""Whether something touches: the total charge, with hysteresis.

A touch begins when the total charge rises out of the noise, and ends when it falls below a share of that press's own
peak: an absolute release threshold would never release once the base has drifted.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.rule import Rule, Setting


class TouchRule(Rule, frozen=True, kw_only=True):
    """When something touches.

    The smallest press we care about, 0.05 N on a 25 um film, gives 340 pC in total; reference noise makes the touch
    threshold 20 pC. A press that falls from 2 N (4000 pC) to 0.05 N keeps 8 % of its peak.

    Attributes:
        sigmas: Part of the touch threshold in standard deviations of the total charge at rest.
        floor_pC: Constant part of the touch threshold, pC, added to the other.
        release_share: Release threshold as a share of the press's peak; it is at least half the touch threshold.
    """

    sigmas: Setting = 6.0
    floor_pC: Setting = 10.0
    release_share: Setting = 0.05


class Touch(NamedTuple):
    """Whether something touches.

    Attributes:
        contact: Whether something touches.
        peak_pC: Largest total charge in this press that two frames in a row reached, pC: a spike is no peak.
        last_pC: Total charge of the latest frame, pC.
        base_pC: Smallest total charge since the last release, pC; a touch is a rise above it, so drift is no touch.
        below: Whether the total charge lies below zero by more than the touch threshold.
    """

    contact: bool = False
    peak_pC: float = 0.0
    last_pC: float = 0.0
    base_pC: float = 0.0
    below: bool = False


NO_TOUCH = Touch()
"""The state before the first touch."""

UNKNOWN_SIGMAS = 2.0
"""Deviations of what is not known of the film's memory by which a press is released earlier."""


def update_contact(
    rule: TouchRule, touch: Touch, total_pC: float, noise_pC: Array, decay: float = 1.0, unknown: float = 0.0
) -> Touch:
    """Contact with hysteresis.

    Args:
        rule: The thresholds.
        touch: After the frame before.
        total_pC: Total touch charge of this frame, pC; a press makes it positive.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        decay: Factor of the base from frame to frame; below 1 where the charge itself relaxes to zero.
        unknown: Relative standard deviation of this charge, for what the film remembers.
    """
    threshold = rule.floor_pC + rule.sigmas * math.sqrt(float(np.dot(noise_pC, noise_pC)))
    if touch.contact:
        peak = max(touch.peak_pC, min(total_pC, touch.last_pC))
        rest_pC = rule.release_share * peak + UNKNOWN_SIGMAS * unknown * total_pC
        released = total_pC < max(rest_pC, 0.5 * threshold)
        return Touch(last_pC=total_pC, base_pC=total_pC) if released else Touch(True, peak, total_pC)
    base_pC = decay * touch.base_pC
    if total_pC > base_pC + threshold:
        return Touch(True, min(total_pC, touch.last_pC), total_pC)
    return Touch(last_pC=total_pC, base_pC=min(base_pC, total_pC), below=total_pC < -threshold)
