"""Chunks of bytes in, touch charges out: parser, clock, channels and signal chain put in order; no model in it.

`ChannelPicker` knows which channel of a frame is which electrode.
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
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.port.device_clock import DeviceClock, ReadingTime
from isocharge.serve.port.source import Chunk
from isocharge.serve.signal_chain.chain import Chain, Reading, SignalChain
from isocharge.serve.signal_chain.thermal import Misfit


class ChannelPicker:
    """Picks the value of each electrode out of frames; the order is looked up again only when a frame's names change.

    The device file's `[channels]` decides, by the names or numbers of `channel_names`. Without it, channels are matched
    by the names of the electrodes (`A`, `A_pC` or `charge.A`); without such names by their order, if their number is
    that of the electrodes.
    """

    def __init__(
        self, electrodes: tuple[str, ...], channels: Mapping[str, str], reader: str, where: str = "device file"
    ) -> None:
        """Set up the look-up.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            channels: Electrode to the channel's name; empty where nothing is known.
            reader: Who expects these electrodes, for messages: "model three/1".
            where: The device file, for messages.
        """
        self._electrodes, self._channels, self._reader, self._where = electrodes, channels, reader, where
        self._names: tuple[str, ...] | None = None
        self._width = -1
        self._order: tuple[int, ...] = ()

    def pick(self, frame: Frame) -> Array:
        """Values in the order of the electrodes, shape (electrodes,), in the device's unit.

        Raises:
            ChargeError: If a frame has no value for an electrode.
        """
        if frame.names != self._names or len(frame.values) != self._width:
            self._order = self._look_up(frame)
            self._names, self._width = frame.names, len(frame.values)
        return np.array(itemgetter(*self._order)(frame.values), dtype=float).reshape(-1)

    def _look_up(self, frame: Frame) -> tuple[int, ...]:
        if self._channels:
            return tuple(self._position(electrode, frame) for electrode in self._electrodes)
        positions = {electrode_of(name): position for position, name in enumerate(frame.names)}
        if set(self._electrodes) <= set(positions):
            return tuple(positions[name] for name in self._electrodes)
        if len(frame.values) == len(self._electrodes):
            return tuple(range(len(frame.values)))
        raise ChargeError(
            f"{self._reader} expects {len(self._electrodes)} charges {self._electrodes}, frame {frame.seq} has "
            f"{len(frame.values)} {channel_names(frame)}; choose the model of this sensor, or say in the device file "
            "which is which: [channels] " + ", ".join(f'{name} = "..."' for name in self._electrodes)
        )

    def _position(self, electrode: str, frame: Frame) -> int:
        """The position of an electrode's channel among the values of a frame."""
        name = self._channels.get(electrode, electrode)
        position = position_of(name, frame)
        if position is None:
            raise ChargeError(
                f"{self._where}: [channels] {electrode} = {dumps(cut(name))}: no channel is called that; the frames "
                f"have {cut(', '.join(channel_names(frame)))}, or 1 to {len(frame.values)} in their order"
            )
        return position


def channel_names(frame: Frame) -> tuple[str, ...]:
    """Names of the channels as `[channels]` takes them; their numbers from 1 on where the board gives none."""
    return frame.names or tuple(map(str, range(1, len(frame.values) + 1)))


def position_of(name: str, frame: Frame) -> int | None:
    """The position of a channel by its name, or by its number from 1 as `2` or `ch2`; None if there is none."""
    if name in frame.names:
        return frame.names.index(name)
    digits = name.removeprefix("ch")
    number = int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 5 else 0
    return number - 1 if 1 <= number <= len(frame.values) else None


def electrode_of(name: str) -> str:
    """`A` of `A`, `A_pC`, `charge.A` and `charge_raw_pC.A`."""
    return name.rpartition(".")[2].removesuffix("_pC")


BYTES_TO_RECOGNISE = 8192
"""Bytes without one intact frame after which a stream counts as no frames at all."""


class TimedReading(NamedTuple):
    """A frame after the signal chain, and when it was taken."""

    reading: Reading
    time: ReadingTime


class ReadingStream:
    """The path from chunks to readings, with its state; belongs to one thread.

    Attributes:
        parser, gaps, clock: The parts that read the frames, with their counters.
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
        """Put the path together.

        Args:
            electrodes: Names, in the order of the charges.
            device: What is known about the board.
            chain: Rules of the signal chain; by default those of the device.
            parser: By default that of the device.
            gaps: Follows the frame numbers.
            misfit: Of a model of the film; a chain that follows warming needs it, others do not.
            reader: Who expects these electrodes, for messages: "model three/1".

        Raises:
            DeviceError: If the device file has other electrodes.
        """
        self.parser = parser or device.parser()
        self.gaps = gaps or SequenceGaps()
        self.clock = DeviceClock()
        self._device, self._electrodes = device, electrodes
        self._settings = chain or device.chain(electrodes)
        self._picker = ChannelPicker(electrodes, device.channels, reader, device.where)
        self._misfit = misfit
        self._chain = self._new_chain()
        self._pending_flags: tuple[str, ...] = ()

    @property
    def warming_ratio(self) -> Array | float:
        """Charge of each electrode over the mean magnitude of all when the film warms, shape (electrodes,)."""
        return self._settings.pyro

    def _new_chain(self) -> SignalChain:
        return SignalChain(self._settings, len(self._electrodes), self._misfit)

    def tare(self) -> None:
        """Measure the tare again from the next quiet frames."""
        self._chain.reset_tare()

    def restart(self) -> None:
        """Begin as a new stream does: format, frame numbers, clock, tare and all counters are forgotten."""
        self.parser, self.gaps, self.clock = self._device.parser(), SequenceGaps(), DeviceClock()
        self._chain = self._new_chain()
        self._pending_flags = ()

    def feed(self, chunk: Chunk) -> Iterator[TimedReading]:
        """The readings of the frames that end in this chunk.

        Raises:
            ChargeError: If a frame has another number of charges.
            TareError: If the film is not left alone to tare.
            NoFramesError: If the bytes are no frames.
        """
        frames = self.frames(chunk)
        for frame in frames:
            yield self.advance(frame, chunk)
        self.arrived(frames, chunk)

    def frames(self, chunk: Chunk) -> list[Frame]:
        """The frames that end in a chunk; after an outage everything begins anew."""
        if chunk.outage_s > 0.0:
            self._reconnect()
        return self.parser.feed(chunk.data)

    def advance(self, frame: Frame, chunk: Chunk) -> TimedReading:
        """Take the next frame of a chunk through clock and chain."""
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
            rests = zip(self._electrodes, values.tolist(), strict=True)
            offsets = ", ".join(f"{name} = {value:.10g}" for name, value in rests)
            raise TareError(
                f"{error}; if the board rests there without a touch, say so in a device file: [gain] offset = "
                f"{{{offsets}}}"
            ) from error
        return TimedReading(reading, time_of_reading)

    def arrived(self, frames: list[Frame], chunk: Chunk) -> None:
        """A chunk is over: its arrival sets the clock; bytes that are no frames are refused.

        Raises:
            NoFramesError: If there was not one intact frame among many bytes.
        """
        if frames:
            self.clock.arrived(chunk.timestamp)
        else:
            _check_recognised(self.parser)

    def finish(self) -> None:
        """End the stream, as at the end of a file.

        Raises:
            NoFramesError: If there was not one intact frame.
        """
        _check_recognised(self.parser, allowed=-1)

    def _reconnect(self) -> None:
        """Start over after an outage: frames are missing, and the film may have been touched meanwhile."""
        self.parser.reset()
        self.gaps.reset()
        self.clock.reset()
        self.tare()
        self._pending_flags = (RECONNECTED,)


def _check_recognised(parser: Parser, allowed: int = BYTES_TO_RECOGNISE) -> None:
    counts = parser.counts
    if counts.frames == 0 and counts.bytes_dropped > allowed:
        raise NoFramesError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form); {parser.format}: check baud rate and device"
        )
