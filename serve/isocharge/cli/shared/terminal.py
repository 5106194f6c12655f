"""Output and termination of the commands: results, messages, progress, standard streams and signals.

All text that a command prints passes through this module, which escapes the characters that a terminal executes or
hides. Messages are printed on stderr. Progress bars are only shown if stderr is a terminal. If a standard stream is
closed, full or slow, the command does not fail, and its text does not reach another file.
"""

import io
import json
import logging
import os
import select
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import typer

from isocharge.common.errors import OutputError
from isocharge.common.printable_text import printable, printable_lines
from isocharge.common.progress import Listener, listening


class ClosedOutput(io.TextIOBase):
    """Replacement of a stdout that was closed when the command started."""

    def write(self, _: str, /) -> int:
        """Refuse to write.

        Raises:
            OutputError: Always.
        """
        raise OutputError("stdout is closed: expected a place for the results; send them to a file or to /dev/null")


def open_closed_streams() -> None:
    """Replace standard streams that are closed.

    Without this replacement, the next file that is opened would get the file descriptor of stdout, and printed text
    would be written into that file.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free file descriptor, which is `descriptor`
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = ClosedOutput()
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115


def discard_output(number: int) -> None:
    """Redirect a standard stream to the null device. Otherwise Python would fail when it flushes the stream at exit.

    Args:
        number: File descriptor of the stream.
    """
    with suppress(OSError):
        null_device = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null_device, number)
        os.close(null_device)


def show(text: str) -> None:
    """Print a result as text on stdout, in which all characters that are not printable are escaped."""
    typer.echo(printable_lines(text))


def show_json(value: Any) -> None:
    """Print a result for programs on stdout, as one line of JSON. Numbers that are not finite become null."""
    from isocharge.common.json_values import plain_values  # imports numpy, which help does not need

    print(printable(json.dumps(plain_values(value), allow_nan=False)), flush=True)


def announce(line: str) -> None:
    """Print a line on stdout and flush it, for programs that wait for this line.

    A server continues if stdout is closed.
    """
    try:
        print(printable(line), flush=True)
    except OSError:
        discard_output(1)


def stdout_writer() -> Callable[[str], None]:
    """Return the function that writes lines of records to stdout at once.

    The function does not use Python's buffer, in which a thread may hang at exit.
    """
    try:
        descriptor = sys.stdout.fileno()
    except (OSError, io.UnsupportedOperation):
        return _write_buffered
    return lambda text: _write_all(descriptor, text.encode())


def write_stderr(line: str) -> None:
    """Write a line to stderr at once. The command continues if stderr is full or closed."""
    try:
        _write_all(2, f"{printable(line)}\n".encode())
    except OSError:
        discard_output(2)


def stdout_is_ready() -> bool:
    """Return whether stdout accepts a line within a tenth of a second.

    A pipe that is ready has room for `PIPE_BUF` bytes, which is more than the length of a record.
    """
    try:
        return bool(select.select([], [sys.stdout.fileno()], [], 0.1)[1])
    except (OSError, ValueError, io.UnsupportedOperation):
        return True  # the write raises the error


def _write_buffered(text: str) -> None:
    sys.stdout.write(text)
    sys.stdout.flush()


def _write_all(descriptor: int, data: bytes) -> None:
    while data:
        try:
            data = data[os.write(descriptor, data) :]
        except BlockingIOError:  # another program on the same terminal has made it non-blocking
            select.select([], [descriptor], [])


@contextmanager
def until_stopped() -> Iterator[None]:
    """Leave the block without an error after Ctrl-C, after SIGTERM, or if the reader of stdout closes it."""
    previous_handler = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        discard_output(1)
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


@contextmanager
def stop_after(seconds: float | None) -> Iterator[None]:
    """Interrupt the block after the given time in the same way as Ctrl-C, even while the command waits for a port.

    Args:
        seconds: Time, s; None for no limit.
    """
    if seconds is None:
        yield
        return
    previous_handler = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous_handler)


@contextmanager
def on_signal(number: signal.Signals, act: Callable[[], object]) -> Iterator[None]:
    """Call `act` whenever a signal arrives during the block."""
    previous_handler = signal.signal(number, lambda *_: act())
    try:
        yield
    finally:
        signal.signal(number, previous_handler)


def unless_hung_up(act: Callable[[], object]) -> Callable[[], object]:
    """Return a handler of the signal SIGHUP. The system also sends this signal if the terminal of the command is
    closed.

    Args:
        act: Function that the handler calls if the terminal is open. Otherwise the handler stops the command like
            Ctrl-C.
    """
    terminals = [descriptor for descriptor in (0, 1, 2) if os.isatty(descriptor)]

    def act_or_stop() -> None:
        """Call `act`, or stop the command if its terminal has been closed."""
        is_open = all(map(os.isatty, terminals))
        if not is_open:
            raise KeyboardInterrupt
        act()

    return act_or_stop


PROGRESS_LINE_INTERVAL_S = 5.0
"""Time between two lines of progress if stderr is not a terminal, s."""


def say(message: str) -> None:
    """Print a message on stderr, in which all characters that are not printable are escaped.

    The command continues if stderr is full or closed.
    """
    try:
        typer.echo(printable_lines(message), err=True)
    except OSError:
        discard_output(2)


def this_command() -> str:
    """Return the command line as it was given, for the cards and reports that state how they were made."""
    return shlex.join(["isocharge", *sys.argv[1:]])


@contextmanager
def warnings_to_stderr() -> Iterator[None]:
    """Print the warnings of all packages. Warnings of simulation and training begin with `caution:`."""
    handler = logging.StreamHandler()
    logger = logging.getLogger("isocharge")
    handler.setFormatter(_WarningFormatter())
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


class _WarningFormatter(logging.Formatter):
    """Formats a warning as one sentence in printable characters, without time and traceback."""

    def format(self, record: logging.LogRecord) -> str:
        caution = "" if record.name.startswith("isocharge.serve") else "caution: "
        return caution + printable_lines(record.getMessage())


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show the progress of all work inside the block: bars on a terminal, otherwise a line every few seconds."""
    if not sys.stderr.isatty():
        with listening(_ProgressLines()):
            yield
        return
    with _progress_bars() as bar, listening(bar):
        yield


class _ProgressLines:
    """Progress as plain lines, at most one every `PROGRESS_LINE_INTERVAL_S`."""

    def __init__(self) -> None:
        self._next_line_s = time.monotonic() + PROGRESS_LINE_INTERVAL_S

    def __call__(self, title: str, done: int, total: int, note: str) -> None:
        if time.monotonic() >= self._next_line_s:
            self._next_line_s = time.monotonic() + PROGRESS_LINE_INTERVAL_S
            say(f"{title}: {done} of {total} {note}".rstrip())


@contextmanager
def _progress_bars() -> Iterator[Listener]:
    """Show a bar for each title, with the remaining time."""
    # The import takes 40 ms, which help and short commands need not wait for.
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
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        rows: dict[str, TaskID] = {}

        def show(title: str, done: int, total: int, note: str) -> None:
            """Show the progress of one piece of work in its own bar, which is identified by the title."""
            shown_title = printable(title)
            shown_note = printable(note)
            if shown_title not in rows:
                rows[shown_title] = bars.add_task(shown_title, total=total, note=shown_note)
            row = rows[shown_title]
            has_restarted = done < bars.tasks[row].completed
            if has_restarted:
                bars.reset(row)  # the time starts again, too
            bars.update(row, completed=done, total=total, note=shown_note)

        yield show
