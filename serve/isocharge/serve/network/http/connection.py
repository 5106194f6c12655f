"""HTTP on one connection: bounded, and without a detour for what is answered in microseconds.

uvicorn's httptools protocol makes a task, an event and three dictionaries for each request before the application sees
it: twice the time that the answer takes. So a request is collected until it is complete, and then answered at once;
only what may take long, and what follows it on the same connection, goes through uvicorn as ASGI.

uvicorn also bounds neither headers nor the time they take. A timer for each request would cost as much as parsing it,
so a connection only notes the deadline of its next step, and the server looks through the connections now and then
(`close_overdue`).

A client may send thousands of requests at once, and the server has one thread for all connections: what arrives is
parsed in slices, and after `TURN_SECONDS` it is the turn of other connections.
"""

import asyncio
import math
import time
import urllib.parse
from collections.abc import Iterable
from enum import Enum
from functools import lru_cache
from typing import Any

import httptools
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from isocharge.common.errors import TooLarge
from isocharge.serve.network.http.answerer import Answerer
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.protocol import Response
from isocharge.serve.network.protocol.response import error_response, refusal

UNSENT_BYTES = 1 << 22
"""Answers that may wait for a client that sends requests and reads none, bytes; then the connection is closed."""

SLICE_BYTES = 4096
"""Bytes that are parsed at a time; nearly every request is shorter."""

TURN_SECONDS = 250e-6
"""Time after which a connection that has more to parse lets others go first, s."""

LINGER_SECONDS = 2.0
"""Time that a refused client may go on sending, s: if the connection closed at once, it might never read why."""


class Phase(Enum):
    """The next thing that a connection waits for."""

    IDLE = "a request"
    HEADERS = "the end of the headers"
    BODY = "the end of the body"
    ANSWER = "our answer"


class BoundedProtocol(HttpToolsProtocol):
    """One connection; subclasses carry application and limits, because uvicorn makes protocols from their class."""

    direct: Answerer
    limits = ServerLimits()

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.deadline = math.inf  # the loop's time, s
        self.has_asked = False  # whether a request was ever complete
        self._phase = self._timed = Phase.IDLE
        self._chunk = self._fed = 0  # bytes of this piece, and of all since the request began
        self._body, self._unparsed = bytearray(), bytearray()
        self._turn: asyncio.Handle | None = None
        self._starts_in_chunk = True  # whether this piece begins with a request
        self._has_answered = False  # whether a request of this piece was answered
        self._head, self._repeat_bytes = b"", 0  # head and size of a request that came in one piece, to know it again
        self._is_last = self._is_refused = self._is_half_closed = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection, or refuse it if there are too many."""
        super().connection_made(transport)
        self._allow(self.limits.header_seconds)
        if len(self.connections) > self.limits.connections and not self._make_room():
            self._refuse(refusal(503, f"all {self.limits.connections} connections are taken; try again later"))

    def _make_room(self) -> bool:
        """End the connection that has waited longest without one complete request; False if each has had one."""
        connections: set[Any] = self.connections
        silent = [other for other in connections if other is not self and not other.has_asked]
        if not silent:
            return False
        oldest = min(silent, key=lambda other: other.deadline)
        connections.discard(oldest)
        oldest.transport.abort()
        return True

    def data_received(self, data: bytes) -> None:
        """Parse at once what is short and may be answered now; the rest in slices, in turns with other connections."""
        if self._is_refused or self.transport.is_closing():
            return
        cycle = self.cycle  # the tests of `_may_answer` stand here: a call takes longer than they do
        may_answer = (cycle is None or cycle.response_complete) and not self.flow.write_paused
        if may_answer and not self._unparsed and len(data) <= SLICE_BYTES:
            if len(data) == self._repeat_bytes and data.startswith(self._head):
                self._answer(data[len(self._head) :])
                return
            is_new = self._phase is Phase.IDLE
            self._parse(data)
            if is_new and self._has_answered:
                self._remember(data)
            return
        self._unparsed += data
        if self._turn is None:
            self._take_turn()

    def eof_received(self) -> bool:  # type: ignore[override]
        """The client sends no more; what it has asked for is still answered, where the transport can do that."""
        self._is_half_closed = bool(self._unparsed) or not self._is_answered()
        return self._is_half_closed and self.transport.can_write_eof()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is over, and what it sent is forgotten."""
        self._unparsed.clear()
        super().connection_lost(exc)

    def _may_answer(self) -> bool:
        """Whether an answer could go out now: the one before is complete, and the client reads."""
        return self._is_answered() and not self.flow.write_paused

    def _is_answered(self) -> bool:
        return self.cycle is None or bool(self.cycle.response_complete)

    def _take_turn(self) -> None:
        """Parse slices for as long as a turn lasts."""
        self._turn, end = None, time.perf_counter() + TURN_SECONDS
        while self._unparsed and self._may_answer() and not (self._is_refused or self.transport.is_closing()):
            if time.perf_counter() > end:
                self._turn = self.loop.call_soon(self._take_turn)
                break
            piece = bytes(self._unparsed[:SLICE_BYTES])
            del self._unparsed[:SLICE_BYTES]
            self._parse(piece)
        self._go_on_reading()

    def _go_on_reading(self) -> None:
        """Read more once everything is parsed; a client that sends no more has had its last answer then."""
        if self.transport.is_closing():
            return
        if self._unparsed and not self._is_refused:
            self.flow.pause_reading()
        elif not self.flow.write_paused:
            self.flow.resume_reading()
            if self._is_half_closed and self._is_answered():
                self.transport.close()

    def _parse(self, data: bytes) -> None:
        """Parse a piece; a request that is then still incomplete is measured and timed."""
        self._chunk = len(data)
        self._fed += self._chunk
        self._starts_in_chunk = self._phase is Phase.IDLE or self._phase is Phase.ANSWER
        self._has_answered, self._repeat_bytes = False, 0
        try:
            self.parser.feed_data(data)
        except httptools.HttpParserUpgrade as upgrade:
            rest = data[upgrade.args[0] :]
            if self._should_upgrade():
                self._go_on_as_websocket(rest)
            else:
                self._parse_without_upgrade(rest)
        except httptools.HttpParserError:
            self._refuse(refusal(400, "Invalid HTTP request received."))
        if self._phase is Phase.HEADERS or self._phase is Phase.BODY:
            self._measure_incomplete()

    def _should_upgrade(self) -> bool:
        """Whether a WebSocket is asked for, and this server has one under the path."""
        return not self._is_refused and super()._should_upgrade() and self.direct.has_websocket(_path(self.url))

    def _go_on_as_websocket(self, rest: bytes) -> None:
        """Hand the connection over with its request; uvicorn's own method needs the request as ASGI, which is not made.

        Args:
            rest: Bytes that came after the headers.
        """
        self.connections.discard(self)
        lines = [b"%s %s HTTP/1.1" % (self.parser.get_method(), self.url)]
        lines += [b"%s: %s" % header for header in self.headers]
        make: Any = self.ws_protocol_class
        protocol = make(config=self.config, server_state=self.server_state, app_state=self.app_state)
        protocol.connection_made(self.transport)
        self.transport.set_protocol(protocol)
        rest += bytes(self._unparsed)
        self._unparsed.clear()
        protocol.data_received(b"\r\n".join(lines) + b"\r\n\r\n" + rest)

    def _parse_without_upgrade(self, rest: bytes) -> None:
        """Parse a request that asks for another protocol as if it had not, with a new parser: HTTP lets a server do so.

        The old parser has taken everything after the headers for that protocol.
        """
        method = self.parser.get_method()
        if method == b"CONNECT":
            self._refuse(refusal(400, "CONNECT: this server opens no tunnels"))
            return
        self.parser, self._phase = httptools.HttpRequestParser(self), Phase.IDLE
        self.parser.set_dangerous_leniencies(lenient_data_after_close=True)  # as uvicorn does
        lines = [b"%s %s HTTP/1.1" % (method, self.url)]
        lines += [b"%s: %s" % (name, _plain_connection(name, value)) for name, value in self.headers]
        self._parse(b"\r\n".join(line for line in lines if not line.startswith(b"upgrade:")) + b"\r\n\r\n" + rest)

    def on_message_begin(self) -> None:
        """A request begins, somewhere in this piece of data; of what is before it in the piece, it knows nothing."""
        self._phase, self._fed = Phase.HEADERS, self._chunk if self._starts_in_chunk else 0
        self._starts_in_chunk = False
        self.url, self.headers, self._body = b"", [], bytearray()
        self.expect_100_continue = False

    def on_headers_complete(self) -> None:
        """The headers are complete; they are measured if enough bytes arrived for them to be too long."""
        self._phase = Phase.BODY
        longest = self._fed + SLICE_BYTES  # with the piece in which the request began, if that began with another
        if longest > self.limits.header_bytes and self._header_bytes() > self.limits.header_bytes:
            self._refuse_headers()
        elif self.expect_100_continue and not self.parser.should_upgrade():
            self.transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def on_body(self, body: bytes) -> None:
        """A piece of the body, up to the limit."""
        if self._is_refused:
            return
        self._body += body
        try:
            self.limits.check_body(len(self._body))
        except TooLarge as error:
            self._refuse(error_response(error))

    def on_message_complete(self) -> None:
        """The request is complete: answer it, unless it was refused."""
        if self._is_refused or self.transport.is_closing() or self.parser.should_upgrade():
            return  # refused, or to be parsed again
        self._phase, self.has_asked = Phase.ANSWER, True
        path = _path(self.url)
        if self.direct.blocks(path) or not (self.cycle is None or self.cycle.response_complete):
            self._allow(math.inf)
            self._answer_as_asgi()
        else:
            self._has_answered = True
            self._answer(bytes(self._body))

    def _answer(self, body: bytes) -> None:
        """Answer the request whose head was parsed last."""
        method = self.parser.get_method().decode("latin-1")
        response = self.direct.answer(method, _path(self.url), self.headers, body, self.client)
        self._write(response, with_body=method != "HEAD")
        self._wait_for_request()

    def _remember(self, data: bytes) -> None:
        """Remember the head of a request if it came alone and in one piece.

        Clients send the same head again and again. Where its bytes are the same, and as many bytes follow it, the
        parser would say the same of it again.
        """
        head, end, body = data.partition(b"\r\n\r\n")
        if body == self._body and self._phase is Phase.IDLE:
            self._head, self._repeat_bytes = head + end, len(data)

    def on_response_complete(self) -> None:
        """uvicorn has sent an answer: do what its own method does, but start no timer."""
        self.server_state.total_requests += 1
        if self.transport.is_closing():
            return
        if self.pipeline:
            self._start_asgi_task(*self.pipeline.pop())
        else:
            self._wait_for_request()
            self._take_turn()

    def pause_writing(self) -> None:
        """The client does not read its answer; it has `body_seconds` to go on."""
        self._allow(self.limits.body_seconds)
        super().pause_writing()
        self.flow.pause_reading()

    def resume_writing(self) -> None:
        """The client has read what was waiting."""
        super().resume_writing()
        self._allow(self.limits.idle_seconds)
        if self._turn is None:
            self._take_turn()

    def send_400_response(self, msg: str) -> None:
        """Refuse what is not HTTP."""
        self._refuse(refusal(400, msg))

    def shutdown(self) -> None:
        """The server stops: a request that has begun is still answered, as the last one."""
        self._is_last = True
        if self._is_refused:
            self.transport.abort()
        elif self._phase not in (Phase.HEADERS, Phase.BODY):
            super().shutdown()

    def overdue(self) -> None:
        """End a connection that took too long; a client that is sending gets the reason."""
        if self._phase in (Phase.HEADERS, Phase.BODY) and not self._is_refused:
            self._refuse(refusal(408, f"waited too long for {self._phase.value}"))
        else:
            self.transport.abort()

    def _answer_as_asgi(self) -> None:
        """Hand the whole request to uvicorn: its answer may take long."""
        url, headers, body = self.url, self.headers, bytes(self._body)
        super().on_message_begin()
        self.url = url
        self.headers.extend(headers)
        super().on_headers_complete()
        super().on_body(body)
        super().on_message_complete()

    def _write(self, response: Response, *, with_body: bool) -> None:
        """Send an answer in one piece."""
        is_last = self._is_last or not self.parser.should_keep_alive()
        self.transport.write(_text_of(response, is_last=is_last, with_body=with_body))
        if is_last:
            self.transport.close()
        elif self.flow.write_paused and self.transport.get_write_buffer_size() > UNSENT_BYTES:
            self.transport.abort()

    def _wait_for_request(self) -> None:
        """Wait for the next request."""
        self._phase = self._timed = Phase.IDLE
        self._allow(self.limits.idle_seconds)

    def _measure_incomplete(self) -> None:
        if self._phase is Phase.HEADERS and self._fed > self.limits.header_bytes:
            self._refuse_headers()
        if self._timed is not self._phase and not self._is_refused:
            self._timed = self._phase
            self._allow(self.limits.header_seconds if self._phase is Phase.HEADERS else self.limits.body_seconds)

    def _allow(self, seconds: float) -> None:
        if not self.flow.write_paused:  # the time for a client that reads no answer is already running
            self.deadline = self.loop.time() + seconds

    def _header_bytes(self) -> int:
        return len(self.url) + sum(len(name) + len(value) + 4 for name, value in self.headers)

    def _refuse_headers(self) -> None:
        limit = self.limits.header_bytes
        self._refuse(refusal(431, f"the request line and headers are longer than {limit} bytes"))

    def _refuse(self, response: Response) -> None:
        """Answer without asking the application, read no more requests, and hang up when the client does or soon."""
        if self._is_refused or self.transport.is_closing():
            return
        self._is_refused = True
        self._unparsed.clear()
        self.direct.refused(response, self.client)
        self.transport.write(_text_of(response, is_last=True))
        if self.transport.can_write_eof():
            self.transport.write_eof()
            self._allow(LINGER_SECONDS)
        else:
            self.transport.close()


def _text_of(response: Response, *, is_last: bool, with_body: bool = True) -> bytes:
    """A response as HTTP sends it; the last one says that the connection closes."""
    parts = [STATUS_LINE[response.status]]
    for name, value in response.headers:
        parts += (name, b": ", value, b"\r\n")
    parts += (b"connection: close\r\n\r\n" if is_last else b"\r\n", response.body if with_body else b"")
    return b"".join(parts)


def _plain_connection(name: bytes, value: bytes) -> bytes:
    """The value of a header; of `Connection` without the option `upgrade`."""
    if name != b"connection":
        return value
    return b", ".join(option for option in map(bytes.strip, value.split(b",")) if option.lower() != b"upgrade")


@lru_cache(64)
def _path(url: bytes) -> str:
    """The path in a request line's target, percent signs undone, as ASGI has it."""
    path = httptools.parse_url(url).path or b"/"
    return urllib.parse.unquote_to_bytes(path).decode("utf-8", "replace")


def bounded(app: Answerer, limits: ServerLimits) -> type[BoundedProtocol]:
    """The protocol with this application and these limits."""
    return type("BoundedProtocol", (BoundedProtocol,), {"direct": app, "limits": limits})


def close_overdue(connections: Iterable[Any], now: float) -> None:
    """End every connection whose time is over."""
    for connection in list(connections):
        if connection.deadline < now:
            connection.overdue()
