"""What is known about a board and its amplifier: its frames, its channels, and the rules of its signal chain."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DeviceError
from isocharge.serve.frames.autodetect import AutoParser
from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import Parser
from isocharge.serve.frames.frame_layout import FrameLayout
from isocharge.serve.frames.layout_parser import described_parser
from isocharge.serve.frames.text import TextParser
from isocharge.serve.port.request import Request
from isocharge.serve.signal_chain.chain import Chain
from isocharge.serve.signal_chain.contact import TouchRule
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.thermal import ThermalRule

LEAST_ELECTRODES_FOR_WARMING = 4
"""Number of electrodes from which warming can be separated from force: a contact alone has three unknowns."""


@dataclass(frozen=True)
class ByElectrode:
    """A setting that is one number for all electrodes, or one for each.

    Attributes:
        value: The number, or the numbers by electrode.
        name: File and key, for messages.
    """

    value: float | Mapping[str, float]
    name: str

    def array(self, electrodes: tuple[str, ...]) -> Array:
        """The setting of each electrode, shape (electrodes,).

        Raises:
            DeviceError: If the numbers are those of other electrodes.
        """
        numbers = self.value if isinstance(self.value, Mapping) else dict.fromkeys(electrodes, self.value)
        if set(numbers) != set(electrodes):
            raise DeviceError(
                f"{self.name}: expected a number, or one for each of the electrodes {electrodes}, got {self.value}"
            )
        return np.array([numbers[name] for name in electrodes], dtype=float)

    def of(self, electrode: str, default: float) -> float:
        """The setting of one electrode; the default if there is none for it."""
        return self.value.get(electrode, default) if isinstance(self.value, Mapping) else self.value


@dataclass(frozen=True)
class FrameSettings:
    """What a board sends.

    Attributes:
        format: "auto", "binary", "text" or "described".
        columns: Names for the columns of a CSV.
        meanings: `seq`, `t_us`, `t_ms` or `t_s` by the name that the board has for it; of text.
        layout: Of described frames.
        request: What the board has to be asked; None if it sends unasked.
    """

    format: str = "auto"
    columns: tuple[str, ...] = ()
    meanings: Mapping[str, str] = field(default_factory=dict)
    layout: FrameLayout | None = None
    request: Request | None = None

    def parser(self) -> Parser:
        """A new parser."""
        if self.layout is not None:
            return described_parser(self.layout)
        parsers: dict[str, Callable[[], Parser]] = {
            "auto": lambda: AutoParser(self.columns, self.meanings),
            "binary": BinaryParser,
            "text": lambda: TextParser(self.columns, self.meanings),
        }
        return parsers[self.format]()


@dataclass(frozen=True)
class GainSettings:
    """From the unit of a board to charge.

    Attributes:
        per_unit: Charge of one unit, pC; or voltage, V, where there is a feedback capacitance.
        feedback_pF: Feedback capacitance of the amplifiers, pF, so that 1 V is that number of pC.
        offset: What a board shows without charge, in its unit; None for 0.
    """

    per_unit: ByElectrode
    feedback_pF: ByElectrode | None = None
    offset: ByElectrode | None = None

    def pC_per_unit(self, electrodes: tuple[str, ...]) -> Array:
        """Charge of one unit with its sign, shape (electrodes,), pC.

        Raises:
            DeviceError: If the numbers are those of other electrodes.
        """
        per_unit = self.per_unit.array(electrodes)
        return per_unit if self.feedback_pF is None else per_unit * self.feedback_pF.array(electrodes)

    def charge_pC(self, electrode: str, values: Array) -> Array:
        """Values of one electrode, of any shape, as charges, pC; as they are where there is no setting for it."""
        factor = self.per_unit.of(electrode, 1.0)
        if self.feedback_pF is not None:
            factor *= self.feedback_pF.of(electrode, 1.0)
        return (values - (self.offset.of(electrode, 0.0) if self.offset else 0.0)) * factor

    def zero(self, electrodes: tuple[str, ...]) -> Array | None:
        """What is subtracted before the gain, shape (electrodes,), in the board's unit; None for nothing.

        Raises:
            DeviceError: If the numbers are those of other electrodes.
        """
        return None if self.offset is None else self.offset.array(electrodes)


@dataclass(frozen=True)
class LeakSettings:
    """The amplifier's decay.

    Attributes:
        tau_s: Time constant, s.
        learning: The other settings of a `LeakRule` that the file has.
    """

    tau_s: ByElectrode
    learning: Mapping[str, Any] = field(default_factory=dict)

    def rule(self, electrodes: tuple[str, ...]) -> LeakRule:
        """The rule for these electrodes.

        Raises:
            DeviceError: If the time constants are those of other electrodes.
        """
        return LeakRule(self.tau_s.array(electrodes), **self.learning)


@dataclass(frozen=True)
class Device:
    """What is known about a board; a stage that is None is switched off.

    Attributes:
        name: For people.
        frames: What it sends.
        channels: Electrode to the channel's name in the frame; empty where nothing is known.
        gain: From the board's unit to charge; None if it sends pC.
        limit_pC: Largest charge that the converter can show, pC.
        hum, tare, leak, touch: Rules of the stages.
        common_mode: How warming of the film is followed.
        table: The content of the device file; recordings keep it.
        where: The file, for messages.
    """

    name: str = "any board"
    frames: FrameSettings = field(default_factory=FrameSettings)
    channels: Mapping[str, str] = field(default_factory=dict)
    gain: GainSettings | None = None
    limit_pC: float | None = None
    hum: HumRule | None = None
    tare: TareRule | None = field(default_factory=TareRule)
    leak: LeakSettings | None = None
    touch: TouchRule | None = field(default_factory=TouchRule)
    common_mode: ThermalRule | None = None
    table: Mapping[str, Any] = field(default_factory=dict)
    where: str = "device"

    @property
    def layout(self) -> FrameLayout | None:
        """The layout of described frames; None for other formats."""
        return self.frames.layout

    def parser(self) -> Parser:
        """A new parser for its frames."""
        return self.frames.parser()

    def chain(self, electrodes: tuple[str, ...]) -> Chain:
        """The signal chain for these electrodes.

        Raises:
            DeviceError: If a setting is for other electrodes, or they are too few to follow warming.
        """
        if self.common_mode is not None and len(electrodes) < LEAST_ELECTRODES_FOR_WARMING:
            raise DeviceError(
                f"{self.where}: common_mode: expected four electrodes or more, the model has {electrodes}; with three "
                "every set of charges fits some contact, and warming cannot be separated from force: remove the section"
            )
        return Chain(
            gain_pC=None if self.gain is None else self.gain.pC_per_unit(electrodes),
            zero=None if self.gain is None else self.gain.zero(electrodes),
            limit_pC=self.limit_pC,
            hum=self.hum,
            tare=self.tare,
            leak=None if self.leak is None else self.leak.rule(electrodes),
            touch=self.touch,
            thermal=self.common_mode,
        )


ANY_BOARD = Device()
"""The board of which nothing is known."""
