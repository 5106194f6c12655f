"""Detection of a touch by the total charge, which is the sum of the charges of all electrodes.

The detection has a hysteresis. A touch begins when the total charge exceeds a threshold that is derived from the noise.
A touch ends when the total charge falls below a given share of the largest total charge of this touch. If the threshold
for the end did not depend on the touch, a touch would never end after the charge at rest has drifted above this
threshold.
"""

import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.flags import DRIFT, NEGATIVE
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.rule import Rule, Setting
from isocharge.serve.signal_chain.stage import Setup, Stage


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

    def threshold_pC(self, noise_pC: Array) -> float:
        """Return the touch threshold, pC.

        Args:
            noise_pC: Standard deviation of the charge of each electrode at rest, shape (n_electrode,), pC.
        """
        return self.floor_pC + self.sigmas * math.sqrt(float(np.dot(noise_pC, noise_pC)))


SCALE_STD_FACTOR = 2.0
"""Number of common standard deviations of the charges by which the release threshold is raised."""

RISE_S = 0.1
"""Time constant of the mean total charge that shows whether the total charge rises slowly, s.

The total charge of a press of a film of 25 um rises slowly if its force grows by less than about 0.005 N/s.
"""


class Touch(Stage):
    """Determines whether something touches the film.

    A touch begins when the total charge exceeds the base by the touch threshold. The base is the smallest total charge
    since the last release, so a slow drift does not begin a touch. The base decays exponentially with time.

    A touch ends when the total charge falls below the release threshold. The release threshold is a given share of the
    peak, plus the uncertainty of the total charge. It is at least half of the touch threshold. The peak is the largest
    total charge that two consecutive frames of the touch have reached. The spike of a single frame is not a peak.

    If the mean total charge of the last `RISE_S` has already exceeded half of the touch threshold when a touch begins,
    the charge has risen slowly, and a drift of the charge at rest may have caused the touch. All frames of the touch
    then have the flag `drift`.

    If the total charge lies below zero by more than the touch threshold, the frame has the flag `negative`.
    """

    section = "touch"
    is_required = True
    rule_class = TouchRule
    is_default = True
    c_prefix = "TOUCH"

    def __init__(self, setup: Setup) -> None:
        """Begin without a touch."""
        self._rule = setup.rule(TouchRule)
        self._offset_stage = setup.offset_stage
        self.reset()

    def reset(self) -> None:
        """Discard the touch."""
        self._is_contact = False
        self._peak_pC = 0.0  # largest total charge in this touch
        self._last_pC = 0.0  # total charge of the latest frame
        self._base_pC = 0.0  # smallest total charge since the last release
        self._mean_pC = 0.0  # exponential mean of the total charge out of contact
        self._has_drifted = False  # whether the total charge rose too slowly at the beginning of this touch

    def step(self, frame: Frame) -> None:
        """Determine whether something touches the film in this frame.

        If a touch begins, the stage that stores the charge at rest may change the charges of the frame, because the
        touch began before it was detected.
        """
        if frame.charge_pC is None:
            return
        was_contact = self._is_contact
        if self._rule is None:
            self._is_contact = True
        else:
            self._detect(self._rule, frame, float(frame.charge_pC.sum()))
        frame.is_contact = self._is_contact
        if self._is_contact and self._has_drifted:
            frame.flags.append(DRIFT)
        if self._is_contact and not was_contact and self._offset_stage is not None:
            self._offset_stage.begin_touch(frame)

    def _detect(self, rule: TouchRule, frame: Frame, total_pC: float) -> None:
        """Update the state with the total charge of a frame, pC. A press makes the total charge positive."""
        touch_threshold_pC = rule.threshold_pC(frame.noise_pC)
        two_frame_peak_pC = min(total_pC, self._last_pC)  # a spike of a single frame is not a peak
        self._last_pC = total_pC
        if self._is_contact:
            self._peak_pC = max(self._peak_pC, two_frame_peak_pC)
            uncertainty_pC = SCALE_STD_FACTOR * frame.charge_scale_std * total_pC
            release_threshold_pC = rule.release_share * self._peak_pC + uncertainty_pC
            if total_pC < max(release_threshold_pC, 0.5 * touch_threshold_pC):
                self._is_contact = False
                self._base_pC = total_pC
                self._mean_pC = total_pC
            return

        # While a finger leaves the film, a positive base must not decay, because this charge still belongs to the
        # finger.
        if not (frame.is_base_held and self._base_pC > 0.0):
            self._base_pC *= math.exp(-frame.dt_s / frame.base_relax_s)
        if total_pC > self._base_pC + touch_threshold_pC:
            self._is_contact = True
            self._peak_pC = two_frame_peak_pC
            self._has_drifted = self._mean_pC > self._base_pC + 0.5 * touch_threshold_pC
            return
        self._mean_pC = total_pC + math.exp(-frame.dt_s / RISE_S) * (self._mean_pC - total_pC)
        self._base_pC = min(self._base_pC, total_pC)
        if total_pC < -touch_threshold_pC:
            frame.flags.append(NEGATIVE)

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings, and the time constant of the mean total charge."""
        return super().c_settings(setup) | {"rise_s": RISE_S}
