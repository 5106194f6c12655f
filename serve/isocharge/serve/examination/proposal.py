"""Proposal of a device file for a board: the frames, the channel of each electrode, and the offsets of the channels.

The charge of one count cannot be derived from the bytes. The user has to state this charge.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError
from isocharge.serve.examination.listening import Capture, ReceivedData
from isocharge.serve.examination.press_detector import estimate_noise
from isocharge.serve.frames.formats import BINARY_FORMAT
from isocharge.serve.recognition.recognise import recognise
from isocharge.serve.signal_chain.channels import Channels, stated_unit
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.signal_chain.tare import TareRule

ELECTRODES = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
"""Names of the electrodes if there is no model."""


def recognised_frames(received: ReceivedData) -> dict[str, Any]:
    """Return the section `[frames]` that describes the received bytes in a device file; empty for an unknown format."""
    frames = recognise(received.data, received.span_s, are_datagrams=received.are_datagrams)
    if frames is None:
        return {}
    if received.request is not None:
        frames["request"] = received.request.data.hex(" ").upper()  # bytes as hexadecimal numbers, such as "3F 0A"
    return frames


def propose(
    capture: Capture,
    rest_values: Array,
    frames: Mapping[str, Any],
    electrodes: tuple[str, ...],
    gain: Mapping[str, Any],
) -> dict[str, Any]:
    """Propose the content of a device file for a board.

    The offset of a channel is its value without charge. The section `[gain]` is proposed if the user states the gain,
    if the channels have large offsets, or if their unit is not pC.

    Args:
        capture: Frames that the board sent, at least one.
        rest_values: Values of all channels while the film is at rest, shape (n, channels).
        frames: Section `[frames]` of the device file, which describes the format of the frames.
        electrodes: Electrodes of the model. Without a model, each channel whose values vary is an electrode.
        gain: Gain as the user states it, such as `pC_per_unit`; empty if it is unknown.
    """
    table: dict[str, Any] = {"name": "board", "frames": frames}
    values, _times_s = capture.values()
    channel_positions = _choose_channels(capture, values, electrodes)  # for each electrode: index of its channel
    if channel_positions:  # otherwise it is not clear which channels belong to the electrodes
        table["channels"] = {electrode: capture.names[position] for electrode, position in channel_positions.items()}
    offset = {electrode: _rest_level(rest_values[:, position]) for electrode, position in channel_positions.items()}
    has_large_offset = any(abs(level) > TareRule().offset_limit_pC for level in offset.values())
    is_in_pC = unit_of(capture, channel_positions.values()) == "pC"
    if gain or has_large_offset or not is_in_pC:
        table["gain"] = {"offset": offset} if any(offset.values()) else {}
        if gain:
            table["gain"] |= gain
        elif is_in_pC:  # in another unit, the user has to state `pC_per_unit`
            table["gain"]["pC_per_unit"] = 1.0
    return table


def unit_of(capture: Capture, positions: Iterable[int], max_noise_V: float = 0.02) -> str:
    """Return the unit of the values of a board whose gain is unknown: "pC", "counts", "V", or a unit in the names.

    The unit is guessed from the names and the values of the electrodes' channels. Other channels, such as a
    temperature, have units of their own. The first rule that applies determines the unit.

    - If the names of the channels state only one unit, the values are in this unit, such as nC for `A_nC` and `B_nC`.
    - If the names state different units, the unit is assumed to be pC. The report requests the gains.
    - The unit is pC for binary frames of isocharge.
    - The unit is counts if all values are whole numbers.
    - The unit is volts if all names end in `V`. The unit is also volts if some channel has noise, but no channel has
      more noise than `max_noise_V`.
    - The unit of all other values is assumed to be pC.

    Args:
        capture: The frames that were received, at least one.
        positions: Positions of the electrodes' channels in the frame; empty for all channels.
        max_noise_V: Largest noise of a board that sends volts, V. Charges of a film in pC have more noise.
    """
    channels = list(positions) or list(range(len(capture.names)))
    names = [capture.names[position] for position in channels]
    units = {stated_unit(name) for name in names} - {""}
    if len(units) == 1:
        return units.pop()
    if units or capture.parser.format == BINARY_FORMAT:
        return "pC"
    values = capture.values()[0][:, channels]  # the values without their times, shape (frames, channels)
    finite_values = values[np.isfinite(values)]
    if finite_values.size and (finite_values == np.round(finite_values)).all():
        return "counts"
    names_state_volts = all(name.endswith("V") for name in names)
    if names_state_volts or 0.0 < estimate_noise(values).max() <= max_noise_V:
        return "V"
    return "pC"


def _choose_channels(
    capture: Capture, values: Array, electrodes: tuple[str, ...], min_noise_share: float = 0.1
) -> dict[str, int]:
    """Choose the channel of each electrode.

    If there are channels with the names of the electrodes, or as many channels as electrodes, the channels are chosen
    as in a stream. Otherwise, the electrodes are assigned, in their order, to the channels whose values vary. If more
    channels vary than there are electrodes, the adjacent channels with the most similar noise are chosen. If no
    electrodes are given, each varying channel is an electrode, with the name A, B, C and so on.

    Args:
        capture: The frames.
        values: Values of all channels, shape (n, channels).
        electrodes: Names of the electrodes of the model; empty without a model.
        min_noise_share: Smallest noise of a channel that is connected to an electrode, relative to the median noise.

    Returns:
        For each electrode, by its name: the position of its channel in the frame. The result is empty if there are too
        few channels.
    """
    # Find the channels that may belong to electrodes, the candidates. A channel is left out if its values vary much
    # less than the others, or are mostly not finite. If no channel varies, all channels are candidates.
    noise = estimate_noise(values)  # standard deviation of each channel
    is_mostly_finite = 2 * np.isfinite(values).sum(axis=0) > len(values)
    noise[~is_mostly_finite] = 0.0
    usual_noise = np.median(noise[noise > 0.0]) if noise.any() else 0.0
    candidates = np.flatnonzero(noise >= min_noise_share * usual_noise).tolist()
    if not electrodes:
        electrodes = tuple(ELECTRODES[: len(candidates)])  # A, B, C, ...

    # Choose the channels as in a stream, if this is possible.
    try:
        # Units in the names are ignored here. If a unit requires a gain that is missing, the gain is requested later.
        positions = Channels(Setup(electrodes), any_unit=True).indices_by_name_or_order(capture.frames[-1])
    except ChargeError:  # the names are nearly those of electrodes, which is reported later
        return {}
    if positions is not None:  # one of these channels may never change, which is reported later
        return dict(zip(electrodes, positions, strict=True))
    if len(candidates) < len(electrodes):
        return {}

    # Choose the group of adjacent candidates in which the ratio of the largest to the smallest noise is smallest. The
    # ratios are rounded to powers of ten, so that small differences do not matter, and the first of the groups with the
    # smallest ratio is chosen.
    log_noise = np.log10(np.maximum(noise[candidates], np.finfo(float).tiny))
    groups = np.lib.stride_tricks.sliding_window_view(log_noise, len(electrodes))  # shape (groups, electrodes)
    log_ratios = np.round(np.ptp(groups, axis=1))
    begin = int(np.argmin(log_ratios))
    end = begin + len(electrodes)
    return dict(zip(electrodes, candidates[begin:end], strict=True))


def _rest_level(values: Array) -> float:
    """Return the median of the finite values of a channel, rounded to six digits, or 0 without finite values."""
    finite_values = values[np.isfinite(values)]
    return float(f"{np.median(finite_values):.6g}") if len(finite_values) else 0.0
