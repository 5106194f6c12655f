"""Progress of long work: who works reports, who shows it listens; nothing is handed through the layers between."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Item = TypeVar("Item")

Listener = Callable[[str, int, int, str], None]
"""Called with (title, done, total, note): the work, finished and planned steps, and its latest figure for people."""

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
    """Tell the listener, if there is one, how far a piece of work is."""
    listener = _listener.get()
    if listener:
        listener(title, done, total, note)


def track(items: Iterable[Item], title: str, total: int | None = None) -> Iterator[Item]:
    """The items one by one; each counts as done when the next is asked for.

    Args:
        items: What the work goes through.
        title: Of the work, for people: "solving the film".
        total: Number of items; may be absent if they have a length.
    """
    count = len(items) if total is None else total  # type: ignore[arg-type]
    for done, item in enumerate(items, start=1):
        yield item
        report(title, done, count)
