"""Encoder that converts charges to the frames that a board sends.

The encoder reverses the conversion of frames to charges, and uses the same device file of the board.
"""

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
from isocharge.serve.live.device import Device, create_stages
from isocharge.serve.signal_chain.channels import Channels, channel_number
from isocharge.serve.signal_chain.gain import Gain

BINARY = "binary"
"""Name of the notation that is the binary frame of isocharge."""

CSV = "csv"
"""Name of the notation of text frames in which the channels have no names."""

PAIRS = "pairs"
"""Name of the notation of text frames in which each channel has a name."""

FRAMES_TO_RECOGNISE = 8
"""Number of frames from which every parser can recognise the layout of the frames."""


class BoardFrames(NamedTuple):
    """Description of the frames that a board sends, including the function that encodes a frame.

    Attributes:
        names: Names of the channels; empty if the frames contain no names.
        channels: Field of each channel in a frame. The type of the field determines the range of the values.
        encode: Function that returns the bytes of a frame. The frame must have one value for each channel.
        seq_modulus: Value at which the frame counter wraps to 0.
        t_us_modulus: Time at which the clock wraps to 0, us.
    """

    names: tuple[str, ...]
    channels: tuple[Field, ...]
    encode: Callable[[Frame], bytes]
    seq_modulus: int = SEQ_MODULUS
    t_us_modulus: int = T_US_MODULUS


class BoardEncoder:
    """Encoder that converts charges to the frames of a board, which a device file describes.

    The value of a channel is the charge of its electrode divided by the gain, plus the offset of the board. The device
    file assigns the channels to the electrodes. Channels without an electrode have the value 0. If a value is outside
    the range of its field, the encoder sets the value to the nearest limit of the range. A frame with such a value gets
    the flag `saturated` if the frames of the board contain flags.

    Attributes:
        seq_modulus: Value at which the frame counter of the board wraps to 0.
        t_us_modulus: Time at which the clock of the board wraps to 0, us.
        request: Request that the board answers with a frame, or None if the board sends frames without requests.
        clipped: Number of frames in which a value was set to a limit of its range.
    """

    def __init__(self, device: Device, electrodes: tuple[str, ...], notation: str | None = None) -> None:
        """Assign the electrodes to the channels, and check that frames of an untouched film can be encoded and parsed.

        Args:
            device: Settings of the board.
            electrodes: Names of the electrodes, in the order of the charges.
            notation: Notation of the frames if the device file does not describe them. It is "binary" or a notation of
                `encode_text`. By default, a notation is chosen that fits the device file.

        Raises:
            DeviceError: If the device file describes datagrams, contains settings for other electrodes, contains a
                channel number that is too large, states an offset that its field cannot contain, or does not fit the
                notation; or if the parser of the device file cannot read the frames.
            ChargeError: If an electrode has no channel.
        """
        self._frames = _board_frames(device, electrodes, notation)
        setup = device.setup(electrodes)
        create_stages(setup)  # raises an error for settings of other electrodes
        self._gain = Gain(setup)

        # Find the index of each electrode's channel in a frame. All frames have the same channels, so that any frame
        # can be used.
        zeros = (0.0,) * len(self._frames.channels)
        frame_of_zeros = Frame(0, 0, zeros, names=self._frames.names)
        self._channel_indices = Channels(setup).channel_indices(frame_of_zeros)

        self.seq_modulus = self._frames.seq_modulus
        self.t_us_modulus = self._frames.t_us_modulus
        self.request = device.request
        self.clipped = 0

        # The checks come last. The second check calls the method `encode`, which needs all attributes.
        self._check_offsets(device.where, electrodes)
        self._check_reading(device, electrodes)

    def _check_offsets(self, where: str, electrodes: tuple[str, ...]) -> None:
        """Check that the channel of each electrode can contain the value that the board sends without charge.

        Args:
            where: Name of the device file, for messages.
            electrodes: Names of the electrodes, in the order of the charges.

        Raises:
            DeviceError: If a channel cannot contain its value.
        """
        no_charge_pC = np.zeros(len(electrodes))
        offsets = self._gain.revert(no_charge_pC).tolist()
        for electrode, channel_index, offset in zip(electrodes, self._channel_indices, offsets, strict=True):
            channel = self._frames.channels[channel_index]
            if not channel.holds(offset):
                raise DeviceError(
                    f"{where}: gain: without charge, electrode {electrode} has the value {offset:g}, which does not "
                    f"fit its channel {channel.name} of the type {channel.type_name}; correct gain.offset or the type"
                )

    def _check_reading(self, device: Device, electrodes: tuple[str, ...]) -> None:
        """Check that the parser of the device file can read frames in which all charges are zero.

        Args:
            device: Settings of the board, from which the parser is created.
            electrodes: Names of the electrodes, in the order of the charges.

        Raises:
            DeviceError: If the parser reads none of the frames.
        """
        parser = device.parser()
        no_charge = (0.0,) * len(electrodes)
        # A parser may need several frames to recognise their layout.
        for seq in range(FRAMES_TO_RECOGNISE):
            t_us = 1000 * seq  # as from a board that sends one frame per millisecond
            encoded_frame = self.encode(Frame(seq, t_us, no_charge))
            parser.feed(encoded_frame)
        if parser.counts.frames == 0:
            raise DeviceError(
                f"{device.where}: frames: the frames that the virtual sensor sends cannot be read with this section; "
                "describe the frames, or remove the section"
            )

    def encode(self, frame: Frame) -> bytes:
        """Return the bytes that the board sends for the charges of a frame.

        If a value is outside the range of its channel, the value is set to the nearest limit of the range. A frame with
        such a value gets the flag `saturated`, and the count `clipped` is increased by one. Channels without an
        electrode have the value 0.

        Args:
            frame: Frame whose values are the charges of the electrodes, pC, in the order of the electrodes.
        """
        board_values = self._gain.revert(np.array(frame.values)).tolist()
        channels = self._frames.channels
        channel_values = [0.0] * len(channels)
        is_clipped = False
        for channel_index, value in zip(self._channel_indices, board_values, strict=True):
            channel = channels[channel_index]
            channel_values[channel_index] = channel.nearest_value(value)
            if not channel.holds(value):
                is_clipped = True
        bits = frame.bits
        if is_clipped:
            self.clipped += 1
            bits |= SATURATED_BIT
        board_frame = Frame(frame.seq, frame.t_us, tuple(channel_values), bits, self._frames.names)
        return self._frames.encode(board_frame)


def _board_frames(device: Device, electrodes: tuple[str, ...], notation: str | None) -> BoardFrames:
    """Return the description of the frames that a board sends.

    Args:
        device: Settings of the board. They may describe the channels as binary fields or as columns of text.
        electrodes: Names of the electrodes.
        notation: Notation of the frames: "binary", or a notation of `encode_text`. It must fit the device file. If
            None, a notation is chosen that fits the device file.

    Raises:
        DeviceError: If the device file describes datagrams, contains a channel number that is too large, or does not
            fit the notation.
    """
    frames = device.frames
    if isinstance(frames, FrameLayout):  # the device file describes the channels as binary fields
        _check_notation(device.where, notation, fitting_notations=())  # raises an error if a notation is given
        return _layout_frames(frames, device.where)
    if isinstance(frames, TextFrames) and frames.columns:  # the device file describes the channels as columns of a CSV
        _check_notation(device.where, notation, fitting_notations=(CSV,))
        return _column_frames(frames.columns)

    return _undescribed_frames(device, electrodes, notation)


def _undescribed_frames(device: Device, electrodes: tuple[str, ...], notation: str | None) -> BoardFrames:
    """Return the description of frames whose channels the device file does not describe.

    The names and the number of the channels are derived from the electrodes. The notation determines the type of the
    channels, and whether the frames contain the names.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes.
        notation: Notation of the frames: "binary", or a notation of `encode_text`. If None, a notation is chosen that
            fits the device file.

    Raises:
        DeviceError: If the device file contains a channel number that is too large, or does not fit the notation.
    """
    channel_names, n_channel = _used_channels(device, electrodes)
    default_notation, fitting_notations = _fitting_notations(device, has_channel_names=bool(channel_names))
    _check_notation(device.where, notation, fitting_notations)
    chosen_notation = notation or default_notation
    # The second argument of `Field` is its name, which is only used in messages here. It states the notation.
    if chosen_notation == BINARY:
        binary_channels = (Field("f32", BINARY),) * n_channel
        return BoardFrames(names=(), channels=binary_channels, encode=encode_frame)
    frame_names = () if chosen_notation == CSV else channel_names  # lines of CSV contain no names
    text_channels = (Field("f64", chosen_notation),) * n_channel
    encode = partial(encode_text, notation=chosen_notation)
    return BoardFrames(names=frame_names, channels=text_channels, encode=encode)


def _layout_frames(layout: FrameLayout, where: str) -> BoardFrames:
    """Return the description of binary frames whose fields a device file describes.

    Args:
        layout: Layout of the fields in the device file.
        where: Name of the device file, for messages.

    Raises:
        DeviceError: If the frames are sent as datagrams.
    """
    if layout.framing == DATAGRAM:
        raise DeviceError(
            f'{where}: frames.framing: a pseudo-terminal has no datagrams, got "{DATAGRAM}"; choose the '
            'framing "sync", "cobs", "slip" or "hdlc"'
        )
    names = tuple(channel.name for channel in layout.channels)
    return BoardFrames(names, layout.channels, layout.encode, layout.seq_modulus, layout.t_us_modulus)


def _column_frames(columns: tuple[str, ...]) -> BoardFrames:
    """Return the description of frames that are sent as lines of CSV.

    Args:
        columns: Names of the columns. A column contains the frame number, the time, or the values of a channel.
    """
    channel_names = tuple(name for name in columns if name not in (SEQ, *TIMES_US))
    channels = tuple(Field("f64", name) for name in channel_names)
    return BoardFrames(channel_names, channels, encode=partial(_encode_row, columns))


def _fitting_notations(device: Device, *, has_channel_names: bool) -> tuple[str, tuple[str, ...]]:
    """Return the notations that fit a device file if the file does not describe the channels.

    Args:
        device: Settings of the board.
        has_channel_names: Whether the channels have names. False if they only have numbers.

    Returns:
        The default notation, and a tuple of all notations that fit the device file.
    """
    if isinstance(device.frames, BinaryFrames):
        return BINARY, (BINARY,)
    if isinstance(device.frames, AutoFrames):
        # The default is not binary if a section [channels] contains names, because binary frames contain no names.
        default = PAIRS if device.channels and has_channel_names else BINARY
        return default, (BINARY, *TEXT_FORMATS)
    default = PAIRS if has_channel_names else CSV
    return default, tuple(TEXT_FORMATS)


def _check_notation(where: str, notation: str | None, fitting_notations: tuple[str, ...]) -> None:
    """Check that the notation fits the device file, if a notation is given.

    Args:
        where: Name of the device file, for messages.
        notation: The given notation, or None if no notation is given.
        fitting_notations: Notations that fit the device file. The tuple is empty if the device file describes the
            frames, so that a notation must not be given.

    Raises:
        DeviceError: If the given notation does not fit the device file.
    """
    if notation is None or notation in fitting_notations:
        return
    if not fitting_notations:
        raise DeviceError(
            f"{where}: frames: expected no notation, because the file describes the frames, got {notation}"
        )
    expected = f"a notation that fits the device file ({', '.join(fitting_notations)})"
    raise DeviceError(f"{where}: frames: expected {expected}, got {notation}")


def _used_channels(device: Device, electrodes: tuple[str, ...]) -> tuple[tuple[str, ...], int]:
    """Return the names of the channels that the electrodes use, and the number of channels in a frame.

    By default, an electrode uses the channel with its own name. The section `[channels]` of the device file may state
    another name, or a number. If the section states numbers for all electrodes, the tuple of names is empty.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes.

    Raises:
        DeviceError: If the number of a channel is larger than the largest possible number of values in a frame.
    """
    assigned_names = [device.channels.get(electrode, electrode) for electrode in electrodes]
    names = tuple(dict.fromkeys(assigned_names))  # each name once, because two electrodes may use the same channel
    numbers = [channel_number(name) for name in names]  # None for a name that is not a number
    if None in numbers:  # the channels are identified by their names
        return names, len(names)

    # All channels are identified by numbers. A frame contains all channels up to the largest used number. It contains
    # at least as many channels as there are electrodes.
    used_numbers = [number for number in numbers if number is not None]
    n_channel = max(len(electrodes), *used_numbers)
    if n_channel > MAX_CHARGES:
        raise DeviceError(f"{device.where}: channels: expected numbers from 1 to {MAX_CHARGES}, got {n_channel}")
    return (), n_channel


def _encode_row(columns: tuple[str, ...], frame: Frame) -> bytes:
    """Encode a frame as a line of CSV.

    Args:
        columns: Names of the columns in their order. A column contains the frame number (`seq`), the time (`t_us`,
            `t_ms` or `t_s`), or the value of a channel.
        frame: Frame with one value for each channel. If the frame has no time, the line contains the time 0.
    """
    value_of_channel = dict(zip(frame.names, frame.values, strict=True))
    cells = []
    for name in columns:
        if name == SEQ:
            cells.append(str(frame.seq))
        elif name in TIMES_US:
            clock_unit_us = TIMES_US[name]
            cells.append(repr((frame.t_us or 0) / clock_unit_us))  # `repr` writes all digits
        else:
            cells.append(f"{value_of_channel[name]:.7g}")  # seven digits, as a float32 number has
    return (",".join(cells) + "\n").encode()
