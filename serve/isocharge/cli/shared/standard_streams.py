"""stdin, stdout and stderr that are closed, full, or slow: a command neither breaks nor writes where it should not."""

import io
import os
import select
import sys
from collections.abc import Callable
from contextlib import suppress

from isocharge.common.errors import OutputError


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
