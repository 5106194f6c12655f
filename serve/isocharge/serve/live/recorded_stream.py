"""A touch stream with its recording: chunks and records are written as they come, and played again.

A recording holds what `RecordedStream` passed on; `replay` takes it through the same stream. The same model gives the
same records, bit for bit.
"""

import time
from collections.abc import Generator, Iterable, Iterator

from isocharge.serve.live.stream import TouchStream
from isocharge.serve.port.recording import RecordedClock, Recorder, Recording
from isocharge.serve.port.serial_port import Chunk
from isocharge.serve.prediction.record import PredictionRecord


class RecordedStream:
    """Records of a touch stream, which go into a recording if there is one; belongs to one thread."""

    def __init__(self, stream: TouchStream, recorder: Recorder | None = None) -> None:
        """Put stream and recording together.

        Args:
            stream: From chunks to records.
            recorder: Open while `follow` runs; None for no recording.
        """
        self._stream, self._recorder = stream, recorder
        self._tare_requested = False

    def request_tare(self) -> None:
        """Tare again before the next chunk; may be called from a signal handler."""
        self._tare_requested = True

    def follow(self, chunks: Iterable[Chunk]) -> Generator[tuple[PredictionRecord, str]]:
        """Records, each with its line of JSON, until the chunks end.

        A chunk is recorded when its last record was taken. Close the generator before the recorder: so the chunk that
        is under way is written, too.

        Raises:
            As `isocharge.serve.live.stream.stream`.
        """
        for chunk in chunks:
            if self._tare_requested:
                self._tare()
            lines: list[str] = []
            try:
                for record in self._stream.feed(chunk):
                    lines.append(record.to_json())
                    yield record, lines[-1]
            finally:
                if self._recorder is not None:
                    self._recorder.chunk(chunk, lines)
        self._stream.finish()

    def _tare(self) -> None:
        self._tare_requested = False
        self._stream.tare()
        if self._recorder is not None:
            self._recorder.tare()


def replay(
    recording: Recording, stream: TouchStream, clock: RecordedClock, *, real_time: bool = False
) -> Iterator[tuple[PredictionRecord, str]]:
    """The records of a recording, each with its line of JSON; as many for each chunk as were taken then.

    Args:
        recording: What was recorded.
        stream: A new stream of the same model, device and policy, whose `now_ns` is the clock.
        clock: The clock of the replay.
        real_time: Whether to wait as long between two chunks as it took then.

    Raises:
        RecordingError: If a line other than the last one is damaged.
    """
    delay_s: float | None = None
    for event in recording.events():
        clock.set(event)
        if event.chunk is None:
            stream.tare()
            continue
        if real_time:
            delay_s = time.time() - event.chunk.timestamp if delay_s is None else delay_s
            time.sleep(max(0.0, event.chunk.timestamp + delay_s - time.time()))
        for number, record in enumerate(stream.feed(event.chunk)):
            if number < len(event.latencies_us):
                yield record, record.to_json()
