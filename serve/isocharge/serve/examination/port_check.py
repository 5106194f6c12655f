"""The port check, which examines the bytes that a board sends.

The result contains the format and the rate of the frames, the health of the channels, the content of a device file, and
the settings that are still missing.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import IsochargeError
from isocharge.common.printable_text import printable
from isocharge.serve.examination.channel_health import ChannelHealth, measure_channel_health
from isocharge.serve.examination.current_press import find_current_press
from isocharge.serve.examination.held_press import HeldPress, find_held_press
from isocharge.serve.examination.listening import BAUDS, Capture, ReceivedData, listen, read_frames
from isocharge.serve.examination.missing import CLEAN_SHARE, held_press_sentences, missing_sentences
from isocharge.serve.examination.press_detector import find_touch
from isocharge.serve.examination.proposal import Proposal, propose, unit_of
from isocharge.serve.frames.frame import Frame
from isocharge.serve.live.device import ANY_BOARD, Device, device_from_table
from isocharge.serve.live.stream import ReadingStream
from isocharge.serve.port.serial_line import Request, without_telnet
from isocharge.serve.port.source import has_speed
from isocharge.serve.recognition.recognise import recognise
from isocharge.serve.signal_chain.channels import channel_index
from isocharge.serve.signal_chain.gain import Gain, GainRule
from isocharge.serve.signal_chain.tare import TareRule

RIGHT_BAUD_SHARE = 0.5
"""Smallest share of bytes in good frames at the right baud rate, dimensionless."""

PRESS_MARGIN_S = 0.2
"""Time before the beginning of a held press that does not count as rest, s, because the force is already rising."""


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
        unit: Unit of the channels: "pC", or "counts", "V" or a unit in their names, such as "nC", if the charge of one
            unit is not known.
        channels: Health of each channel that is used; empty without frames.
        unused: Channels that no electrode uses.
        held: Sentence about a press that was held during the check; empty if there was none.
        touch: Sentence about a touch while the film should be at rest; empty if there was none.
        missing: One sentence for each setting or property that is missing before contacts can be computed.
        missing_for_held_presses: One sentence for each setting or property without which the force of a held press
            seems to change. Touches are computed without them.
        works: Whether a film at rest can be tared with this device file. It is false after a touch.
        device: Content of the given device file, or of a proposed device file. It is empty without frames, and has no
            offsets after a touch.
    """

    url: str
    baud: int
    format: str
    bytes_seen: int
    seconds: float
    rate_Hz: float
    good: int
    bad: int
    lost: int | None
    repeated: int | None
    device_clock: bool
    unit: str
    channels: tuple[ChannelHealth, ...]
    unused: tuple[str, ...]
    held: str
    touch: str
    missing: tuple[str, ...]
    missing_for_held_presses: tuple[str, ...]
    works: bool
    device: Mapping[str, Any]


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
        return _intact_share(received_at_baud, device) > RIGHT_BAUD_SHARE

    received = listen(url, bauds, seconds, request or device.request, has_frames, wait)
    return examine_received(received, device=device, electrodes=electrodes, gain=gain)


def _intact_share(received: ReceivedData, device: Device) -> float:
    """Return the share of the bytes that belong to frames. A large share shows that the baud rate is right.

    Args:
        received: The bytes.
        device: Settings of the board. For `ANY_BOARD`, the format of the frames is recognised from the bytes.
    """
    if device is ANY_BOARD:
        frames = recognise(received.data, received.span_s, are_datagrams=received.are_datagrams)
        device = device_from_table({"frames": frames or {}}, "board")
    return read_frames(received, device).intact_share


def _uses_telnet(received: ReceivedData, device: Device, intact_share: float) -> bool:
    """Return whether a serial server uses the telnet protocol, so that more bytes are frames without its escapes.

    Args:
        received: The bytes.
        device: Settings of the board, or `ANY_BOARD`.
        intact_share: Share of the bytes that belong to frames.
    """
    data = b"".join(received.data)
    unescaped = without_telnet(data)
    if has_speed(received.url) or unescaped == data or intact_share >= CLEAN_SHARE:
        return False
    chunks = [chunk._replace(data=without_telnet(chunk.data)) for chunk in received.chunks]
    return _intact_share(replace(received, chunks=chunks), device) > intact_share


def _proposed_device(proposal: Proposal, *, is_gain_stated: bool) -> Device:
    """Return the settings of a proposed device file.

    Args:
        proposal: The content of the file, and the names of the electrodes.
        is_gain_stated: Whether the user has stated the gain. Otherwise the settings leave out the proposed section
            `[gain]`, so that the values remain as the board sends them.

    Raises:
        DeviceError: If the gain is not valid, or is stated for other electrodes.
    """
    table = {key: value for key, value in proposal.table.items() if is_gain_stated or key != "gain"}
    device = device_from_table(table, "board")
    Gain(device.setup(proposal.electrodes))  # raises an error for the numbers of other electrodes
    return device


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
    given_device = device
    if is_proposed:
        proposal = propose(received, electrodes, gain or {})
        device = _proposed_device(proposal, is_gain_stated=bool(gain))
    else:
        proposal = Proposal(dict(device.table), electrodes)

    # Read the frames, and examine the channels in the time before a held press. With a gain, all values are converted
    # to pC.
    capture = read_frames(received, device)
    unit = "pC" if device.rule(GainRule) is not None else unit_of(capture)
    electrode_at_position = electrodes_by_position(capture, device)
    unused_channels = tuple(
        name for position, name in enumerate(capture.names) if position not in electrode_at_position
    )
    find_press = find_current_press if device.front_end == "current" else find_held_press
    held_press = find_press(*capture.values()) if capture.frames else None
    rest_end_s = math.inf if held_press is None else held_press.begin_s  # the film is at rest until a held press begins
    channels = tuple(_measure_channels(capture, device, electrode_at_position, rest_end_s))
    touch_sentence = _touch_sentence(capture, device, electrode_at_position, held_press, unit)

    # Complete the device file, and test whether the film can be tared with its settings. Proposed offsets that were
    # measured on a touched film are wrong.
    table = _completed_table(proposal.table, held_press, without_offsets=is_proposed and bool(touch_sentence))
    electrode_names = proposal.electrodes or tuple(electrode_at_position.values())
    is_at_rest = bool(electrode_at_position) and not touch_sentence
    can_be_tared = is_at_rest and _can_be_tared(received, table, electrode_names)

    # The first frame shows whether the frames have a number and a time. Without frames, both are None.
    first_frame = capture.frames[0] if capture.frames else Frame(None, None, ())
    is_numbered = first_frame.seq is not None
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
        lost=capture.gaps.lost if is_numbered else None,
        repeated=capture.gaps.repeated if is_numbered else None,
        device_clock=first_frame.t_us is not None,
        unit=unit,
        channels=channels,
        unused=unused_channels,
        held="" if held_press is None else held_press.description,
        touch=touch_sentence,
        missing=(),
        missing_for_held_presses=tuple(held_press_sentences(capture, device, held_press)),
        works=can_be_tared,
        device=table,
    )
    uses_telnet = _uses_telnet(received, given_device, capture.intact_share)
    missing = missing_sentences(examination, capture, device, proposal.electrodes, uses_telnet=uses_telnet)
    return replace(examination, missing=tuple(missing))


def _completed_table(
    table: Mapping[str, Any], held_press: HeldPress | None, *, without_offsets: bool
) -> dict[str, Any]:
    """Return the content of a device file, completed with the sections that follow from a held press.

    Args:
        table: Sections of the device file by name. They take precedence over the sections of the press.
        held_press: The press, with sections that correct the change of its charge; None if no press was held.
        without_offsets: Whether the key `offset` of the section `[gain]` is removed. Offsets that were measured on a
            touched film are wrong.

    Returns:
        The completed sections by name. The given table is not changed.
    """
    completed_table = dict(table)
    if held_press is not None:
        for name, section in held_press.sections.items():
            completed_table.setdefault(name, section)  # keeps a section that the device file already has
    if without_offsets and "gain" in completed_table:
        gain = completed_table.pop("gain")
        remaining_gain = {key: value for key, value in gain.items() if key != "offset"}
        if remaining_gain:  # an empty section is not valid
            completed_table["gain"] = remaining_gain
    return completed_table


def _touch_sentence(
    capture: Capture, device: Device, electrode_at_position: Mapping[int, str], held_press: HeldPress | None, unit: str
) -> str:
    """Return a sentence if the film was touched before any held press; otherwise, return an empty text.

    The film should be at rest before a held press.

    Args:
        capture: The frames.
        device: Settings of the board, with its gain.
        electrode_at_position: Name of the electrode by the position of its channel in the frame.
        held_press: The held press; None if there was none.
        unit: Unit of the channels: "pC", "counts", "V", or a unit in their names, such as "nC".
    """
    if not capture.frames or not electrode_at_position:
        return ""
    # The last moments before a held press do not count as rest, because the force is already rising.
    rest_end_s = math.inf if held_press is None else held_press.begin_s - PRESS_MARGIN_S
    charges, times_s = _rest_charges(capture, device, electrode_at_position, rest_end_s)
    touch = find_touch(charges, times_s, unit_is_pC=unit == "pC")
    if touch is None:
        return ""

    # The charges have one column for each electrode. Find the channel of the column that was touched.
    positions_in_frame = list(electrode_at_position)
    position_in_frame = positions_in_frame[touch.column]
    name = printable(capture.names[position_in_frame])
    return (
        f"an untouched film: channel {name} changes by {touch.total_change:.4g} {unit} about {touch.time_s:.1f} s "
        "after the first frame, as under a touch; take the finger away, and try again"
    )


def _can_be_tared(received: ReceivedData, table: Mapping[str, Any], electrodes: tuple[str, ...]) -> bool:
    """Return whether a tare succeeds with a device file. A tare is a measurement of the charges at rest.

    There are four other cases.

    - If there are no frames, the result is false.
    - If reading the frames raises an error, the result is false.
    - If the device file switches the tare off, the result is true.
    - If there are fewer than twice as many frames as a tare needs, the result is true. The frames then do not show
      that a tare would fail.

    Args:
        received: Bytes that the board sent while the film was at rest.
        table: Content of the device file.
        electrodes: Electrodes of the model.
    """
    frame_count = 0
    try:
        # Process the bytes again as a reader of the board does, until a frame has a tare.
        device = device_from_table(table, "board")
        tare_rule = device.rule(TareRule)
        stream = ReadingStream(electrodes, device)
        for chunk in received.chunks:
            for frame in stream.frames(chunk):
                frame_count += 1
                if frame.tare_pC is not None or tare_rule is None:
                    return True
    except IsochargeError:
        return False

    if tare_rule is None or frame_count == 0:  # without a tare rule, the first frame has ended the loop
        return False
    # No frame has a tare. If there were few frames, this does not show that a tare fails.
    return frame_count < 2 * tare_rule.frames


def electrodes_by_position(capture: Capture, device: Device) -> dict[int, str]:
    """Return the name of each electrode, by the position of its channel in the frame.

    If the device file has no section `[channels]`, every channel is an electrode with the name of the channel.
    Electrodes whose channel is missing in the frames are left out.

    Args:
        capture: The frames. Without frames, the result is empty.
        device: Settings of the board. `channels` contains the name of the channel of each electrode.
    """
    if not device.channels or not capture.frames:
        return dict(enumerate(capture.names))
    electrode_at_position = {}
    for electrode, channel in device.channels.items():
        position = channel_index(channel, capture.frames[-1])
        if position is not None:
            electrode_at_position[position] = electrode
    return electrode_at_position


def _measure_channels(
    capture: Capture, device: Device, electrode_at_position: Mapping[int, str], rest_end_s: float
) -> Iterator[ChannelHealth]:
    """Yield the health (offset, noise, drift and hum) of each channel that belongs to an electrode.

    Args:
        capture: The frames.
        device: Settings of the board, with its gain.
        electrode_at_position: Name of the electrode by the position of its channel in the frame.
        rest_end_s: Time until which the film is at rest, s from the first frame. Later frames are left out.
    """
    if not capture.frames:
        return
    charges_pC, times_s = _rest_charges(capture, device, electrode_at_position, rest_end_s)
    for position, charge_pC in zip(electrode_at_position, charges_pC.T, strict=True):
        yield measure_channel_health(capture.names[position], charge_pC, times_s, capture.rate_Hz)


def _rest_charges(
    capture: Capture, device: Device, electrode_at_position: Mapping[int, str], rest_end_s: float
) -> tuple[Array, Array]:
    """Return the charges of the frames in which the film is at rest, and the times of these frames.

    Args:
        capture: The frames.
        device: Settings of the board, with its gain.
        electrode_at_position: Name of the electrode by the position of its channel in the frame.
        rest_end_s: Time until which the film is at rest, s from the first frame. Later frames are left out.

    Returns:
        Two arrays. The first array contains the charges, shape (n, n_electrode), with the columns in the order of
        `electrode_at_position`. Their unit is pC if the gain is known, and the unit of the board otherwise. The second
        array contains the times since the first frame, shape (n,), s.
    """
    values, times_s = capture.values()  # shape (frames, channels) and shape (frames,)
    is_rest = times_s < rest_end_s
    positions_in_frame = list(electrode_at_position)
    charges = values[is_rest][:, positions_in_frame]
    gain = device.rule(GainRule)
    if gain is not None:
        for column, electrode in enumerate(electrode_at_position.values()):
            with np.errstate(over="ignore"):  # an unusable value may become infinite, and is ignored later
                charges[:, column] = gain.charge_pC(electrode, charges[:, column])
    return charges, times_s[is_rest]
