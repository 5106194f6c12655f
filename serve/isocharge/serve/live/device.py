"""Device file, which contains the settings of a board and its amplifiers in TOML.

    name = "bench board 3"         # optional

    [frames]                       # optional; without this section the format is recognised
    format = "described"           # or "auto", "binary", "text"; the keys of "described" are those of
                                   # isocharge.serve.frames.frame_layout, the keys of the others those of .formats
    request = "3F 0A"              # bytes that request a frame from the board, hexadecimal; optional

    [channels]                     # name or number of each electrode's channel; without this section, channels are
    A = "adc0"                     # assigned by the names of the electrodes, or by their order

    [gain]                         # optional; each setting is a number, or a number for each electrode
    offset = 8388608               # value of the board without charge, in its unit; optional
    pC_per_unit = {A = 0.0457, B = -0.0459, C = 0.0457}     # negative where the amplifier inverts; or
    # V_per_unit = 0.000045        # with the amplifier's feedback capacitance:
    # feedback_pF = 1000.0

    [saturation]
    limit_pC = 1500.0

    [leak]
    tau_s = {A = 10.0, B = 10.2, C = 9.9}

The sections `[hum]`, `[tare]`, `[leak]`, `[memory]`, `[touch]` and `[common_mode]` contain the settings of the signal
chain. The classes of these settings are in `isocharge.serve.signal_chain`. The sections `[track]` and `[follow]`
contain the settings of the tracking. The classes of these settings are in `isocharge.serve.tracking`. The section
`[touch_offset]` contains the settings of `TouchOffsetRule`. The key `on = false` switches off the stage to which the
section belongs. The stages of the sections `[tare]` and `[touch]` are switched on, with their default settings, even if
the file has no such section. An unknown key causes an error.
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
from isocharge.serve.live.contact_stages import TouchOffsetRule
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

MIN_ELECTRODES_FOR_WARMING = 4
"""Smallest number of electrodes with which warming can be distinguished from force.

A contact has three unknowns, and warming is a fourth unknown.
"""


class Gain(Rule, frozen=True, kw_only=True):
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


class Saturation(Rule, frozen=True, kw_only=True):
    """Section `[saturation]` of a device file.

    Attributes:
        limit_pC: Largest charge that the converter can represent, pC.
    """

    limit_pC: Setting


class LeakSection(LeakRule, frozen=True, kw_only=True):
    """Section `[leak]` of a device file, which describes the leak of the charge amplifiers.

    Attributes:
        tau_s: Time constant of the amplifiers, s, as one number for all electrodes or one number for each electrode.
    """

    tau_s: Positive | dict[str, Positive]


class CommonMode(ThermalRule, frozen=True, kw_only=True):
    """Section `[common_mode]` of a device file, with the settings for estimating the warming of the film.

    Attributes:
        pC_per_K: Charge of each electrode if the film warms by 1 K, pC/K. Only the ratios and the signs are used. None
            if all electrodes collect the same charge.
    """

    pC_per_K: dict[str, Finite] | None = None


class DeviceSections(Settings, frozen=True):
    """Content of a device file. Each attribute except `name` is a section or a table of the file."""

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
    touch_offset: TouchOffsetRule | None = None


class Device(DeviceSections, frozen=True):
    """Settings of a board, as its device file states them.

    The inherited attributes are the name of the board and the sections of the device file. The section of a stage is
    None if the stage is switched off.

    Attributes:
        table: Content of the device file without any conversion, which is stored in recordings.
        where: Name of the file, for messages.
    """

    table: Mapping[str, Any] = field(default_factory=dict)
    where: str = "device"

    @property
    def request(self) -> Request | None:
        """Request that the board answers with a frame, or None if the board sends frames without requests."""
        if self.frames.request is None:
            return None
        return Request(bytes.fromhex(self.frames.request), self.frames.request_Hz, self.frames.echo)

    def parser(self) -> Parser:
        """Return a new parser that reads the frames of the board."""
        return self.frames.parser()

    def chain(self, electrodes: tuple[str, ...]) -> Chain:
        """Return the settings of the signal chain for a sensor with the given electrodes.

        If the section of a stage is None, the settings of the stage are None. The attribute `leak` of the result is an
        exception: without a section `[leak]`, it contains the default settings.

        Args:
            electrodes: Names of the electrodes of the model, in the order of the charges.

        Raises:
            DeviceError: If a setting states numbers for other electrodes than the given ones, if the numbers of
                `pC_per_K` are all 0, or if warming must be estimated with too few electrodes.
        """
        if self.common_mode is not None and len(electrodes) < MIN_ELECTRODES_FOR_WARMING:
            raise DeviceError(
                f"{self.where}: common_mode: expected four electrodes or more, the model has {electrodes}; with three "
                "every set of charges fits some contact, and warming cannot be separated from force: remove the section"
            )
        gain_pC = None
        offset = None
        if self.gain is not None:
            gain_pC = self._gain_pC(self.gain, electrodes)
            offset = self._for_each_electrode("gain.offset", self.gain.offset, electrodes)
        limit_pC = None
        if self.saturation is not None:
            limit_pC = self.saturation.limit_pC
        tau_s = None
        if self.leak is not None:
            tau_s = self._for_each_electrode("leak.tau_s", self.leak.tau_s, electrodes)
        return Chain(
            gain_pC=gain_pC,
            zero=offset,
            limit_pC=limit_pC,
            hum=self.hum,
            tare=self.tare,
            tau_s=tau_s,
            leak=self.leak or LeakRule(),
            memory=self.memory,
            touch=self.touch,
            thermal=self.common_mode,
            warming_ratios=self._warming_ratios(electrodes),
        )

    def _warming_ratios(self, electrodes: tuple[str, ...]) -> Array | float:
        """Return the charge that warming adds to each electrode, relative to the mean magnitude over all electrodes.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.

        Returns:
            Ratio of the charge of each electrode to the mean magnitude, shape (n_electrode,), dimensionless. The single
            number 1.0, for equal charges on all electrodes, if the device file does not contain the key `pC_per_K`.

        Raises:
            DeviceError: If the charges of all electrodes are 0, or if the setting states numbers for other electrodes.
        """
        # The section [common_mode] states the charge that each electrode collects if the film warms by 1 K.
        setting = None if self.common_mode is None else self.common_mode.pC_per_K
        charge_pC_per_K = self._for_each_electrode("common_mode.pC_per_K", setting, electrodes)
        if charge_pC_per_K is None:
            return 1.0
        mean_magnitude_pC_per_K = float(np.abs(charge_pC_per_K).mean())
        if mean_magnitude_pC_per_K == 0.0:
            raise DeviceError(f"{self.where}: common_mode.pC_per_K: expected a number other than 0, got {setting}")
        return charge_pC_per_K / mean_magnitude_pC_per_K

    def check_gain(self, electrodes: tuple[str, ...]) -> None:
        """Check that a section `[gain]` contains numbers for exactly the given electrodes.

        Raises:
            DeviceError: If the section contains numbers for other electrodes.
        """
        if self.gain is not None:
            self._gain_pC(self.gain, electrodes)

    def _gain_pC(self, gain: Gain, electrodes: tuple[str, ...]) -> Array | None:
        """Return the charge of one unit of the board for each electrode.

        Args:
            gain: Section `[gain]` of the device file.
            electrodes: Names of the electrodes.

        Returns:
            Charge of one unit with its sign, shape (n_electrode,), pC. None if the section does not state the charge of
            one unit, which `Gain` does not allow.

        Raises:
            DeviceError: If a setting states numbers for other electrodes.
        """
        if gain.V_per_unit is None:
            return self._for_each_electrode("gain.pC_per_unit", gain.pC_per_unit, electrodes)
        V_per_unit = self._for_each_electrode("gain.V_per_unit", gain.V_per_unit, electrodes)
        feedback_pF = self._for_each_electrode("gain.feedback_pF", gain.feedback_pF, electrodes)
        if V_per_unit is None or feedback_pF is None:  # never, because `Gain` checks that both are given
            return None
        return V_per_unit * feedback_pF  # V times pF is pC

    def _for_each_electrode(
        self, key: str, setting: float | Mapping[str, float] | None, electrodes: tuple[str, ...]
    ) -> Array | None:
        """Return the value of a setting for each electrode, shape (n_electrode,), or None if the setting is not given.

        Args:
            key: Section and key of the setting, for messages.
            setting: One number for all electrodes, a dictionary of numbers by electrode name, or None if the setting is
                not given.
            electrodes: Names of the electrodes, in the order of the charges.

        Raises:
            DeviceError: If the keys of the dictionary are not exactly the given electrodes.
        """
        if setting is None:
            return None
        numbers = setting if isinstance(setting, Mapping) else dict.fromkeys(electrodes, setting)
        if set(numbers) != set(electrodes):
            raise DeviceError(
                f"{self.where}: {key}: expected a number, or one for each of the electrodes {electrodes}, got {setting}"
            )
        return np.array([numbers[name] for name in electrodes], dtype=float)


ANY_BOARD = Device(name="any board")
"""Settings of a board that has no device file."""


def load_device(path: str | Path | None) -> Device:
    """Read a device file and return its settings, or return `ANY_BOARD` if the path is None.

    Raises:
        DeviceError: If the file cannot be read, or a key is unknown, missing or wrong.
    """
    if path is None:
        return ANY_BOARD
    return device_from_table(read_toml(Path(path), "a device file", DeviceError, dict[str, Any]), str(path))


def device_from_table(table: Mapping[str, Any], where: str) -> Device:
    """Convert the content of a device file to the settings of a board.

    If the section `[frames]` has no key `format`, the format of the frames is `auto`. If a section contains the key
    `on = false`, the stage of the section is switched off, and the section is None in the result.

    Args:
        table: Sections and keys of the file, as the docstring of this module describes them.
        where: Name of the file, for messages.

    Raises:
        DeviceError: If a key is unknown, missing or wrong.
    """
    frames = table.get("frames")
    complete_table = dict(table)
    if isinstance(frames, Mapping):  # `convert` adds a missing section, and reports an error if it is not a mapping
        complete_table["frames"] = {"format": "auto", **frames}
    converted_sections = convert(complete_table, DeviceSections, where, DeviceError)
    sections: dict[str, Any] = structs.asdict(converted_sections)
    for name, section in sections.items():
        is_switched_off = isinstance(section, Rule) and not section.on
        if is_switched_off:
            sections[name] = None
    return Device(**sections, table=table, where=where)


def with_settings(device: Device, section: str, **settings: Any) -> Device:
    """Return a copy of the settings of a board in which one section is changed.

    The attribute `table` of the copy contains the same changes, because recordings store this attribute.

    Args:
        device: The settings of the board, which are not changed.
        section: Name of the section that is changed.
        settings: New values by the names of their keys. The other keys of the section keep their values.

    Raises:
        DeviceError: If a key is unknown, or a value is out of its range.
    """
    changed_section = {**device.table.get(section, {}), **settings}
    return device_from_table({**device.table, section: changed_section}, device.where)
