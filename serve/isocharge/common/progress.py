"""Reporting of the progress of long computations.

A computation reports its progress to a function, the listener. The listener is stored in a context variable. The
functions of a computation therefore need no additional argument for the listener.
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
    """Pass the progress reports of the present thread to a listener during the `with` block.

    Args:
        listener: Function that is called with the arguments of `report` for each report.

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
    """Report the progress of a computation to the listener. If there is no listener, do nothing.

    Args:
        title: Title of the computation for the user, such as "solving the film".
        done: Number of finished items.
        total: Number of all items.
        note: Additional text for the user.
    """
    listener = _listener.get()
    if listener:
        listener(title, done, total, note)


@contextmanager
def second_thread(shown_title: str | None = None) -> Iterator[Executor]:
    """Provide an executor with one thread. The calls in this thread report to the listener of the present thread.

    At the end of the `with` block, the executor waits for all calls. If the block raises an exception, calls that have
    not started are cancelled. The running call ends with a `CancelledError` when it next reports its progress.

    Args:
        shown_title: Title that replaces the titles of all reports of the thread; None if the reports keep their own
            titles. A title identifies a progress bar, so two computations that run at the same time need different
            titles.

    Yields:
        The executor.
    """
    listener = _listener.get()
    has_failed = threading.Event()  # is set when the block has raised an exception

    def report_unless_failed(title: str, done: int, total: int, note: str) -> None:
        """Pass the progress on to the listener. If the block has raised an exception, end the running call."""
        if has_failed.is_set():
            raise CancelledError
        if listener:
            listener(shown_title or title, done, total, note)

    # The listener is a context variable, which a new thread does not inherit. The executor therefore calls
    # `_listener.set(report_unless_failed)` in its new thread.
    with ThreadPoolExecutor(1, initializer=_listener.set, initargs=(report_unless_failed,)) as executor:
        try:
            yield executor
        except BaseException:
            has_failed.set()
            executor.shutdown(wait=False, cancel_futures=True)
            raise  # the end of the `with` block then waits for the running call


def track(items: Iterable[Item], title: str, total: int | None = None) -> Iterator[Item]:
    """Yield items, and report the progress after each item.

    An item counts as finished when the caller requests the next item.

    Args:
        items: The items that the caller processes.
        title: Title of the computation for the user, such as "solving the film".
        total: Number of items. If `items` has a length, the number may be None.
    """
    count = len(items) if total is None else total  # type: ignore[arg-type]
    for done, item in enumerate(items, start=1):
        yield item
        report(title, done, count)
