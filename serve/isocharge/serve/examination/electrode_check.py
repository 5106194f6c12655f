"""Check which channel belongs to which electrode. The user presses near each electrode in turn.

The electrode next to a press collects the largest charge. The change of each channel under one press is compared with
the changes of the same channel under the other presses. The gains of the channels therefore need not be known or equal.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressCheckError
from isocharge.common.printable_text import printable
from isocharge.serve.examination.proposal import estimate_noise
from isocharge.serve.examination.touch_search import BLOCK_S, CHANGE_SIGMAS, rounding_error_std
from isocharge.serve.live.device import Device
from isocharge.serve.live.reading_stream import channel_index
from isocharge.serve.port.source import Port

REST_BLOCKS = 5
"""Number of quiet blocks before a press, from which the rest is measured: half a second."""

RELEASED_SHARE = 0.3
"""Share of the largest change below which a press has ended, dimensionless.

The share is not small, because a leaking amplifier returns to rest slowly.
"""

REST_UPDATE = 0.2
"""Weight of a new block in the rest level while nothing presses, dimensionless. The rest level follows a slow drift."""

NORMALISATION_STEPS = 20
"""Number of times that the changes are divided by the means of their rows and columns."""

MIN_ADVANTAGE = 1.1
"""Smallest ratio of the largest normalised change under a press to the change of any other channel, dimensionless."""

PRESS_TIMEOUT_S = 60.0
"""Time to wait for each press, s."""


@dataclass(frozen=True)
class ElectrodeCheck:
    """Result of the electrode check: the channel that changed most under the press near each electrode.

    Attributes:
        expected: Assumed channel of each electrode, by the name of the electrode.
        found: Channel of each electrode that the presses show, by the name of the electrode.
        changes: Change of each channel under each press, shape (electrodes, channels), in the unit of the board.
        inverted: Channels whose charge falls under a press.
    """

    expected: Mapping[str, str]
    found: Mapping[str, str]
    changes: Array
    inverted: tuple[str, ...]

    @property
    def is_as_expected(self) -> bool:
        """Whether the presses have confirmed the assumed channel of every electrode."""
        return dict(self.expected) == dict(self.found)

    @property
    def sentences(self) -> Iterator[str]:
        """Sentences for the user about the channel of each electrode, the order of the channels, and wrong signs."""
        for electrode, channel in self.found.items():
            yield f"press near {electrode}: channel {printable(channel)} answers most strongly"
        yield _order_sentence(self.expected, self.found)
        # If all channels are inverted, only the sign convention of the board differs, which is no mistake.
        is_part_inverted = 0 < len(self.inverted) < len(self.found)
        if is_part_inverted:
            names = printable(", ".join(self.inverted))
            yield f"channel {names} falls under a press and the others rise: check the signs of the gain"


def _order_sentence(expected_channels: Mapping[str, str], found_channels: Mapping[str, str]) -> str:
    """Return a sentence about the order of the channels, which may be swapped, turned or otherwise different.

    Args:
        expected_channels: Assumed channel of each electrode, by the name of the electrode.
        found_channels: Channel of each electrode that the presses show, by the name of the electrode.
    """
    electrodes = list(expected_channels)
    wrong_electrodes = [name for name in electrodes if found_channels[name] != expected_channels[name]]
    if not wrong_electrodes:
        return "every channel belongs to its electrode"

    # For each electrode that was pressed, find the electrode to which the found channel was assumed to belong.
    expected_electrode = {channel: electrode for electrode, channel in expected_channels.items()}
    assumed_electrodes = []
    for electrode in electrodes:
        found_channel = found_channels[electrode]
        assumed_electrodes.append(expected_electrode[found_channel])

    # With two electrodes, turned channels are also swapped. "Swapped" is then the simpler description.
    turned_places = _turned_places(electrodes, assumed_electrodes)
    if turned_places is not None and len(electrodes) > 2:
        return f"the channels are turned by {turned_places} of {len(electrodes)} places"
    if len(wrong_electrodes) == 2:
        return f"the channels of {wrong_electrodes[0]} and {wrong_electrodes[1]} are swapped"
    return f"the channels of {', '.join(wrong_electrodes)} are in another order"


def _turned_places(electrodes: list[str], assumed_electrodes: list[str]) -> int | None:
    """Return the number of electrodes by which all channels are shifted around the film.

    For example, the channels of A, B and C are turned by one place if the presses near A, B and C change the channels
    that were assumed to belong to B, C and A.

    Args:
        electrodes: Names of the electrodes in the order of the presses.
        assumed_electrodes: For each press, the electrode to which the channel that changed was assumed to belong.

    Returns:
        The number of electrodes, at least 1; None if the channels are not shifted by the same number of electrodes.
    """
    for places in range(1, len(electrodes)):
        turned_electrodes = electrodes[places:] + electrodes[:places]
        if assumed_electrodes == turned_electrodes:
            return places
    return None


def check_electrodes(
    port: Port,
    device: Device,
    channels: Mapping[str, str],
    ask: Callable[[str], None],
    timeout_s: float = PRESS_TIMEOUT_S,
) -> ElectrodeCheck:
    """For each electrode, ask the user for a press near it, and find the channel that changes most under this press.

    Args:
        port: The open port.
        device: Format of the frames.
        channels: Assumed channel of each electrode, by the name of the electrode.
        ask: Function that is called with a sentence that asks the user for a press.
        timeout_s: Time to wait for each press, s.

    Returns:
        The assumed and the found channel of each electrode, the changes of the channels, and the inverted channels.

    Raises:
        PressCheckError: If a press does not come in time, or the presses do not distinguish the channels.
        PortLost: If the connection to the board is lost.
    """
    electrodes = list(channels)
    channel_names = list(channels.values())
    blocks = _BlockReader(port, device, channel_names)  # reads the port, and computes medians over short blocks of time
    measured_changes = []
    for electrode in electrodes:
        ask(f"press near electrode {electrode}, as close to it as you can, and let go")
        measured_changes.append(_wait_for_press(blocks, electrode, timeout_s))
    changes = np.array(measured_changes)  # shape (electrodes, channels)

    # A channel is inverted if its value falls under the press near its own electrode.
    found_channels = {}
    inverted_channels = []
    columns = assign_channels(changes, electrodes)  # column of the channel that belongs to each electrode
    for press, column in enumerate(columns):
        channel = channel_names[column]
        found_channels[electrodes[press]] = channel
        if changes[press, column] < 0.0:
            inverted_channels.append(channel)
    return ElectrodeCheck(
        expected=dict(channels), found=found_channels, changes=changes, inverted=tuple(inverted_channels)
    )


def assign_channels(changes: Array, electrodes: Sequence[str]) -> list[int]:
    """For each electrode, find the channel that changes most under the press near the electrode.

    The changes depend on the forces of the presses and on the gains of the channels. To remove these effects, the rows
    and the columns of the matrix of changes are divided alternately by their means (Sinkhorn and Knopp 1967).

    Args:
        changes: Change of each channel under the press near each electrode, shape (electrodes, channels), any unit.
        electrodes: Names of the electrodes.

    Returns:
        Column of the channel for each electrode.

    Raises:
        PressCheckError: If two presses change the same channel most, or a press changes two channels almost equally.
    """
    normalised = np.abs(changes) + 1e-30  # a channel that never changes must not cause a division by zero
    for _ in range(NORMALISATION_STEPS):
        normalised = normalised / normalised.mean(axis=0)  # removes the gain of each channel
        normalised = normalised / normalised.mean(axis=1, keepdims=True)  # removes the force of each press

    # The channel of each electrode is the column with the largest change in its row. Check that the choice is clear.
    columns = [int(column) for column in np.argmax(normalised, axis=1)]
    for row, column in enumerate(columns):
        other_changes = np.delete(normalised[row], column)  # empty if there is only one channel
        if other_changes.size and normalised[row, column] < MIN_ADVANTAGE * other_changes.max():
            raise PressCheckError(
                f"the press near electrode {electrodes[row]} changes two channels by almost the same amount; press "
                "closer to the electrode, with a thinner probe, and try again"
            )
        if column in columns[:row]:
            earlier_electrode = electrodes[columns.index(column)]
            raise PressCheckError(
                f"the presses near electrodes {earlier_electrode} and {electrodes[row]} change the same channel most; "
                "press closer to each electrode, and try again"
            )
    return columns


def corrected_table(table: Mapping[str, Any], check: ElectrodeCheck) -> dict[str, Any]:
    """Assign the channels found by the presses to the electrodes, and return the new content of a device file.

    Settings of single electrodes, such as gains and offsets, belong to the amplifiers, so they are moved together with
    the channels.

    Args:
        table: Content of the device file with the assumed channels.
        check: Result of the presses.
    """
    # Each electrode receives the settings of the electrode to which its channel was assumed to belong.
    expected_electrode = {channel: electrode for electrode, channel in check.expected.items()}
    source_electrode = {electrode: expected_electrode[channel] for electrode, channel in check.found.items()}
    corrected_sections = {name: _reassigned_settings(section, source_electrode) for name, section in table.items()}
    corrected_sections["channels"] = dict(check.found)
    return corrected_sections


def _reassigned_settings(section: Any, source_electrode: Mapping[str, str]) -> Any:
    """Move settings between electrodes in a section of a device file, and return the new section.

    A setting with one value for each electrode is a table, such as `offset = {A = 1.0, B = 2.0}`. All other settings
    are returned unchanged.

    Args:
        section: A table of settings by name, or a single value, which is returned unchanged.
        source_electrode: For each electrode, the electrode whose settings it receives.
    """
    if not isinstance(section, Mapping):
        return section
    reassigned_section = {}
    for key, setting in section.items():
        is_for_each_electrode = isinstance(setting, Mapping) and set(setting) == set(source_electrode)
        if is_for_each_electrode:
            reassigned_section[key] = {electrode: setting[source] for electrode, source in source_electrode.items()}
        else:
            reassigned_section[key] = setting
    return reassigned_section


class _BlockReader:
    """Reader of a port that computes the medians of the given channels over blocks of time of the length `BLOCK_S`."""

    def __init__(self, port: Port, device: Device, channels: list[str]) -> None:
        """Store the port and the channels. The first data are read by `next_block`.

        Args:
            port: The open port.
            device: Format of the frames.
            channels: Names of the channels.
        """
        self._port = port
        self._parser = device.parser()
        self._channels = channels

    def next_block(self, deadline_s: float) -> tuple[Array, Array] | None:
        """Collect the frames of one block of time, and return the median and the noise of each channel.

        A block lasts for `BLOCK_S`, or longer if no frame has arrived during this time.

        Args:
            deadline_s: Time on the monotonic clock until which the function waits for frames, s.

        Returns:
            Medians of the block and noise of one frame, each of shape (channels,), in the unit of the board; None if
            no frames come before the deadline.
        """
        rows: list[list[float]] = []  # the values of the channels in each frame
        end_s = time.monotonic() + BLOCK_S
        while time.monotonic() < end_s or not rows:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0.0:
                return None
            chunk = self._port.read(min(BLOCK_S, remaining_s))
            if chunk is not None:  # otherwise no bytes have arrived in time
                rows += self._rows(chunk.data)
        values = np.array(rows)  # shape (frames, channels)
        # Consecutive values of a coarse converter may be equal. The noise is then the rounding error of whole numbers.
        noise = np.array([max(estimate_noise(column), rounding_error_std(column)) for column in values.T])
        return np.median(values, axis=0), noise

    def _rows(self, data: bytes) -> Iterator[list[float]]:
        """Yield the values of the channels in each frame that has a finite number for every channel.

        Args:
            data: Bytes from the port. They may end within a frame, which the next bytes complete.
        """
        for frame in self._parser.feed(data):
            positions = [channel_index(channel, frame) for channel in self._channels]  # None for a missing channel
            values = [frame.values[position] for position in positions if position is not None]
            has_all_channels = len(values) == len(positions)
            if has_all_channels and all(map(math.isfinite, values)):
                yield values


def _wait_for_press(blocks: _BlockReader, electrode: str, timeout_s: float) -> Array:
    """Wait for a press that begins and ends, and return the change of the channels at its peak.

    Each block contains the median of each channel over a short time. The change of a channel is the difference between
    a block and the rest level. The press begins when the change of a channel is much larger than the noise. Before the
    press begins, the rest level is updated in order to follow a slow drift. The press ends when the changes have become
    small again.

    Args:
        blocks: Source of the blocks.
        electrode: Electrode near which the press is expected, for the error message.
        timeout_s: Longest time to wait, s.

    Returns:
        Change of each channel in the block with the largest total change, shape (channels,), in the unit of the board.

    Raises:
        PressCheckError: If the press does not begin and end within `timeout_s`.
    """
    deadline_s = time.monotonic() + timeout_s
    rest_level, noise = _wait_for_rest(blocks, electrode, deadline_s, timeout_s)
    largest_change = np.zeros_like(rest_level)
    is_pressed = False
    while (block := blocks.next_block(deadline_s)) is not None:
        level, _block_noise = block  # the noise at rest is used instead, because a press changes the noise of a block
        change = level - rest_level
        if np.any(np.abs(change) > CHANGE_SIGMAS * noise):
            is_pressed = True
        if not is_pressed:
            rest_level = rest_level + REST_UPDATE * change
            continue

        total_change = np.abs(change).sum()
        if total_change > np.abs(largest_change).sum():
            largest_change = change
        is_released = total_change < RELEASED_SHARE * np.abs(largest_change).sum()
        if is_released:
            return largest_change

    # No block came before the deadline. Either the press did not end, or it did not begin.
    if is_pressed:
        raise _restless_error(electrode, timeout_s)
    raise _missing_press_error(electrode, timeout_s)


def _wait_for_rest(blocks: _BlockReader, electrode: str, deadline_s: float, timeout_s: float) -> tuple[Array, Array]:
    """Wait until the channels are quiet in `REST_BLOCKS` consecutive blocks.

    A block contains the level (median) and the noise of each channel over a short time. The channels are quiet if the
    level of each channel varies by at most half of the change that begins a press.

    Args:
        blocks: Source of the blocks.
        electrode: Electrode near which the next press is expected, for the error message.
        deadline_s: Time on the monotonic clock until which the function waits, s.
        timeout_s: Time to wait for the press, s, for the error message.

    Returns:
        Rest level and noise of each channel, both of shape (channels,), in the unit of the board. The noise is the
        standard deviation of a single frame.

    Raises:
        PressCheckError: If the channels are not quiet before the deadline.
    """
    recent_blocks: deque[tuple[Array, Array]] = deque(maxlen=REST_BLOCKS)
    while (block := blocks.next_block(deadline_s)) is not None:
        recent_blocks.append(block)
        levels = np.array([level for level, _block_noise in recent_blocks])  # shape (blocks, channels)
        noise = np.median([block_noise for _level, block_noise in recent_blocks], axis=0)
        variation = np.ptp(levels, axis=0)  # largest minus smallest level of each channel
        change_of_press = CHANGE_SIGMAS * noise  # smallest change that counts as the beginning of a press
        is_quiet = bool(np.all(variation <= 0.5 * change_of_press))
        if len(recent_blocks) == REST_BLOCKS and is_quiet:
            return levels.mean(axis=0), noise

    # No block came before the deadline. Either the channels were not quiet, or no frames came.
    if recent_blocks:
        raise _restless_error(electrode, timeout_s)
    raise _missing_press_error(electrode, timeout_s)


def _restless_error(electrode: str, timeout_s: float) -> PressCheckError:
    """Return the error for charges that have not come to rest within `timeout_s`."""
    return PressCheckError(
        f"electrode {electrode}: the charges did not come to rest within {timeout_s:g} s; take the finger away after "
        "each press, and try again"
    )


def _missing_press_error(electrode: str, timeout_s: float) -> PressCheckError:
    """Return the error for a press that has not begun within `timeout_s`."""
    return PressCheckError(f"electrode {electrode}: no press came within {timeout_s:g} s; try again")
