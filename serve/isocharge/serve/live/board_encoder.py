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

        The two checks at the end encode frames. They therefore follow after all attributes are set.

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
        self._gain = Gain(chain.gain_pC, chain.zero)

        # All frames of the board have the same channels, so that one frame determines the positions of the electrodes.
        picker = ChannelPicker(electrodes, device.channels, "the sensor", device.where)
        zeros = (0.0,) * len(self._frames.channels)
        frame_of_zeros = Frame(0, 0, zeros, names=self._frames.names)
        self._positions = picker.positions(frame_of_zeros)

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
        no_charge_pC = np.zeros(len(electrodes))
        offsets = self._gain.revert(no_charge_pC).tolist()
        for electrode, position, offset in zip(electrodes, self._positions, offsets, strict=True):
            channel = self._frames.channels[position]
            if not channel.holds(offset):
                raise DeviceError(
                    f"{where}: gain: without charge, electrode {electrode} has the value {offset:g}, which does not "
                    f"fit its channel {channel.name} of the type {channel.kind}; correct gain.offset or the type"
                )

    def _check_reading(self, device: Device, electrodes: tuple[str, ...]) -> None:
        """Raise DeviceError if the parser of the device file does not read frames without charge.

        Args:
            device: Settings of the board.
            electrodes: Names of the electrodes.
        """
        parser = device.parser()
        no_charge = (0.0,) * len(electrodes)
        # A parser may need several frames to recognise their layout.
        for seq in range(FRAMES_TO_RECOGNISE):
            t_us = 1000 * seq
            encoded_frame = self.encode(Frame(seq, t_us, no_charge))
            parser.feed(encoded_frame)
        if parser.counts.frames == 0:
            raise DeviceError(
                f"{device.where}: frames: the frames that the virtual sensor sends cannot be read with this section; "
                "describe the frames, or remove the section"
            )

    def encode(self, frame: Frame) -> bytes:
        """Return the bytes that the board sends for a frame whose values are charges, pC.

        A value outside the range of its channel is set to the limit of the range. The frame then gets the flag
        `saturated` and is counted in `clipped`. Channels without an electrode are 0.

        Args:
            frame: A frame with one charge for each electrode, in the order of the electrodes.
        """
        board_values = self._gain.revert(np.array(frame.values)).tolist()
        channels = self._frames.channels
        values = [0.0] * len(channels)
        is_clipped = False
        for position, value in zip(self._positions, board_values, strict=True):
            channel = channels[position]
            values[position] = channel.limited(value)
            if not channel.holds(value):
                is_clipped = True
        flags = frame.flags
        if is_clipped:
            self.clipped += 1
            flags |= SATURATED_BIT
        return self._frames.encode(Frame(frame.seq, frame.t_us, tuple(values), flags, self._frames.names))


def _frames_of(device: Device, electrodes: tuple[str, ...], notation: str | None) -> BoardFrames:
    """Return the names, the fields and the encoder of the frames that the board of a device file sends.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes.
        notation: Notation of frames whose channels the device file does not describe: "binary", or a notation of
            `encode_text`; None for the default notation of the device file.

    Raises:
        DeviceError: If the device file describes datagrams, has a channel with too large a number, or does not fit the
            notation.
    """
    # The device file describes the channels as a layout of binary fields, or as the columns of a CSV.
    frames = device.frames
    if isinstance(frames, FrameLayout):
        no_notations = ()
        _check_notation(device.where, notation, no_notations)
        return _layout_frames(frames, device.where)
    if isinstance(frames, TextFrames) and frames.columns:
        _check_notation(device.where, notation, (CSV,))
        return _column_frames(frames.columns)

    # The device file does not describe the channels, so that they follow from the electrodes and the notation.
    channel_names, n_channel = _channel_names(device, electrodes)
    default_notation, fitting_notations = _fitting_notations(device, has_channel_names=bool(channel_names))
    _check_notation(device.where, notation, fitting_notations)
    chosen_notation = notation or default_notation
    if chosen_notation == BINARY:
        binary_channels = (Field("f32", BINARY),) * n_channel
        return BoardFrames((), binary_channels, encode_frame)
    frame_names = () if chosen_notation == CSV else channel_names
    text_channels = (Field("f64", chosen_notation),) * n_channel
    encode = partial(encode_text, notation=chosen_notation)
    return BoardFrames(frame_names, text_channels, encode)


def _layout_frames(layout: FrameLayout, where: str) -> BoardFrames:
    """Return the frames of a layout of binary fields that a device file describes.

    Args:
        layout: The layout.
        where: Name of the device file, for messages.

    Raises:
        DeviceError: If the frames are datagrams.
    """
    if layout.framing == DATAGRAM:
        raise DeviceError(
            f'{where}: frames.framing: a pseudo-terminal has no datagrams, got "{DATAGRAM}"; choose the '
            'framing "sync", "cobs", "slip" or "hdlc"'
        )
    names = tuple(channel.name for channel in layout.channels)
    return BoardFrames(names, layout.channels, layout.encode, layout.seq_modulus, layout.t_us_modulus)


def _column_frames(columns: tuple[str, ...]) -> BoardFrames:
    """Return the frames of a CSV. Its columns contain the frame number, clocks, and the values of the channels."""
    names = tuple(name for name in columns if name not in (SEQ, *TIMES_US))
    channels = tuple(Field("f64", name) for name in names)
    return BoardFrames(names, channels, partial(_encode_row, columns))


def _fitting_notations(device: Device, *, has_channel_names: bool) -> tuple[str, tuple[str, ...]]:
    """Return the notations that fit a device file which does not describe the channels of the frames.

    Args:
        device: Settings of the board.
        has_channel_names: Whether the channels of the electrodes have names, and not only numbers.

    Returns:
        The default notation, and all notations that fit.
    """
    if isinstance(device.frames, BinaryFrames):
        return BINARY, (BINARY,)
    if isinstance(device.frames, AutoFrames):
        # Binary frames contain no names, so that they do not fit a section [channels] that refers to names.
        default = PAIRS if device.channels and has_channel_names else BINARY
        return default, (BINARY, *TEXT_FORMATS)
    default = PAIRS if has_channel_names else CSV
    return default, tuple(TEXT_FORMATS)


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

    The names are empty if the device file states only the numbers of the channels. An electrode that the device file
    does not assign to a channel uses the channel with the name of the electrode.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes.

    Raises:
        DeviceError: If the number of a channel is larger than the number of values in a frame can be.
    """
    name_of_electrode = [device.channels.get(electrode, electrode) for electrode in electrodes]
    names = tuple(dict.fromkeys(name_of_electrode))  # each channel once
    numbers = [channel_number(name) for name in names]  # None for a name that is not a number
    if None in numbers:
        return names, len(names)

    # Channels with numbers have no gaps: a frame contains all channels up to the largest number.
    used_numbers = [number for number in numbers if number is not None]
    n_channel = max(len(electrodes), *used_numbers)
    if n_channel > MAX_CHARGES:
        raise DeviceError(f"{device.where}: channels: expected numbers from 1 to {MAX_CHARGES}, got {n_channel}")
    return (), n_channel


def _encode_row(columns: tuple[str, ...], frame: Frame) -> bytes:
    """Return a frame as a line of a CSV.

    Args:
        columns: Names of the columns, in their order: `seq`, clocks (`t_us`, `t_ms` or `t_s`) and channels.
        frame: The frame, with a value for each channel. A frame without a time has the time 0.
    """
    value_of_channel = dict(zip(frame.names, frame.values, strict=True))
    cells = []
    for name in columns:
        if name == SEQ:
            cells.append(str(frame.seq))
        elif name in TIMES_US:
            clock_unit_us = TIMES_US[name]
            cells.append(repr((frame.t_us or 0) / clock_unit_us))
        else:
            cells.append(f"{value_of_channel[name]:.7g}")  # seven digits, as a float32 number has
    return (",".join(cells) + "\n").encode()
