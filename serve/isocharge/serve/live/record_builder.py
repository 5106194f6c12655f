"""Prediction records from readings."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from isocharge.common.arrays import Array
from isocharge.serve.flags import INVALID
from isocharge.serve.frames.frame import Frame
from isocharge.serve.port.device_clock import ReadingTime
from isocharge.serve.port.serial_port import Chunk
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.record import OUT_OF_CONTACT, UNKNOWN, Charges, PredictionRecord
from isocharge.serve.prediction.validity import Validity
from isocharge.serve.signal_chain.chain import Reading


@dataclass(frozen=True, slots=True)
class RecordBuilder:
    """Builds prediction records; holds what all of them share."""

    predictor: Predictor
    validity: Validity
    electrodes: tuple[str, ...]
    model: str
    frame_id: str

    @classmethod
    def of(cls, predictor: Predictor, frame_id: str | None = None) -> "RecordBuilder":
        """The builder for a model; `frame_id` names the film, by default as the model's sensor."""
        metadata = predictor.metadata
        return cls(predictor, predictor.validity, metadata.electrodes, metadata.label, frame_id or metadata.frame_id)

    def record(
        self, chunk: Chunk, frame: Frame, reading: Reading, when: ReadingTime, now_ns: Callable[[], int]
    ) -> PredictionRecord:
        """The record of one reading.

        Args:
            chunk: The bytes in which the frame ended.
            frame: As the parser read it.
            reading: The frame after the signal chain.
            when: When it was taken.
            now_ns: The clock of `chunk.clock_ns`, asked once everything is computed.
        """
        contact, flags = self._contact(reading)
        return PredictionRecord(
            timestamp=when.host_s,
            t_device_us=when.device_us,
            seq=frame.seq,
            **contact,
            contact=reading.contact,
            charge_pC=self._by_electrode(reading.charge_pC),
            charge_raw_pC=self._by_electrode(reading.raw_pC),
            tare_pC=self._by_electrode(reading.tare.charge_pC if reading.tare else None),
            flags=flags,
            latency_us=(now_ns() - chunk.clock_ns) / 1e3,
            model=self.model,
            frame_id=self.frame_id,
        )

    def _contact(self, reading: Reading) -> tuple[dict[str, Any], tuple[str, ...]]:
        """The fields of the contact, and the reading's flags with those of the contact."""
        flags = reading.flags
        if INVALID in flags:
            return UNKNOWN, flags
        if not reading.contact or reading.charge_pC is None:
            return OUT_OF_CONTACT, flags
        contact = self.predictor.predict(reading.charge_pC)
        return contact._asdict(), flags + self.validity.flags(contact)

    def _by_electrode(self, charge_pC: Array | None) -> Charges | None:
        """Charges by electrode name; None for one that is not a number."""
        if charge_pC is None:
            return None
        values = charge_pC.tolist()
        return {name: q if math.isfinite(q) else None for name, q in zip(self.electrodes, values, strict=True)}
