"""A touch stream with its recording: chunks and records are written as they come, and played again.

A recording holds what `RecordedStream` passed on; `replay` takes it through the same stream. The same models give the
same records, bit for bit.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

from isocharge.common.errors import IsochargeError
from isocharge.serve.live.stream import TouchStream
from isocharge.serve.port.recording import Back, Event, Marker, NewModel, RecordedClock, Recorder, Recording
from isocharge.serve.port.source import Chunk
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.record.record import PredictionRecord

Load = Callable[[], Predictor]

log = logging.getLogger(__name__)


class RecordedStream:
    """Records of a touch stream, which go into a recording if there is one; belongs to one thread.

    What is requested, from any thread, is done before the next chunk.

    Attributes:
        recorder: The recording that is under way.
    """

    def __init__(self, stream: TouchStream, recorder: Recorder | None = None) -> None:
        """Put stream and recording together.

        Args:
            stream: From chunks to records.
            recorder: Open while `follow` runs; None for no recording.
        """
        self._stream, self.recorder = stream, recorder
        self._borrowed = recorder  # whoever opened it closes it
        self._under_way: tuple[Chunk, list[str]] | None = None
        self._requests: deque[Callable[[], None]] = deque()
        self._recording_requested: deque[Recorder | None] = deque(maxlen=1)
        self._load_requested: Load | None = None
        self._loading: Future[Predictor] | None = None

    @property
    def predictor(self) -> Predictor:
        """The model of the next record."""
        return self._stream.predictor

    def request_tare(self) -> None:
        """Tare again; may be called from a signal handler."""
        self._requests.append(self._tare)

    def request_film_reset(self) -> None:
        """Go back to the film as it was calibrated; may be called as `request_tare`."""
        self._requests.append(self._reset_film)

    def request_recording(self, recorder: Recorder | None) -> None:
        """End the recording that is under way; begin another one, in the place of one that still waits for data.

        A recording begins with a new stream, tare included: its replay has nothing but its bytes to go by.

        Args:
            recorder: It is opened then, and closed at the end. None for no recording.
        """
        self._recording_requested.append(recorder)
        self._requests.append(self._record)

    def request_marker(self, marker: Marker) -> None:
        """Note a moment in the recording, if there is one."""
        self._requests.append(partial(self._mark, marker))

    def request_model(self, load: Load) -> None:
        """Load a model meanwhile, and go on with it from the first chunk after that; may be called as `request_tare`.

        A model that cannot be loaded, or has other electrodes, is refused with a word, and the one before serves on.
        """
        self._load_requested = load

    def follow(self, chunks: Iterable[Chunk]) -> Generator[PredictionRecord]:
        """Yield the records until the chunks end.

        A chunk is recorded when its last record was taken. Close the generator before the recorder: so the chunk that
        is under way is written, too, wherever Ctrl-C came.

        Raises:
            As `isocharge.serve.live.stream.stream`.
        """
        try:
            for chunk in chunks:
                if self._load_requested or self._loading:
                    self._take_model()
                while self._requests:
                    self._requests.popleft()()
                lines: list[str] = []
                self._under_way = (chunk, lines)
                for record in self._stream.feed(chunk):
                    lines.append(record.to_json())
                    yield record
                self._record_chunk()
            self._stream.finish()
        finally:
            self._record_chunk()
            self._end_recording()

    def _record_chunk(self) -> None:
        if self.recorder is not None and self._under_way is not None:
            self.recorder.chunk(*self._under_way)
        self._under_way = None

    def _record(self) -> None:
        if not self._recording_requested:  # a later request was done in the place of this one
            return
        self._end_recording()
        recorder = self._recording_requested.pop()
        if recorder is not None:
            try:
                self.recorder = recorder.__enter__()
            except IsochargeError as error:
                log.error("no recording: %s", error)
                return
            self._stream.restart()
            if recorder.model_label != self.predictor.metadata.label:  # it was taken since the request
                recorder.model(self.predictor.metadata.label)

    def _end_recording(self) -> None:
        recorder, self.recorder = self.recorder, None
        if recorder is not None and recorder is not self._borrowed:
            recorder.close()

    def _mark(self, marker: Marker) -> None:
        if self.recorder is not None:
            self.recorder.mark(marker)

    def _take_model(self) -> None:
        """Use the model whose loading is done; begin to load the next one."""
        if self._loading is not None and self._loading.done():
            self._use(self._loading)
            self._loading = None
        if self._load_requested and self._loading is None:
            load, self._load_requested = self._load_requested, None
            loader = ThreadPoolExecutor(1, "model")
            self._loading = loader.submit(load)
            loader.shutdown(wait=False)

    def _use(self, loaded: "Future[Predictor]") -> None:
        before = self._stream.predictor.metadata.label
        try:
            predictor = loaded.result()
            self._stream.use(predictor)
        except Exception as error:  # whatever is wrong with a new model, the old one serves
            log.error("%s serves on, because the new model is refused: %s: %s", before, type(error).__name__, error)
            return
        if self.recorder is not None:
            self.recorder.model(predictor.metadata.label)
        log.warning("%s serves from now on, after %s", predictor.metadata.label, before)

    def _tare(self) -> None:
        self._stream.tare()
        if self.recorder is not None:
            self.recorder.tare()

    def _reset_film(self) -> None:
        self._stream.reset_film()
        if self.recorder is not None:
            self.recorder.back()


def replay(
    recording: Recording,
    stream: TouchStream,
    clock: RecordedClock,
    *,
    real_time: bool = False,
    load: Callable[[str], Predictor] | None = None,
    on_marker: Callable[[Marker], object] = lambda _: None,
) -> Iterator[PredictionRecord]:
    """Yield the records of a recording: for each chunk as many as were taken when it was recorded.

    Args:
        recording: What was recorded.
        stream: A new stream of the same model, device and policy, whose `now_ns` is the clock.
        clock: The clock of the replay.
        real_time: Whether to wait as long between two chunks as it took then.
        load: Gives the model of a label, where the recording went on with another one; None stays with the first.
        on_marker: Called with each marker, between the records before and after it.

    Raises:
        RecordingError: If a line other than the last one is damaged.
        ModelError: If a model of the recording cannot be loaded.
    """
    delay_s: float | None = None
    for event in recording.events():
        match event:
            case Marker():
                on_marker(event)
            case NewModel(label=label):
                if load is not None:
                    stream.use(load(label))
            case Back():
                stream.reset_film()
            case Event(chunk=None):
                clock.set(event)
                stream.tare()
            case Event(chunk=Chunk() as chunk, latencies_us=latencies_us):
                clock.set(event)
                if real_time:
                    delay_s = time.time() - chunk.timestamp if delay_s is None else delay_s
                    time.sleep(max(0.0, chunk.timestamp + delay_s - time.time()))
                for number, record in enumerate(stream.feed(chunk)):
                    if number < len(latencies_us):
                        yield record
