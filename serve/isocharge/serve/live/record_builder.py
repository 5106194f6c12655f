"""Prediction records from readings."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from isocharge.arrays import Array
from isocharge.serve.flags import INVALID
from isocharge.serve.frames.frame import Frame
from isocharge.serve.port.device_clock import ReadingTime
from isocharge.serve.port.serial_port import Chunk
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.record import OUT_OF_CONTACT, UNKNOWN, Charges, PredictionRecord
from isocharge.serve.prediction.validity import Domain
from isocharge.serve.signal_chain.chain import Reading


@dataclass(frozen=True, slots=True)
class RecordBuilder:
    """Writes records; holds what is the same in each."""

    predictor: Predictor
    domain: Domain
    electrodes: tuple[str, ...]
    model: str
    frame_id: str

    @classmethod
    def of(cls, predictor: Predictor) -> "RecordBuilder":
        metadata = predictor.metadata
        return cls(predictor, Domain.of(metadata), metadata.electrodes, metadata.label, metadata.frame_id)

    def record(
        self,
        chunk: Chunk,
        frame: Frame,
        reading: Reading,
        when: ReadingTime,
        flags: tuple[str, ...],
        now_ns: Callable[[], int],
    ) -> PredictionRecord:
        """What one reading means."""
        felt, flags = self._feel(reading, flags + reading.flags)
        return PredictionRecord(
            timestamp=when.host_s,
            t_device_us=when.device_us,
            seq=frame.seq,
            **felt,
            contact=reading.contact,
            charge_pC=self._named(reading.charge_pC),
            charge_raw_pC=self._named(reading.raw_pC),
            tare_pC=self._named(reading.tare.charge_pC if reading.tare else None),
            flags=flags,
            latency_us=(now_ns() - chunk.clock_ns) / 1e3,
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
