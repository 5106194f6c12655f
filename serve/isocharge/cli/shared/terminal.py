"""Messages and progress bars for people, on stderr; bars only if stderr is a terminal."""

import logging
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import typer

from isocharge.cli.shared.standard_streams import forget

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


def cautions_to_stderr() -> AbstractContextManager[None]:
    """Print warnings of the simulator for people."""
    return _printed("isocharge.simulate", "caution: %(message)s")


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
