"""The device file: what is known about a board and its amplifier, in TOML.

    name = "bench board 3"         # optional

    [frames]                       # optional; without, the format is recognised
    format = "described"           # or "auto", "binary", "text"; with "described" the keys of serve/described.py
    columns = ["seq", "A", "B"]    # "auto" and "text": names of a CSV without header; optional

    [channels]                     # electrode -> name in the frame; without, same names, or the same order
    A = "adc0"

    [gain]                         # optional; a number for all channels, or one for each electrode
    pC_per_unit = {A = 0.0457, B = -0.0459, C = 0.0457}     # negative where the amplifier inverts

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

    [common_mode]                  # warming told from force by the model; four electrodes or more

Each stage also takes the settings of its rule (see the modules), and `on = false`, which switches it off. Tare and
touch are on without a section. An unknown key is an error.
"""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import DeviceError
from isocharge.serve.frames.autodetect import AutoParser
from isocharge.serve.frames.binary import BinaryParser
from isocharge.serve.frames.frame import Parser
from isocharge.serve.frames.frame_layout import FrameLayout, frame_layout
from isocharge.serve.frames.layout_parser import DescribedParser
from isocharge.serve.frames.text import TextParser
from isocharge.serve.signal_chain.chain import Chain
from isocharge.serve.signal_chain.contact import TouchRule
from isocharge.serve.signal_chain.hum import HumRule
from isocharge.serve.signal_chain.leak import LeakRule
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.thermal import ThermalRule

SECTIONS = {"frames", "channels", "gain", "saturation", "hum", "tare", "leak", "touch", "common_mode"}

LARGEST, TIMES_S = 1e9, {"settle_s": 1e-3, "relax_s": 1e-3}
"""Largest setting of a rule, and the smallest of those that are divided by."""

STAGES: dict[str, type] = {"hum": HumRule, "tare": TareRule, "touch": TouchRule}


@dataclass(frozen=True)
class Device:
    """What is known about a board.

    Attributes:
        name: For people.
        table: The whole file; recordings keep it.
        where: The file, for messages.
    """

    name: str = "any board"
    table: Mapping[str, Any] = field(default_factory=dict)
    where: str = "device"

    @property
    def channels(self) -> Mapping[str, str]:
        """Electrode to the name in the frame; empty where nothing is said."""
        return dict(self.table.get("channels", {}))

    @property
    def layout(self) -> FrameLayout | None:
        """Of described frames."""
        table = dict(self.table.get("frames", {}))
        return frame_layout(table, self.where) if table.pop("format", "auto") == "described" else None

    def parser(self) -> Parser:
        """A new parser for its frames."""
        table = self.table.get("frames", {})
        columns, layout = tuple(table.get("columns", ())), self.layout
        if layout is not None:
            return DescribedParser(layout)
        parsers: dict[str, Callable[[], Parser]] = {
            "auto": lambda: AutoParser(columns),
            "binary": BinaryParser,
            "text": lambda: TextParser(columns),
        }
        return parsers[table.get("format", "auto")]()

    def chain(self, electrodes: tuple[str, ...]) -> Chain:
        """The signal chain for these electrodes.

        Raises:
            DeviceError: If a table by electrode has other names.
        """
        rules = {name: self._rule(name) for name in STAGES}
        return Chain(
            gain_pC=self._each("gain", "pC_per_unit", electrodes),
            limit_pC=self.table["saturation"]["limit_pC"] if self._is_on("saturation") else None,
            hum=rules["hum"] if "hum" in self.table else None,
            tare=rules["tare"],
            leak=self._leak(electrodes),
            touch=rules["touch"],
        )

    def common_mode(self, electrodes: tuple[str, ...]) -> ThermalRule | None:
        """How warming is followed; None if it is not.

        Raises:
            DeviceError: If there are too few electrodes.
        """
        if not self._is_on("common_mode"):
            return None
        if len(electrodes) < 4:
            raise DeviceError(
                f"{self.where}: common_mode: expected four electrodes or more, the model has {electrodes}; with three "
                "every charge triple fits some contact, and temperature cannot be told from force"
            )
        return ThermalRule(**{key: value for key, value in self.table["common_mode"].items() if key != "on"})

    def _is_on(self, stage: str) -> bool:
        return stage in self.table and bool(self.table[stage].get("on", True))

    def _rule(self, stage: str) -> Any:
        settings = dict(self.table.get(stage, {}))
        return STAGES[stage](**settings) if settings.pop("on", True) else None

    def _leak(self, electrodes: tuple[str, ...]) -> LeakRule | None:
        tau_s = self._each("leak", "tau_s", electrodes)
        if tau_s is None:
            return None
        settings = {key: value for key, value in self.table["leak"].items() if key not in ("on", "tau_s")}
        return LeakRule(tau_s, **settings)

    def _each(self, stage: str, key: str, electrodes: tuple[str, ...]) -> Array | None:
        """A setting for each electrode, shape (electrodes,); None if the stage is off."""
        if not self._is_on(stage):
            return None
        value = self.table[stage][key]
        by_name = value if isinstance(value, dict) else dict.fromkeys(electrodes, value)
        if set(by_name) != set(electrodes):
            raise DeviceError(
                f"{self.where}: {stage}.{key}: expected a number, or one for each of the electrodes {electrodes}, "
                f"got {value}"
            )
        return np.array([by_name[name] for name in electrodes], dtype=float)


ANY_BOARD = Device()


def load_device(path: Path) -> Device:
    """Read a device file.

    Raises:
        DeviceError: If it cannot be read, or a key is unknown, missing or wrong.
    """
    try:
        table = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise DeviceError(f"{path}: cannot be read ({error.strerror}); expected a device file in TOML") from error
    except ValueError as error:
        raise DeviceError(f"{path}: not TOML in UTF-8: {error}") from error
    return device_from_table(table, str(path))


def device_from_table(table: Mapping[str, Any], where: str) -> Device:
    """Check the content of a device file.

    Raises:
        DeviceError: If a key is unknown, missing or wrong.
    """
    unknown = set(table) - SECTIONS - {"name"}
    _expect(not unknown, where, f"the sections {', '.join(sorted(SECTIONS))}", sorted(unknown))
    for name in SECTIONS & set(table):
        _expect(isinstance(table[name], dict), f"{where}: {name}", "a section", table[name])
        _CHECKS[name](table[name], f"{where}: {name}")
    device = Device(str(table.get("name", "unnamed board")), table, where)
    device.parser()
    return device


def _expect(holds: bool, where: str, expected: str, value: object) -> None:
    if not holds:
        raise DeviceError(f"{where}: expected {expected}, got {value!r}")


def _check_frames(table: Mapping[str, Any], where: str) -> None:
    kind = table.get("format", "auto")
    _expect(kind in ("auto", "binary", "text", "described"), where, "format auto, binary, text or described", kind)
    if kind != "described":  # the others are checked by what reads them
        _check_keys(table, {"format"} | ({"columns"} if kind != "binary" else set()), where)
        columns = table.get("columns", [])
        names = isinstance(columns, list) and all(isinstance(name, str) for name in columns)
        _expect(names, where, "columns as a list of names", columns)


def _check_keys(table: Mapping[str, Any], known: set[str], where: str) -> None:
    _expect(set(table) <= known, where, f"the keys {', '.join(sorted(known))}", sorted(set(table) - known))


def _check_channels(table: Mapping[str, Any], where: str) -> None:
    _expect(all(isinstance(name, str) for name in table.values()), where, "names of channels", dict(table))


def _check_each(key: str, others: Mapping[str, type], positive: bool) -> Callable[[Mapping[str, Any], str], None]:
    def check(table: Mapping[str, Any], where: str) -> None:
        _check_keys(table, {"on", key, *others}, where)
        _expect(key in table, where, f"the key {key}", sorted(table))
        value = table[key]
        for number in value.values() if isinstance(value, dict) else [value]:
            good = _is_number(number) and number != 0 and (number > 0 or not positive)
            _expect(good, f"{where}: {key}", "positive numbers" if positive else "numbers that are not 0", value)
        _check_types({name: item for name, item in table.items() if name != key}, others, where)

    return check


def _check_rule(rule: type) -> Callable[[Mapping[str, Any], str], None]:
    types = _types(rule)

    def check(table: Mapping[str, Any], where: str) -> None:
        _check_keys(table, {"on", *types}, where)
        _check_types(table, types, where)

    return check


def _types(rule: type) -> dict[str, type]:
    return {item.name: type(item.default) for item in fields(rule) if isinstance(item.default, int | float)}


def _check_types(table: Mapping[str, Any], types: Mapping[str, type], where: str) -> None:
    for key, value in table.items():
        kind = bool if key == "on" else types[key]
        least = TIMES_S.get(key, 0)
        good = isinstance(value, bool) if kind is bool else _is_number(value) and least <= value <= LARGEST
        good = good and (kind is not int or isinstance(value, int))
        expected = {bool: "true or false", int: "a whole number"}.get(kind, "a number")
        _expect(good, f"{where}: {key}", expected if kind is bool else f"{expected} from {least} to {LARGEST:g}", value)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _check_saturation(table: Mapping[str, Any], where: str) -> None:
    _expect("limit_pC" in table, where, "the key limit_pC", sorted(table))
    _check_keys(table, {"on", "limit_pC"}, where)
    _check_types(table, {"limit_pC": float}, where)


_CHECKS: dict[str, Callable[[Mapping[str, Any], str], None]] = {
    "frames": _check_frames,
    "channels": _check_channels,
    "gain": _check_each("pC_per_unit", {}, positive=False),
    "saturation": _check_saturation,
    "hum": _check_rule(HumRule),
    "tare": _check_rule(TareRule),
    "leak": _check_each("tau_s", _types(LeakRule), positive=True),
    "touch": _check_rule(TouchRule),
    "common_mode": _check_rule(ThermalRule),
}
