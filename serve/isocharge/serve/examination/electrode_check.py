"""Check which channel belongs to which electrode, by a press near each electrode in turn.

The electrode next to a press collects the largest charge. The gains of the channels need not be known or equal: each
channel is compared with its own answers to the other presses.
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
"""Share of the largest change below which a press has ended, dimensionless. A leaking amplifier does not return to rest
at once."""

REST_UPDATE = 0.2
"""Weight of a new block in the rest while nothing presses, dimensionless. The rest follows a slow drift."""

NORMALISATION_STEPS = 20
"""Number of times that the answers are divided by the means of their rows and columns."""

MIN_ADVANTAGE = 1.1
"""Smallest ratio of the answer of the nearest electrode to that of any other, dimensionless."""

PRESS_TIMEOUT_S = 60.0
"""Time to wait for each press, s."""


@dataclass(frozen=True)
class ElectrodeCheck:
    """Which channel answered to the press near each electrode.

    Attributes:
        expected: Channel of each electrode as it was assumed, by the names of the electrodes.
        found: Channel of each electrode by the presses.
        answers: Change of each channel under each press, shape (electrodes, channels), in the unit of the board.
        inverted: Channels whose charge falls under a press.
    """

    expected: Mapping[str, str]
    found: Mapping[str, str]
    answers: Array
    inverted: tuple[str, ...]

    @property
    def is_as_expected(self) -> bool:
        """Whether every channel belongs to the electrode that was assumed."""
        return dict(self.expected) == dict(self.found)

    @property
    def sentences(self) -> Iterator[str]:
        """What the presses show, for people."""
        for electrode, channel in self.found.items():
            yield f"press near {electrode}: channel {printable(channel)} answers most strongly"
        yield _order_sentence(self.expected, self.found)
        if 0 < len(self.inverted) < len(self.found):
            names = printable(", ".join(self.inverted))
            yield f"channel {names} falls under a press and the others rise: check the signs of the gain"


def _order_sentence(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """Return whether channels are swapped or turned."""
    names = list(expected)
    electrode_of_channel = {channel: electrode for electrode, channel in expected.items()}
    assumed = [electrode_of_channel[found[name]] for name in names]
    moved = [name for name, other in zip(names, assumed, strict=True) if name != other]
    if not moved:
        return "every channel belongs to its electrode"
    for places in range(1, len(names)):
        if len(names) > 2 and assumed == names[places:] + names[:places]:
            return f"the channels are turned by {places} of {len(names)} places"
    if len(moved) == 2:
        return f"the channels of {moved[0]} and {moved[1]} are swapped"
    return f"the channels of {', '.join(moved)} are in another order"


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
        ask: Called with a sentence that asks for a press.
        timeout_s: Time to wait for each press, s.

    Raises:
        PressCheckError: If a press does not come in time, or the presses do not tell the channels apart.
        PortLost: If the port goes away.
    """
    blocks = _Blocks(port, device, list(channels.values()))
    answers = []
    for electrode in channels:
        ask(f"press near electrode {electrode}, as close to it as you can, and let go")
        answers.append(_answer_to_press(blocks, electrode, timeout_s))
    order = assign_channels(np.array(answers), list(channels))
    names = list(channels.values())
    found = {electrode: names[column] for electrode, column in zip(channels, order, strict=True)}
    changes = np.array(answers)
    own_changes = changes[np.arange(len(order)), order]
    inverted = tuple(found[electrode] for electrode, change in zip(found, own_changes, strict=True) if change < 0.0)
    return ElectrodeCheck(dict(channels), found, changes, inverted)


def assign_channels(answers: Array, electrodes: Sequence[str]) -> list[int]:
    """Find the channel that answers most strongly to the press near each electrode.

    The forces of the presses and the gains of the channels differ. They are removed by dividing rows and columns
    alternately by their means (Sinkhorn and Knopp 1967).

    Args:
        answers: Change of each channel under the press near each electrode, shape (electrodes, channels), any unit.
        electrodes: Names of the electrodes.

    Returns:
        Column of the channel for each electrode.

    Raises:
        PressCheckError: If two presses move the same channel most, or a press moves two channels alike.
    """
    strength = np.abs(answers) + 1e-30
    for _ in range(NORMALISATION_STEPS):
        strength = strength / strength.mean(axis=0)
        strength = strength / strength.mean(axis=1, keepdims=True)
    order = [int(column) for column in np.argmax(strength, axis=1)]
    for row, column in enumerate(order):
        others = np.delete(strength[row], column)
        if others.size and strength[row, column] < MIN_ADVANTAGE * others.max():
            raise PressCheckError(
                f"the press near electrode {electrodes[row]} moves two channels alike; press closer to the electrode, "
                "with a thinner probe, and try again"
            )
        if column in order[:row]:
            first = electrodes[order.index(column)]
            raise PressCheckError(
                f"the presses near electrodes {first} and {electrodes[row]} move the same channel most; press closer "
                "to each electrode, and try again"
            )
    return order


def corrected_table(table: Mapping[str, Any], check: ElectrodeCheck) -> dict[str, Any]:
    """Return the content of a device file in which every electrode has the channel that answered to its press.

    Settings for single electrodes, such as gains and offsets, belong to the amplifiers and move with the channels.

    Args:
        table: Content of the device file with the assumed channels.
        check: Result of the presses.
    """
    electrode_of_channel = {channel: electrode for electrode, channel in check.expected.items()}
    source = {electrode: electrode_of_channel[channel] for electrode, channel in check.found.items()}
    corrected = {name: _moved_settings(section, source) for name, section in table.items()}
    corrected["channels"] = dict(check.found)
    return corrected


def _moved_settings(section: Any, source: Mapping[str, str]) -> Any:
    """Return a section in which the settings of each electrode are those of its source."""
    if not isinstance(section, Mapping):
        return section
    moved = {}
    for key, setting in section.items():
        if isinstance(setting, Mapping) and set(setting) == set(source):
            setting = {electrode: setting[source[electrode]] for electrode in source}
        moved[key] = setting
    return moved


class _Blocks:
    """Medians of some channels over blocks of `BLOCK_S`, as they come from a port."""

    def __init__(self, port: Port, device: Device, channels: list[str]) -> None:
        self._port = port
        self._parser = device.parser()
        self._channels = channels

    def next_block(self, deadline_s: float) -> tuple[Array, Array] | None:
        """Wait for the next block.

        Args:
            deadline_s: Time on the monotonic clock until which frames are waited for, s.

        Returns:
            Medians and noise of one frame, each of shape (channels,); None if no frames come before the deadline.
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
        values = np.array(rows)
        noise = np.array([max(noise_of(column), resolution_of(column)) for column in values.T])
        return np.median(values, axis=0), noise

    def _rows(self, data: bytes) -> Iterator[list[float]]:
        """Yield the values of the channels in each frame that has all of them as finite numbers."""
        for frame in self._parser.feed(data):
            positions = [position_of(channel, frame) for channel in self._channels]
            row = [frame.values[position] for position in positions if position is not None]
            if len(row) == len(positions) and all(map(math.isfinite, row)):
                yield row


def _answer_to_press(blocks: _Blocks, electrode: str, timeout_s: float) -> Array:
    """Wait for a press that begins and ends, and return the largest change of each channel, shape (channels,)."""
    deadline_s = time.monotonic() + timeout_s
    rest, noise = _rest(blocks, electrode, deadline_s, timeout_s)
    largest_change = np.zeros_like(rest)
    is_pressed = False
    while (block := blocks.next_block(deadline_s)) is not None:
        levels, _ = block
        change = levels - rest
        is_pressed = is_pressed or bool(np.any(np.abs(change) > CHANGE_SIGMAS * noise))
        if not is_pressed:
            rest = rest + REST_UPDATE * change
            continue
        if np.abs(change).sum() > np.abs(largest_change).sum():
            largest_change = change
        if np.abs(change).sum() < RELEASED_SHARE * np.abs(largest_change).sum():
            return largest_change
    raise _timeout_error(electrode, timeout_s, is_pressed=is_pressed)


def _rest(blocks: _Blocks, electrode: str, deadline_s: float, timeout_s: float) -> tuple[Array, Array]:
    """Wait until the channels are quiet, and return their rest and the noise of a frame, each of shape (channels,)."""
    recent: deque[tuple[Array, Array]] = deque(maxlen=REST_BLOCKS)
    while (block := blocks.next_block(deadline_s)) is not None:
        recent.append(block)
        levels = np.array([levels for levels, _ in recent])
        noise = np.median([noise for _, noise in recent], axis=0)
        is_quiet = bool(np.all(np.ptp(levels, axis=0) <= 0.5 * CHANGE_SIGMAS * noise))
        if len(recent) == REST_BLOCKS and is_quiet:
            return levels.mean(axis=0), noise
    raise _timeout_error(electrode, timeout_s, is_pressed=bool(recent))


def _timeout_error(electrode: str, timeout_s: float, *, is_pressed: bool) -> PressCheckError:
    if is_pressed:
        return PressCheckError(
            f"electrode {electrode}: the charges did not come to rest within {timeout_s:g} s; take the finger away "
            "after each press, and try again"
        )
    return PressCheckError(f"electrode {electrode}: no press came within {timeout_s:g} s; try again")
