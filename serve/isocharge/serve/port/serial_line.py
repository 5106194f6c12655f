"""Connections to a board, and the requests that some boards need before they send a frame.

A line is a serial port, opened by pyserial, or a UDP socket. If the system has file descriptors for ports, reading a
serial port takes two system calls. Each datagram of a socket is one chunk.

Some boards send one line of text in each datagram, without a line feed at its end. A line feed is then added, because
parsers of text need it. If a datagram of the board has ended with a line feed, nothing is added to later datagrams.

On a line with two wires, both ends receive everything that is sent. The line therefore returns the request as an echo
before the answer, and the echo has to be removed from the received bytes. The next request waits until the answer has
arrived and the line is quiet.
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

QUIET_TIME_s = 0.002
"""Silence after which an answer is complete, s. Two bytes take this time at 9600 baud."""

REPEAT_TIME_s = 0.2
"""Time after which a request without an answer is repeated, s."""


@dataclass(frozen=True)
class Request:
    """Request that a board needs for each frame.

    Attributes:
        data: The bytes to send.
        rate_Hz: Largest number of requests per second.
        echo: Whether the line returns the bytes of the request before the answer.
    """

    data: bytes
    rate_Hz: float = 100.0
    echo: bool = False


class Requester:
    """Computes when a request is due, and removes the echo of requests from received bytes."""

    def __init__(self, request: Request, now_s: Callable[[], float] = time.monotonic) -> None:
        """Begin with a request that is due.

        Args:
            request: The request.
            now_s: Clock, s.
        """
        self._request = request
        self._now_s = now_s
        self._requests = 0  # number of requests so far
        self._echoes = 0  # number of complete echoes so far
        self.reset()  # makes the first request due

    @property
    def echo_share(self) -> float:
        """Share of the requests that the line returned, whether or not the echo was removed."""
        return self._echoes / max(1, self._requests)

    def reset(self) -> None:
        """Make the next request due at once, because the line was opened again."""
        self._requested_s = -float("inf")
        self._received_s = -float("inf")
        self._expected_echo = b""

    def wait_s(self) -> float:
        """Return the time until the next request is due, s; 0 if it is due now.

        Requests are due at the rate of the board. After a request without an answer, at least `REPEAT_TIME_s` must
        pass. After the latest received byte, at least `QUIET_TIME_s` must pass.
        """
        now_s = self._now_s()
        due_s = self._requested_s + 1.0 / self._request.rate_Hz
        is_unanswered = self._received_s < self._requested_s
        if is_unanswered:
            due_s = max(due_s, self._requested_s + REPEAT_TIME_s)
        quiet_end_s = self._received_s + QUIET_TIME_s  # bytes of the answer may arrive until then
        return max(0.0, due_s - now_s, quiet_end_s - now_s)

    def next_request(self) -> bytes:
        """Return the bytes of the next request, and store the time of the request."""
        self._requested_s = self._now_s()
        self._requests += 1
        self._expected_echo = self._request.data
        return self._request.data

    def remove_echo(self, received: bytes) -> bytes:
        """Return the received bytes without the echo of the request.

        The echo consists of the bytes of the request, and may arrive in several parts. If the line has no echo
        according to the request, complete echoes are counted, but the bytes are returned unchanged.
        """
        if not received:
            return b""
        self._received_s = self._now_s()

        # The received bytes may be shorter than the expected echo, or may continue after it.
        echo_length = min(len(received), len(self._expected_echo))
        is_echo = received[:echo_length] == self._expected_echo[:echo_length]
        if echo_length == 0 or not is_echo:
            self._expected_echo = b""  # the answer has begun, so no echo follows
            return received

        self._expected_echo = self._expected_echo[echo_length:]  # the part that has not arrived yet
        if not self._expected_echo:
            self._echoes += 1
        if not self._request.echo:  # the line has no echo, so these bytes belong to the answer
            return received
        return received[echo_length:]


MAX_READ_BYTES = 65536
"""Largest number of bytes that are read at once. No datagram is larger."""


def _terminal_errors() -> tuple[type[Exception], ...]:
    """Return the exceptions other than OSError that pyserial raises.

    The result is empty on systems without POSIX terminals.
    """
    try:
        return (importlib.import_module("termios").error,)
    except ImportError:
        return ()


HAS_POSIX_PORTS = bool(_terminal_errors())
"""Whether ports have file descriptors for which `select` can wait. Otherwise pyserial reads the ports."""

READ_ERRORS: tuple[type[Exception], ...] = (OSError, *_terminal_errors())
"""Exceptions that reading a line can raise."""

OPEN_ERRORS: tuple[type[Exception], ...] = (ValueError, *READ_ERRORS)
"""Exceptions that opening a line can raise."""


class SerialLine:
    """An open line that pyserial provides."""

    def __init__(self, url: str, baud: int) -> None:
        """Open the line. The system is set to deliver bytes without a delay.

        Args:
            url: Device path, or a URL that pyserial accepts.
            baud: Bits per second.

        Raises:
            OSError, ValueError: If the line cannot be opened.
        """
        # pyserial is imported only here, so that programs that only predict need not wait for the import.
        serial = importlib.import_module("serial")
        if url.startswith("tcp://"):  # pyserial has another name for this scheme
            url = url.replace("tcp://", "socket://", 1)
        self._serial: Any = serial.serial_for_url(url, baudrate=baud, exclusive=True)
        # Without this mode, USB adapters collect bytes for 16 ms.
        with suppress(AttributeError, NotImplementedError, OSError, ValueError):
            self._serial.set_low_latency_mode(True)
        # Lines that exist only inside pyserial have no file descriptor.
        self._descriptor: int | None = None
        if HAS_POSIX_PORTS:
            with suppress(AttributeError, io.UnsupportedOperation):
                self._descriptor = int(self._serial.fileno())

    def reset_input_buffer(self) -> None:
        """Drop the bytes that have arrived."""
        self._serial.reset_input_buffer()

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._serial.write(data)

    def close(self) -> None:
        """Close the line."""
        self._serial.close()

    def receive(self, timeout_s: float) -> bytes:
        """Wait for a byte, and return all bytes that have arrived.

        Args:
            timeout_s: Longest time to wait, s.

        Returns:
            The bytes; empty if none arrive in time.

        Raises:
            READ_ERRORS: If the line disappears.
        """
        if self._descriptor is None:
            return self._receive_by_pyserial(timeout_s)
        readable, _, _ = select.select([self._descriptor], [], [], timeout_s)
        if not readable:
            return b""
        # This needs one system call. pyserial would need five, or one for each byte of a socket.
        data = os.read(self._descriptor, MAX_READ_BYTES)
        if not data:  # the end of the stream is also readable
            raise OSError("it is readable and has no data: it was unplugged, or the other end has closed")
        return data

    def _receive_by_pyserial(self, timeout_s: float) -> bytes:
        """Receive bytes from a line without a file descriptor.

        Args:
            timeout_s: Longest time to wait for the first byte, s.

        Returns:
            All bytes that have arrived; empty if none arrive in time.
        """
        if timeout_s != self._serial.timeout:  # Setting the timeout costs a system call.
            self._serial.timeout = timeout_s
        data: bytes = self._serial.read(1)  # waits for at most the timeout
        if data:
            data += self._serial.read(self._serial.in_waiting)
        return data


UDP_SCHEME = "udp://"
"""First characters of the URL of a UDP socket, udp://HOST:PORT, which names the address on which it receives."""

_CONTROL_CHARACTER = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


class UdpSocket:
    """An open socket that receives datagrams."""

    def __init__(self, url: str) -> None:
        """Open the socket and bind it to the address.

        Args:
            url: udp://HOST:PORT. Without a host, the socket receives on every address of the machine.

        Raises:
            OSError: If the address cannot be bound.
            ValueError: If the URL has no port, or has more than a host and a port.
        """
        parts = urlsplit(url)
        if parts.port is None or parts.path or parts.query:
            raise ValueError(f"expected {UDP_SCHEME}HOST:PORT, got {url!r}")
        addresses = socket.getaddrinfo(
            parts.hostname or "", parts.port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
        )
        family, kind, protocol, _, address = addresses[0]  # the address that the system prefers
        self._socket = socket.socket(family, kind, protocol)
        try:
            self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._board_ends_lines = False  # whether a datagram of the board has ended with a line feed
        self._peer: tuple[str, int] | None = None  # sender of the latest datagram, to which answers are sent

    def reset_input_buffer(self) -> None:
        """Drop the datagrams that have arrived."""
        while self._is_ready(0.0):
            self._socket.recv(MAX_READ_BYTES)

    def receive(self, timeout_s: float) -> bytes:
        """Return the next datagram that is not empty. A line feed is added to text if the board sends none.

        Args:
            timeout_s: Longest time to wait, s.

        Returns:
            The datagram; empty bytes if no datagram arrives in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while self._is_ready(max(0.0, deadline_s - time.monotonic())):
            data, self._peer = self._socket.recvfrom(MAX_READ_BYTES)
            if data:
                return self._end_line(data)
        return b""

    def write(self, data: bytes) -> None:
        """Send bytes to the board that sent the latest datagram. Without such a board, nothing is sent."""
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _is_ready(self, timeout_s: float) -> bool:
        """Return whether a datagram has arrived or arrives within `timeout_s`, s."""
        readable, _, _ = select.select([self._socket], [], [], timeout_s)
        return bool(readable)

    def _end_line(self, data: bytes) -> bytes:
        """Add a line feed to a datagram of text, unless the board ends its datagrams with line feeds.

        A datagram is text if it is valid UTF-8 without control characters. Other datagrams are returned unchanged.
        """
        if data.endswith(b"\n"):
            self._board_ends_lines = True
        has_control_characters = _CONTROL_CHARACTER.search(data) is not None
        if self._board_ends_lines or has_control_characters:
            return data
        is_utf8 = data.decode("utf-8", "replace").encode() == data  # invalid bytes would have been replaced
        return data + b"\n" if is_utf8 else data
