"""Detection of a touch from the vector of the charges of all electrodes, in units of the noise.

Each charge is divided by the touch threshold of its electrode. The size of the charges is the norm of the vector of
these ratios, so the size does not depend on the signs of the charges.

The detection has a hysteresis. A touch begins when the size of the difference from the base exceeds 1. A touch ends
when the size of the charges falls below a given share of the largest size of this touch. With a fixed threshold for the
end, a touch would never end if the charge at rest had drifted above this threshold.
"""

import math
from typing import Any

import numpy as np
from msgspec import structs

from isocharge.common.arrays import Array
from isocharge.serve.flags import DRIFT, NEGATIVE
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.stage import Rule, Setting, Setup, Share, Stage, SUM_TOLERANCE_s


class TouchRule(Rule, frozen=True, kw_only=True):
    """Thresholds for the detection of a touch, from the section `[touch]` of a device file.

    With the reference noise, a press with equal charges on three electrodes is detected from a total charge of 20 pC. A
    press of 0.05 N on a film with a thickness of 25 um gives a total charge of 340 pC. If the force of a press falls
    from 2 N to 0.05 N, the charges fall to 8 % of their peak, so the touch does not end.

    Attributes:
        sigmas: First part of the touch threshold, in standard deviations of the size of the noise.
        floor_pC: Second part of the touch threshold, pC: the total charge of a press with equal charges on all
            electrodes. The touch threshold is the sum of both parts. None stands for 10 pC, or for 0 if the board sends
            currents.
        release_share: Release threshold, relative to the peak of the press. The release threshold is at least half of
            the touch threshold. None stands for 0.05, or for 0.3 if the board sends currents, because their integral
            does not return to zero exactly.
    """

    sigmas: Setting = 6.0
    floor_pC: Setting | None = None
    release_share: Share | None = None

    def resolved(self, *, has_currents: bool) -> "TouchRule":
        """Return the settings, with default values for this kind of board instead of None."""
        floor_pC, release_share = (0.0, 0.3) if has_currents else (10.0, 0.05)
        return structs.replace(
            self,
            floor_pC=floor_pC if self.floor_pC is None else self.floor_pC,
            release_share=release_share if self.release_share is None else self.release_share,
        )

    def threshold_pC(self, noise_pC: Array) -> Array:
        """Return the touch threshold of each electrode, shape (n_electrode,), pC.

        The threshold has two parts. The first part is a multiple of the noise, and the noise of all electrodes together
        rarely exceeds this part. The second part is constant, and is called the floor. The norm of the noise of n
        electrodes, in standard deviations, has a mean of about sqrt(n) and a standard deviation of about sqrt(1/2). The
        settings must come from the method `resolved`, which replaces a floor of None by a number.

        Args:
            noise_pC: Standard deviation of the charge of each electrode at rest, shape (n_electrode,), pC.
        """
        root_count = math.sqrt(len(noise_pC))
        largest_noise_norm = root_count + self.sigmas * math.sqrt(0.5)  # in standard deviations
        # The norm of the floors of all electrodes is `floor_pC`.
        floor_pC = (self.floor_pC or 0.0) / root_count
        threshold_pC = largest_noise_norm * noise_pC + floor_pC
        return np.maximum(threshold_pC, np.finfo(float).eps)  # not 0, for a board without noise


RISE_S = 0.1
"""Time constant of the mean charges that show whether the charges rise slowly, s.

After the same time with small charges, the direction of the latest touch no longer matters.

On a film of 25 um, the charges rise slowly if the force of a press grows by less than about 0.005 N/s.
"""

OPPOSING_COSINE = -0.25
"""Cosine of the angle between a change of the charges and the latest touch, below which both are opposite.

The charges of a touch may have any sign, so the angle of another touch is about 90 degrees or less.
"""


class Touch(Stage):
    """Determines whether something touches the film.

    A touch begins when the charges, and their difference from the base, exceed the touch threshold. The base consists
    of the charges that remained after the last release. The base follows charges that fall further, and decays
    exponentially.

    After a long press, an amplifier with a leak shows charges of the opposite sign. Charges that are opposite to the
    latest touch are therefore not a touch, and neither is a change of the charges in the opposite direction. After a
    change in the opposite direction, the base becomes the mean of the latest charges. If all charges of a film are
    known to be positive, the same rules apply to charges that become negative before the first touch.

    A touch ends when the size of the charges falls below the release threshold. A touch also ends when the charges
    change their sign from one frame to the next. On a film whose charges are positive, a touch ends when the charges
    become negative. The release threshold is a given share of the peak. The release threshold is at least half of the
    touch threshold. The peak is the largest size that two consecutive frames of the touch have reached. The spike of a
    single frame is not a peak.

    When a touch begins, the mean charges of the last `RISE_S` may already exceed half of the touch threshold. The
    charges have then risen slowly, and a drift of the charge at rest may have caused the touch. In this case, all
    frames of the touch have the flag `drift`. For a board that sends currents, the limit is three quarters of the
    threshold. A touch also has the flag `drift` if the charges before the touch were opposite to the touch, as after a
    long press with a leak.

    If charges exceed the touch threshold in the direction opposite to a touch, the frame has the flag `negative`.
    """

    section = "touch"
    is_required = True
    rule_class = TouchRule
    is_default = True

    def __init__(self, setup: Setup) -> None:
        """Begin without a touch."""
        self._setup = setup
        rule = setup.device.rule(TouchRule)
        # None if the detection is switched off. `resolved` sets the default thresholds for charges or for currents.
        self._rule = None if rule is None else rule.resolved(has_currents=setup.device.has_currents)
        # Expected direction of the charges of a touch if there was no earlier touch. The length of the vector does not
        # matter. The second vector is used if the charges of a touch may have any sign.
        self._positive_direction = np.ones(len(setup.electrodes))  # equal positive charges
        self._any_direction = np.zeros(len(setup.electrodes))  # every direction is accepted
        self._noise_pC: Array | None = None  # noise of the latest tare
        self._threshold_pC = np.zeros(0)  # touch thresholds of the electrodes with this noise
        self.reset()

    def reset(self) -> None:
        """Discard the touch."""
        no_charge = np.zeros(len(self._setup.electrodes))  # shared, because no array is changed in place
        # Charges and sizes are relative to the touch thresholds. The size of charges is the norm of their vector.
        self._touch_direction = no_charge  # sum of the directions of the frames of the latest touch
        self._base_charge = no_charge  # charges that are no touch
        self._previous_charge = no_charge  # charges of the previous frame
        self._previous_size = 0.0
        self._idle_mean_charge = no_charge  # exponential mean of the charges out of contact
        self._may_have_drifted = False  # whether the charge at rest may have drifted before this touch
        self._is_contact = False
        self._peak_size = 0.0  # largest size in this touch
        self._quiet_s = math.inf  # time for which the charges have been small

    def step(self, frame: Frame) -> None:
        """Determine whether something touches the film in this frame. A frame without charges is not changed."""
        if frame.charge_pC is None:
            return
        if self._rule is None:  # the detection is switched off, so every frame counts as a contact
            self._is_contact = True
        else:
            # An array is never changed in place. Another array is therefore another noise: the film was tared, or the
            # board sends currents.
            has_new_noise = frame.noise_pC is not self._noise_pC
            if has_new_noise and not self._is_contact:
                self._noise_pC = frame.noise_pC
                self._threshold_pC = self._rule.threshold_pC(frame.noise_pC)
            charge = frame.charge_pC / self._threshold_pC
            size = math.sqrt(charge @ charge)
            if self._is_contact:
                self._step_in_touch(self._rule, charge, size)
            else:
                self._step_without_touch(frame, charge, size)
            self._previous_charge = charge
            self._previous_size = size
        frame.is_contact = self._is_contact
        if self._is_contact and self._may_have_drifted:
            frame.flags.append(DRIFT)

    def _step_in_touch(self, rule: TouchRule, charge: Array, size: float) -> None:
        """Update the present touch with the charges of a frame, or end the touch.

        Args:
            rule: Thresholds.
            charge: Charges relative to the touch thresholds, shape (n_electrode,), dimensionless.
            size: Size of the charges, which is the norm of their vector. A size of 1 is the touch threshold.
        """
        # Update the peak, from which the release threshold follows. The release threshold is at least half of the touch
        # threshold. A smaller release threshold of a weak touch could be below the noise, so the touch would never end.
        held_size = min(size, self._previous_size)  # a spike of a single frame is not a peak
        self._peak_size = max(self._peak_size, held_size)
        release_size = max((rule.release_share or 0.0) * self._peak_size, 0.5)

        # End the touch if the charges are small, or have changed their sign. If charges may have any sign, they are
        # compared with those of the previous frame. Otherwise, most charges of a touch are positive, as is their sum.
        expected_direction = self._previous_charge if self._setup.has_any_sign else self._positive_direction
        is_reversed = charge @ expected_direction < 0.0
        if size < release_size or is_reversed:
            self._is_contact = False
            self._base_charge = charge  # the charges that remain of the touch
            self._idle_mean_charge = charge  # beginning of the exponential mean of the charges out of contact
            self._quiet_s = 0.0  # time for which the charges have been small
        else:
            self._touch_direction = self._touch_direction + charge / size  # sum over the frames of the touch

    def _step_without_touch(self, frame: Frame, charge: Array, size: float) -> None:
        """Process a frame while nothing touches the film: begin a touch, or update the base.

        The base (`_base_charge`) contains the charges that belong to no touch. Out of contact, the base decays to zero.
        It does not decay if it remains of the latest touch, and the frame has `is_base_held`. The change is the
        difference between the charges and the base. The first rule in this list that applies is used:

        - If the change is opposite to the expected direction, a release or a drift has caused the change. The base
          becomes the mean of the latest charges (`_idle_mean_charge`).
        - If both the charges and the change exceed the threshold, and the charges are not opposite to the expected
          direction, a touch begins.
        - If the base is a remainder of the latest touch, and the charges are smaller than the base, the charges become
          the new base.

        Unless a touch begins, the exponential mean of the charges out of contact is then updated.

        While charges of the latest touch may remain, the expected direction is the direction of the latest touch.
        Later, the expected charges are positive and equal. If touches may have charges of any sign, the expected
        direction is then the zero vector, with which every direction is accepted.

        Args:
            frame: The frame.
            charge: Charges relative to the touch thresholds, shape (n_electrode,), dimensionless.
            size: Size of the charges, which is the norm of their vector. A size of 1 is the threshold.
        """
        # After some time with small charges, the latest touch no longer matters. The tolerance allows for the rounding
        # errors of the summed times.
        if self._quiet_s >= RISE_S - SUM_TOLERANCE_s:
            self._touch_direction = self._any_direction if self._setup.has_any_sign else self._positive_direction
        direction = self._touch_direction
        # Charges are opposite if their scalar product with `direction` is below this limit times their size.
        opposing_limit = OPPOSING_COSINE * math.sqrt(direction @ direction)

        # After a touch, the base is the charge that remains of it. While the finger leaves the film, the charge at rest
        # is held, and the base must not decay, because the finger still causes this charge.
        is_remainder = self._base_charge @ direction >= 0.0
        if not (frame.is_base_held and is_remainder):
            self._base_charge = self._base_charge * math.exp(-frame.dt_s / frame.base_relax_s)

        change = charge - self._base_charge
        change_size = math.sqrt(change @ change)
        if change @ direction < opposing_limit * change_size:
            self._base_charge = self._idle_mean_charge  # a release or a drift, and not the noise of a single frame
        elif min(size, change_size) > 1.0 and charge @ direction >= opposing_limit * size:  # a touch begins
            self._is_contact = True
            self._peak_size = min(size, self._previous_size)  # a spike of a single frame is not a peak
            self._touch_direction = charge / size
            # The charge at rest may have drifted in two cases. The mean charges before the touch already exceeded half
            # of the threshold, or the base was opposite to the touch, so that the change is larger than the charges.
            # For currents, the limit is higher, because the sum of their noise changes slowly, like a drift.
            drift_limit = 0.75 if self._setup.device.has_currents else 0.5
            earlier_rise = self._idle_mean_charge - self._base_charge  # before this frame
            earlier_rise_size = math.sqrt(earlier_rise @ earlier_rise)
            # A base that is opposite to the touch makes `change_size` larger than `size`.
            self._may_have_drifted = max(earlier_rise_size, change_size - size) > drift_limit
            return
        elif is_remainder and size < math.sqrt(self._base_charge @ self._base_charge):
            self._base_charge = charge  # the charge that remains of the latest touch becomes smaller
            self._idle_mean_charge = charge

        # Exponential mean of the charges with the time constant `RISE_S`
        decay = math.exp(-frame.dt_s / RISE_S)
        self._idle_mean_charge = charge + decay * (self._idle_mean_charge - charge)
        if size > 1.0 and charge @ direction < 0.0:
            frame.flags.append(NEGATIVE)
        self._quiet_s = 0.0 if size > 1.0 else self._quiet_s + frame.dt_s

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the settings, whether the charges of a touch may have any sign, and the time constant of the mean."""
        rule = cls(setup)._rule
        settings = {} if rule is None else structs.asdict(rule)
        return settings | {"any_sign": setup.has_any_sign, "rise_s": RISE_S}
