"""Connections to a board, and the requests that some boards need before they send a frame.

A connection is called a line. A line is either a serial port, which pyserial opens, or a UDP socket. If the system has
file descriptors for serial ports, each read from a serial port needs only three system calls.

If the program has not read a line for some time, many bytes are waiting. All waiting bytes, at least up to
`MAX_READ_BYTES`, are received at once. The time in which these bytes arrived is therefore divided among all frames in
them. Only datagrams of binary frames are received one by one, because the beginning of a datagram is the beginning of a
frame.

Some boards send datagrams of text that do not end with a line feed. A line feed is added to each datagram of such a
board, because text parsers need the line feed. If a datagram of the board has ended with a line feed, nothing is added
to later datagrams.

On a connection with only two wires, each end also receives the bytes that it sends itself. On such a connection, the
received bytes begin with an echo of the request, and the echo must be removed. The next request is sent only after the
answer has arrived and the connection is quiet.
"""

import io
import logging
import os
import re
import select
import socket
import termios
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

log = logging.getLogger(__name__)

QUIET_TIME_s = 0.002
"""Silence after which an answer is considered complete, s. Two bytes take this time at 9600 baud."""

REPEAT_TIME_s = 0.2
"""Time after which a request without an answer is repeated, s."""


@dataclass(frozen=True)
class Request:
    """Request that a board needs for each frame.

    Attributes:
        data: The bytes of the request.
        rate_Hz: Largest number of requests per second.
    """

    data: bytes
    rate_Hz: float = 100.0


MAX_READ_BYTES = 65536
"""Largest number of bytes of one read. Once the received bytes have reached this size, no more bytes are added.

No datagram is larger.
"""

READ_ERRORS = (OSError, termios.error)
"""Exceptions that reading a line can raise."""

OPEN_ERRORS = (ValueError, *READ_ERRORS)
"""Exceptions that opening a line can raise."""


SOCKET_SCHEMES = ("tcp://", "socket://", "rfc2217://")
"""First characters of the URLs that need a port number."""


class SerialLine:
    """An open connection to a board through a serial port or another port that pyserial supports.

    Many boards restart when the signal DTR of the port rises. The operating system sets the signal when a port is
    opened. If possible, the signal remains set when the line is closed, so that the next opening does not restart the
    board.
    """

    def __init__(self, url: str, baud: int) -> None:
        """Open the line, and configure the system to deliver received bytes without a delay if this is possible.

        Args:
            url: Device path, or a URL that pyserial accepts.
            baud: Bits per second.

        Raises:
            OSError, ValueError: If the line cannot be opened, or the URL of a socket has no port.
        """
        if url.startswith(SOCKET_SCHEMES) and urlsplit(url).port is None:  # ValueError for a wrong port
            raise ValueError(f"expected a port number, as in {url.rstrip('/:')}:7000")
        # pyserial is imported only here, so programs that open no port do not wait for the import.
        import serial

        if url.startswith("tcp://"):  # pyserial has another name for this scheme
            url = url.replace("tcp://", "socket://", 1)
        # The timeout of an attempt to read never changes, because RFC 2217 would negotiate all settings again.
        self._serial: Any = serial.serial_for_url(url, baudrate=baud, exclusive=True, timeout=QUIET_TIME_s)
        # Without this mode, USB adapters collect bytes for 16 ms. Some systems and ports do not have the mode.
        with suppress(AttributeError, NotImplementedError, OSError, ValueError):
            self._serial.set_low_latency_mode(True)
        # Lines that exist only inside pyserial have no file descriptor.
        self._descriptor: int | None = None
        with suppress(AttributeError, io.UnsupportedOperation):
            self._descriptor = self._serial.fileno()
        # Make the system leave the signal DTR of a terminal set when the terminal is closed.
        if self._descriptor is not None and os.isatty(self._descriptor):
            attributes = termios.tcgetattr(self._descriptor)
            control_modes = 2  # index in the attributes
            attributes[control_modes] &= ~termios.HUPCL  # switches off "hang up on close"
            termios.tcsetattr(self._descriptor, termios.TCSANOW, attributes)

    def write(self, data: bytes) -> None:
        """Send bytes to the board."""
        self._serial.write(data)

    def close(self) -> None:
        """Close the line."""
        self._serial.close()

    def receive(self, timeout_s: float) -> bytes:
        """Wait for a byte, and return all bytes that have arrived.

        Args:
            timeout_s: Longest time to wait, s.

        Returns:
            The bytes; empty if no byte arrives in time.

        Raises:
            BlockingIOError: If bytes arrived, but another program has read them.
            READ_ERRORS: If the line disappears. If bytes had arrived before, these bytes are returned, and the next
                call raises the error.
        """
        if self._descriptor is None:
            return self._receive_by_pyserial(timeout_s)
        data = b""
        try:
            while len(data) < MAX_READ_BYTES:  # a terminal returns at most 4 kB at a time
                # Wait only for the first bytes.
                readable, _, _ = select.select([self._descriptor], [], [], 0.0 if data else timeout_s)
                if not readable:
                    break
                # `os.read` needs one system call. pyserial would need five, or one for each byte of a socket.
                received = os.read(self._descriptor, MAX_READ_BYTES)
                if not received:  # `select` also reports the end of a stream as readable
                    if os.isatty(self._descriptor):  # false if the terminal was unplugged
                        raise BlockingIOError
                    raise OSError("it is readable and has no data: it was unplugged, or the other end has closed")
                data += received
        except READ_ERRORS:
            if not data:
                raise
        return data

    def _receive_by_pyserial(self, timeout_s: float) -> bytes:
        """Receive bytes from a line without a file descriptor.

        Args:
            timeout_s: Longest time to wait for the first byte, s.

        Returns:
            All bytes that have arrived; empty if no byte arrives in time.
        """
        deadline_s = time.monotonic() + timeout_s
        data = b""
        while not data and time.monotonic() < deadline_s:
            data = self._serial.read(1)  # waits until a byte arrives or the timeout of the line has passed
        if data:
            data += self._serial.read(self._serial.in_waiting)
        return data


class Requester:
    """Connection to a board that sends a frame only on request. It sends the requests, and removes their echoes."""

    def __init__(self, line: SerialLine, request: Request) -> None:
        """Store the line and the request. The first request is due at once.

        Args:
            line: The open line to the board.
            request: Request that the board needs for each frame.
        """
        self._line = line
        self._request = request
        self._earliest_request_s = 0.0  # time before which the limit of the rate allows no further request
        self._next_request_s = 0.0  # time at which the next request is due; not before the time above
        self._expects_echo = False  # whether the next bytes may be an echo of the request
        self._kept_bytes = b""  # first bytes after the request, which may be the beginning of its echo

    def receive(self, timeout_s: float) -> bytes:
        """Send requests whenever they are due until an answer arrives, and return the answer.

        Args:
            timeout_s: Longest time to wait, s.

        Returns:
            The answer; empty if no answer arrives in time.

        Raises:
            READ_ERRORS: If the line disappears.
        """
        deadline_s = time.monotonic() + timeout_s
        while (remaining_s := deadline_s - time.monotonic()) > 0.0:
            if self.wait_s() == 0.0:
                self._line.write(self.next_request())  # the following request is then due later
            # Wait for bytes, at most until the next request is due or the timeout has passed.
            received = self._line.receive(min(self.wait_s(), remaining_s))
            answer = self.remove_echo(received)
            if answer:
                return answer
        return b""

    def close(self) -> None:
        """Close the line."""
        self._line.close()

    def wait_s(self) -> float:
        """Return the time until the next request is due, s, or 0 if a request is due now.

        At least 1 / `rate_Hz` must pass between two requests. If a request receives no answer, `REPEAT_TIME_s` must
        pass, too. If an answer arrives, `QUIET_TIME_s` must pass after its latest byte.
        """
        return max(0.0, self._next_request_s - time.monotonic())

    def next_request(self) -> bytes:
        """Return the bytes of the next request, which the caller must send now, and begin to wait for the answer.

        If the board does not answer, the request is due again after `REPEAT_TIME_s`, but not earlier than the limit of
        the rate allows.
        """
        now_s = time.monotonic()
        self._earliest_request_s = now_s + 1.0 / self._request.rate_Hz
        self._next_request_s = max(self._earliest_request_s, now_s + REPEAT_TIME_s)
        self._expects_echo = True
        self._kept_bytes = b""
        return self._request.data

    def remove_echo(self, received: bytes) -> bytes:
        """Return the received bytes without the echo of the request.

        The echo consists of the same bytes as the request, and may arrive in several parts. Bytes that may be the
        beginning of an echo are kept back. If later bytes differ from the request, the kept bytes are returned, too. If
        bytes are returned, the next request is due when the board has been quiet for `QUIET_TIME_s`, but not earlier
        than the limit of the rate allows.

        Args:
            received: Bytes that arrived after the latest request; may be empty.
        """
        if self._expects_echo:
            self._kept_bytes += received
            request = self._request.data
            if request != self._kept_bytes and request.startswith(self._kept_bytes):  # an incomplete echo
                return b""
            self._expects_echo = False
            # Nothing is removed if the board sends no echo. The next request clears the kept bytes.
            received = self._kept_bytes.removeprefix(request)
        if received:
            self._next_request_s = max(self._earliest_request_s, time.monotonic() + QUIET_TIME_s)
        return received


UDP_SCHEME = "udp://"
"""First characters of the URL of a UDP socket, `udp://HOST:PORT`.

The URL contains the address on which the socket receives datagrams.
"""

MAX_LINE_DATAGRAMS = 8
"""Largest number of datagrams over which a serial bridge divides a line."""

_CONTROL_CHARACTER = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")


class UdpSocket:
    """An open UDP socket that receives datagrams from a board."""

    def __init__(self, url: str) -> None:
        """Open the socket, and bind it to the address in the URL.

        Args:
            url: udp://HOST:PORT. Without a host, the socket receives on every address of the machine.

        Raises:
            OSError: If the address cannot be bound.
            ValueError: If the URL has no port, or contains more than a host and a port.
        """
        parts = urlsplit(url)
        if parts.port is None or parts.path or parts.query:
            raise ValueError(f"expected {UDP_SCHEME}HOST:PORT, got {url!r}")
        addresses = socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE)
        family, socket_type, protocol, _canonical_name, address = addresses[0]  # the address that the system prefers
        self._socket = socket.socket(family, socket_type, protocol)
        try:
            self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._board_ends_lines = False  # whether the board itself ends each line, perhaps after several datagrams
        self._datagrams_without_end = 0  # number of successive datagrams without a line feed
        self._is_text = False  # whether the latest datagram is text, which is valid UTF-8 without control characters
        self._senders: list[tuple[Any, ...]] = []  # host and port of the first two senders of datagrams

    def receive(self, timeout_s: float) -> bytes:
        """Wait for a datagram, and return it. If the datagram is text, return all datagrams that have arrived.

        Args:
            timeout_s: Longest time to wait, s.

        Returns:
            The datagrams; empty bytes if no datagram arrives in time.
        """
        data = self._receive_datagram(timeout_s)
        while self._is_text and len(data) < MAX_READ_BYTES and (datagram := self._receive_datagram(0.0)):
            data += datagram
        return data

    def _receive_datagram(self, timeout_s: float) -> bytes:
        """Wait for a datagram that is not empty, and return it. A second sender causes one warning.

        The attribute `_is_text` then states whether the datagram is text, which is UTF-8 without control characters. If
        it is text and the board sends no line feeds, a line feed is added at the end.

        Args:
            timeout_s: Longest time to wait, s.

        Returns:
            The datagram; empty bytes if no datagram arrives in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while select.select([self._socket], [], [], max(0.0, deadline_s - time.monotonic()))[0]:
            data, sender = self._socket.recvfrom(MAX_READ_BYTES)
            if len(self._senders) < 2 and sender not in self._senders:
                self._senders.append(sender)
                if len(self._senders) == 2:
                    log.warning(
                        "datagrams of %s and of %s are read as those of one board; give each board its own UDP port",
                        *self._senders,
                    )
            if data:
                is_utf8 = data.decode("utf-8", "replace").encode() == data  # decoding replaces invalid bytes
                # A program in C may send the zero byte at the end of its text.
                self._is_text = is_utf8 and _CONTROL_CHARACTER.search(data.removesuffix(b"\0")) is None
                return self._with_line_feed(data)
        return b""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _with_line_feed(self, data: bytes) -> bytes:
        """Add a line feed to a datagram of text if the board does not end its lines with line feeds.

        If a datagram ends with a line feed, the board is assumed to end its lines itself. Because a serial bridge may
        divide a line over several datagrams, the next datagrams need not contain a line feed. After more than
        `MAX_LINE_DATAGRAMS` datagrams without a line feed, the board is assumed not to end its lines any more. A
        datagram that is no text is returned unchanged.

        Args:
            data: The datagram.
        """
        self._datagrams_without_end = 0 if b"\n" in data else self._datagrams_without_end + 1
        if self._datagrams_without_end > MAX_LINE_DATAGRAMS:
            self._board_ends_lines = False
        elif data.endswith(b"\n"):
            self._board_ends_lines = True
        return data + b"\n" if self._is_text and not self._board_ends_lines else data
