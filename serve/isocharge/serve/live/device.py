"""The device file: what is known about a board and its amplifier, in TOML.

    name = "bench board 3"         # optional

    [frames]                       # optional; without it the format is recognised
    format = "described"           # or "auto", "binary", "text"; the keys of "described" are those of
                                   # isocharge.serve.frames.frame_layout, of the others those of .formats
    request = "3F 0A"              # what the board has to be asked, hexadecimal; optional

    [channels]                     # electrode -> name or number in the frame; without it the same names, or the same
    A = "adc0"                     # order

    [gain]                         # optional; a number for all channels, or one for each electrode
    offset = 8388608               # what the board shows without charge, in its unit; optional
    pC_per_unit = {A = 0.0457, B = -0.0459, C = 0.0457}     # negative where the amplifier inverts; or
    # V_per_unit = 0.000045        # with the amplifier's feedback capacitance:
    # feedback_pF = 1000.0

    [saturation]
    limit_pC = 1500.0

    [leak]
    tau_s = {A = 10.0, B = 10.2, C = 9.9}

`[hum]`, `[tare]`, `[leak]`, `[memory]`, `[touch]` and `[common_mode]` take the settings of their rules (see
`isocharge.serve.signal_chain`), `[track]` and `[follow]` those of `isocharge.serve.tracking`, and every stage
`on = false`, which switches it off. Tare and touch are on without a section. An unknown key is an error.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import field, structs

from isocharge.common.arrays import Array
from isocharge.common.errors import DeviceError
from isocharge.common.structs import Finite, Positive, Settings, WrongKey, convert, read_toml
from isocharge.serve.frames.formats import AutoFrames, Frames
from isocharge.serve.frames.frame import Parser
from isocharge.serve.port.serial_line import Request
from isocharge.serve.signal_chain.chain import Chain
from isocharge.serve.signal_chain.contact import TouchRule
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.memory import MemoryRule
from isocharge.serve.signal_chain.rule import Rule, Setting
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.thermal import ThermalRule
from isocharge.serve.tracking.film_follower import FollowRule
from isocharge.serve.tracking.tracker import TrackRule

LEAST_ELECTRODES_FOR_WARMING = 4
"""Number of electrodes from which warming can be separated from force: a contact alone has three unknowns."""


class Gain(Rule, frozen=True, kw_only=True):
    """From the unit of a board to charge; each setting is one number, or one for each electrode.

    Attributes:
        pC_per_unit: Charge of one unit, pC.
        V_per_unit: In its place, the voltage of one unit, V, with the feedback capacitance of the amplifiers.
        feedback_pF: That capacitance, pF: 1 V is that number of pC.
        offset: What a board shows without charge, in its unit.
    """

    pC_per_unit: Finite | dict[str, Finite] | None = None
    V_per_unit: Finite | dict[str, Finite] | None = None
    feedback_pF: Positive | dict[str, Positive] | None = None
    offset: Finite | dict[str, Finite] | None = None

    def __post_init__(self) -> None:
        if self.V_per_unit is not None and self.pC_per_unit is not None:
            raise WrongKey("V_per_unit", "either pC_per_unit, or V_per_unit and feedback_pF", self.V_per_unit)
        if self.V_per_unit is None and self.feedback_pF is not None:
            raise WrongKey(
                "feedback_pF", "no capacitance beside pC_per_unit: it belongs to V_per_unit", self.feedback_pF
            )
        if self.V_per_unit is not None and self.feedback_pF is None:
            raise WrongKey("feedback_pF")
        if self.per_unit is None:
            raise WrongKey("pC_per_unit")
        key = "pC_per_unit" if self.V_per_unit is None else "V_per_unit"
        if 0.0 in (self.per_unit.values() if isinstance(self.per_unit, dict) else (self.per_unit,)):
            raise WrongKey(key, "a finite number that is not 0, or one for each electrode", self.per_unit)

    @property
    def per_unit(self) -> float | dict[str, float] | None:
        """Charge of one unit, pC; or its voltage, V, where there is a feedback capacitance."""
        return self.pC_per_unit if self.V_per_unit is None else self.V_per_unit

    def charge_pC(self, electrode: str, values: Array) -> Array:
        """Values of one electrode, of any shape, as charges, pC; as they are where there is no setting for it."""
        per_unit, feedback, offset = (
            setting.get(electrode, default) if isinstance(setting, dict) else default if setting is None else setting
            for setting, default in ((self.per_unit, 1.0), (self.feedback_pF, 1.0), (self.offset, 0.0))
        )
        return (values - offset) * (per_unit * feedback)


class Saturation(Rule, frozen=True, kw_only=True):
    """The converter's range: the largest charge that it can show, pC."""

    limit_pC: Setting


class LeakSection(LeakRule, frozen=True, kw_only=True):
    """The amplifiers' decay: their time constant, s, one for all or one for each electrode."""

    tau_s: Positive | dict[str, Positive]


class CommonMode(ThermalRule, frozen=True, kw_only=True):
    """How warming is followed, and its charge on each electrode, pC/K, whose ratios and signs count; None for alike."""

    pC_per_K: dict[str, Finite] | None = None


class DeviceSections(Settings, frozen=True):
    """The content of a device file."""

    name: str = "unnamed board"
    frames: Frames = AutoFrames()
    channels: dict[str, str] = field(default_factory=dict)
    gain: Gain | None = None
    saturation: Saturation | None = None
    hum: HumRule | None = None
    tare: TareRule | None = TareRule()
    leak: LeakSection | None = None
    memory: MemoryRule | None = None
    touch: TouchRule | None = TouchRule()
    common_mode: CommonMode | None = None
    track: TrackRule | None = None
    follow: FollowRule | None = None


class Device(DeviceSections, frozen=True):
    """What is known about a board; the other attributes are the sections of its file, None for what is switched off.

    Attributes:
        table: The content of the device file as it came; recordings keep it.
        where: The file, for messages.
    """

    table: Mapping[str, Any] = field(default_factory=dict)
    where: str = "device"

    @property
    def request(self) -> Request | None:
        """What the board has to be asked; None if it sends unasked."""
        if self.frames.request is None:
            return None
        return Request(bytes.fromhex(self.frames.request), self.frames.request_Hz, self.frames.echo)

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
        gain, leak = self.gain, self.leak
        return Chain(
            gain_pC=None if gain is None else self._gain_pC(gain, electrodes),
            zero=None if gain is None else self._of_each("gain.offset", gain.offset, electrodes),
            limit_pC=None if self.saturation is None else self.saturation.limit_pC,
            hum=self.hum,
            tare=self.tare,
            tau_s=None if leak is None else self._of_each("leak.tau_s", leak.tau_s, electrodes),
            leak=leak or LeakRule(),
            memory=self.memory,
            touch=self.touch,
            thermal=self.common_mode,
            pyro=self._pyro(electrodes),
        )

    def _pyro(self, electrodes: tuple[str, ...]) -> Array | float:
        """Charges of warming over their mean magnitude, shape (electrodes,), dimensionless."""
        per_K = None if self.common_mode is None else self.common_mode.pC_per_K
        charges = self._of_each("common_mode.pC_per_K", per_K, electrodes)
        if charges is None:
            return 1.0
        size = float(np.abs(charges).mean())
        if not size > 0.0:
            raise DeviceError(f"{self.where}: common_mode.pC_per_K: expected a number other than 0, got {per_K}")
        return charges / size

    def check_gain(self, electrodes: tuple[str, ...]) -> None:
        """Raise DeviceError if the gain is for other electrodes than these."""
        if self.gain is not None:
            self._gain_pC(self.gain, electrodes)

    def _gain_pC(self, gain: Gain, electrodes: tuple[str, ...]) -> Array | None:
        """Charge of one unit with its sign, shape (electrodes,), pC."""
        if gain.V_per_unit is None:
            return self._of_each("gain.pC_per_unit", gain.pC_per_unit, electrodes)
        volts = self._of_each("gain.V_per_unit", gain.V_per_unit, electrodes)
        feedback_pF = self._of_each("gain.feedback_pF", gain.feedback_pF, electrodes)
        return None if volts is None or feedback_pF is None else volts * feedback_pF

    def _of_each(
        self, key: str, setting: float | Mapping[str, float] | None, electrodes: tuple[str, ...]
    ) -> Array | None:
        """A setting for each electrode, shape (electrodes,)."""
        if setting is None:
            return None
        numbers = setting if isinstance(setting, Mapping) else dict.fromkeys(electrodes, setting)
        if set(numbers) != set(electrodes):
            raise DeviceError(
                f"{self.where}: {key}: expected a number, or one for each of the electrodes {electrodes}, got {setting}"
            )
        return np.array([numbers[name] for name in electrodes], dtype=float)


ANY_BOARD = Device(name="any board")
"""The board of which nothing is known."""


def load_device(path: str | Path | None) -> Device:
    """Read a device file; without one, it is any board.

    Raises:
        DeviceError: If it cannot be read, or a key is unknown, missing or wrong.
    """
    if path is None:
        return ANY_BOARD
    return device_from_table(read_toml(Path(path), "a device file", DeviceError, dict[str, Any]), str(path))


def device_from_table(table: Mapping[str, Any], where: str) -> Device:
    """Read the content of a device file.

    Args:
        table: Sections and keys as above.
        where: The file, for messages.

    Raises:
        DeviceError: If a key is unknown, missing or wrong.
    """
    frames = table.get("frames")
    tagged = {**table, "frames": {"format": "auto", **frames}} if isinstance(frames, Mapping) else table
    sections = structs.asdict(convert(tagged, DeviceSections, where, DeviceError))
    on: dict[str, Any] = {name: None if isinstance(one, Rule) and not one.on else one for name, one in sections.items()}
    return Device(**on, table=table, where=where)


def with_settings(device: Device, section: str, **settings: Any) -> Device:
    """A board with other settings in a section; in its table too, so that a recording keeps them.

    Raises:
        DeviceError: If a setting is out of its range.
    """
    changed = {**device.table.get(section, {}), **settings}
    return device_from_table({**device.table, section: changed}, device.where)
