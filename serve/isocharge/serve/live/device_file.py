"""The device file: what is known about a board and its amplifier, in TOML.

    name = "bench board 3"         # optional

    [frames]                       # optional; without it the format is recognised
    format = "described"           # or "auto", "binary", "text"; the keys of "described" are those of
                                   # isocharge.serve.frames.frame_layout
    columns = ["seq", "A", "B"]    # "auto" and "text": names of the columns of a CSV; optional
    seq = "n"                      # and the names that the board has for its number and clock; optional
    t_ms = "millis"                # or t_us, t_s
    request = "3F 0A"              # what the board has to be asked, hexadecimal; optional
    request_Hz = 100.0             # at most that often
    echo = true                    # if the line brings the request back

    [channels]                     # electrode -> name or number in the frame; without it the same names, or the same
    A = "adc0"                     # order

    [gain]                         # optional; a number for all channels, or one for each electrode
    offset = 8388608               # what the board shows without charge, in its unit; optional
    pC_per_unit = {A = 0.0457, B = -0.0459, C = 0.0457}     # negative where the amplifier inverts; or
    # V_per_unit = 0.000045        # with the amplifier's feedback capacitance:
    # feedback_pF = 1000.0

    [saturation]
    limit_pC = 1500.0

    [hum]
    frequency_Hz = 50.0

    [tare]
    frames = 100

    [leak]
    tau_s = {A = 10.0, B = 10.2, C = 9.9}

    [touch]
    floor_pC = 10.0

    [common_mode]                  # warming separated from force by the model; four electrodes or more

Each stage also takes the settings of its rule (see `isocharge.serve.signal_chain`), and `on = false`, which switches it
off. Tare and touch are on without a section. An unknown key is an error.
"""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from isocharge.common.errors import DeviceError
from isocharge.common.tables import Table, read_toml
from isocharge.serve.frames.frame_layout import frame_layout
from isocharge.serve.frames.text_lines import SEQ, TIMES_US
from isocharge.serve.live.device import ByElectrode, Device, FrameSettings, GainSettings, LeakSettings
from isocharge.serve.port.request import Request
from isocharge.serve.signal_chain.contact import TouchRule
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.thermal import ThermalRule

SECTIONS = ("frames", "channels", "gain", "saturation", "hum", "tare", "leak", "touch", "common_mode")

FORMATS = ("auto", "binary", "text", "described")

REQUEST_KEYS = ("request", "request_Hz", "echo")
"""Keys of every format: what a board has to be asked."""

TEXT_KEYS = ("columns", SEQ, *TIMES_US)
"""Keys of the formats that may be text."""

GAIN_KEYS = ("pC_per_unit", "V_per_unit", "feedback_pF", "offset")

FASTEST_HZ = 100_000.0
"""Highest rate of requests, Hz."""

LARGEST = 1_000_000_000
"""Largest setting of a rule, in the setting's unit."""

SMALLEST_TIMES_S = {"settle_s": 1e-3, "relax_s": 1e-3}
"""Smallest value of those settings that the chain divides by, s."""

Rule = TypeVar("Rule", HumRule, TareRule, TouchRule, ThermalRule)


def load_device(path: Path) -> Device:
    """Read a device file.

    Raises:
        DeviceError: If it cannot be read, or a key is unknown, missing or wrong.
    """
    return device_from_table(read_toml(path, "a device file", DeviceError), str(path))


def device_from_table(table: Mapping[str, Any], where: str) -> Device:
    """Read the content of a device file.

    Args:
        table: Sections and keys as above.
        where: The file, for messages.

    Raises:
        DeviceError: If a key is unknown, missing or wrong.
    """
    file = Table(table, where, DeviceError).only("name", *SECTIONS)
    return Device(
        name=str(file.get("name", "unnamed board")),
        frames=_frames(file.table("frames", {})),
        channels=_channels(file.table("channels", {})),
        gain=_gain(file),
        limit_pC=_limit(file),
        hum=_rule(file, "hum", HumRule, None),
        tare=_rule(file, "tare", TareRule, TareRule()),
        leak=_leak(file),
        touch=_rule(file, "touch", TouchRule, TouchRule()),
        common_mode=_rule(file, "common_mode", ThermalRule, None),
        table=table,
        where=where,
    )


def with_offset_limit(device: Device, offset_limit_pC: float) -> Device:
    """A board with another `offset_limit_pC` of its tare, pC; in its table too, so that a recording keeps it.

    Raises:
        DeviceError: If the limit is out of its range.
    """
    tare = {**device.table.get("tare", {}), "offset_limit_pC": offset_limit_pC}
    return device_from_table({**device.table, "tare": tare}, device.where)


def _frames(table: Table) -> FrameSettings:
    kind, request = table.choice("format", FORMATS, "auto"), _request(table)
    if kind == "described":
        others = {key: table.get(key) for key in table if key not in ("format", *REQUEST_KEYS)}
        return FrameSettings(kind, layout=frame_layout(others, table.where), request=request)
    table.only("format", *REQUEST_KEYS, *(() if kind == "binary" else TEXT_KEYS))
    meanings = {table.text(key): key for key in (SEQ, *TIMES_US) if key in table}
    return FrameSettings(kind, table.texts("columns", (), of="names", or_empty=True), meanings, request=request)


def _request(table: Table) -> Request | None:
    if "request" not in table:
        return None
    try:
        data = bytes.fromhex(table.text("request"))
    except ValueError:
        data = b""
    if not data:
        table.refuse("request", "bytes in hexadecimal, as in '3F 0A'")
    return Request(data, table.number("request_Hz", 100.0, above=0.0, most=FASTEST_HZ), table.flag("echo", False))


def _channels(table: Table) -> dict[str, str]:
    return {electrode: table.text(electrode, or_empty=True) for electrode in table}


def _gain(file: Table) -> GainSettings | None:
    if "gain" not in file:
        return None
    table = file.table("gain").only("on", *GAIN_KEYS)
    offset = _by_electrode(table, "offset") if "offset" in table else None
    if "V_per_unit" not in table:
        if "feedback_pF" in table:
            table.refuse("feedback_pF", "no capacitance beside pC_per_unit: it belongs to V_per_unit")
        gain = GainSettings(_by_electrode(table, "pC_per_unit", not_zero=True), None, offset)
    elif "pC_per_unit" in table:
        table.refuse("V_per_unit", "either pC_per_unit, or V_per_unit and feedback_pF")
    else:
        volts = _by_electrode(table, "V_per_unit", not_zero=True)
        gain = GainSettings(volts, _by_electrode(table, "feedback_pF", above=0.0), offset)
    return gain if table.flag("on", True) else None


def _limit(file: Table) -> float | None:
    if "saturation" not in file:
        return None
    table = file.table("saturation").only("on", "limit_pC")
    limit_pC = table.number("limit_pC", least=0, most=LARGEST)
    return limit_pC if table.flag("on", True) else None


def _leak(file: Table) -> LeakSettings | None:
    if "leak" not in file:
        return None
    table = file.table("leak")
    learning = _settings(table, LeakRule, "tau_s")
    leak = LeakSettings(_by_electrode(table, "tau_s", above=0.0), learning)
    return leak if table.flag("on", True) else None


def _by_electrode(table: Table, key: str, **bounds: Any) -> ByElectrode:
    """One number for all electrodes, or one for each."""
    name = f"{table.where}: {table.path}.{key}"
    if not isinstance(table.get(key), Mapping):
        return ByElectrode(table.number(key, **bounds), name)
    numbers = table.table(key)
    return ByElectrode({electrode: numbers.number(electrode, **bounds) for electrode in numbers}, name)


def _rule(file: Table, section: str, rule: type[Rule], default: Rule | None) -> Rule | None:
    """The rule of a stage; the default without a section, None if it is switched off."""
    if section not in file:
        return default
    table = file.table(section)
    settings = _settings(table, rule)
    return rule(**settings) if table.flag("on", True) else None


def _settings(table: Table, rule: type, *others: str) -> dict[str, Any]:
    """The settings of a rule that a section has, checked by the types of their defaults; `others` are known, too."""
    defaults = {item.name: item.default for item in fields(rule) if isinstance(item.default, int | float)}
    table.only("on", *others, *defaults)
    return {key: _setting(table, key, default) for key, default in defaults.items() if key in table}


def _setting(table: Table, key: str, default: float) -> float:
    if isinstance(default, bool):
        return table.flag(key)
    if isinstance(default, int):
        return table.whole(key, least=0, most=LARGEST)
    return table.number(key, least=SMALLEST_TIMES_S.get(key, 0), most=LARGEST)
