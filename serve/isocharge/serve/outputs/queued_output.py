"""Output with its own queue and thread, so that a live stream never waits for a slow consumer."""

import logging
from collections.abc import Callable

from isocharge.serve.outputs.output import Output, discard, output_error
from isocharge.serve.outputs.writer_queue import WriterQueue
from isocharge.serve.record.record import PredictionRecord

log = logging.getLogger(__name__)


class QueuedOutput:
    """Output that passes its records to another output in a separate thread.

    Attributes:
        has_failed: Whether the other output has raised an error. It receives no more records afterwards.
    """

    def __init__(
        self, output: Output, target: str, *, is_ready: Callable[[], bool] = lambda: True, ends_stream: bool = False
    ) -> None:
        """Start the thread.

        Args:
            output: The other output, to which the thread writes the records.
            target: Target of the other output, for messages.
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
        """Number of records that were dropped because the consumer was too slow."""
        return self._queue.lost

    def write(self, record: PredictionRecord) -> None:
        """Append a record to the queue, from which the thread takes it and writes it to the other output.

        Raises:
            Exception: The error of the other output, if its errors end the stream.
        """
        self._queue.put(record)

    def close(self) -> None:
        """Write the records that are still in the queue, and close the other output.

        If the consumer no longer accepts records, the remaining records are dropped. If the other output has raised an
        error before, the other output is discarded instead of closed.

        Raises:
            Exception: The error of the other output, if its errors end the stream.
        """
        self._queue.close()
        if self._queue.is_stuck:  # the thread is still in `write` of the other output, which therefore cannot be closed
            return
        try:
            if self.has_failed:
                discard(self._output)
            else:
                self._output.close()
        except Exception as error:
            self._handle_error(error)

    def _write(self, record: PredictionRecord) -> None:
        """Write a record to the other output, unless the other output has failed before.

        The thread of the queue calls this method.
        """
        if self.has_failed:
            return
        try:
            self._output.write(record)
        except Exception as error:
            self._handle_error(error)

    def _handle_error(self, error: Exception) -> None:
        """Raise an error of the other output again, or write it to the log.

        If errors of the other output end the stream, the error is raised. An error that is raised in the thread of the
        queue reaches the caller of the next `write`. Otherwise, the first error of the output is written to the log,
        and its later errors are ignored.

        Raises:
            Exception: The given error, if errors of the other output end the stream.
        """
        is_first_error = not self.has_failed
        self.has_failed = True
        if self._ends_stream:
            raise error
        if is_first_error:
            reason = output_error(error, self._target)
            log.error("%s: stopped (%s); the records after that are missing", self._target, reason)
