"""The link between the process that reads a port and the process of the page: samples one way, messages both ways.

The reader never waits: a sample or a message for which there is no room is dropped and counted. Samples go through a
pipe, where writes of this size are whole or not at all; messages are JSON, one a datagram of a socket pair.
"""

import fcntl
import json
import os
import socket
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from typing import Any

import msgspec

from isocharge.serve.viewer.messages import LiveRequest

PIPE_BYTES = 1 << 20
"""Room for samples that the page's process has not taken yet: some 10 s at 1 kHz."""

MOST_BYTES = 1 << 16
"""Largest message."""

Message = dict[str, Any]

REQUESTS: msgspec.json.Decoder[LiveRequest] = msgspec.json.Decoder(LiveRequest)


@dataclass
class LinkEnd:
    """One end.

    Attributes:
        is_open: Whether the other process was there at the last attempt.
    """

    samples: Connection
    messages: socket.socket
    is_open: bool = True

    def close_here(self) -> None:
        """Close this process's copy of the end, which another process may have."""
        self.messages.close()
        self.samples.close()

    def _send(self, message: bytes, flags: int) -> bool:
        """Send a message; False where there was no room for it."""
        try:
            self.messages.send(message, flags)
        except OSError:
            return False
        return True


@dataclass
class ReaderEnd(LinkEnd):
    """The end in the process that reads the port.

    Attributes:
        dropped: Samples for which there was no room.
        waits: Whether to wait for room.
    """

    dropped: int = 0
    waits: bool = False

    def put(self, sample: bytes) -> None:
        """Hand over a sample, or drop it: does not wait, unless `wait` was called."""
        try:
            os.write(self.samples.fileno(), sample)
        except BlockingIOError:
            self.dropped += 1
        except OSError:
            self.is_open = False

    def wait(self) -> None:
        """Wait for room from now on: for a recording, of which nothing must be missing."""
        os.set_blocking(self.samples.fileno(), True)
        self.waits = True

    def tell(self, **content: Any) -> bool:
        """Send a message; False where there was no room for it."""
        return self._send(json.dumps(content).encode(), 0 if self.waits else socket.MSG_DONTWAIT)

    def request(self) -> LiveRequest | None:
        """Wait for what the page asks for; None once its process has ended."""
        try:
            data = self.messages.recv(MOST_BYTES)
        except OSError:
            return None
        return REQUESTS.decode(data) if data else None

    def close(self) -> None:
        """Close this end, and wake who waits in `request`."""
        self.is_open = False
        with suppress(OSError):
            self.messages.shutdown(socket.SHUT_RDWR)
        self.close_here()


@dataclass
class PageEnd(LinkEnd):
    """The end in the page's process."""

    _partial: bytes = b""

    def take(self, size: int) -> bytes:
        """The samples that have come, each of `size` bytes; does not wait."""
        data, self._partial = self._partial, b""
        try:
            data += os.read(self.samples.fileno(), PIPE_BYTES)
        except BlockingIOError:
            pass
        except OSError:
            self.is_open = False
        else:
            self.is_open = bool(data)
        whole = len(data) - len(data) % size
        self._partial = data[whole:]
        return data[:whole]

    def replies(self) -> list[Message]:
        """The messages that have come; does not wait."""
        messages: list[Message] = []
        with suppress(OSError):
            while data := self.messages.recv(MOST_BYTES, socket.MSG_DONTWAIT):
                messages.append(json.loads(data))
        return messages

    def ask(self, request: LiveRequest) -> bool:
        """Send a request to the reader; False where it has ended, or takes none."""
        return self._send(msgspec.json.encode(request), socket.MSG_DONTWAIT)


def make_link() -> tuple[ReaderEnd, PageEnd]:
    """Both ends; each may be handed to a process that is started by `spawn`."""
    reading, writing = Pipe(duplex=False)
    for end in (reading, writing):
        os.set_blocking(end.fileno(), False)
    with suppress(OSError):  # the system allows no more: a smaller pipe will do
        fcntl.fcntl(writing.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return ReaderEnd(writing, ours), PageEnd(reading, theirs)
