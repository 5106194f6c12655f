"""An output with its own queue and thread, so that a live stream never waits for a slow consumer."""

import logging
from collections.abc import Callable

from isocharge.common.writer_queue import WriterQueue
from isocharge.serve.outputs.output import Output, discard
from isocharge.serve.record.record import PredictionRecord

log = logging.getLogger(__name__)


class QueuedOutput:
    """Writes records to another output in a thread.

    Attributes:
        has_failed: Whether the other output has raised an error. It receives no more records afterwards.
    """

    def __init__(
        self, output: Output, target: str, *, is_ready: Callable[[], bool] = lambda: True, ends_stream: bool = False
    ) -> None:
        """Start the thread.

        Args:
            output: The other output.
            target: Its target, for messages.
            is_ready: Function that waits a short time and returns whether the consumer would accept a record.
            ends_stream: Whether an error of the other output ends the stream. The next call of `write` then raises the
                error. Otherwise the error is written to the log.
        """
        self.has_failed = False
        self._output = output
        self._target = target
        self._ends_stream = ends_stream
        self._queue = WriterQueue(self._write, is_ready)  # starts the thread, which calls these functions

    @property
    def lost(self) -> int:
        """Number of records that were never written, because the consumer was too slow."""
        return self._queue.lost

    def write(self, record: PredictionRecord) -> None:
        """Append a record to the queue, or raise the error of the other output if this error ends the stream."""
        self._queue.put(record)

    def close(self) -> None:
        """Write the waiting records until the consumer no longer accepts them, and close the other output.

        If the other output has failed, it is discarded instead.
        """
        self._queue.close()
        if self._queue.is_stuck:  # the thread still writes to the other output, which therefore cannot be closed
            return
        try:
            if self.has_failed:
                discard(self._output)
            else:
                self._output.close()
        except Exception as error:
            self._handle_error(error)

    def _write(self, record: PredictionRecord) -> None:
        """Write a record to the other output, unless this output has failed before. The thread calls this method."""
        if self.has_failed:
            return
        try:
            self._output.write(record)
        except Exception as error:
            self._handle_error(error)

    def _handle_error(self, error: Exception) -> None:
        """Raise an error that ends the stream, or write the first error of the output to the log.

        Raises:
            Exception: The error, if the errors of this output end the stream.
        """
        is_first_error = not self.has_failed
        self.has_failed = True
        if self._ends_stream:
            raise error
        if is_first_error:
            log.error("%s: stopped (%s); the records after that are missing", self._target, error)
