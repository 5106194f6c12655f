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
from msgspec import structs

from isocharge.common.arrays import Array
from isocharge.common.errors import PressCheckError, printable
from isocharge.serve.frames.frame import Frame
from isocharge.serve.live.steady_press import PressWatch
from isocharge.serve.live.stream import ReadingStream
from isocharge.serve.port.source import Port
from isocharge.serve.signal_chain.channels import GainRule
from isocharge.serve.signal_chain.stage import Device, Rule
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.touch import TouchRule


@dataclass(frozen=True)
class ElectrodeCheck:
    """Result of the electrode check: the channel that changed most under the press near each electrode.

    Attributes:
        expected: Assumed channel of each electrode, by the name of the electrode.
        found: Channel of each electrode according to the presses, by the name of the electrode.
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
    unit: str = "pC",
    rest_span: float = math.inf,
    timeout_s: float = 60.0,
) -> ElectrodeCheck:
    """For each electrode, ask the user for a press near it, and find the channel that changes most under this press.

    Args:
        port: The open port.
        device: Format of the frames.
        channels: Assumed channel of each electrode, by the name of the electrode.
        ask: Function that is called with a sentence that asks the user to wait or to press.
        unit: Unit of the charges: "pC", "counts" or another unit.
        rest_span: Largest minus smallest charge of a channel at rest. If the charges vary more, the film is considered
            touched.
        timeout_s: Time to wait for each press, s.

    Returns:
        The assumed and the found channel of each electrode, and the inverted channels.

    Raises:
        PressCheckError: If a press does not come in time, or the presses do not distinguish the channels.
        ChargeError: If the frames lack a channel.
        PortLost: If the connection to the board is lost.
    """
    electrodes = list(channels)
    channel_names = list(channels.values())
    ask("wait, and do not touch the film, until the rest level is known")
    frames = _charge_frames(port, device, channels, unit, rest_span)
    changes = np.array([_charges_of_press(frames, electrode, ask, timeout_s) for electrode in electrodes])
    columns = assign_channels(changes, electrodes)  # for each electrode: index in `channel_names`
    found = {electrode: channel_names[column] for electrode, column in zip(electrodes, columns, strict=True)}
    # A channel is inverted if its value falls under the press near its own electrode.
    inverted = tuple(channel_names[column] for row, column in enumerate(columns) if changes[row, column] < 0.0)
    return ElectrodeCheck(dict(channels), found, inverted)


def assign_channels(changes: Array, electrodes: Sequence[str], min_advantage: float = 1.1) -> list[int]:
    """For each electrode, find the channel that changes most under the press near the electrode.

    The changes depend on the forces of the presses and on the gains of the channels. To remove these effects, the rows
    and the columns of the matrix of changes are divided by their geometric means.

    Args:
        changes: Change of each channel under the press near each electrode, shape (electrodes, channels), any unit.
        electrodes: Names of the electrodes.
        min_advantage: Smallest ratio of the largest normalised change under a press to the normalised change of any
            other channel.

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
    columns: list[int] = np.argmax(normalised, axis=1).tolist()
    for row, column in enumerate(columns):
        largest_other_change = np.delete(normalised[row], column).max(initial=0.0)  # 0 if there is only one channel
        if normalised[row, column] < min_advantage * largest_other_change:
            raise PressCheckError(
                f"the press near electrode {electrodes[row]} changes two channels by almost the same amount; press "
                "closer to the electrode, with a thinner probe, and try again"
            )
        first_row = columns.index(column)
        if first_row < row:
            raise PressCheckError(
                f"the presses near electrodes {electrodes[first_row]} and {electrodes[row]} change the same channel "
                "most; press closer to each electrode, and try again"
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
    # Each electrode receives the settings of its source, the electrode to which its channel was assumed to belong.
    expected_electrode = {channel: electrode for electrode, channel in check.expected.items()}
    source_of_electrode = {electrode: expected_electrode[channel] for electrode, channel in check.found.items()}

    def moved(setting: Any) -> Any:
        """Return a setting, section or table, with the values of single electrodes moved to other electrodes.

        The new value of each electrode is the old value of its source. The presses have shown that the channel of the
        electrode had been assumed to belong to this source, and the values belong to the channels.
        """
        if not isinstance(setting, Mapping):
            return setting
        if set(setting) == set(source_of_electrode):  # the setting has one value for each electrode
            return {electrode: setting[source] for electrode, source in source_of_electrode.items()}
        return {name: moved(value) for name, value in setting.items()}

    return {**moved(table), "channels": dict(check.found)}


def _charge_frames(
    port: Port, device: Device, channels: Mapping[str, str], unit: str, rest_span: float
) -> Iterator[Frame]:
    """Yield the frames of a board with their touch charges in the order of the electrodes.

    If the gain is unknown, the charges have the unit of the board. The tare therefore always accepts any offset, and
    the charges of a touch may have any sign.

    Args:
        port: The open port.
        device: Settings of the board. Only the frames, the kind of front end and the gain are used.
        channels: Channel of each electrode, by the name of the electrode.
        unit: Unit of the charges. The default threshold of a touch is for pC and counts. In another unit, the threshold
            depends only on the noise.
        rest_span: Largest minus smallest charge of a channel at rest. A tare is measured only from frames whose
            standard deviation is not larger, so that the noise of an untouched film is accepted.
    """
    rules: dict[type[Rule], Rule] = {
        # The stream waits without a time limit for the first frames that are quiet enough (`patience=0`).
        TareRule: TareRule(noise_limit_pC=rest_span, offset_limit_pC=math.inf, patience=0),
        TouchRule: TouchRule() if unit in ("pC", "counts") else TouchRule(floor_pC=0.0),
    }
    gain = device.rule(GainRule)
    if gain is not None:
        rules[GainRule] = gain
    # The stream uses only these rules, so no other section of the device file, such as [leak], changes the charges.
    device_with_few_rules = structs.replace(device, channels=dict(channels), rules=rules)
    stream = ReadingStream(tuple(channels), device_with_few_rules, has_any_sign=True)
    for chunk in port:
        yield from stream.frames(chunk)


def _charges_of_press(frames: Iterator[Frame], electrode: str, ask: Callable[[str], None], timeout_s: float) -> Array:
    """Ask for a press, wait until it has begun and ended, and return its mean touch charges.

    Args:
        frames: The frames of the board.
        electrode: Electrode near which the press is expected.
        ask: Function that is called with the request.
        timeout_s: Longest time to wait for the press, s.

    Returns:
        Mean touch charges of the press, shape (n_electrode,), in the unit of the board.

    Raises:
        PressCheckError: If the press does not begin or does not end in time.
    """
    deadline_s = time.monotonic() + timeout_s
    charges: list[Array] = []
    is_asked = False
    for frame in frames:
        if time.monotonic() > deadline_s:
            break
        if frame.charge_pC is None:  # the tare is being measured, or the frame is invalid
            continue
        if not is_asked:
            ask(f"press near electrode {electrode}, as close to it as you can, and let go")
            is_asked = True
        if frame.is_contact:
            if not charges:
                begin_s = frame.clock_s
            charges.append(frame.charge_pC)
        elif charges and frame.clock_s - begin_s >= PressWatch.MIN_HELD_S:  # the press has ended
            return np.asarray(np.mean(charges, axis=0))
        else:  # there was no touch, or only a short one, which damaged frames can cause
            charges = []
    raise PressCheckError(
        f"electrode {electrode}: no press began and ended within {timeout_s:g} s; take the finger away after each "
        "press, and try again"
    )
