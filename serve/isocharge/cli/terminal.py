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
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[words]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(title, total=None, words="")

        def advance(done: int, total: int, words: str = "") -> None:
            bar.update(task, completed=done, total=total, words=words)

        yield advance
