"""HTTP/1.1 on one connection, bounded in size and in time.

A request is collected until it is complete, and then answered at once in the event loop: that takes microseconds. Only
what may take long is answered in another thread; the requests that follow it on the same connection wait.

A timer for each request would cost as much as parsing it, so a connection notes the deadline of its next step, and the
server looks through its connections now and then (`close_overdue`).

A client may send thousands of requests at once, and the server has one thread for all connections: what arrives is
parsed in slices, and after `TURN_SECONDS` it is the turn of other connections.
"""

import asyncio
import math
import time
import urllib.parse
from collections import deque
from collections.abc import Iterable
from enum import Enum
from functools import lru_cache
from http import HTTPStatus
from typing import NamedTuple

import httptools

from isocharge.common.errors import TooLarge
from isocharge.serve.network.protocol import Handler, Response
from isocharge.serve.network.protocol.response import error_response, refusal
from isocharge.serve.network.traffic import Client

UNSENT_BYTES = 1 << 22
"""Answers that may wait for a client that sends requests and reads none, bytes; then the connection is closed."""

SLICE_BYTES = 4096
"""Bytes that are parsed at a time; nearly every request is shorter."""

TURN_SECONDS = 250e-6
"""Time after which a connection that has more to parse lets others go first, s."""

LINGER_SECONDS = 2.0
"""Time that a refused client may go on sending, s: if the connection closed at once, it might never read why."""

STATUS_LINES = {status.value: b"HTTP/1.1 %d %s\r\n" % (status, status.phrase.encode()) for status in HTTPStatus}

LAST = b"connection: close\r\n\r\n"
"""End of the head of a connection's last answer."""


class Phase(Enum):
    """The next thing that a connection waits for."""

    IDLE = "a request"
    HEADERS = "the end of the headers"
    BODY = "the end of the body"


class Head(NamedTuple):
    """The head of a complete request; after the last request of a connection the client wants it closed."""

    method: str
    path: str
    headers: list[tuple[bytes, bytes]]
    is_last: bool


class Connection(asyncio.Protocol):
    """One connection.

    Attributes:
        deadline: Until when the client may take for its next step, s by the clock of the loop.
        has_asked: Whether a request was ever complete.
    """

    def __init__(self, handler: Handler, connections: "set[Connection]", loop: asyncio.AbstractEventLoop) -> None:
        """Set up a connection of a server; `connections` are those that are open."""
        self.deadline, self.has_asked = math.inf, False
        self._handler, self._limits, self._connections, self._loop = handler, handler.limits, connections, loop
        self._transport: asyncio.Transport
        self._client: Client = None
        self._phase = self._timed = Phase.IDLE
        self._parser = self._new_parser()
        self._url, self._headers, self._body = b"", list[tuple[bytes, bytes]](), bytearray()
        self._piece = self._fed = 0  # bytes of this piece; bytes since the request began, or since the last of its body
        self._starts_in_piece = True  # whether this piece begins with a request
        self._has_answered = False  # whether a request of this piece was answered
        self._expects_continue = False
        self._unparsed = bytearray()
        self._turn: asyncio.Handle | None = None
        self._head: Head | None = None  # of the request that was complete last
        self._repeat, self._repeat_bytes = b"", 0  # its text and size if it came in one piece, to know it again
        self._answering: asyncio.Task[None] | None = None  # the answer that takes long
        self._waiting: deque[tuple[Head, bytes]] = deque()  # complete requests behind it, with their bodies
        self._is_stopping = self._is_refused = self._is_half_closed = self._is_blocked = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, or refuse it if there are too many."""
        self._transport = transport
        peer = transport.get_extra_info("peername")
        self._client = (str(peer[0]), int(peer[1])) if isinstance(peer, tuple) else None
        self._connections.add(self)
        self._allow(self._limits.header_seconds)
        if len(self._connections) > self._limits.connections and not self._make_room():
            self._refuse(refusal(503, f"all {self._limits.connections} connections are taken; try again later"))

    def _make_room(self) -> bool:
        """End the connection that has waited longest without one complete request; False if each has had one."""
        silent = [other for other in self._connections if other is not self and not other.has_asked]
        if not silent:
            return False
        oldest = min(silent, key=lambda other: other.deadline)
        self._connections.discard(oldest)
        oldest._transport.abort()
        return True

    def connection_lost(self, _error: Exception | None) -> None:
        """The connection is over, and what it sent is forgotten."""
        self._connections.discard(self)
        self._unparsed.clear()
        self._waiting.clear()

    def data_received(self, data: bytes) -> None:
        """Parse at once what is short and may be answered now; the rest in slices, in turns with other connections."""
        if self._is_refused or self._transport.is_closing():
            return
        if self._unparsed or self._answering or self._is_blocked or len(data) > SLICE_BYTES:
            self._unparsed += data
            if self._turn is None:
                self._take_turn()
        elif len(data) == self._repeat_bytes and data.startswith(self._repeat) and self._head is not None:
            self._answer(self._head, data[len(self._repeat) :])
        else:
            is_new = self._phase is Phase.IDLE
            self._parse(data)
            if is_new and self._has_answered:
                self._remember(data)

    def eof_received(self) -> bool:
        """The client sends no more; what it has asked for is still answered, where the transport can do that."""
        self._is_half_closed = bool(self._unparsed or self._answering)
        return self._is_half_closed and self._transport.can_write_eof()

    def pause_writing(self) -> None:
        """The client does not read its answer; it has `body_seconds` to go on."""
        self._allow(self._limits.body_seconds)
        self._is_blocked = True
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        """The client has read what was waiting."""
        self._is_blocked = False
        self._allow(self._limits.idle_seconds)
        if self._turn is None:
            self._take_turn()

    def shutdown(self) -> None:
        """The server stops: a request that has begun is still answered, as the last one."""
        self._is_stopping = True
        if self._is_refused:
            self._transport.abort()
        elif self._phase is Phase.IDLE and not self._answering:
            self._transport.close()

    def overdue(self) -> None:
        """End a connection that took too long; a client that is sending gets the reason."""
        if self._phase is Phase.IDLE or self._is_refused:
            self._transport.abort()
        else:
            self._refuse(refusal(408, f"waited too long for {self._phase.value}"))

    def abort(self) -> None:
        """End the connection at once."""
        self._transport.abort()

    def _take_turn(self) -> None:
        """Parse slices for as long as a turn lasts."""
        self._turn, end = None, time.perf_counter() + TURN_SECONDS
        while self._unparsed and not (self._answering or self._is_blocked or self._is_refused):
            if self._transport.is_closing():
                return
            if time.perf_counter() > end:
                self._turn = self._loop.call_soon(self._take_turn)
                break
            piece = bytes(self._unparsed[:SLICE_BYTES])
            del self._unparsed[:SLICE_BYTES]
            self._parse(piece)
        self._go_on_reading()

    def _go_on_reading(self) -> None:
        """Read more once everything is parsed; a client that sends no more has had its last answer then."""
        if self._transport.is_closing():
            return
        if self._unparsed:
            self._transport.pause_reading()
        elif not self._is_blocked:
            self._transport.resume_reading()
            if self._is_half_closed and not self._answering:
                self._transport.close()

    def _new_parser(self) -> httptools.HttpRequestParser:
        parser = httptools.HttpRequestParser(self)
        parser.set_dangerous_leniencies(lenient_data_after_close=True)  # it is ignored
        return parser

    def _parse(self, data: bytes) -> None:
        """Parse a piece; a request that is then still incomplete is measured and timed."""
        self._piece = len(data)
        self._fed += self._piece
        self._starts_in_piece = self._phase is Phase.IDLE
        self._has_answered, self._repeat_bytes = False, 0
        try:
            self._parser.feed_data(data)
        except httptools.HttpParserUpgrade as upgrade:
            self._parse_without_upgrade(data[upgrade.args[0] :])
        except httptools.HttpParserError:
            self._refuse(refusal(400, "Invalid HTTP request received."))
        if self._phase is not Phase.IDLE and not self._is_refused:
            self._measure_incomplete()

    def _measure_incomplete(self) -> None:
        if self._fed > self._limits.header_bytes:  # of a head; or of trailers, or of what goes with a chunk
            self._refuse_headers()
        elif self._timed is not self._phase:
            self._timed = self._phase
            is_head = self._phase is Phase.HEADERS
            self._allow(self._limits.header_seconds if is_head else self._limits.body_seconds)

    def _parse_without_upgrade(self, rest: bytes) -> None:
        """Parse a request that asks for another protocol as if it had not, with a new parser: HTTP lets a server do so.

        The old parser has taken everything after the headers for that protocol.
        """
        method = self._parser.get_method()
        if method == b"CONNECT":
            self._refuse(refusal(400, "CONNECT: this server opens no tunnels"))
        if self._is_refused:
            return
        self._parser, self._phase = self._new_parser(), Phase.IDLE
        lines = [b"%s: %s" % header for header in self._headers if header[0] != b"upgrade"]
        self._parse(b"\r\n".join([b"%s %s HTTP/1.1" % (method, self._url), *lines, b"", rest]))

    def on_message_begin(self) -> None:
        """A request begins, somewhere in this piece of data; of what is before it in the piece, it knows nothing."""
        self._phase, self._fed = Phase.HEADERS, self._piece if self._starts_in_piece else 0
        self._starts_in_piece = self._expects_continue = False
        self._url, self._headers, self._body = b"", [], bytearray()

    def on_url(self, url: bytes) -> None:
        """A piece of the request line's target."""
        self._url += url

    def on_header(self, name: bytes, value: bytes) -> None:
        """A header; a trailer is ignored."""
        if self._phase is Phase.BODY:
            return
        name = name.lower()
        if name == b"expect":
            self._expects_continue = value.lower() == b"100-continue"
        self._headers.append((name, value))

    def on_headers_complete(self) -> None:
        """The headers are complete; they are measured if enough bytes arrived for them to be too long."""
        longest = self._fed + SLICE_BYTES  # with the piece in which the request began, if that began with another
        self._phase, self._fed = Phase.BODY, 0
        if longest > self._limits.header_bytes and self._header_bytes() > self._limits.header_bytes:
            self._refuse_headers()
        elif self._expects_continue and not self._is_refused and not self._parser.should_upgrade():
            self._transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def on_body(self, body: bytes) -> None:
        """A piece of the body, up to the limit."""
        if self._is_refused:
            return
        self._fed = 0
        self._body += body
        try:
            self._limits.check_body(len(self._body))
        except TooLarge as error:
            self._refuse(error_response(error))

    def on_message_complete(self) -> None:
        """The request is complete: answer it, unless it was refused, or is to be parsed again."""
        if self._is_refused or self._transport.is_closing() or self._parser.should_upgrade():
            return
        self._phase, self.has_asked = Phase.IDLE, True
        method = self._parser.get_method().decode("latin-1")
        head = self._head = Head(method, _path(self._url), self._headers, not self._parser.should_keep_alive())
        if self._answering:
            self._waiting.append((head, bytes(self._body)))
        elif self._handler.may_block(head.path):
            self._answer_in_thread(head, bytes(self._body))
        else:
            self._has_answered = True
            self._answer(head, bytes(self._body))

    def _answer(self, head: Head, body: bytes) -> None:
        self._write(self._handler.answer(head.method, head.path, head.headers, body, self._client), head)

    def _answer_in_thread(self, head: Head, body: bytes) -> None:
        self._answering = self._loop.create_task(self._answer_later(head, body))
        self._timed, self.deadline = Phase.IDLE, math.inf

    async def _answer_later(self, head: Head, body: bytes) -> None:
        """Answer in another thread, and then the requests that came behind, in their order."""
        request = head.method, head.path, head.headers, body, self._client
        response = await asyncio.to_thread(self._handler.answer, *request)
        self._answering = None
        self._write(response, head)
        while self._waiting and self._answering is None:
            head, body = self._waiting.popleft()
            if self._handler.may_block(head.path):
                self._answer_in_thread(head, body)
            else:
                self._answer(head, body)
        self._take_turn()

    def _remember(self, data: bytes) -> None:
        """Remember the head of a request if it came alone and in one piece.

        Clients send the same head again and again. Where its bytes are the same, and as many bytes follow it, the
        parser would say the same of it again.
        """
        head, end, body = data.partition(b"\r\n\r\n")
        if body == self._body and self._phase is Phase.IDLE:
            self._repeat, self._repeat_bytes = head + end, len(data)

    def _write(self, response: Response, head: Head) -> None:
        """Send an answer in one piece, and wait for the next request."""
        if self._is_refused or self._transport.is_closing():
            return
        is_last = self._is_stopping or head.is_last
        self._transport.write(_text_of(response, is_last=is_last, with_body=head.method != "HEAD"))
        if is_last:
            self._transport.close()
        elif self._is_blocked and self._transport.get_write_buffer_size() > UNSENT_BYTES:
            self._transport.abort()
        self._timed = Phase.IDLE
        self._allow(self._limits.idle_seconds)

    def _allow(self, seconds: float) -> None:
        if not (self._is_blocked or self._answering):  # the time for a client that reads no answer is running already
            self.deadline = self._loop.time() + seconds

    def _header_bytes(self) -> int:
        return len(self._url) + sum(len(name) + len(value) + 4 for name, value in self._headers)

    def _refuse_headers(self) -> None:
        limit = self._limits.header_bytes
        self._refuse(refusal(431, f"the request line and headers are longer than {limit} bytes"))

    def _refuse(self, response: Response) -> None:
        """Answer without asking the application, read no more requests, and hang up when the client does or soon."""
        if self._is_refused or self._transport.is_closing():
            return
        self._is_refused = True
        self._unparsed.clear()
        self._handler.refused(response, self._client)
        self._transport.write(_text_of(response, is_last=True))
        if self._transport.can_write_eof():
            self._transport.write_eof()
            self._allow(LINGER_SECONDS)
        else:
            self._transport.close()


def _text_of(response: Response, *, is_last: bool, with_body: bool = True) -> bytes:
    """A response as HTTP sends it; the last one says that the connection closes."""
    parts = [STATUS_LINES[response.status]]
    for name, value in response.headers:
        parts += (name, b": ", value, b"\r\n")
    parts += (LAST if is_last else b"\r\n", response.body if with_body else b"")
    return b"".join(parts)


@lru_cache(64)
def _path(url: bytes) -> str:
    """The path in a request line's target, percent signs undone."""
    path = httptools.parse_url(url).path or b"/"
    return urllib.parse.unquote_to_bytes(path).decode("utf-8", "replace")


def close_overdue(connections: Iterable[Connection], now: float) -> None:
    """End every connection whose time is over."""
    for connection in list(connections):
        if connection.deadline < now:
            connection.overdue()
