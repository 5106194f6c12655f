"""Lines on their way to a consumer that may be slow: who has them to give never waits.

A thread writes what waits, oldest first. When the consumer is so slow that too much waits, the oldest lines are dropped
and counted: what it gets next is as new as can be, and chain and recording never stop for it.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Self

MOST_LINES = 10_000
"""Lines that may wait: ten seconds at 1 kHz, some 10 MB."""

PATIENCE_S = 1.0
"""Time at the end for which a consumer may take no line before the rest is counted as lost, s."""


class LineQueue:
    """A bounded queue of lines and the thread that writes them; a context manager.

    Attributes:
        lost: Lines that were never written, the oldest of those that waited.
    """

    def __init__(
        self, write: Callable[[str], object], is_ready: Callable[[], bool] = lambda: True, most: int = MOST_LINES
    ) -> None:
        """Set up the queue.

        Args:
            write: Called in the thread with each line.
            is_ready: Called before that; waits a little while, and says whether the consumer would take a line now.
            most: Lines that may wait.
        """
        self.lost = 0
        self._write, self._is_ready, self._most = write, is_ready, most
        self._lines: deque[str] = deque()
        self._change = threading.Condition()
        self._written, self._is_waiting, self._is_closed = 0, False, False  # waiting: a line that was taken out
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="lines", daemon=True)  # it may hang in a write for ever

    def __enter__(self) -> Self:
        """Start the thread."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """As `close`."""
        self.close()

    def put(self, line: str) -> None:
        """Let a line wait for its turn; the oldest one is dropped if too many wait.

        Raises:
            Whatever `write` has raised in the thread.
        """
        with self._change:
            self._raise_error()
            if len(self._lines) >= self._most:
                self._lines.popleft()
                self.lost += 1
            self._lines.append(line)
            self._change.notify_all()

    def close(self) -> None:
        """Write what waits for as long as the consumer goes on taking it; count the rest as lost.

        Raises:
            As `put`, once.
        """
        with self._change:
            written, end = self._written, time.monotonic() + PATIENCE_S
            while self._waits() and time.monotonic() < end:
                self._change.wait(max(0.0, end - time.monotonic()))
                if self._written > written:
                    written, end = self._written, time.monotonic() + PATIENCE_S
            self.lost += len(self._lines) + self._is_waiting
            self._lines.clear()
            self._is_waiting, self._is_closed = False, True
            self._change.notify_all()
            self._raise_error()

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            self._is_closed = True
            raise error

    def _waits(self) -> bool:
        """Whether a line waits that may still be written."""
        return self._error is None and not self._is_closed and bool(self._lines or self._is_waiting)

    def _run(self) -> None:
        while (line := self._next()) is not None:
            try:
                if not self._goes_out():
                    return
                self._write(line)
            except Exception as error:  # raised again where lines are put in
                with self._change:
                    self._error, self._is_waiting = error, False
                    self._change.notify_all()
                return

    def _next(self) -> str | None:
        """The next line to write, or None at the end."""
        with self._change:
            self._change.wait_for(lambda: self._lines or self._is_closed)
            self._is_waiting = bool(self._lines)
            return self._lines.popleft() if self._lines else None

    def _goes_out(self) -> bool:
        """Wait for the consumer; False if the queue was closed meanwhile, and the line counted as lost."""
        while not self._is_ready() and not self._is_closed:
            pass
        with self._change:
            self._written += self._is_waiting
            self._is_waiting = False
            self._change.notify_all()
            return not self._is_closed
