"""Messages and progress bars for people, on stderr; bars only if stderr is a terminal."""

import logging
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from isocharge.cli.shared.standard_streams import forget
from isocharge.common.progress import Listener, listening

LINE_S = 5.0
"""Time between two lines of progress where there is no terminal, s."""


def say(message: str) -> None:
    """Print a message for people on stderr; if that is full or gone, the command goes on without."""
    try:
        typer.echo(message, err=True)
    except OSError:
        forget(2)


def this_command() -> str:
    """The command line as it was given, for cards and reports that say how they were made."""
    return shlex.join(["isocharge", *sys.argv[1:]])


@contextmanager
def warnings_to_stderr() -> Iterator[None]:
    """Print warnings of all packages for people; those of simulation and training begin with `caution:`."""
    handler, logger = logging.StreamHandler(), logging.getLogger("isocharge")
    handler.setFormatter(_Sentence())
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class _Sentence(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        caution = "" if record.name.startswith("isocharge.serve") else "caution: "
        return caution + record.getMessage()


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
