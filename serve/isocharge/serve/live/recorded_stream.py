"""A touch stream whose chunks and records are written to a recording, and the replay of such a recording.

`replay` feeds the chunks of a recording to a stream with the same settings. With the same models, the records of a
replay are the same, bit for bit.
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
"""A function that loads a model."""

log = logging.getLogger(__name__)


class RecordedStream:
    """A touch stream that writes its chunks and records to a recording.

    An object belongs to one thread. Only the methods `request_...` may be called from any thread. The requests are
    executed before the next chunk.

    Attributes:
        recorder: The recording that is being written; None if there is none.
    """

    def __init__(self, stream: TouchStream, recorder: Recorder | None = None) -> None:
        """Set the stream and its recording.

        Args:
            stream: The stream from chunks to records.
            recorder: A recording that is open while `follow` runs; None for no recording.
        """
        self._stream = stream
        self.recorder = recorder
        self._caller_recorder = recorder  # The caller opened this recording and closes it.
        self._current_chunk: tuple[Chunk, list[str]] | None = None  # a chunk and its records, which are not written yet
        self._requests: deque[Callable[[], None]] = deque()
        # The latest requested recording, or None as a request to end the recording; empty without a request.
        self._next_recorder: deque[Recorder | None] = deque(maxlen=1)
        self._next_load: Load | None = None
        self._loading_model: Future[Predictor] | None = None

    @property
    def predictor(self) -> Predictor:
        """The model that computes the next record."""
        return self._stream.predictor

    def request_tare(self) -> None:
        """Request a new tare. The method may also be called from a signal handler."""
        self._requests.append(self._tare)

    def request_film_reset(self) -> None:
        """Request a reset of the followed film to its calibration.

        The method may also be called from a signal handler.
        """
        self._requests.append(self._reset_film)

    def request_recording(self, recorder: Recorder | None) -> None:
        """Request to end the present recording and to begin another recording.

        The request replaces an earlier request that has not been executed yet. When a recording begins, the stream is
        restarted and the tare is measured again, because a replay only has the bytes of the recording.

        Args:
            recorder: The next recording, which the stream opens and closes; None for no recording.
        """
        self._next_recorder.append(recorder)
        self._requests.append(self._begin_requested_recording)

    def request_marker(self, marker: Marker) -> None:
        """Request to write a marker to the recording, if there is one."""
        self._requests.append(partial(self._mark, marker))

    def request_model(self, load: Load) -> None:
        """Request another model, which is loaded in the background.

        When the model has been loaded, it is used for the next chunk and all later chunks. If the model cannot be
        loaded, or has other electrodes, an error is logged and the present model is kept. The method may also be called
        from a signal handler.

        Args:
            load: Function that loads the model.
        """
        self._next_load = load

    def follow(self, chunks: Iterable[Chunk]) -> Generator[PredictionRecord]:
        """Yield the records until the chunks end.

        Requests are executed before each chunk. A chunk is recorded after its last record has been yielded. Close the
        generator before the recorder, so that the present chunk is also recorded, even if the program is interrupted.

        Args:
            chunks: Chunks of a port or of a file.

        Raises:
            ChargeError: If a frame has another number of charges than the model.
            TareError: If the film is touched during the whole search for a tare.
            PortError: If the bytes contain no frames.
            PortLost: If the port disappears.
        """
        try:
            for chunk in chunks:
                # Execute the requests before the chunk.
                if self._next_load or self._loading_model:
                    self._continue_loading()
                while self._requests:
                    execute_request = self._requests.popleft()
                    execute_request()

                # The chunk is stored before its records, so that it is also recorded if the caller closes the generator
                # at a `yield`. The lines of the records are added one by one.
                lines: list[str] = []
                self._current_chunk = (chunk, lines)
                for record in self._stream.feed(chunk):
                    lines.append(record.to_json())
                    yield record
                self._record_chunk()
            self._stream.finish()
        finally:
            self._record_chunk()  # writes the present chunk after an interruption, and nothing otherwise
            self._end_recording()

    def _record_chunk(self) -> None:
        """Write the present chunk and its records to the recording."""
        if self.recorder is not None and self._current_chunk is not None:
            self.recorder.chunk(*self._current_chunk)
        self._current_chunk = None

    def _begin_requested_recording(self) -> None:
        """Begin the recording that was requested, or end the recording if no recording was requested.

        The stream is restarted, so that the records of the recording depend only on the bytes in the recording. If the
        file cannot be created, an error is logged.
        """
        if not self._next_recorder:  # an earlier call has already executed the latest request
            return
        self._end_recording()
        recorder = self._next_recorder.pop()
        if recorder is None:  # the request was only to end the recording
            return
        try:
            self.recorder = recorder.__enter__()  # opens the file; `_end_recording` closes it
        except IsochargeError as error:
            log.error("no recording: %s", error)
            return
        self._stream.restart()
        present_label = self.predictor.metadata.label
        if recorder.model_label != present_label:  # the model has changed since the request
            recorder.model(present_label)

    def _end_recording(self) -> None:
        """End the present recording. If this object has opened the recording, close it."""
        recorder = self.recorder
        self.recorder = None
        if recorder is not None and recorder is not self._caller_recorder:
            recorder.close()

    def _mark(self, marker: Marker) -> None:
        """Write a marker to the recording."""
        if self.recorder is not None:
            self.recorder.mark(marker)

    def _continue_loading(self) -> None:
        """Use the requested model if it has been loaded, and begin to load the next requested model.

        A separate thread loads a model, so that the stream does not wait. At most one model is loaded at a time.
        """
        if self._loading_model is not None and self._loading_model.done():
            self._use(self._loading_model)
            self._loading_model = None
        if self._next_load and self._loading_model is None:
            load = self._next_load
            self._next_load = None
            loader = ThreadPoolExecutor(1, "model")
            self._loading_model = loader.submit(load)
            loader.shutdown(wait=False)  # the thread ends after this model

    def _use(self, loaded: "Future[Predictor]") -> None:
        """Use a loaded model for all later chunks.

        If the loaded model cannot be used, log an error and continue with the present model.

        Args:
            loaded: Result of the thread that has loaded the model.
        """
        present_label = self._stream.predictor.metadata.label
        try:
            new_predictor = loaded.result()
            self._stream.use(new_predictor)
        except Exception as error:  # after any error of the new model, the present model stays
            log.error(
                "%s serves on, because the new model is refused: %s: %s", present_label, type(error).__name__, error
            )
            return
        new_label = new_predictor.metadata.label
        if self.recorder is not None:
            self.recorder.model(new_label)
        log.warning("%s serves from now on, after %s", new_label, present_label)

    def _tare(self) -> None:
        """Measure the tare again, and record the request."""
        self._stream.tare()
        if self.recorder is not None:
            self.recorder.tare()

    def _reset_film(self) -> None:
        """Reset the estimate of the film to its calibration, and record the request."""
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
    """Compute the records of a recording again, and yield them.

    A chunk of bytes yields as many records as it yielded when the recording was made.

    Args:
        recording: The recording.
        stream: A new stream with the same model, device and policy, whose `now_ns` is `clock`.
        clock: The clock of the replay.
        real_time: Whether to wait between two chunks for the time that had passed in the recording.
        load: Function that loads a model by its label, for recordings in which the model changes. If None, the first
            model computes all records.
        on_marker: Function that is called with each marker, between the records before and after it.

    Raises:
        RecordingError: If a line other than the last one is damaged.
        ModelError: If a model of the recording cannot be loaded.
    """
    delay_s: float | None = None  # time by which the replay is later than the recording; None before the first chunk
    for event in recording.events():
        match event:
            case Marker():
                on_marker(event)
            case NewModel(label=label):
                if load is not None:
                    stream.use(load(label))
            case Back():  # the followed film was reset to its calibration
                stream.reset_film()
            case Event(chunk=None):  # a new tare was requested
                clock.set(event)
                stream.tare()
            case Event(chunk=Chunk() as chunk, latencies_us=latencies_us):
                clock.set(event)
                if delay_s is None:
                    delay_s = time.time() - chunk.timestamp
                if real_time:
                    due_s = chunk.timestamp + delay_s
                    time.sleep(max(0.0, due_s - time.time()))
                # The consumer of the records may have stopped before the last record of a chunk. The recording has one
                # latency for each record that was used.
                used_count = len(latencies_us)
                for index, record in enumerate(stream.feed(chunk)):
                    if index < used_count:
                        yield record
