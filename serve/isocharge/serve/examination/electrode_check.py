"""Check which channel belongs to which electrode. The user presses near each electrode in turn.

The electrode next to a press collects the largest charge. The change of each channel under one press is compared with
the changes of the same channel under the other presses. The gains of the channels therefore need not be known or equal.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressCheckError
from isocharge.common.printable_text import printable
from isocharge.serve.examination.press_detector import BLOCK_S, CHANGE_BLOCKS, Press, channel_noise, find_press
from isocharge.serve.live.device import Device
from isocharge.serve.port.source import Port
from isocharge.serve.signal_chain.channels import channel_index


@dataclass(frozen=True)
class ElectrodeCheck:
    """Result of the electrode check: the channel that changed most under the press near each electrode.

    Attributes:
        expected: Assumed channel of each electrode, by the name of the electrode.
        found: Channel of each electrode that the presses show, by the name of the electrode.
        inverted: Channels whose charge falls under a press.
    """

    expected: Mapping[str, str]
    found: Mapping[str, str]
    inverted: tuple[str, ...]

    @property
    def sentences(self) -> Iterator[str]:
        """Sentences for the user about the channel of each electrode, the order of the channels, and wrong signs."""
        for electrode, channel in self.found.items():
            yield f"press near {electrode}: channel {printable(channel)} answers most strongly"
        wrong = [electrode for electrode, channel in self.found.items() if channel != self.expected[electrode]]
        if wrong:
            yield f"the channels of {', '.join(wrong)} are in another order than assumed"
        else:
            yield "every channel belongs to its electrode"
        # If all channels are inverted, only the sign convention of the board differs, which is no mistake.
        is_part_inverted = 0 < len(self.inverted) < len(self.found)
        if is_part_inverted:
            names = printable(", ".join(self.inverted))
            yield f"channel {names} falls under a press and the others rise: check the signs of the gain"


def check_electrodes(
    port: Port,
    device: Device,
    channels: Mapping[str, str],
    ask: Callable[[str], None],
    timeout_s: float = 60.0,
) -> ElectrodeCheck:
    """For each electrode, ask the user for a press near it, and find the channel that changes most under this press.

    Args:
        port: The open port.
        device: Format of the frames.
        channels: Assumed channel of each electrode, by the name of the electrode.
        ask: Function that is called with a sentence that asks the user to wait or to press.
        timeout_s: Time to wait for each press, s.

    Returns:
        The assumed and the found channel of each electrode, and the inverted channels.

    Raises:
        PressCheckError: If a press does not come in time, or the presses do not distinguish the channels.
        PortLost: If the connection to the board is lost.
    """
    electrodes = list(channels)
    channel_names = list(channels.values())
    presses = _PressReader(port, device, channel_names, ask, timeout_s)
    changes = np.array([presses.press_near(electrode) for electrode in electrodes])
    columns = assign_channels(changes, electrodes)

    # A channel is inverted if its value falls under the press near its own electrode.
    found_channels = {}
    inverted_channels = []
    for press, column in enumerate(columns):
        channel = channel_names[column]
        found_channels[electrodes[press]] = channel
        if changes[press, column] < 0.0:
            inverted_channels.append(channel)
    return ElectrodeCheck(expected=dict(channels), found=found_channels, inverted=tuple(inverted_channels))


def assign_channels(changes: Array, electrodes: Sequence[str], min_advantage: float = 1.1) -> list[int]:
    """For each electrode, find the channel that changes most under the press near the electrode.

    The changes depend on the forces of the presses and on the gains of the channels. To remove these effects, the rows
    and the columns of the matrix of changes are divided by their geometric means.

    Args:
        changes: Change of each channel under the press near each electrode, shape (electrodes, channels), any unit.
        electrodes: Names of the electrodes.
        min_advantage: Smallest ratio of the largest normalised change under a press to the change of any other
            channel.

    Returns:
        Column of the channel for each electrode.

    Raises:
        PressCheckError: If two presses change the same channel most, or a press changes two channels almost equally.
    """
    log_changes = np.log(np.abs(changes) + 1e-30)  # the second term allows a channel that never changes
    log_changes -= log_changes.mean(axis=0)  # removes the gain of each channel
    log_changes -= log_changes.mean(axis=1, keepdims=True)  # removes the force of each press
    normalised = np.exp(log_changes)

    # The channel of each electrode is the column with the largest change in its row. Check that the choice is clear.
    columns = [int(column) for column in np.argmax(normalised, axis=1)]
    for row, column in enumerate(columns):
        other_changes = np.delete(normalised[row], column)  # empty if there is only one channel
        if other_changes.size and normalised[row, column] < min_advantage * other_changes.max():
            raise PressCheckError(
                f"the press near electrode {electrodes[row]} changes two channels by almost the same amount; press "
                "closer to the electrode, with a thinner probe, and try again"
            )
        if column in columns[:row]:
            raise PressCheckError(
                f"the presses near electrodes {electrodes[columns.index(column)]} and {electrodes[row]} change the "
                "same channel most; press closer to each electrode, and try again"
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

    def moved(setting: Any) -> Any:
        """Return a setting of a section, with the values of single electrodes moved to other electrodes."""
        if not isinstance(setting, Mapping) or set(setting) != set(source_electrode):
            return setting
        return {electrode: setting[source] for electrode, source in source_electrode.items()}

    sections = {name: section for name, section in table.items() if isinstance(section, Mapping)}
    moved_sections = {
        name: {key: moved(setting) for key, setting in section.items()} for name, section in sections.items()
    }
    return {**table, **moved_sections, "channels": dict(check.found)}


class _PressReader:
    """Reader of presses, each of which the user is asked for."""

    def __init__(
        self, port: Port, device: Device, channels: list[str], ask: Callable[[str], None], timeout_s: float
    ) -> None:
        """Store the arguments.

        Args:
            port: The open port.
            device: Format of the frames.
            channels: Names of the channels.
            ask: Function that is called with a sentence that asks the user to wait or to press.
            timeout_s: Longest time to wait for the rest or for a press, s.
        """
        self._port = port
        self._parser = device.parser()
        self._channels = channels
        self._ask = ask
        self._timeout_s = timeout_s
        self._blocks: list[Array] = []  # values of the blocks since the end of the previous press
        self._previous_change = np.zeros(len(channels))  # change of the channels under the previous press

    def press_near(self, electrode: str) -> Array:
        """Ask for a press, wait until it has begun and ended, and return the change of the channels at its peak.

        Args:
            electrode: Electrode near which the press is expected.

        Returns:
            Change of each channel in the block with the largest total change, shape (channels,), in the unit of the
            board.

        Raises:
            PressCheckError: If the rest, or the begin or the end of the press, does not come in time.
        """
        if not self._blocks:
            self._ask("wait, and do not touch the film, until the rest level is known")
            deadline_s = time.monotonic() + self._timeout_s
            while len(self._blocks) <= CHANGE_BLOCKS or self._find_press() is not None:
                self._blocks = [*self._blocks[-CHANGE_BLOCKS:], self._next_block(deadline_s, electrode)]
        self._ask(f"press near electrode {electrode}, as close to it as you can, and let go")
        deadline_s = time.monotonic() + self._timeout_s
        while True:
            self._blocks.append(self._next_block(deadline_s, electrode))
            press = self._find_press()
            if press is not None and press.end is not None:
                self._blocks = self._blocks[press.end :]
                self._previous_change = press.change
                return press.change

    def _find_press(self) -> Press | None:
        """Return the first press in the blocks; None if no press has begun.

        The first blocks are dropped while the charges still fall after the previous press.
        """
        direction = np.sign(self._previous_change)
        while len(self._blocks) > 1:
            first_level, second_level = (np.median(block, axis=0) for block in self._blocks[:2])
            if direction @ (second_level - first_level) >= 0.0:
                break
            del self._blocks[0]
        levels = np.array([np.median(block, axis=0) for block in self._blocks])
        return find_press(levels, channel_noise(np.vstack(self._blocks)))

    def _next_block(self, deadline_s: float, electrode: str) -> Array:
        """Collect the frames of one block of time, and return their values, shape (frames, channels).

        A block lasts for `BLOCK_S`, or longer if no frame has arrived during this time. Frames without a finite number
        for every channel are ignored.

        Args:
            deadline_s: Time on the monotonic clock until which the function waits for frames, s.
            electrode: Electrode near which the press is expected, for the error message.

        Raises:
            PressCheckError: If no frames come before the deadline.
        """
        rows: list[list[float]] = []  # the values of the channels in each frame
        end_s = time.monotonic() + BLOCK_S
        while time.monotonic() < end_s or not rows:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0.0:
                raise PressCheckError(
                    f"electrode {electrode}: no press began and ended within {self._timeout_s:g} s; take the finger "
                    "away after each press, and try again"
                )
            chunk = self._port.read(min(BLOCK_S, remaining_s))
            for frame in [] if chunk is None else self._parser.feed(chunk.data):
                positions = [channel_index(channel, frame) for channel in self._channels]  # None for a missing channel
                values = [math.nan if position is None else frame.values[position] for position in positions]
                if all(map(math.isfinite, values)):
                    rows.append(values)
        return np.array(rows)
