"""Check which channel belongs to which electrode. The user presses near each electrode in turn.

The electrode next to a press collects the largest charge. The change of a channel under one press is compared with its
changes under the other presses. The gains of the channels therefore need not be known or equal.
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
from isocharge.serve.examination.proposal import noise_of
from isocharge.serve.examination.touch_search import BLOCK_S, CHANGE_SIGMAS, resolution_of
from isocharge.serve.live.device import Device
from isocharge.serve.live.reading_stream import position_of
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
    """Result of the presses: the channel that changed most under the press near each electrode.

    Attributes:
        expected: Channel of each electrode as it was assumed, by the names of the electrodes.
        found: Channel of each electrode as the presses show it, by the names of the electrodes.
        changes: Change of each channel under each press, shape (electrodes, channels), in the unit of the board.
        inverted: Channels whose charge falls under a press.
    """

    expected: Mapping[str, str]
    found: Mapping[str, str]
    changes: Array
    inverted: tuple[str, ...]

    @property
    def is_as_expected(self) -> bool:
        """Whether every channel belongs to the electrode that was assumed."""
        return dict(self.expected) == dict(self.found)

    @property
    def sentences(self) -> Iterator[str]:
        """Sentences that describe the result to the user."""
        for electrode, channel in self.found.items():
            yield f"press near {electrode}: channel {printable(channel)} answers most strongly"
        yield _order_sentence(self.expected, self.found)
        # If all channels are inverted, only the sign convention of the board differs, which is no mistake.
        is_part_inverted = 0 < len(self.inverted) < len(self.found)
        if is_part_inverted:
            names = printable(", ".join(self.inverted))
            yield f"channel {names} falls under a press and the others rise: check the signs of the gain"


def _order_sentence(expected_channels: Mapping[str, str], found_channels: Mapping[str, str]) -> str:
    """Return a sentence that states whether the channels are swapped, turned, or in another order.

    The channels are turned if each channel is connected the same number of places too far around the film.

    Args:
        expected_channels: Channel of each electrode as it was assumed, by the names of the electrodes.
        found_channels: Channel of each electrode as the presses show it, by the names of the electrodes.
    """
    electrodes = list(expected_channels)
    wrong_electrodes = [name for name in electrodes if found_channels[name] != expected_channels[name]]
    if not wrong_electrodes:
        return "every channel belongs to its electrode"

    # For each electrode that was pressed, the electrode to which the answering channel was assumed to belong
    electrode_of_channel = {channel: electrode for electrode, channel in expected_channels.items()}
    assumed_electrodes = [electrode_of_channel[found_channels[electrode]] for electrode in electrodes]
    if len(electrodes) > 2:  # two channels that are turned are also swapped, which is the simpler description
        for places in range(1, len(electrodes)):
            # This is the order of the electrodes if every channel is connected `places` electrodes too far.
            turned_electrodes = electrodes[places:] + electrodes[:places]
            if assumed_electrodes == turned_electrodes:
                return f"the channels are turned by {places} of {len(electrodes)} places"
    if len(wrong_electrodes) == 2:
        return f"the channels of {wrong_electrodes[0]} and {wrong_electrodes[1]} are swapped"
    return f"the channels of {', '.join(wrong_electrodes)} are in another order"


def check_electrodes(
    port: Port,
    device: Device,
    channels: Mapping[str, str],
    ask: Callable[[str], None],
    timeout_s: float = PRESS_TIMEOUT_S,
) -> ElectrodeCheck:
    """Ask for a press near each electrode in turn, and find the channel that answers most strongly.

    Args:
        port: The open port.
        device: Format of the frames.
        channels: Name of the channel of each electrode, as it is assumed.
        ask: Function that is called with a sentence that asks the user for a press.
        timeout_s: Time to wait for each press, s.

    Raises:
        PressCheckError: If a press does not come in time, or the presses do not distinguish the channels.
        PortLost: If the connection to the board is lost.
    """
    electrodes = list(channels)
    channel_names = list(channels.values())
    blocks = _Blocks(port, device, channel_names)
    measured_changes = []
    for electrode in electrodes:
        ask(f"press near electrode {electrode}, as close to it as you can, and let go")
        measured_changes.append(_wait_for_press(blocks, electrode, timeout_s))
    changes = np.array(measured_changes)  # shape (electrodes, channels)

    # A channel is inverted if its value falls under the press near its own electrode.
    found_channels = {}
    inverted_channels = []
    for row, column in enumerate(assign_channels(changes, electrodes)):
        channel = channel_names[column]
        found_channels[electrodes[row]] = channel
        if changes[row, column] < 0.0:
            inverted_channels.append(channel)
    return ElectrodeCheck(
        expected=dict(channels), found=found_channels, changes=changes, inverted=tuple(inverted_channels)
    )


def assign_channels(changes: Array, electrodes: Sequence[str]) -> list[int]:
    """Find the channel that changes most under the press near each electrode.

    The forces of the presses and the gains of the channels differ. The rows and the columns of the changes are
    therefore divided alternately by their means, which removes the forces and the gains (Sinkhorn and Knopp 1967).

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
        normalised = normalised / normalised.mean(axis=0)
        normalised = normalised / normalised.mean(axis=1, keepdims=True)

    columns = [int(column) for column in np.argmax(normalised, axis=1)]
    for row, column in enumerate(columns):
        other_changes = np.delete(normalised[row], column)  # empty if there is only one channel
        if other_changes.size and normalised[row, column] < MIN_ADVANTAGE * other_changes.max():
            raise PressCheckError(
                f"the press near electrode {electrodes[row]} moves two channels alike; press closer to the electrode, "
                "with a thinner probe, and try again"
            )
        if column in columns[:row]:
            earlier_electrode = electrodes[columns.index(column)]
            raise PressCheckError(
                f"the presses near electrodes {earlier_electrode} and {electrodes[row]} move the same channel most; "
                "press closer to each electrode, and try again"
            )
    return columns


def corrected_table(table: Mapping[str, Any], check: ElectrodeCheck) -> dict[str, Any]:
    """Return the content of a device file in which the channel of each electrode is the one found by the presses.

    Settings for single electrodes, such as gains and offsets, belong to the amplifiers and move with the channels.

    Args:
        table: Content of the device file with the assumed channels.
        check: Result of the presses.
    """
    # Each electrode receives the settings of the electrode to which its channel was assumed to belong.
    electrode_of_channel = {channel: electrode for electrode, channel in check.expected.items()}
    source_electrode = {electrode: electrode_of_channel[channel] for electrode, channel in check.found.items()}
    corrected = {name: _reassigned_settings(section, source_electrode) for name, section in table.items()}
    corrected["channels"] = dict(check.found)
    return corrected


def _reassigned_settings(section: Any, source_electrode: Mapping[str, str]) -> Any:
    """Return a section of a device file in which the settings of the electrodes are exchanged.

    Args:
        section: The section. It is returned unchanged if it is not a table. Settings that do not have a value for each
            electrode are also returned unchanged.
        source_electrode: For each electrode, the electrode whose settings it receives.
    """
    if not isinstance(section, Mapping):
        return section
    reassigned = {}
    for key, setting in section.items():
        is_for_each_electrode = isinstance(setting, Mapping) and set(setting) == set(source_electrode)
        if is_for_each_electrode:
            reassigned[key] = {electrode: setting[source] for electrode, source in source_electrode.items()}
        else:
            reassigned[key] = setting
    return reassigned


class _Blocks:
    """Reads a port, and averages the values of some channels over blocks of `BLOCK_S`."""

    def __init__(self, port: Port, device: Device, channels: list[str]) -> None:
        """Begin without data.

        Args:
            port: The open port.
            device: Format of the frames.
            channels: Names of the channels.
        """
        self._port = port
        self._parser = device.parser()
        self._channels = channels

    def next_block(self, deadline_s: float) -> tuple[Array, Array] | None:
        """Collect frames for `BLOCK_S`, or longer until a frame has arrived, and return their medians and noise.

        Args:
            deadline_s: Time on the monotonic clock until which frames are waited for, s.

        Returns:
            Medians of the block and noise of one frame, each of shape (channels,), in the unit of the board; None if
            no frames come before the deadline.
        """
        rows: list[list[float]] = []
        end_s = time.monotonic() + BLOCK_S
        while time.monotonic() < end_s or not rows:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0.0:
                return None
            chunk = self._port.read(min(BLOCK_S, remaining_s))
            if chunk is not None:
                rows += self._rows(chunk.data)
        values = np.array(rows)  # shape (frames, channels)
        # Coarse values may have no noise between consecutive frames. The noise is then one step of the values.
        noise = np.array([max(noise_of(column), resolution_of(column)) for column in values.T])
        return np.median(values, axis=0), noise

    def _rows(self, data: bytes) -> Iterator[list[float]]:
        """Yield the values of the channels in each frame that has a finite number for every channel."""
        for frame in self._parser.feed(data):
            positions = [position_of(channel, frame) for channel in self._channels]  # None for a missing channel
            values = [frame.values[position] for position in positions if position is not None]
            has_all_channels = len(values) == len(positions)
            if has_all_channels and all(map(math.isfinite, values)):
                yield values


def _wait_for_press(blocks: _Blocks, electrode: str, timeout_s: float) -> Array:
    """Wait for a press that begins and ends, and return the largest change of each channel, shape (channels,).

    The values are averaged over blocks of time. The change is the difference between a block and the rest level. Until
    the press begins, the rest level is updated, so that it follows a slow drift. The press ends when the change has
    become small again.

    Args:
        blocks: Source of the averaged values.
        electrode: Electrode near which the press is expected, for the error message.
        timeout_s: Longest time to wait, s.

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

        change_size = np.abs(change).sum()
        if change_size > np.abs(largest_change).sum():
            largest_change = change
        if change_size < RELEASED_SHARE * np.abs(largest_change).sum():
            return largest_change

    # The time is over: either the press did not end, or it did not begin.
    if is_pressed:
        raise _restless_error(electrode, timeout_s)
    raise _missing_press_error(electrode, timeout_s)


def _wait_for_rest(blocks: _Blocks, electrode: str, deadline_s: float, timeout_s: float) -> tuple[Array, Array]:
    """Wait until the channels are quiet in `REST_BLOCKS` consecutive blocks.

    The channels are quiet if the level of each channel varies by at most half of the change that begins a press.

    Args:
        blocks: Source of the blocks.
        electrode: Electrode near which the next press is expected, for the error message.
        deadline_s: Time on the monotonic clock until which the rest is waited for, s.
        timeout_s: Time to wait for the press, s, for the error message.

    Returns:
        Rest level of the channels and noise of one frame, each of shape (channels,), in the unit of the board.

    Raises:
        PressCheckError: If the channels are not quiet before the deadline.
    """
    recent_blocks: deque[tuple[Array, Array]] = deque(maxlen=REST_BLOCKS)
    while (block := blocks.next_block(deadline_s)) is not None:
        recent_blocks.append(block)
        levels = np.array([level for level, _ in recent_blocks])  # shape (blocks, channels)
        noise = np.median([block_noise for _, block_noise in recent_blocks], axis=0)
        variation = np.ptp(levels, axis=0)  # largest minus smallest level of each channel
        is_quiet = bool(np.all(variation <= 0.5 * CHANGE_SIGMAS * noise))
        if len(recent_blocks) == REST_BLOCKS and is_quiet:
            return levels.mean(axis=0), noise

    # The time is over: either the channels were not quiet, or no frames came.
    if recent_blocks:
        raise _restless_error(electrode, timeout_s)
    raise _missing_press_error(electrode, timeout_s)


def _restless_error(electrode: str, timeout_s: float) -> PressCheckError:
    """Return the error for charges that do not come to rest within `timeout_s`."""
    return PressCheckError(
        f"electrode {electrode}: the charges did not come to rest within {timeout_s:g} s; take the finger away after "
        "each press, and try again"
    )


def _missing_press_error(electrode: str, timeout_s: float) -> PressCheckError:
    """Return the error for a press that does not begin within `timeout_s`."""
    return PressCheckError(f"electrode {electrode}: no press came within {timeout_s:g} s; try again")
