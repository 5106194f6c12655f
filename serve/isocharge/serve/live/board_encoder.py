"""Encoder of the frames that the board of a device file sends. It is the inverse of the path from frames to charges."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from isocharge.common.errors import DeviceError
from isocharge.serve.frames.binary import MAX_CHARGES, encode_frame
from isocharge.serve.frames.formats import AutoFrames, BinaryFrames, TextFrames
from isocharge.serve.frames.frame import SATURATED_BIT, SEQ, SEQ_MODULUS, T_US_MODULUS, TIMES_US, Frame
from isocharge.serve.frames.frame_field import Field
from isocharge.serve.frames.frame_layout import DATAGRAM, FrameLayout
from isocharge.serve.frames.text_lines import TEXT_FORMATS, encode_text
from isocharge.serve.live.device import Device
from isocharge.serve.live.reading_stream import ChannelPicker, channel_number
from isocharge.serve.signal_chain.stages import Gain

BINARY = "binary"
"""Notation of the binary frame of isocharge."""

CSV = "csv"
"""Notation of text in which channels have no names."""

PAIRS = "pairs"
"""Notation of text in which channels have names."""

FRAMES_TO_RECOGNISE = 8
"""Number of frames after which a parser has recognised the layout of the frames."""


class BoardFrames(NamedTuple):
    """Frames that a board sends.

    Attributes:
        names: Names of the channels; empty if the frames contain no names.
        channels: Field of each channel, which determines the range of its values.
        encode: Function from a frame, with one value for each channel, to its bytes.
        seq_modulus: Value at which the frame counter wraps to 0.
        t_us_modulus: Time at which the clock wraps to 0, us.
    """

    names: tuple[str, ...]
    channels: tuple[Field, ...]
    encode: Callable[[Frame], bytes]
    seq_modulus: int = SEQ_MODULUS
    t_us_modulus: int = T_US_MODULUS


class BoardEncoder:
    """Encodes charges as the frames of the board that a device file describes.

    The charge of an electrode is divided by its gain, and the offset of the board is added. The result is the value of
    the channel that the device file assigns to the electrode. The other channels of the frame are 0. A value outside
    the range of its field is set to the limit of the field, as in a converter, and the frame gets the flag `saturated`
    if the frame has flags.

    Attributes:
        seq_modulus: Value at which the frame counter of the board wraps to 0.
        t_us_modulus: Time at which the clock of the board wraps to 0, us.
        request: Request that the board answers with a frame; None for a board that sends frames by itself.
        clipped: Number of frames with a value that was set to the limit of its field.
    """

    def __init__(self, device: Device, electrodes: tuple[str, ...], notation: str | None = None) -> None:
        """Assign the electrodes to the channels, and check that a frame without charge can be encoded and read.

        Args:
            device: Settings of the board.
            electrodes: Names of the electrodes, in the order of the charges.
            notation: Notation of frames that the device file does not describe: "binary", or a notation of
                `encode_text`. By default it is chosen so that it fits the device file.

        Raises:
            DeviceError: If the device file describes datagrams, is for other electrodes, states an offset that its
                field cannot contain, or does not fit the notation.
            ChargeError: If there is no channel for an electrode.
        """
        self._frames = _frames_of(device, electrodes, notation)
        chain = device.chain(electrodes)
        picker = ChannelPicker(electrodes, device.channels, "the sensor", device.where)
        zeros = (0.0,) * len(self._frames.channels)
        self._gain = Gain(chain.gain_pC, chain.zero)
        self._positions = picker.positions(Frame(0, 0, zeros, names=self._frames.names))
        self.seq_modulus = self._frames.seq_modulus
        self.t_us_modulus = self._frames.t_us_modulus
        self.request = device.request
        self.clipped = 0
        self._check_offsets(device.where, electrodes)
        self._check_reading(device, electrodes)

    def _check_offsets(self, where: str, electrodes: tuple[str, ...]) -> None:
        """Raise DeviceError if a channel cannot contain the value that the board sends without charge.

        Args:
            where: Name of the device file, for messages.
            electrodes: Names of the electrodes.
        """
        offsets = self._gain.revert(np.zeros(len(electrodes))).tolist()
        for electrode, position, offset in zip(electrodes, self._positions, offsets, strict=True):
            channel = self._frames.channels[position]
            if not channel.holds(offset):
                raise DeviceError(
                    f"{where}: gain: without charge, electrode {electrode} has the value {offset:g}, which does not "
                    f"fit its channel {channel.name} of the type {channel.kind}; correct gain.offset or the type"
                )

    def _check_reading(self, device: Device, electrodes: tuple[str, ...]) -> None:
        """Raise DeviceError if the parser of the device file does not read frames without charge."""
        parser = device.parser()
        no_charge = (0.0,) * len(electrodes)
        for seq in range(FRAMES_TO_RECOGNISE):
            parser.feed(self.encode(Frame(seq, 1000 * seq, no_charge)))
        if parser.counts.frames == 0:
            raise DeviceError(
                f"{device.where}: frames: the frames that the virtual sensor sends cannot be read with this section; "
                "describe the frames, or remove the section"
            )

    def encode(self, frame: Frame) -> bytes:
        """Return the bytes that the board sends for a frame whose values are charges, pC."""
        board_values = self._gain.revert(np.array(frame.values)).tolist()
        channels = self._frames.channels
        values = [0.0] * len(channels)
        is_clipped = False
        for position, value in zip(self._positions, board_values, strict=True):
            values[position] = channels[position].limited(value)
            is_clipped = is_clipped or not channels[position].holds(value)
        flags = frame.flags
        if is_clipped:
            self.clipped += 1
            flags |= SATURATED_BIT
        return self._frames.encode(Frame(frame.seq, frame.t_us, tuple(values), flags, self._frames.names))


def _frames_of(device: Device, electrodes: tuple[str, ...], notation: str | None) -> BoardFrames:
    """Return the frames that the board of a device file sends.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes.
        notation: Notation of frames that the device file does not describe; None for a notation that fits.

    Raises:
        DeviceError: If the device file describes datagrams, has a channel with too large a number, or does not fit the
            notation.
    """
    frames = device.frames
    if isinstance(frames, FrameLayout):
        _check_notation(device.where, notation, ())
        if frames.framing == DATAGRAM:
            raise DeviceError(
                f'{device.where}: frames.framing: a pseudo-terminal has no datagrams, got "{DATAGRAM}"; choose the '
                'framing "sync", "cobs", "slip" or "hdlc"'
            )
        names = tuple(channel.name for channel in frames.channels)
        return BoardFrames(names, frames.channels, frames.encode, frames.seq_modulus, frames.t_us_modulus)

    if isinstance(frames, TextFrames) and frames.columns:
        _check_notation(device.where, notation, (CSV,))
        names = tuple(name for name in frames.columns if name not in (SEQ, *TIMES_US))
        channels = tuple(Field("f64", name) for name in names)
        return BoardFrames(names, channels, partial(_encode_row, frames.columns))

    # The device file does not describe the channels of the frames. The format determines the possible notations.
    names, count = _channel_names(device, electrodes)
    fitting_notation = PAIRS if device.channels and names else BINARY
    fitting_notations = (BINARY, *TEXT_FORMATS)
    if isinstance(frames, BinaryFrames):
        fitting_notation = BINARY
        fitting_notations = (BINARY,)
    elif not isinstance(frames, AutoFrames):
        fitting_notation = PAIRS if names else CSV
        fitting_notations = tuple(TEXT_FORMATS)
    _check_notation(device.where, notation, fitting_notations)
    chosen_notation = notation or fitting_notation
    if chosen_notation == BINARY:
        binary_channels = (Field("f32", BINARY),) * count
        return BoardFrames((), binary_channels, encode_frame)
    frame_names = () if chosen_notation == CSV else names
    text_channels = (Field("f64", chosen_notation),) * count
    encode = partial(encode_text, notation=chosen_notation)
    return BoardFrames(frame_names, text_channels, encode)


def _check_notation(where: str, notation: str | None, fitting_notations: tuple[str, ...]) -> None:
    """Raise DeviceError if a notation is given that does not fit the device file.

    Args:
        where: Name of the device file, for messages.
        notation: The notation; None if none is given.
        fitting_notations: Notations that fit the device file; empty if the device file describes the frames.
    """
    if notation is None or notation in fitting_notations:
        return
    if not fitting_notations:
        raise DeviceError(
            f"{where}: frames: expected no notation, because the file describes the frames, got {notation}"
        )
    expected = f"a notation that fits the device file ({', '.join(fitting_notations)})"
    raise DeviceError(f"{where}: frames: expected {expected}, got {notation}")


def _channel_names(device: Device, electrodes: tuple[str, ...]) -> tuple[tuple[str, ...], int]:
    """Return the names and the number of the channels that the electrodes of a device file use.

    The names are empty if the device file states only the numbers of the channels.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes.

    Raises:
        DeviceError: If the number of a channel is larger than the number of values in a frame can be.
    """
    names = tuple(dict.fromkeys(device.channels.get(electrode, electrode) for electrode in electrodes))
    numbers = [channel_number(name) for name in names]
    if None in numbers:
        return names, len(names)
    used_numbers = [number for number in numbers if number is not None]
    count = max(len(electrodes), *used_numbers)
    if count > MAX_CHARGES:
        raise DeviceError(f"{device.where}: channels: expected numbers from 1 to {MAX_CHARGES}, got {count}")
    return (), count


def _encode_row(columns: tuple[str, ...], frame: Frame) -> bytes:
    """Return a frame as a line of a CSV.

    Args:
        columns: Names of the columns, in their order: `seq`, clocks and channels.
        frame: The frame, with a value for each channel.
    """
    values = dict(zip(frame.names, frame.values, strict=True))
    cells = []
    for name in columns:
        if name == SEQ:
            cells.append(str(frame.seq))
        elif name in TIMES_US:
            cells.append(repr((frame.t_us or 0) / TIMES_US[name]))
        else:
            cells.append(f"{values[name]:.7g}")
    return (",".join(cells) + "\n").encode()
