"""A serial line as pyserial opens it, read in two system calls where the system has file descriptors for ports."""

import importlib
import io
import os
import select
from contextlib import suppress
from typing import Any

MOST_BYTES = 65536
"""Largest number of bytes that are read at once."""


def _terminal_errors() -> tuple[type[Exception], ...]:
    """What pyserial lets through besides OSError; empty on systems without POSIX terminals."""
    try:
        return (importlib.import_module("termios").error,)
    except ImportError:
        return ()


HAS_POSIX_PORTS = bool(_terminal_errors())
"""Whether ports are file descriptors for which `select` can wait; where not, pyserial reads them."""

READ_ERRORS: tuple[type[Exception], ...] = (OSError, *_terminal_errors())
OPEN_ERRORS: tuple[type[Exception], ...] = (ValueError, *READ_ERRORS)
"""What reading a line, and opening it, raises."""


class SerialLine:
    """An open line: a device, or another URL that pyserial knows."""

    def __init__(self, url: str, baud: int) -> None:
        """Open it.

        Raises:
            OSError, ValueError: If it cannot be opened.
        """
        serial = importlib.import_module("serial")  # late: who only predicts does not wait for it
        url = url.replace("tcp://", "socket://", 1) if url.startswith("tcp://") else url
        self._serial: Any = serial.serial_for_url(url, baudrate=baud, exclusive=True)
        with suppress(AttributeError, NotImplementedError, OSError, ValueError):
            self._serial.set_low_latency_mode(True)  # USB adapters collect bytes for 16 ms otherwise
        self._descriptor: int | None = None  # of none that exists only inside pyserial
        with suppress(AttributeError, io.UnsupportedOperation):
            self._descriptor = int(self._serial.fileno()) if HAS_POSIX_PORTS else None

    def reset_input_buffer(self) -> None:
        """Drop what has come."""
        self._serial.reset_input_buffer()

    def write(self, data: bytes) -> None:
        """Send."""
        self._serial.write(data)

    def close(self) -> None:
        """Close the line."""
        self._serial.close()

    def receive(self, timeout_s: float) -> bytes:
        """The bytes that come within a time, s: at least one, and all that are there with it; nothing if none come.

        Raises:
            READ_ERRORS: If the line goes away.
        """
        if self._descriptor is None:
            return self._receive_by_pyserial(timeout_s)
        if not select.select([self._descriptor], [], [], timeout_s)[0]:
            return b""
        data = os.read(self._descriptor, MOST_BYTES)  # pyserial takes five system calls, and one a byte of a socket
        if not data:
            raise OSError("it is readable and has no data: it was unplugged, or the other end has closed")
        return data

    def _receive_by_pyserial(self, timeout_s: float) -> bytes:
        if timeout_s != self._serial.timeout:  # to set it costs pyserial a system call
            self._serial.timeout = timeout_s
        first: bytes = self._serial.read(1)
        return first + self._serial.read(self._serial.in_waiting) if first else first
