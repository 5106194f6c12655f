"""What a command says and how it ends: messages and progress for people, standard streams, signals.

Messages go to stderr, and bars only if that is a terminal. Where streams are closed, full or slow, a command neither
breaks nor writes where it should not.
"""

import io
import logging
import os
import select
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import typer

from isocharge.common.errors import OutputError
from isocharge.common.progress import Listener, listening


class ClosedOutput(io.TextIOBase):
    """What takes the place of a stdout that was closed when the command started."""

    def write(self, _: str, /) -> int:
        """Say what is wrong.

        Raises:
            OutputError: Always.
        """
        raise OutputError("stdout is closed: expected a place for the results; send them to a file or to /dev/null")


def open_closed_streams() -> None:
    """Put something in the place of standard streams that are closed.

    Their numbers must not go to the next file that is opened: what is printed would go into it.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = ClosedOutput()
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115


def forget(number: int) -> None:
    """Send what is still to be written to a stream to nowhere, or Python would complain at exit."""
    with suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, number)
        os.close(nowhere)


def announce(line: str) -> None:
    """Print a line on stdout for programs that wait for it; a command that serves others goes on if it cannot."""
    try:
        print(line, flush=True)
    except OSError:
        forget(1)


def stdout_writer() -> Callable[[str], None]:
    """The function that writes a text to stdout at once, without Python's buffer: a thread may hang in it at exit."""
    try:
        descriptor = sys.stdout.fileno()
    except (OSError, io.UnsupportedOperation):
        return _write_buffered
    return lambda text: _write_all(descriptor, text.encode())


def write_stderr(line: str) -> None:
    """Write a line to stderr at once; if that is full or gone, the command goes on without."""
    try:
        _write_all(2, f"{line}\n".encode())
    except OSError:
        forget(2)


def stdout_is_ready() -> bool:
    """Whether stdout would take a line without waiting, after a tenth of a second at most.

    A pipe that is ready has room for `PIPE_BUF` bytes, more than a record has.
    """
    try:
        return bool(select.select([], [sys.stdout.fileno()], [], 0.1)[1])
    except (OSError, ValueError, io.UnsupportedOperation):
        return True  # whatever is wrong, the write says it


def _write_buffered(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()


def _write_all(descriptor: int, data: bytes) -> None:
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:  # another program that has the terminal made it so
            select.select([], [descriptor], [])


@contextmanager
def until_stopped() -> Iterator[None]:
    """Leave the block without an error at Ctrl-C, at SIGTERM, and when the reader of stdout goes away."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        forget(1)
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def stop_after(seconds: float | None) -> Iterator[None]:
    """As if Ctrl-C were pressed after some time, also where the command waits for a port; None for never."""
    if seconds is None:
        yield
        return
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def on_signal(number: signal.Signals, act: Callable[[], object]) -> Iterator[None]:
    """Act when a signal comes."""
    before = signal.signal(number, lambda *_: act())
    try:
        yield
    finally:
        signal.signal(number, before)


def unless_hung_up(act: Callable[[], object]) -> Callable[[], object]:
    """Act at SIGHUP, but stop as at Ctrl-C where it says that the terminal of this command was closed."""
    terminals = [number for number in (0, 1, 2) if os.isatty(number)]

    def act_or_stop() -> None:
        if not all(map(os.isatty, terminals)):
            raise KeyboardInterrupt
        act()

    return act_or_stop


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
