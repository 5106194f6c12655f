"""Detection of a touch by the total charge, which is the sum of the charges of all electrodes.

The detection has a hysteresis. A touch begins when the total charge exceeds a threshold that is derived from the noise.
A touch ends when the total charge falls below a given share of the largest total charge of this touch. If the threshold
for the end did not depend on the touch, a touch would never end after the charge at rest has drifted above this
threshold.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.signal_chain.rule import Rule, Setting


class TouchRule(Rule, frozen=True, kw_only=True):
    """Thresholds for the detection of a touch, from the section `[touch]` of a device file.

    With the reference noise, the touch threshold is 20 pC. A press of 0.05 N on a film with a thickness of 25 um gives
    a total charge of 340 pC. If the force of a press falls from 2 N to 0.05 N, the total charge falls to 8 % of its
    peak, so the touch does not end.

    Attributes:
        sigmas: First part of the touch threshold, in standard deviations of the total charge at rest.
        floor_pC: Second part of the touch threshold, pC. The touch threshold is the sum of both parts.
        release_share: Release threshold, relative to the peak of the press. The release threshold is at least half of
            the touch threshold.
    """

    sigmas: Setting = 6.0
    floor_pC: Setting = 10.0
    release_share: Setting = 0.05


class Touch(NamedTuple):
    """State of the touch detection after a frame.

    Attributes:
        contact: Whether something touches.
        peak_pC: Largest total charge in this press that two consecutive frames reached, pC. The spike of a single frame
            is not a peak.
        last_pC: Total charge of the latest frame, pC.
        base_pC: Smallest total charge since the last release, pC. A touch is a rise above the base, so a slow drift
            does not begin a touch.
        is_negative: Whether the total charge lies below zero by more than the touch threshold.
    """

    contact: bool = False
    peak_pC: float = 0.0
    last_pC: float = 0.0
    base_pC: float = 0.0
    is_negative: bool = False


NO_TOUCH = Touch()
"""The state before the first touch."""

SCALE_STD_FACTOR = 2.0
"""Number of common standard deviations of the charges by which the release threshold is raised."""


def update_contact(
    rule: TouchRule, touch: Touch, total_pC: float, noise_pC: Array, decay: float = 1.0, scale_std: float = 0.0
) -> Touch:
    """Return the state of the touch detection after the next frame.

    A touch begins when the total charge exceeds the base by the touch threshold. The base is the smallest total charge
    since the last release. If the total charge is far below zero, the state has the mark `is_negative`.

    A touch ends when the total charge falls below the release threshold. The release threshold is a given share of the
    peak, plus the uncertainty of the total charge. It is at least half of the touch threshold. The peak is the largest
    total charge that two consecutive frames of the touch have reached.

    Args:
        rule: The thresholds.
        touch: State after the previous frame.
        total_pC: Total touch charge of this frame, pC. A press makes it positive.
        noise_pC: Standard deviation of each electrode at rest, shape (electrodes,), pC.
        decay: Factor by which the base has decayed since the previous frame. It is below 1 if the charge at rest
            decays.
        scale_std: Relative standard deviation that all charges have in common, because the memory of the film (creep
            and the thermoelastic step) is not known exactly.
    """
    total_noise_pC = math.sqrt(float(np.dot(noise_pC, noise_pC)))  # standard deviation of the total charge at rest
    touch_threshold_pC = rule.floor_pC + rule.sigmas * total_noise_pC
    if touch.contact:
        two_frame_peak_pC = min(total_pC, touch.last_pC)  # a spike of a single frame is not a peak
        peak_pC = max(touch.peak_pC, two_frame_peak_pC)
        uncertainty_pC = SCALE_STD_FACTOR * scale_std * total_pC
        min_release_threshold_pC = 0.5 * touch_threshold_pC
        release_threshold_pC = max(rule.release_share * peak_pC + uncertainty_pC, min_release_threshold_pC)
        if total_pC < release_threshold_pC:
            return Touch(last_pC=total_pC, base_pC=total_pC)  # after a release, the base begins at the present charge
        return Touch(contact=True, peak_pC=peak_pC, last_pC=total_pC)

    # Nothing touched in the previous frame.
    base_pC = decay * touch.base_pC
    if total_pC > base_pC + touch_threshold_pC:
        two_frame_peak_pC = min(total_pC, touch.last_pC)
        return Touch(contact=True, peak_pC=two_frame_peak_pC, last_pC=total_pC)
    is_negative = total_pC < -touch_threshold_pC
    return Touch(last_pC=total_pC, base_pC=min(base_pC, total_pC), is_negative=is_negative)
