"""A queue whose items are written by a separate thread, so that the producer never waits for a slow consumer.

The thread writes the oldest item first. If the consumer is so slow that more than `MAX_WAITING` items are waiting, the
oldest items are dropped and counted. A slow consumer therefore receives the newest items.
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
    """Queue of limited length with a thread that writes the items of the queue.

    The queue is a context manager. At the end of the `with` block, the queue is closed.

    Attributes:
        lost: Number of items that were dropped without being written.
    """

    def __init__(self, write: Callable[[T], object], is_ready: Callable[[], bool] = lambda: True) -> None:
        """Start the thread.

        Args:
            write: Function that the thread calls with each item.
            is_ready: Function that the thread calls before it takes an item from the queue. The function waits for a
                short time, and returns whether the consumer accepts an item.
        """
        self.lost = 0
        self._write = write
        self._is_ready = is_ready
        self._waiting: deque[T] = deque()
        self._change = threading.Condition()  # protects the attributes, and is notified when one of them changes
        self._taken_count = 0  # number of items that the thread has taken from the queue
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
        """Whether the queue is closed, but the thread is still waiting for the consumer to accept the last item."""
        return self._is_closed and self._thread.is_alive()

    def put(self, item: T) -> None:
        """Append an item to the queue. If the queue is full, the oldest item is dropped.

        Args:
            item: The item.

        Raises:
            Exception: The exception that `write` has raised in the thread, if there is one.
        """
        with self._change:
            self._raise_error()
            if len(self._waiting) >= MAX_WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(item)
            self._change.notify_all()

    def close(self) -> None:
        """Write the waiting items as long as the consumer accepts items, and close the queue.

        If the consumer accepts no item within the timeout, the waiting items are dropped and counted as lost.

        Raises:
            Exception: The exception that `write` has raised in the thread, unless `put` has raised it already.
        """
        with self._change:
            # Wait until the queue is empty or the thread has ended, but stop waiting if the thread takes no further
            # item from the queue within the timeout.
            while self._waiting and self._thread.is_alive():
                has_advanced_or_failed = partial(self._has_advanced_or_failed, self._taken_count)
                if not self._change.wait_for(has_advanced_or_failed, CLOSE_TIMEOUT_s):  # the timeout has expired
                    break
            self.lost += len(self._waiting)
            self._waiting.clear()
            self._is_closed = True
            self._change.notify_all()
        self._thread.join(CLOSE_TIMEOUT_s)
        if self._thread.is_alive():  # the thread is still writing the last item that it took
            self.lost += 1
        self._raise_error()

    def _has_advanced_or_failed(self, earlier_count: int) -> bool:
        """Return whether the thread has taken an item since an earlier time, or has ended with an error.

        Args:
            earlier_count: Number of items that the thread had taken at the earlier time.
        """
        return self._taken_count > earlier_count or self._error is not None

    def _raise_error(self) -> None:
        """If the thread has ended with an exception, raise this exception, but only once."""
        error = self._error
        self._error = None  # the next call raises nothing
        if error is not None:
            raise error

    def _run(self) -> None:
        """Write items until the queue is closed and empty, or until `write` raises an exception."""
        try:
            while (item := self._next()) is not None:
                self._write(item)
        except Exception as error:  # `put` or `close` raises it again in the thread of the caller
            with self._change:
                self._error = error
                self._change.notify_all()

    def _next(self) -> T | None:
        """Wait until an item is waiting and the consumer is ready, and take the oldest item from the queue.

        The item remains in the queue until the consumer accepts an item. `put` can therefore drop old items while the
        consumer is slow.

        Returns:
            The item; None if the queue is closed and empty.
        """
        with self._change:
            self._change.wait_for(lambda: self._waiting or self._is_closed)
        # The lock is not held during this loop, because each call of `is_ready` waits for a short time.
        while not (self._is_ready() or self._is_closed):
            pass
        with self._change:
            if not self._waiting:  # the queue is closed, because only `close` empties the queue
                return None
            self._taken_count += 1
            self._change.notify_all()
            return self._waiting.popleft()
