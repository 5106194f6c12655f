"""Chunks of bytes in, prediction records out: parser, clock, signal chain and predictor put in order."""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from isocharge.arrays import Array, Reals
from isocharge.errors import PortError
from isocharge.serve.flags import BLIND, INVALID, RECONNECTED, SATURATED, THERMAL
from isocharge.serve.frames.frame import SATURATED_BIT, Frame, Parser
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.live.channels import ChannelPicker
from isocharge.serve.live.device_file import ANY_BOARD, Device
from isocharge.serve.live.record_builder import RecordBuilder
from isocharge.serve.port.device_clock import DeviceClock, ReadingTime
from isocharge.serve.port.serial_port import Chunk
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.record import PredictionRecord
from isocharge.serve.signal_chain.chain import Chain, ChainState, Reading, advance
from isocharge.serve.signal_chain.thermal import NO_DRIFT, ThermalRule, track_thermal_drift

BYTES_TO_RECOGNISE = 8192
"""After so many bytes without one intact frame, they are not frames at all."""


class Policy(StrEnum):
    """Which frames get a record; the chain sees all of them either way."""

    every = "every"
    latest = "latest"


@dataclass(slots=True)
class StreamCounts:
    """What happened on the way, besides what parser and gaps count.

    Attributes:
        records: Records made.
        skipped: Frames without a record, because a newer one was there (`Policy.latest`).
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
    path = TouchStream(predictor, chain=chain, parser=parser, gaps=gaps)
    for chunk in chunks:
        yield from path.feed(chunk)
    path.finish()


class TouchStream:
    """The path from chunks to records, with its state; belongs to one thread.

    Attributes:
        parser, gaps, clock: Their counters say what happened.
        counts: The rest of what happened.
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
        self._largest = self._chain.largest
        self._picker = ChannelPicker(electrodes, device.channels, predictor.metadata.label)
        self._scribe = RecordBuilder.of(predictor)
        self._state = ChainState.start(len(electrodes))
        self._policy = policy
        self._now_ns = now_ns
        self._news: tuple[str, ...] = ()
        self._since_s = 0.0
        self._warming_rule = device.common_mode(electrodes)
        self._warming = NO_DRIFT

    def tare(self) -> None:
        """Forget the tare; the next quiet frames are the new one."""
        self._state = self._state.without_tare()

    def feed(self, chunk: Chunk) -> Iterator[PredictionRecord]:
        """The records of the frames that end in this chunk.

        Raises:
            As `stream`.
        """
        if chunk.outage_s > 0.0:
            self._begin_anew()
        frames = self.parser.feed(chunk.data)
        last = len(frames) - 1
        for at, frame in enumerate(frames):
            reading, when, flags = self._advance(frame, chunk)
            if self._policy is Policy.latest and at < last:
                self.counts.skipped += 1
                continue
            self.counts.records += 1
            yield self._scribe.record(chunk, frame, reading, when, flags, self._now_ns)
        if frames:
            self.clock.arrived(chunk.timestamp)
        else:
            _check_recognised(self.parser)

    def finish(self) -> None:
        """Nothing more comes, as at the end of a file.

        Raises:
            PortError: If there was not one intact frame.
        """
        _check_recognised(self.parser, allowed=-1)

    def _begin_anew(self) -> None:
        """After an outage: nothing that came before goes on, and the film may have been touched meanwhile."""
        self.counts.outages += 1
        self.parser.forget()
        self.gaps.forget()
        self.clock.forget()
        self.tare()
        self._news = (RECONNECTED,)

    def _advance(self, frame: Frame, chunk: Chunk) -> tuple[Reading, ReadingTime, tuple[str, ...]]:
        """Take a frame through clock and chain."""
        when = self.clock.read(frame.t_us, self.parser.t_us_modulus, chunk.timestamp)
        flags = self._news + self.gaps.update(frame.seq, self.parser.seq_modulus)
        self._news = ()
        values = self._picker.pick(frame)
        self._since_s += when.step_s
        if not math.hypot(*values.tolist()) <= self._largest:
            with np.errstate(over="ignore"):  # it may be the largest number there is
                return Reading(self._chain.raw(values), None, None, contact=False), when, (*flags, INVALID)
        device_s = when.host_s if when.device_us is None else when.device_us * 1e-6
        limited = bool(frame.flags & SATURATED_BIT)
        self._state, reading = advance(self._chain, self._state, values, device_s, self._since_s, limited=limited)
        if self._warming_rule is not None:
            flags += self._follow_warming(self._warming_rule, reading, self._since_s)
        self._since_s = 0.0
        return reading, when, flags

    def _follow_warming(self, rule: ThermalRule, reading: Reading, dt_s: float) -> tuple[str, ...]:
        """Take what is found from the charges of the next frames on; the flags that it earns."""
        before = self._warming
        if not reading.contact or reading.charge_pC is None:
            self._warming = NO_DRIFT
            return ()
        if SATURATED in reading.flags:  # a clipped charge fits no contact, whatever the temperature
            return ()
        self._warming = now = track_thermal_drift(rule, before, reading.charge_pC, self._misfit, dt_s)
        if now.charge_pC != before.charge_pC:
            self._state = self._state.shifted(now.charge_pC - before.charge_pC)
        return (THERMAL,) * (abs(now.charge_pC) >= rule.tell_pC) + (BLIND,) * now.blind

    def _misfit(self, charge_pC: Array) -> Reals:
        """Of the model, shape (n,), for charges of shape (n, electrodes), pC."""
        return self._scribe.predictor.predict_batch(charge_pC).misfit


def _check_recognised(parser: Parser, allowed: int = BYTES_TO_RECOGNISE) -> None:
    counts = parser.counts
    if counts.frames == 0 and counts.bytes_dropped > allowed:
        raise PortError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form); {parser.format}: check baud rate and device"
        )
