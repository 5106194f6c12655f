"""The device file that fits a board: its frames, the channels of the electrodes, and their rest.

The charge of one count cannot be found from the bytes. The user has to state it, and it is never guessed.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.examination.held_press import held_press
from isocharge.serve.examination.listening import Capture, ReceivedData, read_frames
from isocharge.serve.frames.binary import FORMAT as BINARY
from isocharge.serve.live.device import device_from_table
from isocharge.serve.live.reading_stream import electrode_of
from isocharge.serve.recognition.recognise import recognise
from isocharge.serve.signal_chain.tare import TareRule

QUIET_SHARE = 0.1
"""Share of the usual noise below which a channel is not connected to an electrode, dimensionless."""

HALF_SCALE_SHARE = 0.05
"""Largest distance of a rest from half of a converter's range, as a share of that half, dimensionless. A rest within
this distance is replaced by half of the range."""

CONVERTER_BITS = range(8, 32)
"""Possible resolutions of converters, bits."""

REST_SIGMAS = 20.0
"""Distance of a rest from zero above which it is an offset, in standard deviations of the noise."""

LARGEST_STILL_PC = 20.0
"""Largest whole number that is taken for a charge in pC if no channel ever changes."""

LARGEST_V = 12.0
"""Largest value of a board that sends volts, V."""

LARGEST_NOISE_V = 0.02
"""Largest noise of a board that sends volts, V. Charges of a film in pC have more noise."""

ELECTRODES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of the electrodes if there is no model."""


def rest_of(values: Array) -> float:
    """Compute the level at which a channel rests: the median of its finite values, or 0 if there is none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else 0.0


def noise_of(values: Array) -> float:
    """Estimate the standard deviation of a channel from the sizes of its steps, on which presses have little influence.

    The median step of normally distributed noise is 0.6745 * sqrt(2) standard deviations. If the median step of coarse
    counts is 0, the mean step is used, which is 2 / sqrt(pi) standard deviations.
    """
    steps = np.abs(np.diff(values[np.isfinite(values)].astype(float)))
    if not len(steps):
        return 0.0
    median_step = float(np.median(steps))
    if median_step > 0.0:
        return median_step / (0.6745 * math.sqrt(2.0))
    return float(steps.mean()) * math.sqrt(math.pi) / 2.0


class Proposal(NamedTuple):
    """A proposed device file.

    Attributes:
        table: Content of the file; empty if the frames are not recognised.
        electrodes: Electrodes of the model, or as many names as there are live channels.
    """

    table: dict[str, Any]
    electrodes: tuple[str, ...]


def propose(received: ReceivedData, electrodes: tuple[str, ...], gain: Mapping[str, Any]) -> Proposal:
    """Propose the device file for a board.

    Args:
        received: Bytes that the board sent.
        electrodes: Electrodes of the model; empty for any model.
        gain: Gain as the user states it: pC_per_unit, or V_per_unit and feedback_pF; empty if it is unknown.
    """
    frames = recognise(received.data, received.span_s, are_datagrams=received.are_datagrams)
    if frames is None:
        return Proposal({}, electrodes)
    if received.request is not None:
        frames |= {"request": received.request.data.hex(" ").upper(), "request_Hz": received.request.rate_Hz}
        if received.request.echo:
            frames["echo"] = True
    table: dict[str, Any] = {"name": "board", "frames": frames}
    capture = read_frames(received, device_from_table(table, "board"))
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
        known_gain = dict(gain)
        if not known_gain and unit_of(capture) == "pC":
            known_gain = {"pC_per_unit": 1.0}
        table["gain"] = _offsets(columns, known_gain) | known_gain
    return Proposal(table, electrodes or tuple(chosen))


def unit_of(capture: Capture) -> str:
    """Return the unit of the values if nothing is known of the gain: "pC", "counts" or "V".

    The binary frames of isocharge contain pC. Whole numbers are counts, small numbers with little noise are volts, and
    all other numbers are taken for pC.
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
    """Choose the channel of each electrode, and return its position; empty if there are too few channels."""
    names = capture.names
    by_electrode = {electrode_of(channel): position for position, channel in enumerate(names)}
    if electrodes and set(electrodes) <= set(by_electrode):
        return {electrode: by_electrode[electrode] for electrode in electrodes}
    alive = _alive(values)
    if not electrodes:
        named = [electrode_of(names[position]) for position in alive]
        electrodes = tuple(named if set(named) <= set(ELECTRODES) else ELECTRODES[: len(alive)])
    if len(alive) < len(electrodes) == len(names):
        alive = list(range(len(names)))  # A channel that never changes keeps its place and is reported.
    if len(alive) < len(electrodes):
        return {}
    return dict(zip(electrodes, _most_alike(values, alive, len(electrodes)), strict=True))


def _alive(values: Array) -> list[int]:
    """Return the positions of the channels that vary like the others; all positions if no channel varies."""
    columns = [column if np.isfinite(column).all() else np.zeros(1) for column in values.T]
    varying = [k for k, column in enumerate(columns) if np.ptp(column) > 0.0]
    if not varying:
        return list(range(len(columns)))
    noise = {k: noise_of(columns[k]) for k in varying}
    usual = float(np.median(list(noise.values())))
    return [k for k in varying if noise[k] >= QUIET_SHARE * usual]


def _most_alike(values: Array, alive: list[int], count: int) -> list[int]:
    """Choose the adjacent channels whose noise is most similar; of several choices the first.

    Args:
        values: Values of all channels, shape (n, channels).
        alive: Positions of the channels to choose from.
        count: Number of channels to choose.
    """
    noise_decades = np.log10([max(noise_of(values[:, position]), 1e-12) for position in alive])
    begins = range(len(alive) - count + 1)
    spreads = [round(float(np.ptp(noise_decades[begin : begin + count]))) for begin in begins]
    best_begin = int(np.argmin(spreads))
    return alive[best_begin : best_begin + count]


def _offsets(columns: Mapping[str, Array], gain: Mapping[str, Any]) -> dict[str, Any]:
    """Return the key `offset` of the section `[gain]`: one value if all electrodes agree; empty if they rest at 0."""
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
    different_offsets = set(offsets.values())
    if len(different_offsets) == 1:
        return {"offset": different_offsets.pop()}
    return {"offset": offsets}


def _largest_pC(gain: Mapping[str, Any]) -> float:
    """Compute the largest magnitude of the charge of one unit, pC."""
    largest_pC = 1.0
    for setting in gain.values():
        numbers = setting.values() if isinstance(setting, Mapping) else [setting]
        largest_pC *= max(abs(float(number)) for number in numbers)
    return largest_pC


def _offset(column: Array) -> float | int:
    """Return the value of a channel without charge: half of a converter's range if the rest is near, else the rest."""
    rest = rest_of(column)
    is_whole = bool((column == np.round(column)).all())
    for bits in CONVERTER_BITS:
        half_range = 1 << (bits - 1)
        if is_whole and abs(rest - half_range) <= HALF_SCALE_SHARE * half_range:
            return half_range
    return _rounded(rest)


def _rounded(rest: float) -> float | int:
    """Round a rest to six digits, or to a whole number if it is large."""
    value = float(f"{rest:.6g}")
    if abs(rest) >= 1000.0 or value.is_integer():
        return round(rest)
    return value
