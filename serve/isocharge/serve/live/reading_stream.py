"""Path from chunks of bytes to touch charges: parser, clock, assignment of the channels, and signal chain.

The readings do not depend on a model of the film, unless the signal chain estimates warming.
"""

from collections.abc import Iterator, Mapping
from json import dumps
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ChargeError, NoFramesError, TareError, cut
from isocharge.serve.flags import RECONNECTED
from isocharge.serve.frames.frame import SATURATED_BIT, Frame, Parser, SequenceGaps
from isocharge.serve.frames.frame_layout import FrameLayout
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.port.device_clock import DeviceClock, ReadingTime
from isocharge.serve.port.source import Chunk
from isocharge.serve.signal_chain.chain import Chain, Reading, SignalChain
from isocharge.serve.signal_chain.thermal import Misfit

MAX_CHANNEL_DIGITS = 4
"""Largest number of digits in the number of a channel."""

BYTES_TO_RECOGNISE = 8192
"""Number of bytes without an intact frame after which an error is raised."""


class ChannelPicker:
    """Selects the value of each electrode from frames.

    The section `[channels]` of the device file assigns a channel to each electrode, by its name or its number. Without
    this section, channels are assigned by the names of the electrodes (`A`, `A_pC` or `charge.A`). If the channels have
    no such names, the channels are assigned by their order. This requires as many channels as electrodes.
    """

    def __init__(
        self, electrodes: tuple[str, ...], channels: Mapping[str, str], reader: str, where: str = "device file"
    ) -> None:
        """Set the assignment.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            channels: Name or number of the channel of each electrode; empty if the device file has no such section.
            reader: Reader that expects these electrodes, for messages, such as "model three/1".
            where: Name of the device file, for messages.
        """
        self._electrodes = electrodes
        self._channels = channels
        self._reader = reader
        self._where = where
        # Names, number of values and positions of the channels of the previous frame, which `pick` uses again.
        self._names: tuple[str, ...] | None = None
        self._n_values = -1
        self._positions: tuple[int, ...] = ()

    def pick(self, frame: Frame) -> Array:
        """Return the values in the order of the electrodes, shape (n_electrode,), in the unit of the device.

        The positions of the channels are only looked up again if the names or the number of values have changed since
        the previous frame.

        Raises:
            ChargeError: If a frame has no value for an electrode.
        """
        if frame.names != self._names or len(frame.values) != self._n_values:
            self._positions = self.positions(frame)
            self._names = frame.names
            self._n_values = len(frame.values)
        values = itemgetter(*self._positions)(frame.values)  # a tuple, or a single number for one electrode
        return np.array(values, dtype=float).reshape(-1)

    def positions(self, frame: Frame) -> tuple[int, ...]:
        """Return the position of each electrode's channel among the values of a frame.

        If the device file assigns channels to the electrodes, these channels are used. Otherwise the channels with the
        names of the electrodes are used. If the channels have other names, they are used in their order.

        Raises:
            ChargeError: If the device file assigns no channels, the names differ, and the number of values is wrong.
        """
        if self._channels:
            return tuple(self._position(electrode, frame) for electrode in self._electrodes)
        position_of_electrode = {electrode_of(name): position for position, name in enumerate(frame.names)}
        if position_of_electrode.keys() >= set(self._electrodes):
            return tuple(position_of_electrode[electrode] for electrode in self._electrodes)
        if len(frame.values) == len(self._electrodes):
            return tuple(range(len(frame.values)))
        example_keys = ", ".join(f'{electrode} = "..."' for electrode in self._electrodes)
        raise ChargeError(
            f"{self._reader} expects {len(self._electrodes)} charges {self._electrodes}, frame {frame.seq} has "
            f"{len(frame.values)} {channel_names(frame)}; choose the model of this sensor, or say in the device file "
            f"which is which: [channels] {example_keys}"
        )

    def _position(self, electrode: str, frame: Frame) -> int:
        """Return the index of the channel that the device file assigns to an electrode.

        Args:
            electrode: Name of the electrode.
            frame: A frame of the board.

        Raises:
            ChargeError: If the frame has no such channel.
        """
        name = self._channels.get(electrode, electrode)
        position = position_of(name, frame)
        if position is None:
            raise ChargeError(
                f"{self._where}: [channels] {electrode} = {dumps(cut(name))}: no channel is called that; the frames "
                f"have {cut(', '.join(channel_names(frame)))}, or 1 to {len(frame.values)} in their order"
            )
        return position


def check_channels(device: Device, electrodes: tuple[str, ...], reader: str) -> None:
    """Check without a frame that the device file assigns a channel to each electrode.

    If the device file describes the layout of the frames, their channels are known, and are assigned as in a received
    frame. Otherwise the channels are not known before the first frame. Each electrode then needs a key in the section
    `[channels]` if there is such a section.

    Args:
        device: Settings of the board.
        electrodes: Names of the electrodes, in the order of the charges.
        reader: Reader that expects these electrodes, for messages, such as "model three/1".

    Raises:
        ChargeError: If there is no channel for an electrode.
    """
    if isinstance(device.frames, FrameLayout):
        picker = ChannelPicker(electrodes, device.channels, reader, device.where)
        picker.positions(device.frames.frame_of_zeros())  # raises an error if an electrode has no channel
        return
    missing = [name for name in electrodes if name not in device.channels]
    if device.channels and missing:
        raise ChargeError(
            f"{device.where}: [channels] {missing[0]}: {reader} expects a channel for each of the electrodes "
            f"{electrodes}, got {', '.join(device.channels)}; add the electrode, or choose the model of this sensor"
        )


def channel_names(frame: Frame) -> tuple[str, ...]:
    """Return the names of the channels as in the section `[channels]`; numbers from 1 if the frames have no names."""
    if frame.names:
        return frame.names
    return tuple(str(number) for number in range(1, len(frame.values) + 1))


def position_of(name: str, frame: Frame) -> int | None:
    """Return the position of a channel among the values of a frame; None if there is no such channel.

    Args:
        name: Name of the channel, or its number from 1, such as `2` or `ch2`.
        frame: A frame of the board.
    """
    if name in frame.names:
        return frame.names.index(name)
    number = channel_number(name)
    if number is None or number > len(frame.values):
        return None
    return number - 1


def channel_number(name: str) -> int | None:
    """Return the number of a channel, counted from 1, for a name such as `2` or `ch2`; None for any other name."""
    digits = name.removeprefix("ch")
    is_number = digits.isascii() and digits.isdigit() and len(digits) <= MAX_CHANNEL_DIGITS
    if not is_number or int(digits) == 0:
        return None
    return int(digits)


def electrode_of(name: str) -> str:
    """Return the name of the electrode in the name of a channel.

    For example, the result is `A` for `A`, `A_pC`, `charge.A` and `charge_raw_pC.A`.
    """
    return name.rpartition(".")[2].removesuffix("_pC")


class TimedReading(NamedTuple):
    """A frame after the signal chain, and its time."""

    reading: Reading
    time: ReadingTime


class ReadingStream:
    """The path from chunks to readings. The object stores the state of the path. An object belongs to one thread.

    Attributes:
        parser: Parser of the frames, with its counters.
        gaps: Counter of missing frame numbers.
        clock: Clock of the device.
    """

    def __init__(
        self,
        electrodes: tuple[str, ...],
        device: Device = ANY_BOARD,
        *,
        chain: Chain | None = None,
        parser: Parser | None = None,
        gaps: SequenceGaps | None = None,
        misfit: Misfit | None = None,
        reader: str = "the sensor",
    ) -> None:
        """Connect the parts of the path.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            device: Settings of the board.
            chain: Settings of the signal chain; by default those of the device.
            parser: Parser of the frames; by default that of the device.
            gaps: Counter of missing frame numbers.
            misfit: Function that returns how badly a model explains charges, in standard deviations of the noise. Only
                a signal chain that estimates warming needs it.
            reader: Reader that expects these electrodes, for messages, such as "model three/1".

        Raises:
            DeviceError: If the device file has other electrodes.
        """
        self.parser = parser or device.parser()
        self.gaps = gaps or SequenceGaps()
        self.clock = DeviceClock()
        self._device = device
        self._electrodes = electrodes
        self._settings = chain or device.chain(electrodes)
        self._picker = ChannelPicker(electrodes, device.channels, reader, device.where)
        self._misfit = misfit
        self._chain = self._new_chain()
        self._pending_flags: tuple[str, ...] = ()  # flags that the next frame gets

    @property
    def warming_ratio(self) -> Array | float:
        """Charge that warming adds to each electrode, relative to the mean magnitude, shape (n_electrode,)."""
        return self._settings.pyro

    def _new_chain(self) -> SignalChain:
        """Return a signal chain without any state."""
        return SignalChain(self._settings, len(self._electrodes), self._misfit)

    def tare(self) -> None:
        """Measure the tare again from the next quiet frames."""
        self._chain.reset_tare()

    def restart(self) -> None:
        """Return to the initial state: discard the format, the frame numbers, the clock, the tare and all counters."""
        self.parser = self._device.parser()
        self.gaps = SequenceGaps()
        self.clock = DeviceClock()
        self._chain = self._new_chain()
        self._pending_flags = ()

    def feed(self, chunk: Chunk) -> Iterator[TimedReading]:
        """Yield the readings of the frames that end in this chunk.

        Raises:
            ChargeError: If a frame has another number of charges.
            TareError: If the film is touched during the whole search for a tare.
            NoFramesError: If the bytes contain no frames.
        """
        frames = self.frames(chunk)
        for frame in frames:
            yield self.advance(frame, chunk)
        self.end_chunk(frames, chunk)

    def frames(self, chunk: Chunk) -> list[Frame]:
        """Return the frames that end in a chunk. If the chunk follows an outage, discard the earlier state first."""
        if chunk.outage_s > 0.0:
            self._reconnect()
        return self.parser.feed(chunk.data)

    def advance(self, frame: Frame, chunk: Chunk) -> TimedReading:
        """Compute the time and the touch charges of the next frame of a chunk.

        The clock of the device gives the time of the frame. The gap counter compares the number of the frame with that
        of the previous frame. The signal chain converts the values of the electrodes to touch charges.

        Args:
            frame: The frame.
            chunk: The chunk. Its time of arrival is the time of frames without a device time.

        Returns:
            The touch charges with the flags of the frame, and the time of the frame.

        Raises:
            ChargeError: If the frame has no value for an electrode.
            TareError: If the film is touched during the whole search for a tare.
        """
        time_of_reading = self.clock.read(frame.t_us, self.parser.t_us_modulus, chunk.timestamp)
        flags = self._pending_flags + self.gaps.update(frame.seq, self.parser.seq_modulus)
        self._pending_flags = ()
        values = self._picker.pick(frame)
        try:
            reading = self._chain.advance(
                values,
                time_of_reading.clock_s,
                time_of_reading.step_s,
                limited=bool(frame.flags & SATURATED_BIT),
                flags=flags,
            )
        except TareError as error:
            # If the film rests after all, the present values are the offsets of the board.
            value_of_electrode = dict(zip(self._electrodes, values.tolist(), strict=True))
            offsets = ", ".join(f"{name} = {value:.10g}" for name, value in value_of_electrode.items())
            setting = "[gain] offset = {" + offsets + "}"
            raise TareError(
                f"{error}; if the board rests there without a touch, say so in a device file: {setting}"
            ) from error
        return TimedReading(reading, time_of_reading)

    def end_chunk(self, frames: list[Frame], chunk: Chunk) -> None:
        """Adjust the clock to the arrival of a chunk whose frames have been processed.

        If the chunk completed no frame, check that the stream has frames of a known format.

        Args:
            frames: The frames that ended in the chunk.
            chunk: The chunk.

        Raises:
            NoFramesError: If there has been no intact frame among many bytes.
        """
        if frames:
            self.clock.arrived(chunk.timestamp)
        else:
            _check_recognised(self.parser)

    def finish(self) -> None:
        """End the stream, as at the end of a file.

        Raises:
            NoFramesError: If there has been no intact frame.
        """
        _check_recognised(self.parser, max_bytes=-1)

    def _reconnect(self) -> None:
        """Discard the state of the parser, the gap counter, the clock and the tare after an outage.

        After an outage, frames are missing, and the film may have been touched. The next frame gets the flag
        `reconnected`.
        """
        self.parser.reset()
        self.gaps.reset()
        self.clock.reset()
        self.tare()
        self._pending_flags = (RECONNECTED,)


def _check_recognised(parser: Parser, max_bytes: int = BYTES_TO_RECOGNISE) -> None:
    """Raise NoFramesError if more than `max_bytes` bytes have arrived without an intact frame."""
    counts = parser.counts
    if counts.frames == 0 and counts.bytes_dropped > max_bytes:
        raise NoFramesError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form); {parser.format}: check baud rate and device"
        )
