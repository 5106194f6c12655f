"""Output and termination of the commands: results, messages, progress, standard streams and signals.

All text that a command prints passes through this module. The module escapes characters that a terminal would interpret
as commands or would not show. Messages are printed on stderr. Progress bars are only shown if stderr is a terminal. If
a standard stream is closed, full or slow, the command does not fail, and text for this stream is not written into
another file.
"""

import json
import logging
import os
import select
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pty import STDERR_FILENO, STDIN_FILENO, STDOUT_FILENO
from threading import Event
from typing import Any

import typer

from isocharge.common.errors import printable, printable_lines
from isocharge.common.progress import Listener, listening


def open_closed_streams() -> None:
    """Open the null device in place of standard streams that were closed when the command started.

    Without this replacement, the next file that is opened would get the file descriptor of stdout, and printed text
    would be written into that file.
    """
    for name, mode in {"stdin": "r", "stdout": "w", "stderr": "w"}.items():  # in the order of the descriptors
        if getattr(sys, name) is None:  # Python found the descriptor closed
            descriptor = os.open(os.devnull, os.O_RDWR)  # the lowest free file descriptor, which is that of the stream
            setattr(sys, name, open(descriptor, mode, closefd=False))  # noqa: SIM115


def discard_output(descriptor: int) -> None:
    """Redirect a standard stream to the null device.

    Without this redirection, Python would fail when it flushes the stream at exit.

    Args:
        descriptor: File descriptor of the stream.
    """
    with suppress(OSError):
        null_device = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null_device, descriptor)
        os.close(null_device)


def show(text: str) -> None:
    """Print a result as text on stdout. All characters that are not printable are escaped."""
    typer.echo(printable_lines(text))


def show_json(value: Any) -> None:
    """Print a result for programs on stdout, as one line of JSON. Numbers that are not finite become null."""
    from isocharge.common.structs import plain_values  # imports msgspec, which help does not need

    print(printable(json.dumps(plain_values(value), allow_nan=False)), flush=True)


def show_result(result: Mapping[str, Any], *, json: bool = False) -> None:
    """Print a result on stdout, either as one line of JSON, or as text with the same names and values.

    In the text, each value, each item of a dictionary and each of several sentences has its own line. A list of
    dictionaries, or a dictionary of dictionaries, is printed as a table. Numbers are rounded to five significant
    digits. A number that is unknown or not finite is printed as a dash.

    Args:
        result: Values by their names, which contain the units. The dictionaries of a table have the same keys.
        json: Whether to print JSON.
    """
    if json:
        show_json(result)
        return
    from isocharge.common.structs import plain_values  # imports msgspec, which help does not need

    values: Any = plain_values(result)
    width = max(map(len, values))
    next_line = "\n" + " " * (width + 2)  # the values begin two blanks after the longest name
    for name, value in values.items():
        rows = _table_rows(value)
        if rows:
            show("\n".join([f"{name}:", *_table_lines(rows)]))
        else:
            show(f"{name:<{width}}  {_value_text(value, separator=next_line)}")


def _table_rows(value: Any) -> list[dict[str, Any]]:
    """Return the table rows of a list of dictionaries or of a dictionary of dictionaries. Other values have no rows.

    The keys of a dictionary of dictionaries become the first column, which has no name.
    """
    if isinstance(value, dict) and all(isinstance(item, dict) for item in value.values()):
        return [{"": key} | item for key, item in value.items()]
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return value
    return []


def _table_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Return the lines of a table with one column for each key of the rows. The cells are aligned at the right."""
    table = [list(rows[0]), *([_value_text(value) for value in row.values()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.rjust, row, widths)).rstrip() for row in table]


def _value_text(value: Any, separator: str = ", ") -> str:
    """Return a value as text.

    Args:
        value: Number, text, None, or a list or dictionary of such values.
        separator: Text between the items of a dictionary or of a list of texts. Inner lists and dictionaries are
            separated by commas.
    """
    if value is None:
        return "-"
    if isinstance(value, float):
        # A number has five significant digits. The format `.5g` writes an exponent if they round to 1e5 or more.
        # Numbers from 1e4 to 1e9 are therefore rounded to whole numbers instead.
        is_large = 1e4 <= abs(value) < 1e9
        return f"{value:.0f}" if is_large else f"{value:.5g}"
    if isinstance(value, dict):
        return separator.join(f"{key} {_value_text(item)}" for key, item in value.items())
    if isinstance(value, list):
        has_texts = value and isinstance(value[0], str)  # all items have the type of the first one
        item_separator = separator if has_texts else ", "
        return item_separator.join(map(_value_text, value)) or "none"
    return printable(str(value))


def announce(line: str) -> None:
    """Print a line on stdout at once, for programs that wait for this line.

    A server continues if stdout is full or closed.
    """
    say(line, err=False)


def write_stdout(text: str) -> None:
    """Write a text to stdout without Python's buffer, because a thread that writes to the buffer may hang at exit."""
    _write_all(STDOUT_FILENO, text.encode())


def write_stderr(line: str) -> bool:
    """Write a line to stderr at once, and return whether this succeeded.

    After a failure, for example because the disk was full, the next line may succeed.
    """
    try:
        _write_all(STDERR_FILENO, f"{printable(line)}\n".encode())
    except OSError:
        return False
    return True


def _write_all(descriptor: int, data: bytes) -> None:
    """Write all data to a file descriptor. If the descriptor is not ready, wait until it is ready."""
    while data:
        try:
            written_bytes = os.write(descriptor, data)
            data = data[written_bytes:]
        except BlockingIOError:  # another program on the same terminal has made it non-blocking
            select.select([], [descriptor], [])


@contextmanager
def until_stopped() -> Iterator[None]:
    """Context manager that ends its block without an error if the command is stopped.

    Three events stop the block: Ctrl-C, the signal SIGTERM, and a reader of stdout that closes its end of the pipe.
    """
    try:
        yield
    except KeyboardInterrupt:  # Ctrl-C, or SIGTERM, whose handler in `isocharge.cli.main` raises the same exception
        pass
    except BrokenPipeError:  # no program reads stdout any more
        discard_output(STDOUT_FILENO)


@contextmanager
def on_signal(number: signal.Signals, act: Callable[[], object]) -> Iterator[None]:
    """Context manager that calls the function `act` whenever the given signal arrives during the block."""
    previous_handler = signal.signal(number, lambda *_: act())
    try:
        yield
    finally:
        signal.signal(number, previous_handler)


@contextmanager
def stop_timer(seconds: float | None, has_expired: Event) -> Iterator[None]:
    """Context manager that interrupts its block after a given time, even while the command waits for a port.

    A timer of the system sends the signal SIGALRM, whose handler raises KeyboardInterrupt, as Ctrl-C does.

    Args:
        seconds: The time, s, which must be positive; None for no limit.
        has_expired: Event that is set if the timer, and not Ctrl-C, has interrupted the block.
    """

    def interrupt() -> None:
        """Stop the block in the same way as Ctrl-C, and store that the time has expired."""
        has_expired.set()
        raise KeyboardInterrupt

    with on_signal(signal.SIGALRM, interrupt):
        signal.setitimer(signal.ITIMER_REAL, seconds or 0.0)  # 0 starts no timer
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)


def unless_hung_up(act: Callable[[], object]) -> Callable[[], object]:
    """Return a handler of SIGHUP that calls `act`. If the terminal has been closed, the handler stops the command.

    The user sends SIGHUP to request the action. The system sends the same signal when the terminal is closed. If a
    standard stream that was a terminal at the start of the command is not a terminal any more, the terminal has been
    closed.

    Args:
        act: Function that the handler calls while the terminal is open.
    """
    terminals = list(filter(os.isatty, (STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO)))
    return lambda: act() if all(map(os.isatty, terminals)) else signal.raise_signal(signal.SIGINT)


PROGRESS_LINE_INTERVAL_S = 5.0
"""Time between two lines of progress if stderr is not a terminal, s."""


def say(message: str, *, err: bool = True) -> None:
    """Print a message. All characters that are not printable are escaped.

    The command continues if the stream is full or closed.

    Args:
        message: The message.
        err: Whether to print on stderr. If not, the message is printed on stdout.
    """
    try:
        typer.echo(printable_lines(message), err=err)
    except OSError:
        discard_output(STDERR_FILENO if err else STDOUT_FILENO)


def this_command() -> str:
    """Return the command line as it was given, for cards and reports that state the command by which they were made."""
    return shlex.join(["isocharge", *sys.argv[1:]])


@contextmanager
def warnings_to_stderr() -> Iterator[None]:
    """Context manager that prints the warnings of all packages of isocharge on stderr, without time and traceback.

    Warnings of simulation and training begin with `caution:`.
    """

    def print_warning(record: logging.LogRecord) -> None:
        """Print a warning. The warnings of a running service do not begin with `caution:`."""
        caution = "" if record.name.startswith("isocharge.serve") else "caution: "
        say(caution + record.getMessage())

    with warnings_passed_to(print_warning, "isocharge"):
        yield


@contextmanager
def warnings_passed_to(write: Callable[[logging.LogRecord], None], package: str) -> Iterator[None]:
    """Context manager that calls a function with each warning and each error that a package logs.

    The messages of subpackages are included. Messages below the level of a warning do not arrive, unless the program
    has set a lower level for a logger.

    Args:
        write: Function that is called with each log record.
        package: Name of the package.
    """
    handler = logging.Handler()
    handler.emit = write  # type: ignore[method-assign, assignment]  # `logging` calls `emit` with each log record
    logger = logging.getLogger(package)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


@contextmanager
def shown_progress() -> Iterator[None]:
    """Context manager that shows the progress of its block: bars on a terminal, otherwise a line every few seconds.

    Each title has its own bar, which shows the finished share and the remaining time.
    """
    if not sys.stderr.isatty():
        with listening(_progress_lines()):
            yield
        return
    # The import takes 40 ms, which help and short commands need not wait for.
    from rich.console import Console
    from rich.progress import Progress, TaskID

    console = Console(stderr=True, markup=False, emoji=False)
    with Progress(*Progress.get_default_columns(), "{task.fields[note]}", console=console, transient=True) as bars:

        @cache  # returns the same bar for the same title
        def bar_of(title: str) -> TaskID:
            """Return the bar with the given title. The first call with a title creates the bar."""
            return bars.add_task(title, total=None, note="")

        def update_bar(title: str, done: int, total: int, note: str) -> None:
            """Show in the bar with the given title that `done` of `total` steps are complete."""
            bars.update(bar_of(printable(title)), completed=done, total=total, note=printable(note))

        with listening(update_bar):
            yield


def _progress_lines() -> Listener:
    """Return a function that prints the progress as lines, at most one line in `PROGRESS_LINE_INTERVAL_S`."""
    next_line_s = time.monotonic() + PROGRESS_LINE_INTERVAL_S

    def show_line(title: str, done: int, total: int, note: str) -> None:
        """Print how many of the `total` steps are complete, unless the latest line is too recent."""
        nonlocal next_line_s
        if time.monotonic() >= next_line_s:
            next_line_s = time.monotonic() + PROGRESS_LINE_INTERVAL_S
            say(f"{title}: {done} of {total} {note}".rstrip())

    return show_line
