"""A queue with a thread that writes its items, so that the caller never waits for a slow consumer.

The thread writes the oldest item first. If the consumer is so slow that more than `MAX_WAITING` items wait, the oldest
items are dropped and counted. The consumer therefore gets the newest items.
"""

import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Generic, Self, TypeVar

T = TypeVar("T")

MAX_WAITING = 10_000
"""Largest number of waiting items. Records of ten seconds at 1 kHz occupy about 10 MB."""

CLOSE_TIMEOUT_s = 1.0
"""Longest time that `close` waits for the consumer to take the next item, s.

After this time, the waiting items count as lost.
"""


class WriterQueue(Generic[T]):
    """Bounded queue with a thread that writes its items. The object is a context manager.

    Attributes:
        lost: Number of items that were dropped and never written.
    """

    def __init__(self, write: Callable[[T], object], is_ready: Callable[[], bool] = lambda: True) -> None:
        """Start the thread.

        Args:
            write: Function that is called in the thread with each item.
            is_ready: Function that is called in the thread before an item is written. It waits a short time and
                returns whether the consumer would accept an item.
        """
        self.lost = 0
        self._write = write
        self._is_ready = is_ready
        self._waiting: deque[T] = deque()
        self._change = threading.Condition()  # guards the attributes, and is notified when one of them changes
        self._taken = 0  # number of items that the thread has taken from the queue
        self._is_closed = False
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)  # a write may hang forever
        self._thread.start()

    def __enter__(self) -> Self:
        """Return the queue itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the queue."""
        self.close()

    @property
    def is_stuck(self) -> bool:
        """Whether the thread is still running after `close`, because the consumer has not accepted the last item."""
        return self._is_closed and self._thread.is_alive()

    def put(self, item: T) -> None:
        """Append an item. If too many items wait, the oldest item is dropped.

        Raises:
            Exception: The exception that `write` has raised in the thread.
        """
        with self._change:
            self._raise_error()
            if len(self._waiting) >= MAX_WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(item)
            self._change.notify_all()

    def close(self) -> None:
        """Write the waiting items for as long as the consumer accepts them, and count the rest as lost.

        Raises:
            Exception: The exception that `write` has raised in the thread, unless `put` has raised it already.
        """
        with self._change:
            # Wait as long as the thread takes the next item from the queue, or raises an error, within the timeout.
            while self._waiting and self._thread.is_alive():
                is_writing = self._change.wait_for(partial(self._has_changed, self._taken), CLOSE_TIMEOUT_s)
                if not is_writing:
                    break
            self.lost += len(self._waiting)
            self._waiting.clear()
            self._is_closed = True
            self._change.notify_all()
        self._thread.join(CLOSE_TIMEOUT_s)
        if self._thread.is_alive():  # the thread is still writing the last item that it took
            self.lost += 1
        self._raise_error()

    def _has_changed(self, taken: int) -> bool:
        """Return whether the thread has taken more than `taken` items, or has ended with an error."""
        return self._taken > taken or self._error is not None

    def _raise_error(self) -> None:
        """Raise the error of the thread, unless there is none or it was raised before."""
        error = self._error
        self._error = None
        if error is not None:
            raise error

    def _run(self) -> None:
        """Write items until the queue is closed and empty, or until `write` raises an error."""
        try:
            while (item := self._next()) is not None:
                self._write(item)
        except Exception as error:  # raised again by `put` and `close`
            with self._change:
                self._error = error
                self._change.notify_all()

    def _next(self) -> T | None:
        """Wait until the consumer accepts an item, and return the oldest item.

        The result is None if the queue is closed and empty. An item is only taken when the consumer accepts it, so that
        `put` can drop old items while the consumer is slow.
        """
        with self._change:
            self._change.wait_for(lambda: self._waiting or self._is_closed)
        # The lock is released meanwhile, because `is_ready` waits a short time. After `close`, all items are written.
        while not (self._is_ready() or self._is_closed):
            pass
        with self._change:
            if not self._waiting:  # only after `close`, because `put` never empties the queue
                return None
            self._taken += 1
            self._change.notify_all()
            return self._waiting.popleft()
