"""Chunks of bytes in, prediction records out: parser, signal chain and predictor put in order."""

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.errors import ChargeError, PortError
from isocharge.serve.arrays import Array
from isocharge.serve.binary import BinaryParser
from isocharge.serve.chain import Chain, ChainState, Reading, advance
from isocharge.serve.domain import Domain
from isocharge.serve.flags import INVALID, SATURATED
from isocharge.serve.frames import SATURATED_BIT, Frame, SequenceGaps
from isocharge.serve.port import Chunk
from isocharge.serve.predictor import Predictor
from isocharge.serve.record import OUT_OF_CONTACT, UNKNOWN, Charges, PredictionRecord

NOTHING = Reading(None, None, contact=False)
BYTES_TO_RECOGNISE = 8192
"""After so many bytes without one intact frame, they are not frames at all."""


def stream(
    chunks: Iterable[Chunk],
    predictor: Predictor,
    chain: Chain | None = None,
    *,
    parser: BinaryParser | None = None,
    gaps: SequenceGaps | None = None,
) -> Iterator[PredictionRecord]:
    """A record for every intact frame.

    Args:
        chunks: Bytes with the time of their arrival: an open `Port`, or anything like it.
        predictor: The model of this sensor.
        chain: Rules of the signal chain.
        parser: Turns bytes into frames; hand one in to read its counters.
        gaps: Follows the frame numbers; hand one in to read its counters.

    Raises:
        ChargeError: If a frame has another number of charges than the model.
        TareError: If the film is not left alone to tare.
        PortError: If the bytes are no frames.
        PortLost: If the port goes away.
    """
    chain, parser, gaps = chain or Chain(), parser or BinaryParser(), gaps or SequenceGaps()
    scribe = _Scribe.of(predictor)
    state = ChainState.start(len(scribe.electrodes))
    for chunk in chunks:
        for frame in parser.feed(chunk.data):
            raw_pC, flags = scribe.raw_charges(frame), _frame_flags(frame, gaps)
            reading = NOTHING
            if INVALID not in flags:
                state, reading = advance(chain, state, raw_pC)
            yield scribe.record(chunk, frame, reading, flags)
        _check_recognised(parser)


def _frame_flags(frame: Frame, gaps: SequenceGaps) -> tuple[str, ...]:
    flags = gaps.update(frame.seq)
    if frame.flags & SATURATED_BIT:
        flags += (SATURATED,)
    return flags if math.isfinite(sum(frame.values)) else (*flags, INVALID)


def _check_recognised(parser: BinaryParser) -> None:
    counts = parser.counts
    if counts.frames == 0 and counts.bytes_dropped > BYTES_TO_RECOGNISE:
        raise PortError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form); expected binary frames of isocharge: check baud rate and device"
        )


@dataclass(frozen=True, slots=True)
class _Scribe:
    """Writes records; holds what is the same in each."""

    predictor: Predictor
    domain: Domain
    electrodes: tuple[str, ...]
    model: str
    frame_id: str

    @classmethod
    def of(cls, predictor: Predictor) -> "_Scribe":
        metadata = predictor.metadata
        return cls(predictor, Domain.of(metadata), metadata.electrodes, metadata.label, metadata.frame_id)

    def raw_charges(self, frame: Frame) -> Array:
        """Charges of a frame, shape (electrodes,), pC; a ChargeError if there are too many or too few."""
        if len(frame.values) != len(self.electrodes):
            raise ChargeError(
                f"model {self.model} expects {len(self.electrodes)} charges {self.electrodes}, frame {frame.seq} "
                f"has {len(frame.values)}; choose the model of this sensor"
            )
        return np.array(frame.values)

    def record(self, chunk: Chunk, frame: Frame, reading: Reading, flags: tuple[str, ...]) -> PredictionRecord:
        """What one reading means."""
        felt, flags = self._feel(reading, flags + reading.flags)
        return PredictionRecord(
            timestamp=chunk.timestamp,
            t_device_us=frame.t_us,
            seq=frame.seq,
            **felt,
            contact=reading.contact,
            charge_pC=self._named(reading.charge_pC),
            charge_raw_pC=self._named(np.array(frame.values)),
            tare_pC=self._named(reading.tare.charge_pC if reading.tare else None),
            flags=flags,
            latency_us=(time.perf_counter_ns() - chunk.clock_ns) / 1e3,
            model=self.model,
            frame_id=self.frame_id,
        )

    def _feel(self, reading: Reading, flags: tuple[str, ...]) -> tuple[dict[str, Any], tuple[str, ...]]:
        """The fields of the contact, and the flags with those that the contact earns."""
        if INVALID in flags:
            return UNKNOWN, flags
        if not reading.contact or reading.charge_pC is None:
            return OUT_OF_CONTACT, flags
        contact = self.predictor.predict(reading.charge_pC)
        return contact._asdict(), flags + self.domain.flags(contact)

    def _named(self, charge_pC: Array | None) -> Charges | None:
        """Charges by electrode name; None for one that is not a number."""
        if charge_pC is None:
            return None
        values = charge_pC.tolist()
        return {name: q if math.isfinite(q) else None for name, q in zip(self.electrodes, values, strict=True)}
