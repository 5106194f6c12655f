"""Conversion of the values of a device to charges, and detection of presses in which an amplifier was at its limit."""

import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.structs import Finite, WrongKey
from isocharge.serve.flags import INVALID, SATURATED
from isocharge.serve.frames.frame import SATURATED_BIT, Frame
from isocharge.serve.signal_chain.stage import LARGEST, Rule, Setting, Setup, Stage


class GainRule(Rule, frozen=True, kw_only=True):
    """Settings that convert the unit of a board to charge.

    Each setting is either a single number for all electrodes or a separate number for each electrode.

    Attributes:
        pC_per_unit: Charge of one unit, pC. For a board that sends volts, it is the feedback capacitance of the
            amplifiers in pF.
        offset: Value that the board sends without charge, in the unit of the board.
    """

    pC_per_unit: Finite | dict[str, Finite]
    offset: Finite | dict[str, Finite] = 0.0

    def __post_init__(self) -> None:
        """Check that the gain is not 0.

        Raises:
            WrongKey: If the gain of an electrode is 0.
        """
        gains = self.pC_per_unit.values() if isinstance(self.pC_per_unit, dict) else [self.pC_per_unit]
        if 0.0 in gains:
            raise WrongKey("pC_per_unit", "a finite number that is not 0, or one for each electrode", self.pC_per_unit)

    def charge_pC(self, electrode: str, values: Array) -> Array:
        """Convert values of one electrode, of any shape, to charges, pC. An unstated gain is 1."""
        gain_pC = self.pC_per_unit.get(electrode, 1.0) if isinstance(self.pC_per_unit, dict) else self.pC_per_unit
        offset = self.offset.get(electrode, 0.0) if isinstance(self.offset, dict) else self.offset
        return (values - offset) * gain_pC


class Gain(Stage):
    """Converts values of the device to charges in pC, with the offset, the sign and the gain of each channel.

    A frame with a value that cannot be a charge gets the flag `invalid`, and no charges. After invalid frames, the time
    step of the next frame begins at the last valid frame.

    Attributes:
        gain_pC: Charge per unit of the device, with sign, shape (n_electrode,), pC.
        zero: Values of the device without charge, shape (n_electrode,), in the unit of the device.
        largest: Largest magnitude of a valid value, in the unit of the device.
    """

    section = "gain"
    is_required = True
    rule_class = GainRule

    def __init__(self, setup: Setup) -> None:
        """Set the conversion. Without settings, the values are charges in pC."""
        rule = setup.device.rule(GainRule) or GainRule(pC_per_unit=1.0)
        self.gain_pC = setup.for_each_electrode("gain.pC_per_unit", rule.pC_per_unit)
        self.zero = setup.for_each_electrode("gain.offset", rule.offset)
        self.largest = LARGEST / float(np.abs(self.gain_pC).max(initial=np.finfo(float).tiny))
        self._skipped_s = 0.0  # duration of the invalid frames since the last valid frame
        self._skipped_intervals = 0

    def step(self, frame: Frame) -> None:
        """Convert the values of a frame to charges, and mark the frame if a value cannot be a charge."""
        with np.errstate(over="ignore"):  # a value may be so large that its conversion overflows
            frame.raw_pC = (frame.sent - self.zero) * self.gain_pC
        magnitude = math.hypot(*frame.sent.tolist())  # at least the largest absolute value; NaN if a value is NaN
        if not magnitude <= self.largest:  # the condition is negated, so that it is true for NaN
            self._skipped_s += frame.dt_s
            self._skipped_intervals += frame.intervals
            frame.is_valid = False
            frame.flags.append(INVALID)
            return
        frame.dt_s += self._skipped_s
        frame.intervals += self._skipped_intervals
        self._skipped_s = 0.0
        self._skipped_intervals = 0
        frame.charge_pC = frame.raw_pC

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the offset and the gain of each channel, and the largest valid value, by name."""
        gain = cls(setup)
        return {"zero": gain.zero, "pC": gain.gain_pC, "largest": gain.largest}


class SaturationRule(Rule, frozen=True, kw_only=True):
    """Section `[saturation]` of a device file.

    Attributes:
        limit_pC: Largest charge that the converter can represent, pC.
    """

    limit_pC: Setting


class Saturation(Stage):
    """Adds the flag `saturated` to the frames of a press in which an amplifier is, or has been, at its limit.

    An amplifier is at its limit if the device reports this, or if the magnitude of a charge reaches the limit of the
    converter. All later frames of the press keep the flag.
    """

    section = "saturation"
    is_required = True
    rule_class = SaturationRule

    def __init__(self, setup: Setup) -> None:
        """Begin without a press."""
        rule = setup.device.rule(SaturationRule)
        self._limit_pC = math.inf if rule is None else rule.limit_pC
        self._is_saturated = False

    def step(self, frame: Frame) -> None:
        """Add the flag to a frame, unless the frame is invalid."""
        if not frame.is_valid:
            return
        largest_pC = max(map(abs, frame.raw_pC.tolist()))
        is_at_limit = bool(frame.bits & SATURATED_BIT) or largest_pC >= self._limit_pC
        self._is_saturated = is_at_limit or (self._is_saturated and frame.is_contact)
        if self._is_saturated:
            frame.flags.append(SATURATED)

    def reset(self) -> None:
        """Discard the press."""
        self._is_saturated = False
