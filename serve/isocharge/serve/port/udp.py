"""A UDP socket as a port: each datagram is a chunk.

A board may send one line of text in each datagram, without a line end. It gets one, because a reader of lines waits for
it; from the first datagram on that ends with a line end, the board ends its lines itself.
"""

import re
import select
import socket
import time
from urllib.parse import urlsplit

SCHEME = "udp://"
"""How the name of such a port begins: udp://HOST:PORT, the address on which datagrams are received."""

MOST_BYTES = 65536
"""Largest datagram, bytes."""

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
