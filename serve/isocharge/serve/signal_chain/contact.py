"""Whether something touches: the total charge, with hysteresis.

A touch begins when the total charge stands out of the noise and ends at a share of that press's own peak: an absolute
release threshold would never release once the base has drifted.
"""

import math
from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array


@dataclass(frozen=True, slots=True)
class TouchRule:
    """When something touches.

    The smallest press we care about, 0.05 N on a 25 um film, gives 340 pC in total; reference noise makes the touch
    threshold 20 pC. A press that falls from 2 N (4000 pC) to 0.05 N keeps 8 % of its peak.

    Attributes:
        sigmas: The total charge must rise by so many of its standard deviations,
        floor_pC: plus this, pC, to be a touch.
        release_share: Release threshold as a share of the press's peak, but at least half the rise of a touch.
    """

    sigmas: float = 6.0
    floor_pC: float = 10.0
    release_share: float = 0.05


@dataclass(frozen=True, slots=True)
class Touch:
    """Whether something touches.

    Attributes:
        contact: Whether it does.
        peak_pC: Largest total charge of this press so far, pC, that two frames in a row reached: a spike is no peak.
        last_pC: Total charge of the latest frame, pC.
        base_pC: Smallest total charge since the last release, pC: a drifted base must not count as the next touch.
        below: Whether the total charge is further below zero than a touch would be above.
    """

    contact: bool = False
    peak_pC: float = 0.0
    last_pC: float = 0.0
    base_pC: float = 0.0
    below: bool = False


def update_contact(rule: TouchRule, touch: Touch, total_pC: float, noise_pC: Array, keep: float = 1.0) -> Touch:
    """Contact with hysteresis.

    Args:
        rule: The thresholds.
        touch: After the frame before.
        total_pC: Total touch charge of this frame, pC; a press makes it positive.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        keep: What is left of the base after this frame: where the charge itself relaxes to zero, so does the base.
    """
    threshold = rule.floor_pC + rule.sigmas * math.sqrt(float(np.dot(noise_pC, noise_pC)))
    if touch.contact:
        peak = max(touch.peak_pC, min(total_pC, touch.last_pC))
        released = total_pC < max(rule.release_share * peak, 0.5 * threshold)
        return Touch(last_pC=total_pC, base_pC=total_pC) if released else Touch(True, peak, total_pC)
    base_pC = keep * touch.base_pC
    if total_pC > base_pC + threshold:
        return Touch(True, min(total_pC, touch.last_pC), total_pC)
    return Touch(last_pC=total_pC, base_pC=min(base_pC, total_pC), below=total_pC < -threshold)
