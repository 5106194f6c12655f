"""Link between the reader, which reads a port, and the process that serves the live page.

Samples are sent through a pipe. Each sample is so small that the operating system always writes the whole sample at
once. Messages in both directions are JSON objects. Each message is sent as one datagram through a socket pair. The
reader of a live stream never waits. If the pipe is full, the reader discards the sample and counts it.
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
"""Size of the pipe, bytes. It has room for the samples of about 10 s at 1 kHz."""

MAX_MESSAGE_BYTES = 1 << 16
"""Largest size of a message, bytes."""

Message = dict[str, Any]

REQUEST_DECODER: msgspec.json.Decoder[LiveRequest] = msgspec.json.Decoder(LiveRequest)


@dataclass
class LinkEnd:
    """One end of the link.

    Attributes:
        samples: This process's end of the pipe, which carries the samples.
        messages: This process's end of the socket pair, which carries the messages.
        is_open: False if the latest attempt to send or receive samples found that the other process has ended.
    """

    samples: Connection
    messages: socket.socket
    is_open: bool = True

    def close_here(self) -> None:
        """Close this process's copy of this end. The copy of another process stays open."""
        self.messages.close()
        self.samples.close()

    def _send(self, message: bytes, flags: int) -> bool:
        """Send a message through the socket pair.

        Args:
            message: A JSON object, encoded as UTF-8.
            flags: Flags of `socket.send`, such as `MSG_DONTWAIT`.

        Returns:
            Whether the message was sent.
        """
        try:
            self.messages.send(message, flags)
        except OSError:
            return False
        return True


@dataclass
class ReaderEnd(LinkEnd):
    """End of the link in the process that reads the port.

    Attributes:
        dropped: Number of samples that were discarded because the pipe was full.
        waits: Whether sending waits while the pipe or the socket is full.
    """

    dropped: int = 0
    waits: bool = False

    def send_sample(self, sample: bytes) -> None:
        """Send a sample. If the pipe is full, discard and count the sample.

        After `enable_waiting` was called, the method instead waits until the pipe has room for the sample.
        """
        try:
            os.write(self.samples.fileno(), sample)
        except BlockingIOError:
            self.dropped += 1
        except OSError:  # the process of the page has ended
            self.is_open = False

    def enable_waiting(self) -> None:
        """Let all later calls of `send_sample` and `send_message` wait for the page instead of discarding data.

        This method must be called for a recording, because the page must show all samples of the recording.
        """
        os.set_blocking(self.samples.fileno(), True)
        self.waits = True

    def send_message(self, **content: Any) -> bool:
        """Send a message to the process of the page, and return whether the message was sent.

        Args:
            content: Names and values of the JSON object.
        """
        flags = 0 if self.waits else socket.MSG_DONTWAIT
        return self._send(json.dumps(content).encode(), flags)

    def wait_for_request(self) -> LiveRequest | None:
        """Wait for a request of the page and return it. If the process of the page has ended, return None."""
        try:
            data = self.messages.recv(MAX_MESSAGE_BYTES)
        except OSError:
            return None
        return REQUEST_DECODER.decode(data) if data else None

    def close(self) -> None:
        """Close this end. If a thread is waiting in `wait_for_request`, the waiting call returns None."""
        self.is_open = False
        with suppress(OSError):
            self.messages.shutdown(socket.SHUT_RDWR)
        self.close_here()


@dataclass
class PageEnd(LinkEnd):
    """End of the link in the process that serves the page."""

    _incomplete: bytes = b""  # beginning of a sample whose other bytes have not arrived yet

    def receive_samples(self, size: int) -> bytes:
        """Return the bytes of all complete samples that have already arrived. The method does not wait.

        If the reader has ended, the method sets `is_open` to False.

        Args:
            size: Size of a sample, bytes. The bytes of an incomplete sample are kept for the next call.
        """
        received = b""
        try:
            received = os.read(self.samples.fileno(), PIPE_BYTES)
        except BlockingIOError:  # no samples have arrived
            pass
        except OSError:
            self.is_open = False
        else:
            self.is_open = bool(received)  # reading returns no bytes if the reader has closed its end
        data = self._incomplete + received
        complete_bytes = len(data) - len(data) % size
        self._incomplete = data[complete_bytes:]
        return data[:complete_bytes]

    def receive_messages(self) -> list[Message]:
        """Return all messages that have already arrived. The method does not wait."""
        messages: list[Message] = []
        with suppress(OSError):  # BlockingIOError means that no further message has arrived
            while data := self.messages.recv(MAX_MESSAGE_BYTES, socket.MSG_DONTWAIT):
                messages.append(json.loads(data))
        return messages

    def send_request(self, request: LiveRequest) -> bool:
        """Send a request to the reader, and return whether the request was sent."""
        return self._send(msgspec.json.encode(request), socket.MSG_DONTWAIT)


def make_link() -> tuple[ReaderEnd, PageEnd]:
    """Create both ends of a link.

    A pipe carries the samples from the reader to the page. A pair of sockets carries messages in both directions. Each
    end can be passed to a new process that `multiprocessing` starts with the method `spawn`.
    """
    page_pipe, reader_pipe = Pipe(duplex=False)  # the page receives, and the reader sends
    for pipe_end in (page_pipe, reader_pipe):
        os.set_blocking(pipe_end.fileno(), False)  # neither end waits
    with suppress(OSError):  # a smaller pipe is sufficient if the system does not allow this size
        fcntl.fcntl(reader_pipe.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    reader_socket, page_socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return ReaderEnd(reader_pipe, reader_socket), PageEnd(page_pipe, page_socket)
