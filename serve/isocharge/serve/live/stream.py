"""Stream that computes prediction records from chunks of bytes.

Each record contains the charges of one frame, and the contact that was computed from these charges.
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
"""Flags of a frame without a record that are added to the next record. They describe events before the next record."""


class Policy(StrEnum):
    """Rule that decides which frames have a record: all frames, or only the latest frame of each chunk.

    Whichever rule is chosen, the signal chain processes all frames.
    """

    every = "every"
    latest = "latest"


@dataclass(slots=True)
class StreamCounts:
    """Counts of a stream that neither its parser nor its counter of missing frame numbers contains.

    Attributes:
        records: Number of records that the stream has yielded.
        skipped: Number of frames that have no record, because the same chunk contained a newer frame (`Policy.latest`).
        outages: Number of outages of the port after which the stream has continued.
    """

    records: int = 0
    skipped: int = 0
    outages: int = 0


class StreamTotals(NamedTuple):
    """Counts of a stream since it began, including the counts before its latest restart.

    The classes `FrameCounts` and `SequenceGaps` describe the meaning of each count.
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
    """Compute the prediction record of every intact frame in the chunks, and yield the records.

    Args:
        chunks: Chunks of bytes with the times of their arrival, for example an open `Port`.
        predictor: Model with which the contacts are predicted.
        device: Settings of the board, as `load_device` returns them.
        chain: Settings of the signal chain. By default, the settings in the device file are used.
        parser: Parser of the frames, whose counters the caller can read. By default, the parser that the device file
            describes is used.
        gaps: Counter of missing frame numbers, which the caller can read. By default, a new counter is created.

    Raises:
        ChargeError: If a frame has no value for an electrode of the model.
        DeviceError: If the device file contains settings for other electrodes than those of the model.
        TareError: If the film is touched during the whole search for a tare.
        PortError: If the stream has contained no intact frame in many bytes.
        PortLost: If the port disappears.
    """
    touch = TouchStream(predictor, device, chain=chain, parser=parser, gaps=gaps)
    for chunk in chunks:
        yield from touch.feed(chunk)
    touch.finish()


class TouchStream:
    """Stream that computes prediction records from chunks of bytes, and stores the state of the computation.

    Each object may be used by only one thread.

    Attributes:
        parser: Parser that finds the frames in the bytes and counts them.
        gaps: Counter of missing frame numbers.
        clock: Clock of the device.
        counts: Numbers of records, of skipped frames and of outages.
        predictor: The loaded model. If the film is followed (the stream estimates its pretension), the contacts are
            predicted with `answering_predictor` instead.
        frame_id: Name of the film, which each record contains.
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
        """Create the signal chain and the stages that compute the contact.

        Args:
            predictor: Model with which the contacts are predicted.
            device: Settings of the board.
            chain: Settings of the signal chain. By default, the settings in the device file are used.
            parser: Parser of the frames. By default, the parser that the device file describes is used.
            gaps: Counter of missing frame numbers. By default, a new counter is created.
            policy: Rule that decides for which frames the stream yields a record.
            now_ns: Function that returns the present time, ns, on the clock of `Chunk.clock_ns`. It is used to measure
                the latency of each record.
            frame_id: Name of the film, which each record contains. By default, the name in the metadata of the model is
                used.

        Raises:
            DeviceError: If the device file contains settings for other electrodes than those of the model.
            ModelError: If the device file requires an estimate of the pretension, but the pretension of this film
                cannot be estimated with the model.
        """
        self._readings = ReadingStream(
            predictor.metadata.electrodes,
            device,
            chain=chain,
            parser=parser,
            gaps=gaps,
            misfit=self._misfit,  # uses the model, but is only called for frames, after `_set_model` below
            reader=f"model {predictor.metadata.label}",
        )
        # Objects that the caller may read
        self.parser = self._readings.parser
        self.gaps = self._readings.gaps
        self.clock = self._readings.clock
        self.counts = StreamCounts()

        self._before_restart = StreamTotals()  # counts of the time before the latest `restart`
        self._policy = policy
        self._now_ns = now_ns

        # Settings and objects from which `_set_model` creates the stages
        self._tracker = None
        if device.track is not None:
            self._tracker = Tracker(device.track)
        self._given_name = frame_id
        self._follow_rule = device.follow
        self._touch_offset_rule = device.touch_offset
        self._set_model(predictor)

    def _set_model(self, predictor: Predictor) -> None:
        """Create the stages that the device file requires, and use them from the next frame on.

        All stages are created before the first attribute is changed. If a stage cannot be created, the stream therefore
        remains unchanged.

        Args:
            predictor: Model with which the stages begin. If the pretension of the film is estimated, the stages change
                their model later.

        Raises:
            ModelError: If a stage cannot use the model.
        """
        model = CurrentModel(predictor)  # shared by all stages
        # The stages process each frame in the order of this list.
        stages: list[ContactStage] = [PredictionStage(model)]
        film_stage = None
        if self._follow_rule is not None:
            film_stage = FilmStage(model, self._follow_rule, self._readings.warming_ratio)
            stages.append(film_stage)
        if self._tracker is not None:
            stages.append(TrackingStage(self._tracker, predictor, is_pretension_estimated=film_stage is not None))
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
        """Use another model with the same electrodes from the next frame on.

        The tare and the state of the signal chain are not changed. The estimates of the contact stages, for example of
        the pretension of the film, begin again.

        Raises:
            ModelError: If the model has other electrodes or another order of the electrodes, or if a stage cannot use
                the model. The present model then remains in use.
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
        """Whether contacts are tracked. If contacts are tracked, the records contain the fields of `Tracking`."""
        return self._tracker is not None

    @property
    def has_film(self) -> bool:
        """Whether the film is followed, that is, whether its pretension is estimated.

        If the film is followed, the records contain the field `film`.
        """
        return self._follow_rule is not None

    @property
    def answering_predictor(self) -> Predictor:
        """Model with which the contacts are predicted at present.

        If the pretension of the film is estimated, the value is the model of the film at its estimated pretension.
        Otherwise, the value is the loaded model.
        """
        return self._model.predictor

    def tare(self) -> None:
        """Discard the tare, and measure it again from the next quiet frames."""
        self._readings.tare()
        self._discard_contact()

    def reset_film(self) -> None:
        """Reset the estimated pretension of the film to the value of its calibration.

        If the pretension is not estimated, nothing changes.
        """
        if self._film_stage is not None:
            self._film_stage.reset_film()

    def _discard_contact(self) -> None:
        """Discard the state of the present contact in all stages, for example after an outage."""
        for stage in self._stages:
            stage.reset()

    def restart(self) -> None:
        """Return to the state of a new stream, so that all later records depend only on later bytes.

        Only the counts that `totals` returns include the time before the restart.
        """
        self._before_restart = self.totals()  # `totals` adds these counts to the counts of the new parser
        self._readings.restart()
        self._discard_contact()
        self.reset_film()

        # `self._readings.restart` has created new objects.
        self.parser = self._readings.parser
        self.gaps = self._readings.gaps
        self.clock = self._readings.clock

    def totals(self) -> StreamTotals:
        """Return the counts of the stream since it began, including the counts before its latest restart."""
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
        count_pairs = zip(self._before_restart, since_restart, strict=True)
        sums = [count_before + count_since for count_before, count_since in count_pairs]
        return StreamTotals(*sums)

    def feed(self, chunk: Chunk) -> Iterator[PredictionRecord]:
        """Process a chunk, and yield the records of the frames whose last byte is in the chunk.

        With the policy `latest`, only the last frame of the chunk has a record.

        Raises:
            ChargeError: If a frame has no value for an electrode of the model.
            TareError: If the film is touched during the whole search for a tare.
            PortError: If the stream has contained no intact frame in many bytes.
        """
        if chunk.outage_s > 0.0:
            self.counts.outages += 1
            self._discard_contact()
        frames = self._readings.frames(chunk)
        skipped_flags: set[str] = set()  # flags of the frames in this chunk that have no record
        for number, (frame, frame_time) in enumerate(frames, start=1):
            timed = self._readings.advance(frame, frame_time)  # the signal chain also processes the skipped frames
            is_last = number == len(frames)
            is_skipped = self._policy is Policy.latest and not is_last
            if is_skipped:
                self.counts.skipped += 1
                skipped_flags.update(timed.reading.flags)
                continue
            if skipped_flags:
                timed = timed._replace(reading=_with_lasting_flags(timed.reading, skipped_flags))
            self.counts.records += 1
            yield self._record(chunk, frame, timed)

    def finish(self) -> None:
        """Finish the stream, for example at the end of a file.

        Raises:
            PortError: If the whole stream has contained no intact frame.
        """
        self._readings.finish()

    def _record(self, chunk: Chunk, frame: Frame, timed: TimedReading) -> PredictionRecord:
        """Compute the contact of a frame, and return the prediction record of the frame.

        Args:
            chunk: The chunk that contains the last byte of the frame.
            frame: The frame.
            timed: Touch charges and time of the frame.
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
            latency_us=(self._now_ns() - chunk.clock_ns) / 1e3,  # includes the time that the stages have taken
            model=self._label,
            frame_id=self.frame_id,
            tracking=contact_frame.tracking,
            film=contact_frame.film,
        )

    def _by_electrode(self, charge_pC: Array | None) -> Charges | None:
        """Return the charges as a dictionary by electrode name. A charge that is not a finite number becomes None.

        Args:
            charge_pC: Charges in the order of the electrodes, shape (n_electrode,), pC; None if there are no charges.
        """
        if charge_pC is None:
            return None
        charges: Charges = {}
        for name, charge in zip(self._electrodes, charge_pC.tolist(), strict=True):
            charges[name] = charge if math.isfinite(charge) else None
        return charges

    def _misfit(self, charge_pC: Array) -> Reals:
        """Return the misfit of each frame: the difference between its charges and those of the nearest contact.

        Args:
            charge_pC: Charges of n frames, shape (n, n_electrode), pC.

        Returns:
            Misfits, shape (n,), in standard deviations of the noise.
        """
        return self.answering_predictor.predict_batch(charge_pC).misfit


def _contact_fields(frame: ContactFrame) -> Mapping[str, Any]:
    """Return the names and values of those fields of a record that describe the contact.

    If the frame has no contact because it is invalid, all values are None. If it has no contact because nothing touches
    the film, the force is 0, and the position is None.
    """
    if frame.contact is not None:
        return frame.contact.fields()
    if INVALID in frame.flags:
        return UNKNOWN_CONTACT
    return NO_CONTACT


def _with_lasting_flags(reading: Reading, skipped_flags: set[str]) -> Reading:
    """Return a reading to which some flags of the skipped frames before it are added.

    Only the flags in `LASTING_FLAGS` are added. Each of these flags describes an event before the reading, for example
    lost frames.

    Args:
        reading: Reading of the next frame that has a record.
        skipped_flags: All flags of the skipped frames.
    """
    added_flags = tuple(flag for flag in LASTING_FLAGS if flag in skipped_flags and flag not in reading.flags)
    return reading._replace(flags=added_flags + reading.flags)
