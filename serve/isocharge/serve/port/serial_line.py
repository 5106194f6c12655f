"""An open line: a serial one as pyserial opens it, or a UDP socket; and what a board on it has to be asked.

A serial line is read in two system calls where the system has file descriptors for ports. Each datagram is a chunk. A
board may send one line of text in each, without a line end. It gets one, because a reader of lines waits for it; from
the first datagram on that ends with a line end, the board ends its lines itself.

On a line with two wires both ends hear everything: what the host sends comes back before the answer, and has to be
taken out of it. The next request waits until the answer has come and the line is quiet.
"""

import importlib
import io
import os
import re
import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

QUIET_S = 0.002
"""Silence after which an answer counts as complete, s: two bytes at 9600 baud."""

UNANSWERED_S = 0.2
"""Time after which a request without an answer is repeated, s."""


@dataclass(frozen=True)
class Request:
    """What a board is asked.

    Attributes:
        data: The bytes to send.
        rate_Hz: Requests per second, at most.
        echo: Whether the line brings them back.
    """

    data: bytes
    rate_Hz: float = 100.0
    echo: bool = False


class Asker:
    """Says when a request is due, and takes its echo out of what comes."""

    def __init__(self, request: Request, now_s: Callable[[], float] = time.monotonic) -> None:
        self._request, self._now_s = request, now_s
        self._requests = self._echoes = 0
        self.forget()

    @property
    def echo_share(self) -> float:
        """Share of the requests that came back, dimensionless, whether they are taken out or not."""
        return self._echoes / max(1, self._requests)

    def forget(self) -> None:
        """The line was opened anew: ask at once."""
        self._asked_s = self._heard_s = -float("inf")
        self._echo = b""

    def wait_s(self) -> float:
        """Time until the next request is due, s; 0 if it is."""
        now_s = self._now_s()
        due_s = self._asked_s + 1.0 / self._request.rate_Hz
        if self._heard_s < self._asked_s:
            due_s = max(due_s, self._asked_s + UNANSWERED_S)
        return max(0.0, due_s - now_s, self._heard_s + QUIET_S - now_s)

    def asked(self) -> bytes:
        """The bytes to send now."""
        self._asked_s = self._now_s()
        self._requests += 1
        self._echo = self._request.data
        return self._request.data

    def heard(self, data: bytes) -> bytes:
        """What of the bytes that came is not the echo of the request."""
        if not data:
            return b""
        self._heard_s = self._now_s()
        common = min(len(data), len(self._echo))
        if not common or data[:common] != self._echo[:common]:
            self._echo = b""
            return data
        self._echo = self._echo[common:]
        self._echoes += not self._echo
        return data[common:] if self._request.echo else data


MOST_BYTES = 65536
"""Largest number of bytes that are read at once; no datagram is larger."""


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


SCHEME = "udp://"
"""How the name of such a port begins: udp://HOST:PORT, the address on which datagrams are received."""

_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


class UdpSocket:
    """An open socket on which datagrams come."""

    def __init__(self, url: str) -> None:
        """Bind a socket.

        Args:
            url: udp://HOST:PORT; without a host, datagrams may come from anywhere.

        Raises:
            OSError: If the address cannot be bound.
            ValueError: If it is none.
        """
        parts = urlsplit(url)
        if parts.port is None or parts.path or parts.query:
            raise ValueError(f"expected {SCHEME}HOST:PORT, got {url!r}")
        family, kind, protocol, _, address = socket.getaddrinfo(
            parts.hostname or "", parts.port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
        )[0]
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._ends_lines = False
        self._peer: tuple[str, int] | None = None

    def reset_input_buffer(self) -> None:
        """Drop what has come."""
        while self._is_ready(0.0):
            self._socket.recv(MOST_BYTES)

    def receive(self, timeout_s: float) -> bytes:
        """The next datagram that is not empty; nothing if none comes in time."""
        end_s = time.monotonic() + timeout_s
        while self._is_ready(max(0.0, end_s - time.monotonic())):
            data, self._peer = self._socket.recvfrom(MOST_BYTES)
            if data:
                return self._with_line_end(data)
        return b""

    def write(self, data: bytes) -> None:
        """Send to the board whose datagram came last; nowhere if none has come."""
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _is_ready(self, timeout_s: float) -> bool:
        return bool(select.select([self._socket], [], [], timeout_s)[0])

    def _with_line_end(self, data: bytes) -> bytes:
        self._ends_lines |= data.endswith(b"\n")
        is_text = not _CONTROL.search(data) and data.decode("utf-8", "replace").encode() == data
        return data + b"\n" if is_text and not self._ends_lines else data
