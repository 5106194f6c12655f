"""The port check, which examines the bytes that a board sends.

The result contains the format and the rate of the frames, the health of the channels, the content of a device file, and
the settings that are still missing.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from isocharge.common.errors import ChargeError, IsochargeError
from isocharge.serve.examination.board_health import (
    ChannelHealth,
    channel_count_sentences,
    channel_sentences,
    held_press_sentences,
    measure_channel_health,
    transmission_sentences,
    unit_sentences,
)
from isocharge.serve.examination.held_press import find_held_press
from isocharge.serve.examination.listening import BAUDS, Capture, ReceivedData, listen, read_frames
from isocharge.serve.examination.press_detector import touch_sentence
from isocharge.serve.examination.proposal import propose, recognised_frames, unit_of
from isocharge.serve.live.device import ANY_BOARD, device_from_table
from isocharge.serve.port.serial_line import Request
from isocharge.serve.recognition.framing import INTACT_SHARE
from isocharge.serve.signal_chain.channels import Channels, Gain, GainRule, channel_index
from isocharge.serve.signal_chain.stage import Device, Setup


@dataclass(frozen=True)
class Examination:
    """The result of a port check.

    Attributes:
        url: The port.
        baud: Bits per second at which most bytes were frames.
        format: Description of the format of the frames, for the user.
        bytes_seen: Number of bytes that were received.
        seconds: Time of listening, s.
        rate_Hz: Frames per second, Hz.
        good: Number of intact frames.
        bad: Number of damaged frames.
        lost: Number of lost frames according to the frame numbers; None if frames have no numbers.
        repeated: Number of repeated frames according to the frame numbers; None if frames have no numbers.
        device_clock: Whether the frames contain the time of a clock of the device.
        unit: Unit of the channels. The unit is "pC" if the charge of one unit is known. Otherwise, it is the unit that
            the channels seem to have: "pC", "counts", "V", or a unit in their names, such as "nC".
        channels: Health of each channel that is used; empty without frames.
        unused: Channels that no electrode uses.
        held: Sentence about a press that was held during the check; empty if there was none.
        touch: Sentence about a touch while the film should be at rest; empty if there was none.
        missing: One sentence for each setting or property that is missing before contacts can be computed.
        missing_for_held_presses: One sentence for each setting or property without which the force of a held press
            seems to change. Contacts can be computed without these settings.
        device: Content of the given device file, or of a proposed device file. A proposed device file is empty if no
            frames were received.
    """

    url: str
    baud: int
    format: str
    bytes_seen: int
    seconds: float
    rate_Hz: float
    good: int
    bad: int
    lost: int | None = None
    repeated: int | None = None
    device_clock: bool = False
    unit: str = "pC"
    channels: tuple[ChannelHealth, ...] = ()
    unused: tuple[str, ...] = ()
    held: str = ""
    touch: str = ""
    missing: tuple[str, ...] = ()
    missing_for_held_presses: tuple[str, ...] = ()
    device: Mapping[str, Any] = field(default_factory=dict)


def examine(
    url: str,
    *,
    bauds: tuple[int, ...] = BAUDS,
    seconds: float = 5.0,
    device: Device = ANY_BOARD,
    electrodes: tuple[str, ...] = (),
    gain: Mapping[str, Any] | None = None,
    request: Request | None = None,
    wait: float = 0.0,
) -> Examination:
    """Listen on a port, and examine what the board sends.

    The film must not be touched during the check, except for a single press that is held for some seconds.

    Args:
        url: Device path or URL, as `Port` takes it.
        bauds: Baud rates to try, bit/s.
        seconds: Time of listening, s.
        device: Settings of the board; by default the format of the frames is recognised.
        electrodes: Electrodes of the model that will be used; empty for any model.
        gain: Keys of the section `[gain]`, if there is no device file.
        request: Request that the board needs for each frame; by default the request in the device file.
        wait: Time to wait until the port can be opened, s.

    Returns:
        The result of the check: the frames, the channels, the missing settings, and the content of a device file.

    Raises:
        PortError: If the port cannot be opened.
        InputError: If the port is a file.
        DeviceError: If the gain is not valid, or is stated for other electrodes.
    """

    def has_frames(received_at_baud: ReceivedData) -> bool:
        """Return whether most of the bytes belong to intact frames, which shows that the baud rate is right."""
        settings = _settings_of(received_at_baud, device)
        return read_frames(received_at_baud, settings).intact_share >= INTACT_SHARE

    received = listen(url, bauds, seconds, request or device.request, has_frames, wait)
    return examine_received(received, device=device, electrodes=electrodes, gain=gain)


def _settings_of(received: ReceivedData, device: Device) -> Device:
    """Return the settings of the board. For `ANY_BOARD`, the format of the frames is recognised from the bytes."""
    if device is not ANY_BOARD:
        return device
    return device_from_table({"frames": recognised_frames(received)}, "board")


def examine_received(
    received: ReceivedData,
    *,
    device: Device = ANY_BOARD,
    electrodes: tuple[str, ...] = (),
    gain: Mapping[str, Any] | None = None,
) -> Examination:
    """Examine the bytes that were received from a port.

    The film must not have been touched during this time, except for a single press that was held.

    Args:
        received: The bytes, with the port and the time of listening.
        device: Settings of the board; by default the format of the frames is recognised and a device file is proposed.
        electrodes: Electrodes of the model that will be used; empty for any model.
        gain: Keys of the section `[gain]`, if there is no device file.

    Returns:
        The result of the check: the frames, the channels, the missing settings, and the content of a device file.

    Raises:
        DeviceError: If the gain is not valid, or is stated for other electrodes.
    """
    # Without a device file (`ANY_BOARD`), the format of the frames and the settings are proposed from the bytes.
    is_proposed = device is ANY_BOARD
    device = _settings_of(received, device)
    capture = read_frames(received, device)
    missing = list(transmission_sentences(capture))
    counts = capture.parser.counts
    examination = Examination(
        url=received.url,
        baud=received.baud,
        format=capture.parser.format,
        bytes_seen=received.bytes_seen,
        seconds=received.seconds,
        rate_Hz=capture.rate_Hz,
        good=len(capture.frames),
        bad=counts.crc_errors + counts.malformed,
        missing=tuple(missing),
        device={} if is_proposed else dict(device.table),
    )
    if not capture.frames:
        return examination

    values, times_s = capture.values()
    held_press = find_held_press(values, times_s)
    is_rest = times_s < held_press.rest_end_s
    rest_values = values[is_rest]
    rest_times_s = times_s[is_rest]

    # Find the channel of each electrode. Without a device file, the settings of the board are proposed first.
    table = dict(device.table)
    if is_proposed:
        table = propose(capture, rest_values, device.table["frames"], electrodes, gain or {})
        electrodes = electrodes or tuple(table.get("channels", {}))
        # Without a stated gain, the proposed section `[gain]` is left out here, so that the values are measured in the
        # unit in which the board sends them.
        device = device_from_table({key: value for key, value in table.items() if gain or key != "gain"}, "board")
        Gain(Setup(electrodes, device))  # raises an error for the numbers of other electrodes
    electrode_at_position = electrodes_by_position(capture, device, electrodes)

    # Measure the channels at rest. If no gain is stated, the values remain as the board sends them.
    gain_rule = device.rule(GainRule)
    unit = "pC" if gain_rule is not None else unit_of(capture, electrode_at_position)
    charges = rest_values[:, list(electrode_at_position)]  # shape (n, n_electrode)
    channels = []
    for (position, electrode), charge in zip(electrode_at_position.items(), charges.T, strict=True):
        if gain_rule is not None:
            with np.errstate(over="ignore"):  # an unusable value may become infinite, and is ignored later
                charge[:] = gain_rule.charge_pC(electrode, charge)
        name = capture.names[position]
        channels.append(measure_channel_health(name, electrode, charge, rest_times_s, capture.rate_Hz))

    # A touch of the film would falsify the measurement at rest. The offset, the noise and the drift of a pressed film
    # say nothing about the board.
    touch = touch_sentence([channel.name for channel in channels], charges, rest_times_s, unit)
    if touch:
        missing.insert(0, touch)
    missing += channel_count_sentences(capture, device, len(channels), electrodes)
    missing += unit_sentences(unit)
    if not touch:
        missing += channel_sentences(channels, unit, device)
    if held_press.tau_s is not None:
        leak = {"tau_s": held_press.tau_s} | table.get("leak", {})  # keeps settings that the device file already has
        table = {**table, "leak": leak}
    first_frame = capture.frames[0]
    is_numbered = first_frame.seq is not None
    return replace(
        examination,
        lost=counts.lost if is_numbered else None,
        repeated=counts.repeated if is_numbered else None,
        device_clock=first_frame.t_us is not None,
        unit=unit,
        channels=tuple(channels),
        unused=tuple(name for position, name in enumerate(capture.names) if position not in electrode_at_position),
        held=held_press.description,
        touch=touch,
        missing=tuple(missing),
        missing_for_held_presses=tuple(held_press_sentences(capture, device, held_press)),
        device=table,
    )


def electrodes_by_position(capture: Capture, device: Device, electrodes: tuple[str, ...]) -> dict[int, str]:
    """Return a dictionary from the position of each channel in the frame to the name of its electrode.

    The section `[channels]` of the device file states the channel of each electrode. Electrodes whose channel is
    missing in the frames are left out. Without the section `[channels]`, the channels are assigned by name or by order,
    as in a stream. If this assignment is not possible, each channel counts as an electrode with the name of the
    channel.

    Args:
        capture: The frames, at least one.
        device: Settings of the board. `channels` contains the name of the channel of each electrode.
        electrodes: Electrodes of the model. Without a model, the electrodes are those for which `[gain]` states
            numbers.
    """
    last_frame = capture.frames[-1]
    if device.channels:
        position_of_electrode = {name: channel_index(channel, last_frame) for name, channel in device.channels.items()}
        return {position: name for name, position in position_of_electrode.items() if position is not None}

    # Without a model, use the names in the section [gain]. Each of its settings is one number for all electrodes, or a
    # dictionary with a number for each electrode.
    names = electrodes
    gain_rule = device.rule(GainRule)  # the section [gain]
    if gain_rule is not None and not names:
        by_electrode = [setting for setting in (gain_rule.offset, gain_rule.pC_per_unit) if isinstance(setting, dict)]
        names = tuple(by_electrode[0]) if by_electrode else ()

    # Find the channels by name or by order, whatever unit their names state. There is no result if no names are known,
    # if there are more or fewer channels than names, or if the names of the channels are not clear.
    with suppress(ChargeError):  # a stream reports this error when it begins
        positions = Channels(Setup(names), any_unit=True).indices_by_name_or_order(last_frame)
        if positions:
            return dict(zip(positions, names, strict=True))
    return dict(enumerate(capture.names))  # no electrodes are known, so each channel counts as one


def port_lines() -> Iterator[str]:
    """Listen on each serial port of this machine for one second, and yield a line for each port.

    The line contains the name of the port and describes the frames that arrived. If no intact frames arrived, the line
    names the first missing setting. If the port cannot be read, the line contains the error message.
    """
    from serial.tools import list_ports  # imported here, because programs that open no port need not wait for it

    for port in sorted(list_ports.comports()):
        try:
            examination = examine(port.device, seconds=1.0)
            result = f"{examination.format}, {examination.rate_Hz:.0f} frames/s at {examination.baud} baud"
            if not examination.good:
                result = examination.missing[0]  # a sentence
        except IsochargeError as error:
            result = str(error)
        yield f"{port.device} ({port.description}): {result}"
