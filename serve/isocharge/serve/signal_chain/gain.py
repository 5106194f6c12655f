"""Conversion of the values of a device to charges."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.structs import Finite, Positive, WrongKey
from isocharge.serve.flags import INVALID
from isocharge.serve.frames.frame import Frame
from isocharge.serve.signal_chain.rule import Rule
from isocharge.serve.signal_chain.stage import Setup, Stage

LARGEST_PC = 1e9
"""Largest charge of a valid reading, pC. Sums of such charges are exact to 1e-7 pC in double precision."""


SMALLEST_GAIN = 1e-300
"""Lower limit of the largest gain, pC. It avoids a division by zero for a board without electrodes."""


class GainRule(Rule, frozen=True, kw_only=True):
    """Settings that convert the unit of a board to charge.

    Each setting is either a single number for all electrodes or a separate number for each electrode.

    Attributes:
        pC_per_unit: Charge of one unit, pC.
        V_per_unit: Voltage of one unit, V. It can be given together with `feedback_pF` instead of `pC_per_unit`.
        feedback_pF: Feedback capacitance of the amplifiers, pF. Its value is the charge, in pC, for an output of 1 V.
        offset: Value that the board sends without charge, in the unit of the board.
    """

    pC_per_unit: Finite | dict[str, Finite] | None = None
    V_per_unit: Finite | dict[str, Finite] | None = None
    feedback_pF: Positive | dict[str, Positive] | None = None
    offset: Finite | dict[str, Finite] | None = None

    def __post_init__(self) -> None:
        """Check that the section contains exactly one form of the gain, and that the gain is not 0.

        The section must contain either `pC_per_unit`, or both `V_per_unit` and `feedback_pF`.

        Raises:
            WrongKey: If a key is missing or wrong. The error names the first such key.
        """
        has_voltage = self.V_per_unit is not None
        has_capacitance = self.feedback_pF is not None
        if has_voltage and self.pC_per_unit is not None:
            raise WrongKey("V_per_unit", "either pC_per_unit, or V_per_unit and feedback_pF", self.V_per_unit)
        if has_capacitance and not has_voltage:
            raise WrongKey(
                "feedback_pF", "no capacitance beside pC_per_unit: it belongs to V_per_unit", self.feedback_pF
            )
        if has_voltage and not has_capacitance:
            raise WrongKey("feedback_pF")

        if self.per_unit is None:
            given_keys = [] if self.offset is None else ["offset"]
            raise WrongKey(
                "pC_per_unit",
                "the charge of one unit of the board, or V_per_unit and feedback_pF of its amplifiers",
                given_keys,
            )
        gains = self.per_unit.values() if isinstance(self.per_unit, dict) else [self.per_unit]
        if 0.0 in gains:
            key = "V_per_unit" if has_voltage else "pC_per_unit"
            raise WrongKey(key, "a finite number that is not 0, or one for each electrode", self.per_unit)

    @property
    def per_unit(self) -> float | dict[str, float] | None:
        """Voltage of one unit, V, if the section contains `V_per_unit`, and otherwise the charge of one unit, pC."""
        return self.pC_per_unit if self.V_per_unit is None else self.V_per_unit

    def charge_pC(self, electrode: str, values: Array) -> Array:
        """Convert values of one electrode to charges.

        The charge is the difference between the value and the offset, times the charge of one unit. The charge of one
        unit is `pC_per_unit`, or the product of `V_per_unit` and `feedback_pF`. A missing offset counts as 0, and a
        missing factor counts as 1.

        Args:
            electrode: Name of the electrode.
            values: Values in the unit of the board, of any shape.

        Returns:
            The charges, pC, with the same shape as `values`.
        """
        per_unit = _setting_of(self.per_unit, electrode, default=1.0)
        feedback_pF = _setting_of(self.feedback_pF, electrode, default=1.0)
        offset = _setting_of(self.offset, electrode, default=0.0)
        return (values - offset) * (per_unit * feedback_pF)


def _setting_of(setting: float | Mapping[str, float] | None, electrode: str, default: float) -> float:
    """Return the value of a setting for one electrode.

    Args:
        setting: One number for all electrodes, a dictionary of numbers by electrode name, or None if the setting is not
            given.
        electrode: Name of the electrode.
        default: Value that is returned if the setting is not given for this electrode.
    """
    if setting is None:
        return default
    if isinstance(setting, Mapping):
        return setting.get(electrode, default)
    return setting


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
    c_prefix = "GAIN"

    def __init__(self, setup: Setup) -> None:
        """Set the conversion. Without settings, the values are charges in pC."""
        rule = setup.rule(GainRule)
        self.gain_pC = np.ones(len(setup.electrodes))
        self.zero = np.zeros(len(setup.electrodes))
        if rule is not None:
            key = "gain.pC_per_unit" if rule.V_per_unit is None else "gain.V_per_unit"
            self.gain_pC = setup.for_each_electrode(key, 1.0 if rule.per_unit is None else rule.per_unit)
            if rule.feedback_pF is not None:
                self.gain_pC = self.gain_pC * setup.for_each_electrode("gain.feedback_pF", rule.feedback_pF)
            if rule.offset is not None:
                self.zero = setup.for_each_electrode("gain.offset", rule.offset)
        self.largest = LARGEST_PC / float(np.abs(self.gain_pC).max(initial=SMALLEST_GAIN))
        self._skipped_s = 0.0  # duration of the invalid frames since the last valid frame

    def step(self, frame: Frame) -> None:
        """Convert the values of a frame to charges, and mark the frame if a value cannot be a charge."""
        magnitude = math.hypot(*frame.sent.tolist())  # at least the largest absolute value; NaN if a value is NaN
        is_valid = magnitude <= self.largest  # false for NaN
        if not is_valid:
            self._skipped_s += frame.dt_s
            frame.is_valid = False
            frame.flags.append(INVALID)
            with np.errstate(over="ignore"):  # a value may be so large that its conversion overflows
                frame.raw_pC = (frame.sent - self.zero) * self.gain_pC
            return
        frame.dt_s += self._skipped_s
        self._skipped_s = 0.0
        frame.raw_pC = (frame.sent - self.zero) * self.gain_pC
        frame.charge_pC = frame.raw_pC

    @classmethod
    def c_settings(cls, setup: Setup) -> dict[str, Any]:
        """Return the conversion of each channel, and the largest valid value."""
        gain = cls(setup)
        return {"zero": gain.zero, "pC": gain.gain_pC, "largest": gain.largest}
