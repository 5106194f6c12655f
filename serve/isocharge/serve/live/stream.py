"""Streams that compute touch charges and prediction records from chunks of bytes.

A parser finds the frames in the bytes, and a clock computes the time of each frame. The stages of the stream then fill
in the charges and the contact of the frame; see `isocharge.serve.live.device.STAGES`. The touch charges do not depend
on a model of the film, unless warming is estimated.
"""

import logging
import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

from isocharge.common.errors import ModelError, NoFramesError, shown
from isocharge.serve.flags import RECONNECTED, REPEAT
from isocharge.serve.frames.device_clock import DeviceClock
from isocharge.serve.frames.frame import Frame
from isocharge.serve.live.device import ANY_BOARD, create_stages
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.port.file_source import Chunk
from isocharge.serve.record.record import NO_CONTACT, UNKNOWN_CONTACT, PredictionRecord, flags_in_order
from isocharge.serve.signal_chain.stage import Device, Setup

log = logging.getLogger(__name__)


def stream(chunks: Iterable[Chunk], predictor: Predictor, device: Device = ANY_BOARD) -> Iterator[PredictionRecord]:
    """Compute the prediction record of every intact frame in the chunks, and yield the records.

    Args:
        chunks: Chunks of bytes with the times of their arrival, for example an open `Port`.
        predictor: Model with which the contacts are predicted.
        device: Settings of the board, as `load_device` returns them.

    Raises:
        ChargeError: If a frame has no value for an electrode of the model.
        DeviceError: If the device file contains settings for electrodes other than those of the model.
        TareError: If the film is touched during the whole search for a tare.
        PortError: If the stream has contained no intact frame in many bytes.
        PortLost: If the port disappears.
    """
    touch = TouchStream(predictor, device)
    for chunk in chunks:
        yield from touch.feed(chunk)
    touch.finish()


class ReadingStream:
    """Stream that computes touch charges from chunks of bytes, and stores the state of the computation.

    Each object may be used by only one thread.

    Attributes:
        parser: Parser that finds the frames in the bytes and counts them.
        clock: Clock of the device.
        dropped_at_frame: Number of dropped bytes at the latest frame; infinite after a warning.
    """

    def __init__(
        self,
        electrodes: tuple[str, ...],
        device: Device = ANY_BOARD,
        *,
        reader: str = "the sensor",
        predictor: Predictor | None = None,
        has_any_sign: bool = False,
    ) -> None:
        """Create the parser, the counters, the clock and the stages.

        Args:
            electrodes: Names of the electrodes, in the order of the charges.
            device: Settings of the board.
            reader: Name of the program part that needs these electrodes, for messages, such as "model three/1".
            predictor: Model with which warming is estimated; None if warming is not estimated.
            has_any_sign: Whether the charges of a touch may have any sign, for example because the gain is unknown.

        Raises:
            DeviceError: If the device file contains settings for other electrodes.
        """
        self._device = device
        self._setup = Setup(electrodes, device, predictor, reader, has_any_sign=has_any_sign)
        self.restart()

    def restart(self) -> None:
        """Return to the state of a new stream, so that all later results depend only on later bytes.

        The parser with its counters of frames, the clock and the stages are created anew.
        """
        self.parser = self._device.parser()
        self.clock = DeviceClock()
        self._stages = create_stages(self._setup)
        self._pending_flags: list[str] = []  # flags that the next frame gets
        self._previous_values: tuple[float, ...] = ()
        self.dropped_at_frame = 0.0  # number of dropped bytes at the latest frame

    def tare(self) -> None:
        """Discard the tare and the present touch, and measure the tare again from the next quiet frames."""
        for stage in self._stages:
            stage.reset()

    def frames(self, chunk: Chunk) -> Iterator[Frame]:
        """Pass each frame whose last byte is in a chunk through all stages, and yield the frame.

        Raises:
            ChargeError: If a frame has no value for an electrode.
            TareError: If the film is touched during the whole search for a tare.
            NoFramesError: If the stream has contained no intact frame in many bytes.
        """
        for frame in self._received_frames(chunk):
            for stage in self._stages:
                stage.step(frame)
            yield frame

    def _received_frames(self, chunk: Chunk) -> list[Frame]:
        """Return the frames whose last byte is in a chunk, with their times and the flags from their sequence numbers.

        If the chunk follows an outage of the port, the state before the outage is discarded first. The next frame also
        gets `_pending_flags`, such as the flag of such an outage.

        Raises:
            NoFramesError: If the stream has contained no intact frame in many bytes.
        """
        if chunk.outage_s > 0.0:
            self._reconnect()  # the port is open again; discards the state
        frames = self.parser.feed(chunk.data)
        if not frames:
            self._check_recognised()
            return frames
        parser = self.parser.recognised or self.parser  # the parser that has recognised the format continues alone
        self.parser = parser
        self.dropped_at_frame = parser.counts.bytes_dropped
        self.clock.stamp(chunk, frames, parser.t_us_modulus)
        for frame in frames:
            # The number of intervals since the previous frame is 1 plus the number of lost frames between them. The
            # number is 0 for a late frame, because this frame was counted as lost before, and for a repeated frame.
            lost_before = parser.counts.lost
            # The next call compares the sequence number with that of the previous frame, and counts the lost frames.
            sequence_flags = parser.sequence_flags(frame.seq, is_clock_reset=frame.is_clock_reset)
            frame.intervals = 1 + parser.counts.lost - lost_before
            if REPEAT in sequence_flags and frame.values == self._previous_values:
                frame.intervals = 0
            self._previous_values = frame.values
            frame.flags = [*self._pending_flags, *sequence_flags]
            self._pending_flags = []
        return frames

    def finish(self) -> None:
        """Finish the stream, for example at the end of a file.

        Raises:
            NoFramesError: If the whole stream has contained no intact frame.
        """
        if self.parser.counts.frames == 0:
            self._check_recognised(max_bytes=-1)  # raises an error, even if no bytes have arrived

    def _check_recognised(self, max_bytes: int = 8192) -> None:
        """Raise an error if more than `max_bytes` bytes have arrived without an intact frame.

        The bytes are counted from the latest frame. After the first frame, a warning is logged instead of the error,
        because a disturbance may end. No second warning follows until the next frame.

        Raises:
            NoFramesError: If the stream has contained no frame.
        """
        counts = self.parser.counts
        dropped_bytes = counts.bytes_dropped - self.dropped_at_frame
        if dropped_bytes <= max_bytes:
            return
        line = f", such as {shown(self.parser.unread_line)}" if self.parser.unread_line else ""
        if counts.frames:
            self.dropped_at_frame = math.inf  # so that no further warning follows before the next frame sets it
            log.warning(
                "no intact frame among the latest %d bytes%s; expected %s, as before: check the cable, and start again "
                "if the board sends other frames now",
                dropped_bytes,
                line,
                self.parser.format,
            )
            return
        raise NoFramesError(
            f"no intact frame among the first {counts.bytes_dropped} bytes ({counts.crc_errors} with a wrong CRC, "
            f"{counts.malformed} of another form{line}); {self.parser.format}: check baud rate and device; "
            "each line of text needs the numbers of all channels, and of all columns that the device file names"
        )

    def _reconnect(self) -> None:
        """Discard the state of the parser, the clock and the tare after an outage of the port, which has reconnected.

        The state before the outage is no longer valid, because frames are missing and the film may have been touched
        during the outage. The next frame gets the flag `reconnected`.
        """
        self.parser.counts.reconnects += 1
        self.parser.reset()
        self.clock.reset()
        self.tare()
        self._pending_flags = [RECONNECTED]


class TouchStream(ReadingStream):
    """Stream that computes prediction records from chunks of bytes, and stores the state of the computation.

    Each object may be used by only one thread.

    Attributes:
        predictor: The loaded model. If the film is followed, a later stage corrects the contacts of the model.
        frame_id: Name of the film, which each record contains.
        sections: Sections of the device file whose stages process contacts. These stages may add fields to the records.
    """

    def __init__(
        self,
        predictor: Predictor,
        device: Device = ANY_BOARD,
        *,
        frame_id: str | None = None,
    ) -> None:
        """Create the stages that compute the charges and the contact.

        Args:
            predictor: Model with which the contacts are predicted.
            device: Settings of the board.
            frame_id: Name of the film, which each record contains. By default, the name in the metadata of the model is
                used.

        Raises:
            DeviceError: If the device file contains settings for electrodes other than those of the model.
            ModelError: If the device file requires an estimate of the pretension, but the pretension of this film
                cannot be estimated with the model.
        """
        self.predictor = predictor
        self._given_frame_id = frame_id
        super().__init__(predictor.metadata.electrodes, device, predictor=predictor)

    def restart(self) -> None:
        """Return to the state of a new stream as in the base class, with stages that also compute contacts."""
        super().restart()
        self._set_model(self.predictor)

    def _set_model(self, predictor: Predictor) -> None:
        """Create the stages that compute contacts, and use them from the next frame on.

        Raises:
            ModelError: If a stage cannot use the model. The present stages and their model then remain in use.
        """
        # The contact stages are created with a copy of the setup. If a stage raises an error, the present setup is
        # unchanged.
        new_setup = replace(self._setup)
        new_setup.use(predictor)
        contact_stages = create_stages(new_setup, needs_contact=True)
        # The first contact stage has replaced the model in the copy by a model with the noise of the board. All stages
        # use this model from now on.
        self._setup.use(new_setup.model)
        charge_stages = [stage for stage in self._stages if not stage.needs_contact]
        self._stages = charge_stages + contact_stages
        self.sections = tuple(stage.section for stage in contact_stages)  # a section may add fields to the records
        self.predictor = predictor
        self._label = predictor.metadata.label
        self.frame_id = self._given_frame_id or predictor.metadata.frame_id

    def use(self, predictor: Predictor) -> None:
        """Use another model with the same electrodes from the next frame on.

        The tare, the state of the signal chain and the present touch are not changed. The tracker, the follower of the
        film and all other contact stages start from their initial states again.

        Raises:
            ModelError: If the model has other electrodes or another order of the electrodes, or if a stage cannot use
                the model. The present model then remains in use.
        """
        present_metadata = self.predictor.metadata
        new_metadata = predictor.metadata
        if new_metadata.electrodes != present_metadata.electrodes:
            raise ModelError(
                f"model {new_metadata.label}: expected the electrodes {present_metadata.electrodes} of "
                f"{present_metadata.label}, got {new_metadata.electrodes}; start another stream for it"
            )
        self._set_model(predictor)

    def feed(self, chunk: Chunk) -> Iterator[PredictionRecord]:
        """Process a chunk, and yield the records of the frames whose last byte is in the chunk.

        Raises:
            ChargeError: If a frame has no value for an electrode of the model.
            TareError: If the film is touched during the whole search for a tare.
            PortError: If the stream has contained no intact frame in many bytes.
        """
        for frame in self.frames(chunk):
            yield self._record(chunk, frame)

    def _record(self, chunk: Chunk, frame: Frame) -> PredictionRecord:
        """Return the prediction record of a frame.

        Args:
            chunk: The chunk that contains the last byte of the frame.
            frame: The frame after all stages.
        """
        if frame.contact is not None:
            contact_fields = frame.contact._asdict()
        else:
            # If nothing touches the film, the force is 0. For an invalid frame, the force is unknown, too.
            contact_fields = NO_CONTACT if frame.is_valid else UNKNOWN_CONTACT
        electrodes = self._setup.electrodes
        charge_pC, raw_pC, tare_pC = [
            None if array is None else dict(zip(electrodes, array.tolist(), strict=True))
            for array in (frame.charge_pC, frame.raw_pC, frame.tare_pC)
        ]
        if raw_pC is not None and not frame.is_valid:  # the charges of an invalid frame may be no finite numbers
            raw_pC = {name: charge if math.isfinite(charge) else None for name, charge in raw_pC.items()}
        flags = {*frame.flags, *frame.contact_flags}
        return PredictionRecord(
            timestamp=frame.host_s,
            t_device_us=frame.device_us,
            seq=frame.seq,
            **contact_fields,
            contact=frame.is_contact,
            charge_pC=charge_pC,
            charge_raw_pC=raw_pC,
            tare_pC=tare_pC,
            flags=flags_in_order(flags) if flags else (),
            latency_us=(time.perf_counter_ns() - chunk.clock_ns) / 1e3,  # includes the time that the stages have taken
            model=self._label,
            frame_id=self.frame_id,
            tracked=frame.tracked,
            event=frame.event,
            other=frame.other,
            film=frame.film,
            sections=self.sections,
        )
