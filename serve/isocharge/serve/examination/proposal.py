"""The device file that fits what was heard: its frames, which channels are electrodes, and their rest.

What cannot be seen from outside, the charge of one count, is asked for and never made up.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.examination.held_press import held_press
from isocharge.serve.examination.listening import Capture, Heard, read_frames
from isocharge.serve.frames.binary import FORMAT as BINARY
from isocharge.serve.live.device import device_from_table
from isocharge.serve.live.reading_stream import electrode_of
from isocharge.serve.recognition.recognise import recognise
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


def rest_of(values: Array) -> float:
    """The level at which a channel rests: the median of its values; 0 without a finite one."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def noise_of(values: Array) -> float:
    """Standard deviation of a channel, from the median size of its steps, which presses hardly change.

    Coarse counts that stand still most of the time have a median step of 0; their mean step decides.
    """
    step = np.abs(np.diff(values[np.isfinite(values)].astype(float)))
    if not len(step):
        return 0.0
    return float(np.median(step) / (0.6745 * np.sqrt(2.0)) or step.mean() * np.sqrt(np.pi) / 2.0)


class Proposal(NamedTuple):
    """A device file.

    Attributes:
        table: Its content; empty if the frames are not recognised.
        electrodes: Those of the model, or as many names as channels are alive.
    """

    table: dict[str, Any]
    electrodes: tuple[str, ...]


def propose(heard: Heard, electrodes: tuple[str, ...], gain: Mapping[str, Any]) -> Proposal:
    """The device file for a board.

    Args:
        heard: What it sent.
        electrodes: Those of the model; empty if any will do.
        gain: What the user knows of the amplifier: pC_per_unit, or V_per_unit and feedback_pF; empty for nothing.
    """
    frames = recognise(heard.data, heard.span_s, are_datagrams=heard.are_datagrams)
    if frames is None:
        return Proposal({}, electrodes)
    if heard.request is not None:
        frames |= {"request": heard.request.data.hex(" ").upper(), "request_Hz": heard.request.rate_Hz}
        frames |= {"echo": True} if heard.request.echo else {}
    table: dict[str, Any] = {"name": "board", "frames": frames}
    capture = read_frames(heard, device_from_table(table, "board"))
    if not capture.frames:
        return Proposal({}, electrodes)
    values, times_s = capture.values()
    chosen = _chosen(capture, values, electrodes)
    if chosen:
        table["channels"] = {electrode: capture.names[position] for electrode, position in chosen.items()}
    held = held_press(values, times_s)
    at_rest = values if held is None else values[times_s < held.begin_s]
    columns = {electrode: at_rest[:, position] for electrode, position in chosen.items()}
    is_far = any(abs(rest_of(column)) > TareRule().offset_limit_pC for column in columns.values())
    if gain or is_far or unit_of(capture) != "pC":
        known = gain or ({"pC_per_unit": 1.0} if unit_of(capture) == "pC" else {})
        table["gain"] = _offsets(columns, known) | dict(known)
    return Proposal(table, electrodes or tuple(chosen))


def unit_of(capture: Capture) -> str:
    """The unit of the values where nothing is known of the gain: "pC", "counts" or "V".

    Our binary frames hold pC, and numbers with a fraction are taken for it.
    """
    if not capture.frames or capture.parser.format == BINARY or all(name.endswith("_pC") for name in capture.names):
        return "pC"
    values, _ = capture.values()
    finite = values[np.isfinite(values).all(axis=1)]
    varies = bool(len(finite)) and bool(np.ptp(finite, axis=0).any())
    if not varies and not np.abs(finite).max(initial=0.0) > LARGEST_STILL_PC:
        return "pC"
    if bool((finite == np.round(finite)).all()):
        return "counts"
    noise = [noise_of(column) for column in finite.T]
    is_small = float(np.abs(finite).max()) <= LARGEST_V and 0.0 < max(noise) <= LARGEST_NOISE_V
    return "V" if is_small or all(name.endswith("V") for name in capture.names) else "pC"


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


def _offsets(columns: Mapping[str, Array], gain: Mapping[str, Any]) -> dict[str, Any]:
    """The key `offset` of the section `[gain]`, one for all electrodes if they are alike; nothing if they rest at 0."""
    rests = {electrode: rest_of(column) for electrode, column in columns.items()}
    offsets = {electrode: _offset(column) for electrode, column in columns.items()}
    if gain:
        limit = 0.5 * TareRule().offset_limit_pC / _largest_pC(gain)
        is_offset = any(abs(rest) > limit for rest in rests.values())
        if any(abs(rest - offsets[electrode]) > limit for electrode, rest in rests.items()):
            offsets = {electrode: _rounded(rest) for electrode, rest in rests.items()}
    else:
        noise = {electrode: noise_of(column) for electrode, column in columns.items()}
        is_offset = any(abs(rest) > max(REST_SIGMAS * noise[electrode], 1e-9) for electrode, rest in rests.items())
    if not is_offset:
        return {}
    alike = set(offsets.values())
    return {"offset": alike.pop() if len(alike) == 1 else offsets}


def _largest_pC(gain: Mapping[str, Any]) -> float:
    """Largest magnitude of the charge of one unit, pC."""
    each = (setting.values() if isinstance(setting, Mapping) else [setting] for setting in gain.values())
    return math.prod(max(abs(float(number)) for number in numbers) for numbers in each)


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
