"""Chunks of bytes in, touch charges out: parser, clock, channels and signal chain put in order; no model in it."""

from collections.abc import Iterator
from typing import NamedTuple

from isocharge.common.arrays import Array
from isocharge.common.errors import PortError, TareError
from isocharge.serve.flags import RECONNECTED
from isocharge.serve.frames.frame import SATURATED_BIT, Frame, Parser
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.live.channels import ChannelPicker
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.port.device_clock import DeviceClock, ReadingTime
from isocharge.serve.port.serial_port import Chunk
from isocharge.serve.signal_chain.chain import Chain, ChainState, Reading, advance
from isocharge.serve.signal_chain.thermal import Misfit

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
        self._chain = chain or device.chain(electrodes)
        self._picker = ChannelPicker(electrodes, device.channels, reader, device.where)
        self._electrodes = electrodes
        self._state = ChainState.start(len(electrodes))
        self._misfit = misfit
        self._pending_flags: tuple[str, ...] = ()

    def tare(self) -> None:
        """Forget the tare; the next quiet frames are the new one."""
        self._state = self._state.without_tare()

    def restart(self) -> None:
        """Begin as a new stream does: format, frame numbers, clock, tare and all counters are forgotten."""
        self.parser, self.gaps, self.clock = self._device.parser(), SequenceGaps(), DeviceClock()
        self._state = ChainState.start(len(self._electrodes))
        self._pending_flags = ()

    def feed(self, chunk: Chunk) -> Iterator[TimedReading]:
        """The readings of the frames that end in this chunk.

        Raises:
            ChargeError: If a frame has another number of charges.
            TareError: If the film is not left alone to tare.
            PortError: If the bytes are no frames.
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
            self._state, reading = advance(
                self._chain,
                self._state,
                values,
                time_of_reading.clock_s,
                time_of_reading.step_s,
                limited=bool(frame.flags & SATURATED_BIT),
                misfit=self._misfit,
                flags=flags,
            )
        except TareError as error:
            raise TareError(f"{error}; {self._rest_words(values)}") from error
        return TimedReading(reading, time_of_reading)

    def _rest_words(self, values: Array) -> str:
        """What the channels show while the film is tared, as the device file would say it."""
        offsets = ", ".join(
            f"{name} = {value:.10g}" for name, value in zip(self._electrodes, values.tolist(), strict=True)
        )
        return f"if the board rests there without a touch, say so in a device file: [gain] offset = {{{offsets}}}"

    def arrived(self, frames: list[Frame], chunk: Chunk) -> None:
        """A chunk is over: its arrival sets the clock; bytes that are no frames are refused.

        Raises:
            PortError: If there was not one intact frame among many bytes.
        """
        if frames:
            self.clock.arrived(chunk.timestamp)
        else:
            _check_recognised(self.parser)

    def finish(self) -> None:
        """End the stream, as at the end of a file.

        Raises:
            PortError: If there was not one intact frame.
        """
        _check_recognised(self.parser, allowed=-1)

    def _reconnect(self) -> None:
        """Start over after an outage: frames are missing, and the film may have been touched meanwhile."""
        self.parser.forget()
        self.gaps.forget()
        self.clock.forget()
        self.tare()
        self._pending_flags = (RECONNECTED,)


def _check_recognised(parser: Parser, allowed: int = BYTES_TO_RECOGNISE) -> None:
    counts = parser.counts
    if counts.frames == 0 and counts.bytes_dropped > allowed:
        raise PortError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form); {parser.format}: check baud rate and device"
        )
