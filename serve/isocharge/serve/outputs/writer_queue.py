"""A queue whose items are written by a separate thread, so that the producer never waits for a slow consumer.

The thread writes the oldest item first. If the consumer is so slow that more than `MAX_WAITING` items are waiting, the
oldest items are dropped and counted. A slow consumer therefore receives the newest items.
"""

import threading
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, Queue
from typing import Generic, Self, TypeVar

T = TypeVar("T")

MAX_WAITING = 10_000
"""Largest number of waiting items. Records of ten seconds at 1 kHz occupy about 10 MB."""

CLOSE_TIMEOUT_s = 1.0
"""Default of `close_timeout_s`, s."""


class WriterQueue(Generic[T]):
    """Queue of limited length with a thread that writes the items of the queue.

    The queue is a context manager. At the end of the `with` block, the queue is closed.

    Attributes:
        lost: Number of items that were dropped without being written.
    """

    def __init__(
        self,
        write: Callable[[T], object],
        is_ready: Callable[[], bool] = lambda: True,
        *,
        close_timeout_s: float = CLOSE_TIMEOUT_s,
    ) -> None:
        """Start the thread.

        Args:
            write: Function that the thread calls with each item.
            is_ready: Function that the thread calls before it writes an item. The function waits for a short time, and
                returns whether the consumer accepts an item.
            close_timeout_s: Longest time that `close` waits for the consumer to take the next item, s. After this time,
                the waiting items count as lost.
        """
        self.lost = 0
        self._close_timeout_s = close_timeout_s
        self._write = write
        self._is_ready = is_ready
        self._items: Queue[T | None] = Queue()  # None ends the thread
        self._is_abandoned = threading.Event()  # is set when the thread must write no further item
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
        return self._is_abandoned.is_set() and self._thread.is_alive()

    def put(self, item: T) -> None:
        """Append an item to the queue. If the queue is full, the oldest item is dropped.

        Args:
            item: The item.

        Raises:
            Exception: The exception that `write` has raised in the thread, if there is one.
        """
        self._raise_error()
        if self._items.qsize() >= MAX_WAITING:
            with suppress(Empty):  # the thread has taken all items in the meantime
                self._items.get_nowait()
                self._items.task_done()
                self.lost += 1
        self._items.put(item)

    def close(self) -> None:
        """Write the waiting items as long as the consumer accepts items, and close the queue.

        If the consumer accepts no item within the timeout, the waiting items are dropped and counted as lost.

        Raises:
            Exception: The exception that `write` has raised in the thread, unless `put` has raised it already.
        """
        self._items.put(None)
        earlier_count = 0
        while self._thread.is_alive() and self._items.unfinished_tasks != earlier_count:
            earlier_count = self._items.unfinished_tasks
            self._thread.join(self._close_timeout_s)
        self._is_abandoned.set()
        self._thread.join(self._close_timeout_s)
        if self._items.unfinished_tasks > 0:
            self.lost += self._items.unfinished_tasks - 1  # the last task is the None
        self._raise_error()

    def _raise_error(self) -> None:
        """If the thread has ended with an exception, raise this exception, but only once."""
        error = self._error
        self._error = None  # the next call raises nothing
        if error is not None:
            raise error

    def _run(self) -> None:
        """Write items until the queue is closed and empty, or until `write` raises an exception."""
        try:
            while (item := self._items.get()) is not None:
                while not (self._is_ready() or self._is_abandoned.is_set()):
                    pass
                if self._is_abandoned.is_set():
                    return
                self._write(item)
                self._items.task_done()
            self._items.task_done()
        except Exception as error:  # `put` or `close` raises it again in the thread of the caller
            self._error = error
