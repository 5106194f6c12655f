"""The stream that computes prediction records from chunks of bytes.

Each record has the charges of a frame and the contact that was computed from them.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from isocharge.common.arrays import Array, Reals
from isocharge.common.errors import ModelError
from isocharge.serve.flags import GAP, INVALID, RECONNECTED, REPEAT, RESTART
from isocharge.serve.frames.frame import Frame, Parser, SequenceGaps
from isocharge.serve.live.contact_stages import (
    ChargeScaleStage,
    ContactFrame,
    ContactStage,
    CurrentModel,
    FilmStage,
    PredictionStage,
    TouchOffsetStage,
    TrackingStage,
)
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.live.reading_stream import ReadingStream, TimedReading
from isocharge.serve.port.source import Chunk
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.record.record import NO_CONTACT, UNKNOWN_CONTACT, Charges, PredictionRecord
from isocharge.serve.signal_chain.chain import Chain, Reading
from isocharge.serve.tracking.tracker import Tracker

LASTING_FLAGS = (RECONNECTED, GAP, REPEAT, RESTART)
"""Flags that the next record receives if a frame has no record. The flags describe events before that record."""


class Policy(StrEnum):
    """Which frames have a record. With both policies, the signal chain processes all frames."""

    every = "every"
    latest = "latest"


@dataclass(slots=True)
class StreamCounts:
    """Counts of a stream, in addition to the counts of its parser and of its frame numbers.

    Attributes:
        records: Number of records.
        skipped: Number of frames without a record, because a newer frame had arrived with them (`Policy.latest`).
        outages: Number of times that the port was connected again after an outage.
    """

    records: int = 0
    skipped: int = 0
    outages: int = 0


class StreamTotals(NamedTuple):
    """All counts of a stream since it began, including the counts before a restart.

    The counts have the same meanings as in `FrameCounts` and `SequenceGaps`.
    """

    frames: int = 0
    lost: int = 0
    repeated: int = 0
    restarts: int = 0
    crc_errors: int = 0
    malformed: int = 0
    bytes_dropped: int = 0
    resyncs: int = 0


def stream(
    chunks: Iterable[Chunk],
    predictor: Predictor,
    device: Device = ANY_BOARD,
    *,
    chain: Chain | None = None,
    parser: Parser | None = None,
    gaps: SequenceGaps | None = None,
) -> Iterator[PredictionRecord]:
    """Yield a record for every intact frame.

    Args:
        chunks: Bytes with the time of their arrival: an open `Port`, or another iterable of chunks.
        predictor: The model of this sensor.
        device: Settings of the board, from `load_device`.
        chain: Settings of the signal chain; by default those of the device.
        parser: Parser of the frames, for example to read its counters; by default that of the device.
        gaps: Counter of missing frame numbers, for example to read it; by default a new one.

    Raises:
        ChargeError: If a frame has another number of charges than the model.
        DeviceError: If the device file has other electrodes than the model.
        TareError: If the film is touched during the whole search for a tare.
        PortError: If the bytes contain no frames.
        PortLost: If the port disappears.
    """
    touch = TouchStream(predictor, device, chain=chain, parser=parser, gaps=gaps)
    for chunk in chunks:
        yield from touch.feed(chunk)
    touch.finish()


class TouchStream:
    """The path from chunks to records. The object stores the state of the path. An object belongs to one thread.

    Attributes:
        parser: Parser of the frames, with its counters.
        gaps: Counter of missing frame numbers.
        clock: Clock of the device.
        counts: Records, skipped frames and outages.
        predictor: The loaded model. If the film is followed, `answering_predictor` is the model of the film at its
            estimated pretension.
        frame_id: Name of the film in the records.
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
        frame_id: str | None = None,
    ) -> None:
        """Connect the parts of the path.

        Args:
            predictor: The model of this sensor.
            device: Settings of the board.
            chain: Settings of the signal chain; by default those of the device.
            parser: Parser of the frames; by default that of the device.
            gaps: Counter of missing frame numbers; by default a new one.
            policy: Which frames have a record.
            now_ns: Function that returns the time of the clock of `Chunk.clock_ns`, ns, for latencies.
            frame_id: Name of this film in its records; by default that of the model's sensor.

        Raises:
            DeviceError: If the device file has other electrodes than the model.
            ModelError: If the film is to be followed, but the model does not allow it.
        """
        self._readings = ReadingStream(
            predictor.metadata.electrodes,
            device,
            chain=chain,
            parser=parser,
            gaps=gaps,
            misfit=self._misfit,
            reader=f"model {predictor.metadata.label}",
        )
        self.parser = self._readings.parser
        self.gaps = self._readings.gaps
        self.clock = self._readings.clock
        self.counts = StreamCounts()
        self._tracker = None
        if device.track is not None:
            self._tracker = Tracker(device.track)
        self._before_restart = StreamTotals()  # counts of the time before the latest `restart`
        self._policy = policy
        self._now_ns = now_ns
        self._given_name = frame_id
        self._follow_rule = device.follow
        self._touch_offset_rule = device.touch_offset
        self._set_model(predictor)

    def _set_model(self, predictor: Predictor) -> None:
        """Build the stages that the device file requests, and use them from the next frame on.

        All stages are built before the first attribute is changed, so that an error changes nothing.

        Args:
            predictor: The model, with which the stages begin.

        Raises:
            ModelError: If a stage cannot use the model. The stream then keeps its stages.
        """
        model = CurrentModel(predictor)
        stages: list[ContactStage] = [PredictionStage(model)]
        film_stage = None
        if self._follow_rule is not None:
            film_stage = FilmStage(model, self._follow_rule, self._readings.warming_ratio)
            stages.append(film_stage)
        if self._tracker is not None:
            stages.append(TrackingStage(self._tracker, predictor, is_film_followed=film_stage is not None))
        stages.append(ChargeScaleStage(model))
        if self._touch_offset_rule is not None:
            stages.append(TouchOffsetStage(model, self._touch_offset_rule, self._readings.warming_ratio))

        self._model = model
        self._stages = stages
        self._film_stage = film_stage
        self.predictor = predictor
        self._electrodes = predictor.metadata.electrodes
        self._label = predictor.metadata.label
        self.frame_id = self._given_name or predictor.metadata.frame_id

    def use(self, predictor: Predictor) -> None:
        """Continue with another model of the same electrodes. The tare and the signal chain keep their state.

        Raises:
            ModelError: If the model has other electrodes, or the electrodes in another order, or a stage cannot use
                the model. The stream then keeps its present model.
        """
        present = self.predictor.metadata
        new = predictor.metadata
        if new.electrodes != present.electrodes:
            raise ModelError(
                f"model {new.label}: expected the electrodes {present.electrodes} of {present.label}, got "
                f"{new.electrodes}; start another stream for it"
            )
        self._set_model(predictor)

    @property
    def has_tracking(self) -> bool:
        """Whether contacts are tracked, so that records have the fields of a `Tracking`."""
        return self._tracker is not None

    @property
    def has_film(self) -> bool:
        """Whether the film is followed, so that records have the field `film`."""
        return self._follow_rule is not None

    @property
    def answering_predictor(self) -> Predictor:
        """The current model. If the film is followed, this is the model of the film at its estimated pretension."""
        return self._model.predictor

    def tare(self) -> None:
        """Discard the tare, and measure it again from the next quiet frames."""
        self._readings.tare()
        self._discard_contact()

    def reset_film(self) -> None:
        """Reset the followed film to its calibration. If the film is not followed, nothing changes."""
        if self._film_stage is not None:
            self._film_stage.reset_film()

    def _discard_contact(self) -> None:
        """Discard the present contact."""
        for stage in self._stages:
            stage.reset()

    def restart(self) -> None:
        """Return to the state of a new stream, so that later records depend only on later bytes.

        The counts of `totals` continue.
        """
        self._before_restart = self.totals()  # `totals` adds them to the counts of the new parser
        self._readings.restart()
        self._discard_contact()
        self.reset_film()

        # The path from chunks to readings has created new objects.
        self.parser = self._readings.parser
        self.gaps = self._readings.gaps
        self.clock = self._readings.clock

    def totals(self) -> StreamTotals:
        """Return the counts since the stream began."""
        counts = self.parser.counts
        since_restart = StreamTotals(
            frames=counts.frames,
            lost=self.gaps.lost,
            repeated=self.gaps.repeated,
            restarts=self.gaps.restarts,
            crc_errors=counts.crc_errors,
            malformed=counts.malformed,
            bytes_dropped=counts.bytes_dropped,
            resyncs=counts.resyncs,
        )
        pairs = zip(self._before_restart, since_restart, strict=True)
        return StreamTotals(*(before + since for before, since in pairs))

    def feed(self, chunk: Chunk) -> Iterator[PredictionRecord]:
        """Yield the records of the frames that end in this chunk.

        Raises:
            ChargeError: If a frame has another number of charges than the model.
            TareError: If the film is touched during the whole search for a tare.
            PortError: If the bytes contain no frames.
        """
        if chunk.outage_s > 0.0:
            self.counts.outages += 1
            self._discard_contact()
        frames = self._readings.frames(chunk)
        # The policy `latest` gives a record only to the last frame of a chunk. The signal chain needs all frames. The
        # flags of skipped frames are collected, because some of them also matter for the frame with the record.
        skipped_flags: set[str] = set()
        for number, frame in enumerate(frames, start=1):
            timed = self._readings.advance(frame, chunk)
            is_last = number == len(frames)
            if self._policy is Policy.latest and not is_last:
                self.counts.skipped += 1
                skipped_flags.update(timed.reading.flags)
                continue
            if skipped_flags:
                timed = timed._replace(reading=_with_lasting_flags(timed.reading, skipped_flags))
            self.counts.records += 1
            yield self._record(chunk, frame, timed)
        self._readings.end_chunk(frames, chunk)

    def finish(self) -> None:
        """End the stream, as at the end of a file.

        Raises:
            PortError: If there was no intact frame.
        """
        self._readings.finish()

    def _record(self, chunk: Chunk, frame: Frame, timed: TimedReading) -> PredictionRecord:
        """Return the record of a frame. The latency is measured last, after the contact has been computed.

        Args:
            chunk: The chunk in which the frame ends.
            frame: The frame.
            timed: Charges of the frame, and its time.
        """
        reading, reading_time = timed
        contact_frame = ContactFrame(reading, reading_time.clock_s, reading.flags)
        for stage in self._stages:
            stage.step(contact_frame)
        tare_pC = None
        if reading.tare is not None:
            tare_pC = reading.tare.charge_pC
        return PredictionRecord(
            timestamp=reading_time.host_s,
            t_device_us=reading_time.device_us,
            seq=frame.seq,
            **_contact_fields(contact_frame),
            contact=reading.contact,
            charge_pC=self._by_electrode(reading.charge_pC),
            charge_raw_pC=self._by_electrode(reading.raw_pC),
            tare_pC=self._by_electrode(tare_pC),
            flags=contact_frame.flags,
            latency_us=(self._now_ns() - chunk.clock_ns) / 1e3,
            model=self._label,
            frame_id=self.frame_id,
            tracking=contact_frame.tracking,
            film=contact_frame.film,
        )

    def _by_electrode(self, charge_pC: Array | None) -> Charges | None:
        """Return charges by electrode name; None for a charge that is not a number."""
        if charge_pC is None:
            return None
        charges: Charges = {}
        for name, charge in zip(self._electrodes, charge_pC.tolist(), strict=True):
            charges[name] = charge if math.isfinite(charge) else None
        return charges

    def _misfit(self, charge_pC: Array) -> Reals:
        """Return the misfits of charges with the current model.

        The charges (pC) have the shape (n, electrodes), and the misfits have the shape (n,).
        """
        return self.answering_predictor.predict_batch(charge_pC).misfit


def _contact_fields(frame: ContactFrame) -> Mapping[str, Any]:
    """Return the fields of a record that describe its contact.

    The fields are null if the frame is invalid. If nothing touches, the force is 0 and the position is null.
    """
    if frame.contact is not None:
        return frame.contact.fields()
    if INVALID in frame.flags:
        return UNKNOWN_CONTACT
    return NO_CONTACT


def _with_lasting_flags(reading: Reading, skipped_flags: set[str]) -> Reading:
    """Add flags of skipped frames to a reading.

    Only flags that describe earlier events, such as lost frames, are added.

    Args:
        reading: The reading.
        skipped_flags: All flags of the skipped frames.
    """
    added_flags = tuple(flag for flag in LASTING_FLAGS if flag in skipped_flags and flag not in reading.flags)
    return reading._replace(flags=added_flags + reading.flags)
