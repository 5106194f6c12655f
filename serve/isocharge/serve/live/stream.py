"""Chunks of bytes in, prediction records out: parser, clock, signal chain and predictor put in order."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum

from isocharge.arrays import Array, Reals
from isocharge.errors import PortError
from isocharge.serve.flags import RECONNECTED
from isocharge.serve.frames.frame import SATURATED_BIT, Frame, Parser
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.live.channels import ChannelPicker
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.live.record_builder import RecordBuilder
from isocharge.serve.port.device_clock import DeviceClock, ReadingTime
from isocharge.serve.port.serial_port import Chunk
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.record import PredictionRecord
from isocharge.serve.signal_chain.chain import Chain, ChainState, Reading, advance

BYTES_TO_RECOGNISE = 8192
"""Bytes without one intact frame after which a stream counts as no frames at all."""


class Policy(StrEnum):
    """Which frames get a record; the chain sees all of them either way."""

    every = "every"
    latest = "latest"


@dataclass(slots=True)
class StreamCounts:
    """Counts of a stream that neither its parser nor its gaps hold.

    Attributes:
        records: Records.
        skipped: Frames without a record, because a newer one had come with them (`Policy.latest`).
        outages: Times that the port came back.
    """

    records: int = 0
    skipped: int = 0
    outages: int = 0


def stream(
    chunks: Iterable[Chunk],
    predictor: Predictor,
    chain: Chain | None = None,
    *,
    parser: Parser | None = None,
    gaps: SequenceGaps | None = None,
) -> Iterator[PredictionRecord]:
    """A record for every intact frame.

    Args:
        chunks: Bytes with the time of their arrival: an open `Port`, or anything like it.
        predictor: The model of this sensor.
        chain: Rules of the signal chain.
        parser: Turns bytes into frames; hand one in to read its counters. By default the format is recognised.
        gaps: Follows the frame numbers; hand one in to read its counters.

    Raises:
        ChargeError: If a frame has another number of charges than the model.
        TareError: If the film is not left alone to tare.
        PortError: If the bytes are no frames.
        PortLost: If the port goes away.
    """
    touch = TouchStream(predictor, chain=chain, parser=parser, gaps=gaps)
    for chunk in chunks:
        yield from touch.feed(chunk)
    touch.finish()


class TouchStream:
    """The path from chunks to records, with its state; belongs to one thread.

    Attributes:
        parser, gaps, clock: The parts that read the frames, with their counters.
        counts: Records, skipped frames and outages.
    """

    def __init__(
        self,
        predictor: Predictor,
        device: Device = ANY_BOARD,
        *,
        chain: Chain | None = None,
        parser: Parser | None = None,
        gaps: SequenceGaps | None = None,
        policy: Policy = Policy.every,
        now_ns: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        """Put the path together.

        Args:
            predictor: The model of this sensor.
            device: What is known about the board.
            chain: Rules of the signal chain; by default those of the device.
            parser: By default that of the device.
            gaps: Follows the frame numbers.
            policy: Which frames get a record.
            now_ns: The clock of `Chunk.clock_ns`, for latencies.

        Raises:
            DeviceError: If the device file has other electrodes than the model.
        """
        electrodes = predictor.metadata.electrodes
        self.parser = parser or device.parser()
        self.gaps = gaps or SequenceGaps()
        self.clock = DeviceClock()
        self.counts = StreamCounts()
        self._chain = chain or device.chain(electrodes)
        self._picker = ChannelPicker(electrodes, device.channels, predictor.metadata.label)
        self._records = RecordBuilder.of(predictor)
        self._state = ChainState.start(len(electrodes))
        self._policy = policy
        self._now_ns = now_ns
        self._predictor = predictor
        self._pending_flags: tuple[str, ...] = ()

    def tare(self) -> None:
        """Forget the tare; the next quiet frames are the new one."""
        self._state = self._state.without_tare()

    def feed(self, chunk: Chunk) -> Iterator[PredictionRecord]:
        """The records of the frames that end in this chunk.

        Raises:
            As `stream`.
        """
        if chunk.outage_s > 0.0:
            self._reconnect()
        frames = self.parser.feed(chunk.data)
        last = len(frames) - 1
        for number, frame in enumerate(frames):
            reading, time_of_reading = self._advance(frame, chunk)
            if self._policy is Policy.latest and number < last:
                self.counts.skipped += 1
                continue
            self.counts.records += 1
            yield self._records.record(chunk, frame, reading, time_of_reading, self._now_ns)
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
        self.counts.outages += 1
        self.parser.forget()
        self.gaps.forget()
        self.clock.forget()
        self.tare()
        self._pending_flags = (RECONNECTED,)

    def _advance(self, frame: Frame, chunk: Chunk) -> tuple[Reading, ReadingTime]:
        """Take a frame through clock and chain."""
        time_of_reading = self.clock.read(frame.t_us, self.parser.t_us_modulus, chunk.timestamp)
        flags = self._pending_flags + self.gaps.update(frame.seq, self.parser.seq_modulus)
        self._pending_flags = ()
        self._state, reading = advance(
            self._chain,
            self._state,
            self._picker.pick(frame),
            time_of_reading.clock_s,
            time_of_reading.step_s,
            limited=bool(frame.flags & SATURATED_BIT),
            misfit=self._misfit,
            flags=flags,
        )
        return reading, time_of_reading

    def _misfit(self, charge_pC: Array) -> Reals:
        """The model's misfit, shape (n,), for charges of shape (n, electrodes), pC."""
        return self._predictor.predict_batch(charge_pC).misfit


def _check_recognised(parser: Parser, allowed: int = BYTES_TO_RECOGNISE) -> None:
    counts = parser.counts
    if counts.frames == 0 and counts.bytes_dropped > allowed:
        raise PortError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form); {parser.format}: check baud rate and device"
        )
