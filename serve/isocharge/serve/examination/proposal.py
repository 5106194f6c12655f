"""The device file that fits what was heard: its frames, which channels are electrodes, and their rest.

What cannot be seen from outside, the charge of one count, is asked for and never made up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.examination.capture import Capture, read_frames
from isocharge.serve.examination.listening import Heard
from isocharge.serve.frames.binary import FORMAT as BINARY
from isocharge.serve.live.channels import electrode_of
from isocharge.serve.live.device import device_from_table
from isocharge.serve.recognition.recognise import recognise
from isocharge.serve.recognition.series import noise_of, rest_of
from isocharge.serve.signal_chain.tare import TareRule

QUIET_SHARE = 0.1
"""A channel with less noise than this share of the others' is not connected, dimensionless."""

HALF_SCALE_SHARE = 0.05
"""Largest distance of a rest from half of a converter's range, in that half, that is taken for it, dimensionless."""

BITS = range(8, 32)
"""Bits of converters."""

REST_SIGMAS = 20.0
"""A rest that is farther from zero than this is an offset, in standard deviations of the noise."""

LARGEST_STILL_PC = 20.0
"""Largest whole number that never changes and is taken for a charge, pC."""

LARGEST_V, LARGEST_NOISE_V = 12.0, 0.02
"""Largest value and noise of a board that sends volts, V: charges of a film have more noise, in pC."""

ELECTRODES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of electrodes where no model says them."""


@dataclass(frozen=True)
class Gain:
    """What the user knows of the amplifier.

    Attributes:
        settings: Keys of the section `[gain]`: pC_per_unit, or V_per_unit and feedback_pF; empty for nothing.
    """

    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def largest_pC(self) -> float | None:
        """Largest magnitude of the charge of one unit, pC; None where it is not known."""
        factors = [_largest(self.settings[key]) for key in self.settings]
        return float(np.prod(factors)) if factors else None


def _largest(setting: Any) -> float:
    return max(abs(float(value)) for value in (setting.values() if isinstance(setting, Mapping) else [setting]))


@dataclass(frozen=True)
class Proposal:
    """A device file.

    Attributes:
        table: Its content.
        unit: Of the board's values: "pC", "counts" or "V".
        electrodes: Those of the model, or as many names as channels are alive.
        unused: Channels that are no electrodes.
        is_complete: Whether every electrode has a channel.
    """

    table: dict[str, Any]
    unit: str
    electrodes: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    is_complete: bool = True

    @property
    def needs_gain(self) -> bool:
        """Whether the charge of one unit has to be filled in."""
        return self.unit != "pC"


def propose(heard: Heard, name: str, electrodes: tuple[str, ...], gain: Gain) -> Proposal | None:
    """The device file for a board; None if its frames are not recognised.

    Args:
        heard: What it sent.
        name: For the file.
        electrodes: Those of the model; empty if any will do.
        gain: What the user knows of the amplifier.
    """
    frames = recognise(heard.data, heard.span_s, are_datagrams=heard.are_datagrams)
    if frames is None:
        return None
    if heard.request is not None:
        frames |= {"request": heard.request.data.hex(" ").upper(), "request_Hz": heard.request.rate_Hz}
        frames |= {"echo": True} if heard.request.echo else {}
    capture = read_frames(heard, device_from_table({"frames": frames}, name))
    if not capture.frames:
        return None
    values, _ = capture.values()
    unit = "pC" if gain.settings else unit_of(capture.parser.format, capture.names, values)
    chosen = _chosen(capture, values, electrodes)
    table: dict[str, Any] = {"name": name, "frames": frames}
    if chosen:
        table["channels"] = {electrode: capture.names[position] for electrode, position in chosen.items()}
    positions = chosen or {channel: position for position, channel in enumerate(capture.names)}
    if section := _gain_section(gain, unit, values, positions if chosen else {}):
        table["gain"] = section
    unused = tuple(channel for position, channel in enumerate(capture.names) if position not in positions.values())
    return Proposal(table, unit, electrodes or tuple(chosen), unused, bool(chosen))


def unit_of(format_name: str, names: Sequence[str], values: Array) -> str:
    """The unit of the values where nothing is known of the gain: numbers with a fraction are taken as pC.

    Args:
        format_name: The format of the frames, for people; our binary frames hold pC.
        names: Of the channels.
        values: Shape (n, channels).

    Returns:
        "pC", "counts" or "V".
    """
    if format_name == BINARY or all(channel.endswith("_pC") for channel in names):
        return "pC"
    finite = values[np.isfinite(values).all(axis=1)]
    varies = bool(len(finite)) and bool(np.ptp(finite, axis=0).any())
    if not varies and not np.abs(finite).max(initial=0.0) > LARGEST_STILL_PC:
        return "pC"
    if bool((finite == np.round(finite)).all()):
        return "counts"
    noise = [noise_of(column) for column in finite.T]
    is_small = float(np.abs(finite).max()) <= LARGEST_V and 0.0 < max(noise) <= LARGEST_NOISE_V
    return "V" if is_small or all(channel.endswith("V") for channel in names) else "pC"


def _chosen(capture: Capture, values: Array, electrodes: tuple[str, ...]) -> dict[str, int]:
    """The position of each electrode's channel; empty if there are too few."""
    names = capture.names
    by_electrode = {electrode_of(channel): position for position, channel in enumerate(names)}
    if electrodes and set(electrodes) <= set(by_electrode):
        return {electrode: by_electrode[electrode] for electrode in electrodes}
    alive = _alive(values)
    if not electrodes:
        named = [electrode_of(names[position]) for position in alive]
        electrodes = tuple(named if set(named) <= set(ELECTRODES) else ELECTRODES[: len(alive)])
    if len(alive) < len(electrodes) == len(names):
        alive = list(range(len(names)))  # a channel without life stays what it is, and is complained of
    if len(alive) < len(electrodes):
        return {}
    return dict(zip(electrodes, _most_alike(values, alive, len(electrodes)), strict=True))


def _alive(values: Array) -> list[int]:
    """Positions of the channels that vary as the others do; all of them where nothing varies."""
    columns = [column if np.isfinite(column).all() else np.zeros(1) for column in values.T]
    varying = [k for k, column in enumerate(columns) if np.ptp(column) > 0.0]
    if not varying:
        return list(range(len(columns)))
    noise = {k: noise_of(columns[k]) for k in varying}
    usual = float(np.median(list(noise.values())))
    return [k for k in varying if noise[k] >= QUIET_SHARE * usual]


def _most_alike(values: Array, alive: list[int], count: int) -> list[int]:
    """As many channels side by side as there are electrodes, whose noise is most alike; of equal ones the first."""
    level = np.log10([max(noise_of(values[:, k]), 1e-12) for k in alive])
    runs = range(len(alive) - count + 1)
    spread = [round(float(np.ptp(level[begin : begin + count])), 0) for begin in runs]
    begin = int(np.argmin(spread))
    return alive[begin : begin + count]


def _gain_section(gain: Gain, unit: str, values: Array, positions: Mapping[str, int]) -> dict[str, Any]:
    """The section `[gain]`: what the user knows, and the rest of each channel where it is an offset."""
    if unit == "pC" and not gain.settings:
        return {}
    offsets = {electrode: _offset(values[:, position]) for electrode, position in positions.items()}
    rests = {electrode: rest_of(values[:, position]) for electrode, position in positions.items()}
    largest_pC = gain.largest_pC
    limit_pC = 0.5 * TareRule().offset_limit_pC
    if largest_pC is not None:
        is_offset = any(abs(rest) * largest_pC > limit_pC for rest in rests.values())
        close = all(abs(rests[electrode] - offsets[electrode]) * largest_pC <= limit_pC for electrode in rests)
        offsets = offsets if close else {electrode: _rounded(rest) for electrode, rest in rests.items()}
    else:
        noise = {electrode: noise_of(values[:, position]) for electrode, position in positions.items()}
        is_offset = any(abs(rests[electrode]) > max(REST_SIGMAS * noise[electrode], 1e-9) for electrode in rests)
    section: dict[str, Any] = {}
    if is_offset and offsets:
        alike = len(set(offsets.values())) == 1
        section["offset"] = next(iter(offsets.values())) if alike else offsets
    return section | dict(gain.settings)


def _offset(column: Array) -> float | int:
    """What a channel shows without charge: half of a converter's range if it is near it, else its rest."""
    rest = rest_of(column)
    for bits in BITS:
        half = 1 << (bits - 1)
        if abs(rest - half) <= HALF_SCALE_SHARE * half and bool((column == np.round(column)).all()):
            return half
    return _rounded(rest)


def _rounded(rest: float) -> float | int:
    """A rest to six digits; whole if it is large."""
    value = float(f"{rest:.6g}")
    return round(rest) if abs(rest) >= 1000.0 or value.is_integer() else value
