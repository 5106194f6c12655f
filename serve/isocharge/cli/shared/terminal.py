"""Words, numbers and progress bars for people, on stderr; bars only where a terminal shows them."""

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer

Advance = Callable[..., None]
"""`advance(done, total)` or `advance(done, total, words)`."""


def say(words: str) -> None:
    """Words for people to stderr."""
    typer.echo(words, err=True)


def this_command() -> str:
    """The command line as it was given, for cards that say how to make a thing again."""
    return shlex.join(["isocharge", *sys.argv[1:]])


@contextmanager
def progress(title: str) -> Iterator[Advance]:
    """A progress bar with the time that is left; yields the function that moves it."""
    with progress_rows((title, "")) as (advance,):
        yield advance


@contextmanager
def progress_rows(*rows: tuple[str, str]) -> Iterator[tuple[Advance, ...]]:
    """A progress bar for each (title, unit), shown once it moves: time left, and so many of the unit a second.

    Yields the functions that move them; one that falls back begins anew.
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
        TextColumn("{task.fields[words]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as bar:

        def mover(title: str, unit: str, visible: bool) -> Advance:
            row = bar.add_task(title, total=None, start=visible, visible=visible, words="", unit=unit)

            def advance(done: int, total: int, words: str = "") -> None:
                task = bar.tasks[row]
                if not task.started or done < task.completed:
                    bar.reset(row, visible=True)
                bar.update(row, completed=done, total=total, words=words)

            return advance

        yield tuple(mover(title, unit, number == 0) for number, (title, unit) in enumerate(rows))


def rate(per_second: float | None, unit: str) -> str:
    """As "1,234 samples/s"; nothing while it is not known."""
    if not unit or per_second is None:
        return ""
    return f"{per_second:,.0f} {unit}/s" if per_second >= 10.0 else f"{per_second:.1f} {unit}/s"
