"""Progress of long computations.

A computation reports its progress to a listener. The listener is stored in a context variable, so that functions do not
need an additional argument to pass it on.
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Executor, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")

Listener = Callable[[str, int, int, str], None]
"""Function that is called with (title, done, total, note); see `report` for the arguments."""

_listener: ContextVar[Listener | None] = ContextVar("progress", default=None)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Call `listener` with the progress of all work inside the block, in this thread.

    Example:
        >>> with listening(lambda title, done, total, note: print(f"{title}: {done} of {total}")):
        ...     squares = [number**2 for number in track([1, 2], "squares")]
        squares: 1 of 2
        squares: 2 of 2
    """
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def report(title: str, done: int, total: int, note: str = "") -> None:
    """Report the progress of a piece of work to the listener, if there is one.

    Args:
        title: Title of the work for people, such as "solving the film".
        done: Number of finished items.
        total: Number of all items.
        note: Further text for people.
    """
    listener = _listener.get()
    if listener:
        listener(title, done, total, note)


@contextmanager
def second_thread() -> Iterator[Executor]:
    """Run calls in a second thread, and report the progress of these calls to the listener of this thread.

    The end of the block waits for all calls. If the block raises an exception, waiting calls are cancelled, and the
    running call ends with a `CancelledError` at its next report.
    """
    listener = _listener.get()
    is_stopped = threading.Event()

    def report_until_stopped(title: str, done: int, total: int, note: str) -> None:
        """Pass the progress on to the listener, or end the running call if the block has raised an exception."""
        if is_stopped.is_set():
            raise CancelledError
        if listener:
            listener(title, done, total, note)

    # The listener is a context variable, which a new thread does not inherit. The initializer sets it in the thread.
    with ThreadPoolExecutor(1, initializer=_listener.set, initargs=(report_until_stopped,)) as executor:
        try:
            yield executor
        except BaseException:
            is_stopped.set()
            executor.shutdown(wait=False, cancel_futures=True)
            raise  # the end of the `with` block then waits for the running call


def track(items: Iterable[Item], title: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items and report the progress. An item counts as done when the next item is requested.

    Args:
        items: The items of the work.
        title: Title of the work for people, such as "solving the film".
        total: Number of items; it may be absent if the items have a length.
    """
    count = len(items) if total is None else total  # type: ignore[arg-type]
    for done, item in enumerate(items, start=1):
        yield item
        report(title, done, count)
