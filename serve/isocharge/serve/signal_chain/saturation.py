"""Detection of presses in which an amplifier was at its limit."""

import numpy as np

from isocharge.serve.flags import SATURATED
from isocharge.serve.frames.frame import SATURATED_BIT, Frame
from isocharge.serve.signal_chain.rule import Rule, Setting
from isocharge.serve.signal_chain.stage import Setup, Stage


class SaturationRule(Rule, frozen=True, kw_only=True):
    """Section `[saturation]` of a device file.

    Attributes:
        limit_pC: Largest charge that the converter can represent, pC.
    """

    limit_pC: Setting


class Saturation(Stage):
    """Adds the flag `saturated` to frames in which an amplifier is or was at its limit in this press.

    An amplifier is at its limit if the device says so, or if the magnitude of a charge reaches the limit of the
    converter. All later frames of the press keep the flag.
    """

    section = "saturation"
    is_required = True
    rule_class = SaturationRule
    c_prefix = "SATURATION"

    def __init__(self, setup: Setup) -> None:
        """Begin without a press."""
        rule = setup.rule(SaturationRule)
        self._limit_pC = None if rule is None else rule.limit_pC
        self._is_saturated = False

    def step(self, frame: Frame) -> None:
        """Add the flag to a frame, unless the frame is invalid."""
        if not frame.is_valid:
            return
        is_at_limit = bool(frame.bits & SATURATED_BIT)
        if self._limit_pC is not None and not is_at_limit:
            is_at_limit = bool((np.abs(frame.raw_pC) >= self._limit_pC).any())
        self._is_saturated = is_at_limit or (self._is_saturated and frame.is_contact)
        if self._is_saturated:
            frame.flags.append(SATURATED)

    def reset(self) -> None:
        """Discard the press."""
        self._is_saturated = False
