"""Messages and progress bars for people, on stderr; bars only if stderr is a terminal."""

import logging
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager

import typer

from isocharge.cli.shared.standard_streams import forget
from isocharge.common.progress import Listener, listening

LINE_S = 5.0
"""Time between two lines of progress where there is no terminal, s."""

Advance = Callable[..., None]
"""`advance(done, total)` or `advance(done, total, note)`: moves a progress bar; the note stands behind it."""


def say(message: str) -> None:
    """Print a message for people on stderr; if that is full or gone, the command goes on without."""
    try:
        typer.echo(message, err=True)
    except OSError:
        forget(2)


def this_command() -> str:
    """The command line as it was given, for cards and reports that say how they were made."""
    return shlex.join(["isocharge", *sys.argv[1:]])


def log_to_stderr() -> AbstractContextManager[None]:
    """Print warnings of the live path for people."""
    return _printed("isocharge.serve", "%(message)s")


@contextmanager
def cautions_to_stderr() -> Iterator[None]:
    """Print warnings of simulation and training for people."""
    with ExitStack() as stack:
        for name in ("common", "simulate", "train"):
            stack.enter_context(_printed(f"isocharge.{name}", "caution: %(message)s"))
        yield


@contextmanager
def _printed(name: str, style: str) -> Iterator[None]:
    """Print what a logger warns of."""
    handler, logger = logging.StreamHandler(), logging.getLogger(name)
    handler.setFormatter(logging.Formatter(style))
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show the progress of all work inside the block: bars on a terminal, else a line every few seconds."""
    if not sys.stderr.isatty():
        with listening(_Lines()):
            yield
        return
    with _bars() as bar, listening(bar):
        yield


class _Lines:
    """Progress as plain lines, at most one every `LINE_S`."""

    def __init__(self) -> None:
        self._next = time.monotonic() + LINE_S

    def __call__(self, title: str, done: int, total: int, note: str) -> None:
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + LINE_S
            say(f"{title}: {done} of {total} {note}".rstrip())


@contextmanager
def _bars() -> Iterator[Listener]:
    """A bar for each title, with the remaining time."""
    # 40 ms that help and short commands need not wait for
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TaskID,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        rows: dict[str, TaskID] = {}

        def show(title: str, done: int, total: int, note: str) -> None:
            if title not in rows:
                rows[title] = bars.add_task(title, total=total, note=note)
            elif done < bars.tasks[rows[title]].completed:  # the same work once more: its clock starts again
                bars.reset(rows[title])
            bars.update(rows[title], completed=done, total=total, note=note)

        yield show


@contextmanager
def progress(title: str) -> Iterator[Advance]:
    """A progress bar with the remaining time; yields the function that moves it."""
    with progress_rows((title, "")) as (advance,):
        yield advance


@contextmanager
def progress_rows(*rows: tuple[str, str]) -> Iterator[tuple[Advance, ...]]:
    """A progress bar for each (title, unit), shown once it moves, with the remaining time and the units per second.

    Yields the functions that move them. A bar that is moved back starts its clock again.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(rate(task.finished_speed or task.speed, task.fields["unit"]))

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as bar:

        def mover(title: str, unit: str, visible: bool) -> Advance:
            row = bar.add_task(title, total=None, start=visible, visible=visible, note="", unit=unit)

            def advance(done: int, total: int, note: str = "") -> None:
                task = bar.tasks[row]
                if not task.started or done < task.completed:
                    bar.reset(row, visible=True)
                bar.update(row, completed=done, total=total, note=note)

            return advance

        yield tuple(mover(title, unit, number == 0) for number, (title, unit) in enumerate(rows))


def rate(per_second: float | None, unit: str) -> str:
    """A rate as "1,234 samples/s"; empty if it is unknown or has no unit."""
    if not unit or per_second is None:
        return ""
    return f"{per_second:,.0f} {unit}/s" if per_second >= 10.0 else f"{per_second:.1f} {unit}/s"
