"""Words, numbers and progress bars for people, on stderr; bars only where a terminal shows them."""

import os
import shlex
import signal
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


@contextmanager
def until_stopped() -> Iterator[None]:
    """Ctrl-C, a SIGTERM and a reader that closes the pipe all mean: enough, and well done."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        # What is still in stdout's buffer goes nowhere, without a complaint at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        signal.signal(signal.SIGTERM, before)
