"""Chunks of bytes in, prediction records out: the stream of readings, each with the answer of a model."""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

from isocharge.common.arrays import Array, Reals
from isocharge.common.errors import ModelError
from isocharge.serve.flags import FILM, GAP, INVALID, RECONNECTED, REPEAT, RESTART
from isocharge.serve.frames.frame import Frame, Parser, SequenceGaps
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.live.reading_stream import ReadingStream, TimedReading
from isocharge.serve.port.source import Chunk
from isocharge.serve.prediction.contact import Contact, Sensitivity
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.record.record import (
    NO_CONTACT,
    NO_TRACKING,
    UNKNOWN_CONTACT,
    Charges,
    PredictionRecord,
    Tracking,
)
from isocharge.serve.signal_chain.chain import Chain, Reading
from isocharge.serve.tracking.branches import branches_of
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.serve.tracking.tracker import Tracker

LASTING_FLAGS = (RECONNECTED, GAP, REPEAT, RESTART)
"""Flags of a frame without a record that pass to the next record: they say what happened before it."""

DOUBT = 0.01
"""Share of all touch charges by which it is told how contacts depend on what is not known of the film's memory."""

LARGEST_POWER = 1.5
"""Growth of the force with all charges together, in powers: that of a film without pretension, the others' is less."""


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


class StreamTotals(NamedTuple):
    """Everything that a stream has counted since it began, restarts included; see `FrameCounts` and `SequenceGaps`."""

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
    """A record for every intact frame.

    Args:
        chunks: Bytes with the time of their arrival: an open `Port`, or anything like it.
        predictor: The model of this sensor.
        device: What is known about the board, of `load_device`.
        chain: Rules of the signal chain; by default those of the device.
        parser: Turns bytes into frames; hand one in to read its counters. By default that of the device.
        gaps: Follows the frame numbers; hand one in to read its counters.

    Raises:
        ChargeError: If a frame has another number of charges than the model.
        DeviceError: If the device file has other electrodes than the model.
        TareError: If the film is not left alone to tare.
        PortError: If the bytes are no frames.
        PortLost: If the port goes away.
    """
    touch = TouchStream(predictor, device, chain=chain, parser=parser, gaps=gaps)
    for chunk in chunks:
        yield from touch.feed(chunk)
    touch.finish()


class TouchStream:
    """The path from chunks to records, with its state; belongs to one thread.

    Attributes:
        parser, gaps, clock: The parts that read the frames, with their counters.
        counts: Records, skipped frames and outages.
        predictor: The model of the next record.
        frame_id: The film's name in the records.
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
        """Put the path together.

        Args:
            predictor: The model of this sensor.
            device: What is known about the board.
            chain: Rules of the signal chain; by default those of the device.
            parser: By default that of the device.
            gaps: Follows the frame numbers.
            policy: Which frames get a record.
            now_ns: The clock of `Chunk.clock_ns`, for latencies.
            frame_id: Name of this film in its records; by default that of the model's sensor.

        Raises:
            DeviceError: If the device file has other electrodes than the model.
            ModelError: If the film is to be followed, and the model cannot.
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
        self.parser, self.gaps, self.clock = self._readings.parser, self._readings.gaps, self._readings.clock
        self.counts = StreamCounts()
        self._tracker = None if device.track is None else Tracker(device.track)
        self._before_restart = StreamTotals()
        self._policy, self._now_ns, self._given_name, self._follow = policy, now_ns, frame_id, device.follow
        self._use(predictor)

    def _use(self, predictor: Predictor) -> None:
        self._follower = None if self._follow is None else FilmFollower(predictor, self._follow)
        self.predictor, self._validity = predictor, predictor.validity
        if self._tracker is not None:
            self._tracker.branches = branches = branches_of(predictor)
            if branches is not None:
                self._validity_followed = replace(self._validity, corners_mm=branches.charges.corners_mm)
        self._electrodes, self._label = predictor.metadata.electrodes, predictor.metadata.label
        self.frame_id = self._given_name or predictor.metadata.frame_id
        self._of_doubt = Sensitivity(DOUBT)

    def use(self, predictor: Predictor) -> None:
        """Go on with another model of the same electrodes; tare and chain stay as they are.

        Raises:
            ModelError: If its electrodes are others, or in another order, or its film cannot be followed as this one
                is; nothing changes then.
        """
        before, after = self.predictor.metadata, predictor.metadata
        if after.electrodes != before.electrodes:
            raise ModelError(
                f"model {after.label}: expected the electrodes {before.electrodes} of {before.label}, got "
                f"{after.electrodes}; start another stream for it"
            )
        self._use(predictor)

    @property
    def has_tracking(self) -> bool:
        """Whether contacts are tracked, so that records have the fields of a `Tracking`."""
        return self._tracker is not None

    @property
    def has_film(self) -> bool:
        """Whether the film is followed, so that records have the field `film`."""
        return self._follow is not None

    def tare(self) -> None:
        """Forget the tare; the next quiet frames are the new one."""
        self._readings.tare()
        self._forget_contact()

    def back(self) -> None:
        """Go back to the film as it was calibrated, where it is followed."""
        if self._follower is not None:
            self._follower.back()

    def _forget_contact(self) -> None:
        self._of_doubt = Sensitivity(DOUBT)
        if self._follower is not None:
            self._follower.forget()
        if self._tracker is not None:
            self._tracker.forget()

    def restart(self) -> None:
        """Begin as a new stream does, so that what follows can be repeated from its bytes alone; `totals` go on."""
        self._before_restart = self.totals()
        self._readings.restart()
        self._forget_contact()
        self.back()
        self.parser, self.gaps, self.clock = self._readings.parser, self._readings.gaps, self._readings.clock

    def totals(self) -> StreamTotals:
        """What was counted since the stream began."""
        frames, gaps = self.parser.counts, self.gaps
        counted = StreamTotals(
            frames.frames,
            gaps.lost,
            gaps.repeated,
            gaps.restarts,
            frames.crc_errors,
            frames.malformed,
            frames.bytes_dropped,
            frames.resyncs,
        )
        return StreamTotals(*map(sum, zip(self._before_restart, counted, strict=True)))

    def feed(self, chunk: Chunk) -> Iterator[PredictionRecord]:
        """The records of the frames that end in this chunk.

        Raises:
            As `stream`.
        """
        if chunk.outage_s > 0.0:
            self.counts.outages += 1
            self._forget_contact()
        frames = self._readings.frames(chunk)
        last, skipped = len(frames) - 1, set[str]()
        for number, frame in enumerate(frames):
            timed = self._readings.advance(frame, chunk)
            if self._policy is Policy.latest and number < last:
                self.counts.skipped += 1
                skipped.update(timed.reading.flags)
                continue
            if skipped:
                timed = timed._replace(reading=_after(skipped, timed.reading))
            self.counts.records += 1
            yield self._record(chunk, frame, timed)
        self._readings.arrived(frames, chunk)

    def finish(self) -> None:
        """End the stream, as at the end of a file.

        Raises:
            PortError: If there was not one intact frame.
        """
        self._readings.finish()

    def _record(self, chunk: Chunk, frame: Frame, timed: TimedReading) -> PredictionRecord:
        """The record of a frame; the clock is asked once everything is computed."""
        reading, when = timed
        contact, flags = self._contact(reading)
        film = None
        if self._follower is not None:
            film = self._follower.film
            self._follower.see(reading.charge_pC, contact, flags, when.clock_s)
            flags += (FILM,) * (contact is not None and self._follower.is_lost)
        tracked, event, other, charge_pC = None, None, None, reading.charge_pC
        if self._tracker is not None:
            tracked, event = self._tracker.update(contact, when.clock_s, flags, charge_pC)
            other = self._tracker.other
        if self._tracker is not None and (answer := self._tracker.answer) is not None:
            contact, flags = answer, reading.flags + self._validity_followed.flags(answer)
            shift = 0.0, 0.0, LARGEST_POWER * reading.doubt * answer.force_N
            contact, tracked = contact.widened(shift), tracked and tracked.widened(shift)
        elif contact is not None and reading.doubt > 0.0 and charge_pC is not None:
            shift = self._of_doubt.shift(
                contact, reading.doubt, lambda: self._answers.predict(charge_pC * (1.0 + DOUBT))
            )
            contact, tracked = contact.widened(shift), tracked and tracked.widened(shift)
        if contact is not None:
            contact_values = contact.fields()
        elif INVALID in flags:
            contact_values = UNKNOWN_CONTACT
        else:
            contact_values = NO_CONTACT
        tracking = None
        if self._tracker is not None:
            found_nothing = tracked is None and event is None and other is None
            tracking = NO_TRACKING if found_nothing else Tracking(tracked, event, other)
        return PredictionRecord(
            timestamp=when.host_s,
            t_device_us=when.device_us,
            seq=frame.seq,
            **contact_values,
            contact=reading.contact,
            charge_pC=self._by_electrode(reading.charge_pC),
            charge_raw_pC=self._by_electrode(reading.raw_pC),
            tare_pC=self._by_electrode(reading.tare.charge_pC if reading.tare else None),
            flags=flags,
            latency_us=(self._now_ns() - chunk.clock_ns) / 1e3,
            model=self._label,
            frame_id=self.frame_id,
            tracking=tracking,
            film=film,
        )

    @property
    def _answers(self) -> Predictor:
        """The model of the film as it is by now."""
        return self.predictor if self._follower is None else self._follower.predictor

    def _contact(self, reading: Reading) -> tuple[Contact | None, tuple[str, ...]]:
        """The contact, None without one, and the reading's flags with those of the contact."""
        flags = reading.flags
        if INVALID in flags or not reading.contact or reading.charge_pC is None:
            return None, flags
        contact = self._answers.predict(reading.charge_pC)
        flags += self._validity.flags(contact)
        return contact if self._follower is None else self._follower.widened(contact, reading.charge_pC), flags

    def _by_electrode(self, charge_pC: Array | None) -> Charges | None:
        """Charges by electrode name; None for one that is not a number."""
        if charge_pC is None:
            return None
        values = charge_pC.tolist()
        return {name: q if math.isfinite(q) else None for name, q in zip(self._electrodes, values, strict=True)}

    def _misfit(self, charge_pC: Array) -> Reals:
        """The model's misfit, shape (n,), for charges of shape (n, electrodes), pC."""
        return self.predictor.predict_batch(charge_pC).misfit


def _after(skipped: set[str], reading: Reading) -> Reading:
    """A reading with the flags of the skipped frames before it that say what happened meanwhile."""
    earlier = tuple(flag for flag in LASTING_FLAGS if flag in skipped and flag not in reading.flags)
    return reading._replace(flags=earlier + reading.flags)
