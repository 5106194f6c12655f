"""Proposal of a device file for a board: the frames, the channel of each electrode, and the offsets of the channels.

The charge of one count cannot be derived from the bytes. The user has to state this charge.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError
from isocharge.serve.examination.held_press import find_held_press
from isocharge.serve.examination.listening import Capture, ReceivedData, read_frames
from isocharge.serve.examination.press_detector import estimate_noise
from isocharge.serve.frames.binary import FORMAT as BINARY
from isocharge.serve.live.device import device_from_table
from isocharge.serve.recognition.recognise import recognise
from isocharge.serve.signal_chain.channels import Channels, electrode_of, stated_unit
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.signal_chain.tare import TareRule

QUIET_SHARE = 0.1
"""Smallest noise of a channel that is connected to an electrode, relative to the median noise of the channels."""

REST_SIGMAS = 20.0
"""Largest rest level of a channel without an offset, in standard deviations of the noise."""

LARGEST_STILL_PC = 20.0
"""Largest value that is assumed to be a charge in pC if no channel ever changes."""

LARGEST_V = 12.0
"""Largest value of a board that sends volts, V."""

LARGEST_NOISE_V = 0.02
"""Largest noise of a board that sends volts, V. Charges of a film in pC have more noise."""

SMALLEST_LIMIT = 1e-9
"""Rest level that counts as 0 even if a channel has no noise, in any unit."""

SMALLEST_NOISE = 1e-12
"""Lower limit for the noise of a channel, in any unit, whose logarithm is computed."""

ELECTRODES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of the electrodes if there is no model."""


def measure_rest_level(values: Array) -> float:
    """Compute the rest level of a channel, which is the median of its finite values. It is 0 without finite values."""
    finite_values = values[np.isfinite(values)]
    return float(np.median(finite_values)) if len(finite_values) else 0.0


class Proposal(NamedTuple):
    """A proposed device file.

    Attributes:
        table: Content of the file; empty if the frames are not recognised.
        electrodes: Electrodes of the model. Without a model, one name for each channel whose values vary.
    """

    table: dict[str, Any]
    electrodes: tuple[str, ...]


def propose(received: ReceivedData, electrodes: tuple[str, ...], gain: Mapping[str, Any]) -> Proposal:
    """Propose the device file for a board.

    The bytes determine the format of the frames, the channels of the electrodes, and the offsets of the channels. An
    offset is the value of a channel without charge. The section `[gain]` is proposed if the user states the gain, if
    the channels have large offsets, or if their unit is not pC.

    Args:
        received: Bytes that the board sent.
        electrodes: Electrodes of the model; empty for any model.
        gain: Gain as the user states it: pC_per_unit, or V_per_unit and feedback_pF; empty if it is unknown.

    Returns:
        The sections of the device file, which are empty if no frames are recognised, and the names of the electrodes.
    """
    frames = _recognise_frames(received)
    if frames is None:
        return Proposal({}, electrodes)
    table: dict[str, Any] = {"name": "board", "frames": frames}
    capture = read_frames(received, device_from_table(table, "board"))
    if not capture.frames:
        return Proposal({}, electrodes)

    values, times_s = capture.values()
    positions = _choose_channels(capture, values, electrodes)
    if positions:  # otherwise there are fewer suitable channels than electrodes
        table["channels"] = {electrode: capture.names[position] for electrode, position in positions.items()}

    # Measure the offsets in the frames in which the film is at rest, which end before a held press.
    held_press = find_held_press(values, times_s)
    rest_values = values if held_press is None else values[times_s < held_press.begin_s]
    rest_columns = {electrode: rest_values[:, position] for electrode, position in positions.items()}
    rest_levels = [measure_rest_level(column) for column in rest_columns.values()]
    largest_tared_offset_pC = TareRule().offset_limit_pC  # a tare fails if a channel rests at a larger value
    has_large_offset = any(abs(rest_level) > largest_tared_offset_pC for rest_level in rest_levels)
    is_in_pC = unit_of(capture) == "pC"
    if gain or has_large_offset or not is_in_pC:
        known_gain = dict(gain)
        if not known_gain and is_in_pC:
            known_gain = {"pC_per_unit": 1.0}  # only the offsets are needed
        table["gain"] = _offset_setting(rest_columns, known_gain) | known_gain
    return Proposal(table, electrodes or tuple(positions))


def _recognise_frames(received: ReceivedData) -> dict[str, Any] | None:
    """Recognise the format of the frames, and return it as the section `[frames]` of a device file.

    If the board needs a request for each frame, the section contains the request.

    Args:
        received: Bytes that the board sent, and the request that was sent to the board.

    Returns:
        The settings of the section by name; None if no format is recognised.
    """
    frames = recognise(received.data, received.span_s, are_datagrams=received.are_datagrams)
    request = received.request
    if frames is None or request is None:
        return frames  # no format is recognised, or the board sends frames without a request
    frames["request"] = request.data.hex(" ").upper()  # bytes as hexadecimal numbers, such as "3F 0A"
    frames["request_Hz"] = request.rate_Hz
    return frames


def unit_of(capture: Capture) -> str:
    """Return the unit of the values of a board whose gain is unknown: "pC", "counts", "V", or a unit in the names.

    The unit is guessed from the names and the values of the channels. The first rule that applies determines the unit.

    - The unit is the unit that all names of channels state, such as nC for `A_nC`.
    - The unit is pC for binary frames of isocharge, or if all values are small and never change.
    - The unit is counts if all values are whole numbers.
    - The unit is volts if all names end in `V`, or if all values are small and have little noise.
    - The unit of all other values is assumed to be pC.

    Args:
        capture: The frames that were received. Without frames, the result is "pC".
    """
    units = {stated_unit(name) for name in capture.names}
    if len(units) == 1 and units != {""}:
        return units.pop()
    if not capture.frames or capture.parser.format == BINARY:
        return "pC"
    values, _times_s = capture.values()  # shape (frames, channels)
    finite_rows = values[np.isfinite(values).all(axis=1)]  # frames in which all values are finite
    largest_magnitude = float(np.abs(finite_rows).max(initial=0.0))
    is_constant = len(finite_rows) == 0 or bool((finite_rows == finite_rows[0]).all())
    if is_constant and largest_magnitude <= LARGEST_STILL_PC:
        return "pC"
    has_whole_numbers = bool((finite_rows == np.round(finite_rows)).all())
    if has_whole_numbers:
        return "counts"

    largest_noise = max(estimate_noise(column) for column in finite_rows.T)
    names_state_volts = all(name.endswith("V") for name in capture.names)
    has_values_of_volts = largest_magnitude <= LARGEST_V and 0.0 < largest_noise <= LARGEST_NOISE_V
    if names_state_volts or has_values_of_volts:
        return "V"
    return "pC"


def _choose_channels(capture: Capture, values: Array, electrodes: tuple[str, ...]) -> dict[str, int]:
    """Choose the channel of each electrode.

    If there are channels with the names of the electrodes, these channels are chosen. If the channels have other names,
    the electrodes are assigned, in their order, to channels whose values vary. Without a model, each varying channel is
    an electrode.

    Args:
        capture: The frames.
        values: Values of all channels, shape (n, channels).
        electrodes: Electrodes of the model; empty for any model.

    Returns:
        Position of the channel in the frame by the name of the electrode; empty if there are too few channels.
    """
    names = capture.names
    candidates = _varying_channels(values)
    if not electrodes:
        # Without a model, use the names in the channels if they are single letters. Otherwise use A, B, C, ...
        letters = tuple(electrode_of(names[position]).upper() for position in candidates)
        electrodes = letters if set(letters) <= set(ELECTRODES) else tuple(ELECTRODES[: len(letters)])
    try:
        # A unit in the names does not matter, because the gain is requested if it is missing.
        named_positions = Channels(Setup(electrodes), any_unit=True).named_indices(capture.frames[-1])
    except ChargeError:  # the names are nearly those of electrodes, which is reported later
        return {}
    if named_positions is not None:
        return dict(zip(electrodes, named_positions, strict=True))

    has_channel_for_each = len(names) == len(electrodes)
    if len(candidates) < len(electrodes) and has_channel_for_each:
        candidates = list(range(len(names)))  # keeps a channel that never changes, which is reported later
    if len(candidates) < len(electrodes):
        return {}
    positions = _channels_of_similar_noise(values, candidates, len(electrodes))
    return dict(zip(electrodes, positions, strict=True))


def _varying_channels(values: Array) -> list[int]:
    """Return the positions of the channels whose values vary, except channels with much less noise than the others.

    A channel of which most values are not finite is left out, too. If no channel remains, all positions are returned.

    Args:
        values: Values of all channels, shape (n, channels).
    """
    noise_at_position = {}  # noise of each channel that varies
    for position, column in enumerate(values.T):
        finite_values = column[np.isfinite(column)]
        if 2 * len(finite_values) > len(column) and np.ptp(finite_values) > 0.0:
            noise_at_position[position] = estimate_noise(column)
    if not noise_at_position:
        channel_count = values.shape[1]
        return list(range(channel_count))
    usual_noise = float(np.median(list(noise_at_position.values())))
    return [position for position, noise in noise_at_position.items() if noise >= QUIET_SHARE * usual_noise]


def _channels_of_similar_noise(values: Array, candidates: list[int], count: int) -> list[int]:
    """Choose the group of adjacent candidates whose noise is most similar, and return their positions.

    A group consists of `count` candidates that follow each other. For each group, the ratio of the largest to the
    smallest noise is rounded to a power of ten, so that small differences do not matter. The first group with the
    smallest rounded ratio is chosen.

    Args:
        values: Values of all channels, shape (n, channels).
        candidates: Positions of the channels to choose from.
        count: Number of channels to choose, at most the number of candidates.
    """
    noise = [estimate_noise(values[:, position]) for position in candidates]
    log_noise = np.log10(np.maximum(noise, SMALLEST_NOISE))  # the lower limit avoids the logarithm of 0
    rounded_log_ratios = []  # logarithm of the rounded ratio of each group
    group_count = len(candidates) - count + 1
    for first in range(group_count):
        log_noise_of_group = log_noise[first : first + count]
        log_ratio = float(np.ptp(log_noise_of_group))  # largest minus smallest logarithm
        rounded_log_ratios.append(round(log_ratio))
    best_first = int(np.argmin(rounded_log_ratios))
    return candidates[best_first : best_first + count]


def _offset_setting(columns: Mapping[str, Array], gain: Mapping[str, Any]) -> dict[str, Any]:
    """Return the setting `offset` of the section `[gain]`, which contains the values of the channels without charge.

    The offset of a channel is its measured value at rest.

    Args:
        columns: Values of the channel of each electrode at rest, each of shape (n,), in the unit of the board.
        gain: The other keys of the section; empty if they are not known.

    Returns:
        The key with a table of numbers by electrode; empty if all electrodes rest at 0.
    """
    limits = _zero_limits(columns, gain)
    rest_levels = {electrode: measure_rest_level(column) for electrode, column in columns.items()}
    if all(abs(rest_level) <= limits[electrode] for electrode, rest_level in rest_levels.items()):
        return {}
    return {"offset": {electrode: _round_rest_level(rest_level) for electrode, rest_level in rest_levels.items()}}


def _zero_limits(columns: Mapping[str, Array], gain: Mapping[str, Any]) -> dict[str, float]:
    """For each electrode, return the largest rest level (magnitude) that counts as 0, in the unit of the board.

    If the gain is known, the limit is half of the largest offset that a tare accepts. If the gain is not known, the
    limit is derived from the noise.

    Args:
        columns: Values of the channel of each electrode at rest, each of shape (n,), in the unit of the board.
        gain: The other keys of the section `[gain]`; empty if they are not known.
    """
    if gain:
        limit = 0.5 * TareRule().offset_limit_pC / _largest_charge_of_unit(gain)
        return dict.fromkeys(columns, limit)
    limits = {}
    for electrode, column in columns.items():
        limits[electrode] = max(REST_SIGMAS * estimate_noise(column), SMALLEST_LIMIT)
    return limits


def _largest_charge_of_unit(gain: Mapping[str, Any]) -> float:
    """Compute an upper limit for the magnitude of the charge that corresponds to one unit of the board, pC.

    The charge of one unit is `pC_per_unit`, or the product of `V_per_unit` and `feedback_pF`. The limit is valid for
    all electrodes. The limit can be larger than the charge of any electrode, because the largest values of the two
    settings may belong to different electrodes.

    Args:
        gain: The settings that state the charge. Each setting is a number, or a table of numbers by electrode.
    """
    product_pC = 1.0
    for setting in gain.values():
        numbers = setting.values() if isinstance(setting, Mapping) else [setting]
        product_pC *= max(abs(float(number)) for number in numbers)
    return product_pC


def _round_rest_level(rest: float) -> float | int:
    """Round a rest level to six digits, or to a whole number if its magnitude is 1000 or more."""
    rounded_rest = float(f"{rest:.6g}")
    if abs(rest) >= 1000.0 or rounded_rest.is_integer():
        return round(rest)
    return rounded_rest
