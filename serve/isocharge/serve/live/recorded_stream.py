"""Recording of the chunks and records of a touch stream, and replay of such a recording.

The function `replay` passes the chunks of a recording to a stream that has the same settings as the recorded stream. If
the replay also uses the same models as the recorded stream, its records are identical to the recorded records.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from functools import partial

from msgspec import structs

from isocharge.serve.frames.device_clock import elapsed_s
from isocharge.serve.live.stream import TouchStream
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.port.file_source import Chunk
from isocharge.serve.port.recording import Marker, Recorder, Recording
from isocharge.serve.record.record import PredictionRecord

Load = Callable[[], Predictor]
"""Function that loads a model and returns its predictor."""

log = logging.getLogger(__name__)


class RecordedStream:
    """Touch stream that writes its chunks and records to a recording.

    Each object may be used by only one thread, except that any thread may call the `request_...` methods. A request is
    executed before the next chunk is processed.

    Attributes:
        recorder: Recorder that writes the present recording, or None if nothing is recorded.
    """

    def __init__(self, stream: TouchStream) -> None:
        """Store the stream, which computes records from chunks. Nothing is recorded at first."""
        self._stream = stream
        self.recorder: Recorder | None = None
        self._opened_recorder = ExitStack()  # closes the present recorder
        # Functions that carry out the requests. They are called before the next chunk is processed.
        self._requests: deque[Callable[[], None]] = deque()
        self._preamble = b""  # chunks up to the one with the first frame, which show the layout of the frames
        self._loader = ThreadPoolExecutor(1, "model")  # loads one model at a time

    def request_tare(self) -> None:
        """Request a new measurement of the tare. A signal handler may also call this method."""
        self._requests.append(self._tare)

    def request_recording(self, recorder: Recorder | None) -> None:
        """Request to end the present recording and, unless `recorder` is None, to begin another recording.

        The file of the recording is created at once. When a recording begins, the stream is restarted and the tare is
        measured again. A replay can therefore compute the same records from the bytes of the recording alone. The
        recording begins with all bytes that the stream had received when its first frame was complete. The first bytes
        contain the names of the channels if the board sends the names only at its start.

        Args:
            recorder: Recorder of the next recording, which this object opens and closes. None to record nothing.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
        """
        if recorder is not None:
            recorder.open()
        self._requests.append(partial(self._use_recorder, recorder))

    def request_marker(self, marker: Marker) -> None:
        """Request to write a marker to the recording. Without a recording, the marker is ignored."""
        self._requests.append(partial(self._record_event, marker=marker))

    def request_model(self, load: Load) -> None:
        """Request to replace the present model by another model.

        The new model is loaded in a separate thread, and is used for all chunks after it has been loaded. If the new
        model cannot be loaded, or has other electrodes, an error is logged and the present model remains in use. A
        signal handler may also call this method.

        Args:
            load: Function that loads and returns the new model.
        """
        self._requests.append(partial(self._begin_loading, load))

    def follow(self, chunks: Iterable[Chunk]) -> Generator[PredictionRecord]:
        """Process and record the chunks, and yield their prediction records.

        Requests are executed before each chunk. A chunk is recorded before its records are computed, and each record
        before it is yielded. When the caller closes the generator, the recording ends, too.

        The bytes up to the first frame (`_preamble`) are stored, because they show the layout of the frames. If a
        recording begins while the stream is running, these bytes are processed again and recorded first.

        Args:
            chunks: Chunks of bytes from a port or from a file.

        Raises:
            ChargeError: If a frame has no value for an electrode of the model.
            TareError: If the film is touched during the whole search for a tare.
            PortError: If the bytes contain no frames.
            PortLost: If the port disappears.
        """
        try:
            for chunk in chunks:
                previous_recorder = self.recorder
                while self._requests:
                    execute_request = self._requests.popleft()
                    execute_request()
                recorder = self.recorder
                if recorder is not None and recorder is not previous_recorder:  # a request began a recording
                    chunk = self._begin_again(recorder, chunk)
                if self._stream.parser.counts.frames == 0:
                    self._preamble += chunk.data

                if recorder is not None:
                    recorder.event(chunk=chunk)
                for record in self._stream.feed(chunk):
                    if recorder is not None:
                        recorder.write(record.to_json())
                    yield record
            self._stream.finish()
        finally:
            self._use_recorder(None)

    def _use_recorder(self, recorder: Recorder | None) -> None:
        """End the present recording, and close its recorder. Then record with `recorder`, unless it is None."""
        self._opened_recorder.close()
        self.recorder = recorder
        if recorder is not None:
            self._opened_recorder.push(recorder)

    def _begin_again(self, recorder: Recorder, chunk: Chunk) -> Chunk:
        """Restart the stream, and process the first bytes of the stream again, for a new recording.

        The records of the new recording then depend only on the bytes in this recording. The first chunk of the
        recording contains the first bytes of the stream, from which a replay learns the layout of the frames. This
        chunk is written without records. The counters of the stream continue, as if it had not been restarted.

        Frames that have arrived between the first bytes and the next chunk are missing in the recording. The next chunk
        therefore states an outage, so that the tare and the clock begin again.

        Args:
            recorder: Recorder of the new recording.
            chunk: The next chunk of the stream.

        Returns:
            The next chunk, with an outage if any bytes were processed before.
        """
        if not self._preamble:  # no bytes have been processed yet
            return chunk
        counts_so_far = self._stream.parser.counts
        self._stream.restart()  # begins new counters
        preamble = chunk._replace(data=self._preamble, outage_s=0.0)
        for _ in self._stream.feed(preamble):  # each step processes a frame, and its record is discarded
            pass
        recorder.event(chunk=preamble)
        self._stream.parser.counts = counts_so_far  # continue to count, also the losses before the recording
        self._stream.dropped_at_frame = counts_so_far.bytes_dropped
        # The stream will count the outage of the next chunk as a reconnection, although the port was not lost.
        counts_so_far.reconnects -= 1
        return chunk._replace(outage_s=max(chunk.outage_s, 1e-6))  # any outage above 0 has the same effect

    def _record_event(self, **event: bool | str | Marker) -> None:
        """Write an event to the recording, if there is a recording; see `Recorder.event`."""
        if self.recorder is not None:
            self.recorder.event(**event)

    def _begin_loading(self, load: Load) -> None:
        """Load a model in another thread, so that the stream need not wait, and request the use of the loaded model."""
        self._loader.submit(load).add_done_callback(
            lambda loaded: self._requests.append(partial(self._use_loaded_model, loaded))
        )

    def _use_loaded_model(self, loading_result: "Future[Predictor]") -> None:
        """Use a newly loaded model for all later chunks, and write its label to the recording.

        If the new model could not be loaded or cannot be used, an error is logged, and the present model remains in
        use.

        Args:
            loading_result: Completed future, which contains the new model or the error that occurred while the model
                was loaded.
        """
        present_label = self._stream.predictor.metadata.label
        try:
            new_predictor = loading_result.result()  # raises the error if the model could not be loaded
            self._stream.use(new_predictor)
        except Exception as error:  # no error of the new model may end the stream
            log.error(
                "%s serves on, because the new model is refused: %s: %s", present_label, type(error).__name__, error
            )
            return
        new_label = new_predictor.metadata.label
        self._record_event(use=new_label)  # a replay uses the same model from here on
        log.warning("%s serves from now on, after %s", new_label, present_label)

    def _tare(self) -> None:
        """Measure the tare again, and write the request to the recording."""
        self._stream.tare()
        self._record_event(tare=True)


def replay(
    recording: Recording,
    stream: TouchStream,
    *,
    real_time: bool = False,
    yields_all: bool = False,
    load: Callable[[str], Predictor] | None = None,
    on_marker: Callable[[Marker], object] = lambda _: None,
) -> Iterator[PredictionRecord]:
    """Compute the records of a recording again from its chunks, and yield the records.

    The replay also executes the recorded requests, such as a new tare. For each chunk, the replay yields the same
    number of records as the recorded stream. A line with a record therefore only means that the replay yields its next
    record. If `yields_all` is true, the replay instead yields all records of each chunk at once.

    Args:
        recording: Recording whose chunks are processed.
        stream: New stream with the model and the device of the recorded stream.
        real_time: Whether to wait before each chunk, so that the replay takes as long as the recording.
        yields_all: Whether to yield all records of each chunk, also those that the recording does not contain. This is
            useful if the settings of the stream differ from those of the recorded stream.
        load: Function that loads the model with a given label. It is called when the recorded stream has changed its
            model. If `load` is None, all records are computed with the first model.
        on_marker: Function that is called with each marker. The call takes place between the records that come before
            and after the marker.

    Raises:
        RecordingError: If a line other than the last one is damaged.
        ModelError: If a model of the recording cannot be loaded.
    """
    previous_chunk: Chunk | None = None
    due_s = 0.0  # monotonic time at which the replay of the latest chunk begins
    # Records of the latest chunk that were not yielded yet. The stream computes each record when it is taken from the
    # iterator.
    pending_records: Iterator[PredictionRecord] = iter(())
    for event in recording.events():
        if event.latency_us is not None:  # the line is a record, which the recorded stream has yielded
            record = next(pending_records, None)
            if record is not None:  # None if all records were yielded at once
                yield structs.replace(record, latency_us=event.latency_us)
            continue

        # The line is no record, so that all recorded records of the previous chunk were yielded. If the recording
        # program ended within that chunk, its last records are missing in the recording. The stream processes the whole
        # chunk all the same, but the remaining records are discarded.
        for _ in pending_records:
            pass
        chunk = event.chunk
        if event.marker is not None:
            on_marker(event.marker)
        elif event.use is not None:  # label of the model that the recorded stream used from here on
            if load is not None:
                stream.use(load(event.use))
        elif event.tare:
            stream.tare()
        elif chunk is not None:
            # The first chunk is due at once. The time between two chunks is the same as between their arrivals.
            if previous_chunk:
                due_s += elapsed_s(previous_chunk, chunk)
            else:
                due_s = time.monotonic()
            previous_chunk = chunk
            if real_time:
                wait_s = max(0.0, due_s - time.monotonic())
                time.sleep(min(wait_s, threading.TIMEOUT_MAX))
            pending_records = stream.feed(chunk)
            if yields_all:
                yield from pending_records
