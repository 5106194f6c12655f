"""HTTP/1.1 protocol of one connection, with limits on the size and the duration of requests.

Most requests are answered at once in the event loop, because most answers take only microseconds. An answer that may
take longer is computed in another thread. Later requests of the same connection wait until that answer was sent.

Each connection stores a deadline, by which the client must send further data or read the response. The server regularly
calls `close_overdue`, which compares all deadlines with the current time. The server does not start a timer for each
request, because a timer would take as much time as parsing the request.

A client may send thousands of requests at once, and all connections share one thread. Long data are therefore parsed in
slices. Whenever parsing has taken `TURN_SECONDS`, the event loop serves the other connections before it parses further
slices.
"""

import asyncio
import math
import time
from collections import deque
from collections.abc import Iterable
from enum import Enum

import httptools

from isocharge.common.errors import TooLarge
from isocharge.serve.network.http.messages import Head, request_path, response_bytes
from isocharge.serve.network.protocol import Handler, Response
from isocharge.serve.network.protocol.response import error_response, refusal
from isocharge.serve.network.traffic import Client

MAX_UNSENT_BYTES = 1 << 22
"""Largest total size of the responses that a client has not read yet, bytes.

If more bytes wait to be read, the connection is closed.
"""

SLICE_BYTES = 4096
"""Number of bytes that are parsed at a time. Nearly all requests are shorter than this."""

TURN_SECONDS = 250e-6
"""Time after which a connection stops parsing so that other connections are served, s."""

LINGER_SECONDS = 2.0
"""Time for which a connection stays open after a refusal, s. In this time, the client can read the reason."""


class Phase(Enum):
    """Part of a request for which a connection is waiting. The values are used in error messages."""

    IDLE = "a request"
    HEADERS = "the end of the headers"
    BODY = "the end of the body"


class Connection(asyncio.Protocol):
    """One connection of the server.

    Attributes:
        deadline: Time by which the client must send further data or read the response, s, on the clock of the event
            loop. After this time, the connection is ended.
        has_completed_request: Whether the client has sent at least one complete request.
    """

    def __init__(self, handler: Handler, connections: "set[Connection]", loop: asyncio.AbstractEventLoop) -> None:
        """Create the state of a new connection, on which no data have arrived yet.

        Args:
            handler: Handler that answers the requests.
            connections: Set of the open connections of the server, to which this connection adds itself.
            loop: Event loop of the server.
        """
        self.deadline = math.inf
        self.has_completed_request = False
        self._handler = handler
        self._limits = handler.limits
        self._connections = connections
        self._loop = loop
        self._transport: asyncio.Transport
        self._client: Client = None

        # The request that is being parsed
        self._phase = Phase.IDLE
        self._timed_phase = Phase.IDLE  # the phase for which the deadline was set
        self._parser = self._new_parser()
        self._url = b""
        self._headers: list[tuple[bytes, bytes]] = []
        self._body = bytearray()
        self._expects_continue = False

        # The data that are being parsed. A piece is the part of the data that is passed to the parser in one call.
        self._piece_size = 0  # bytes in the piece that is being parsed
        self._unchecked_size = 0  # bytes since the request began, or since the latest part of its body
        self._piece_begins_with_request = True  # false after the first request of the piece has begun
        self._piece_was_answered = False  # whether a request of the present piece was answered
        self._unparsed = bytearray()  # received data that have not been parsed yet
        self._next_turn: asyncio.Handle | None = None  # scheduled call of `_parse_stored_data`

        # Head of the latest complete request. If the request arrived alone and in one piece, the bytes of its head and
        # its total size are stored, too. A request with the same head is then recognised without parsing it.
        self._head: Head | None = None
        self._remembered_head = b""
        self._remembered_size = 0

        # The task that computes an answer in another thread, and the heads and bodies of the requests that wait for it
        self._answering: asyncio.Task[None] | None = None
        self._waiting: deque[tuple[Head, bytes]] = deque()

        self._is_stopping = False  # whether the server is being stopped
        self._is_refused = False  # whether a request was refused; no further requests are read then
        self._postponed_refusal: Response | None = None  # refusal that is sent after the answers to earlier requests
        self._is_half_closed = False  # whether the client sends no more data but still reads responses
        self._is_blocked = False  # whether nothing is parsed, because the client does not read its responses

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin the connection.

        If there are too many connections, the oldest other connection on which no complete request has arrived is
        ended. If there is no such connection, the new connection is refused.
        """
        self._transport = transport
        peer = transport.get_extra_info("peername")
        self._client = None  # a Unix socket has no address of the client
        if isinstance(peer, tuple):
            host, port, *_ = peer
            self._client = (str(host), int(port))
        is_full = len(self._connections) >= self._limits.connections
        has_room = not is_full or end_oldest_unused(self._connections)
        self._connections.add(self)
        self._set_deadline(self._limits.header_seconds)
        if not has_room:
            self._refuse(refusal(503, f"all {self._limits.connections} connections are taken; try again later"))

    def connection_lost(self, _error: Exception | None) -> None:
        """Discard the received data, because the connection has ended."""
        self._connections.discard(self)
        self._unparsed.clear()
        self._waiting.clear()

    def data_received(self, data: bytes) -> None:
        """Process data that the client has sent.

        There are three cases. Data that are long or that must wait are stored, and are parsed in slices. A request with
        the same head as the previous request is answered without parsing it. All other data are parsed at once. After a
        refusal, the data are ignored.
        """
        if self._is_refused or self._transport.is_closing():  # the data are ignored
            return

        # Case 1: the data are long, or must wait for earlier data, for an answer, or for the client to read responses.
        must_wait = bool(self._unparsed) or self._answering is not None or self._is_blocked
        if must_wait or len(data) > SLICE_BYTES:
            self._unparsed += data
            if self._next_turn is None:  # otherwise the event loop will call `_parse_stored_data`
                self._parse_stored_data()
            return

        # Case 2: the data have the same head and the same size as the previous request.
        repeats_head = len(data) == self._remembered_size and data.startswith(self._remembered_head)
        if repeats_head and self._head is not None:  # `_head` is the parsed head of the previous request
            body = data[len(self._remembered_head) :]
            self._answer(self._head, body)
            return

        # Case 3: all other data.
        begins_request = self._phase is Phase.IDLE  # no earlier request is incomplete
        self._parse(data)
        if begins_request and self._piece_was_answered:  # the next request may have the same head
            self._remember(data)

    def eof_received(self) -> bool:
        """Handle the end of the data that the client sends.

        Returns:
            Whether the connection stays open, because responses must still be sent.
        """
        self._is_half_closed = bool(self._unparsed or self._answering)
        # With TLS, both directions can only be closed together, and `can_write_eof` returns False.
        return self._is_half_closed and self._transport.can_write_eof()

    def pause_writing(self) -> None:
        """Stop reading requests, because the client does not read its responses.

        The connection is closed unless the client reads its responses within `body_seconds`.
        """
        self.deadline = self._loop.time() + self._limits.body_seconds
        self._is_blocked = True  # the deadline does not change until the client has read its responses
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        """Continue to read and parse requests, because the client has read its responses."""
        self._is_blocked = False
        self._set_deadline(self._limits.idle_seconds)
        if self._next_turn is None:  # otherwise the event loop will call `_parse_stored_data`
            self._parse_stored_data()

    def shutdown(self) -> None:
        """Close the connection, because the server is being stopped.

        If a request is incomplete, or if its answer is being computed, the connection is closed only after the response
        was sent. After a refusal was sent, the connection is ended at once.
        """
        self._is_stopping = True  # the next response closes the connection
        has_open_request = self._phase is not Phase.IDLE or self._answering is not None
        if self._is_refusal_sent:  # the connection is only open so that the client can read the refusal
            self._transport.abort()
        elif not has_open_request:
            self._transport.close()

    def end_overdue(self) -> None:
        """End the connection, because its deadline has passed.

        If a request has begun, a response that states the reason is sent to the client.
        """
        can_refuse = self._phase is not Phase.IDLE and not self._is_refused and not self._transport.is_closing()
        if not can_refuse:
            self._transport.abort()
        else:
            self._refuse(refusal(408, f"waited too long for {self._phase.value}"))

    def abort(self) -> None:
        """End the connection at once."""
        self._transport.abort()

    @property
    def _is_refusal_sent(self) -> bool:
        """Whether a refusal was sent, after which no other response may follow."""
        return self._is_refused and self._postponed_refusal is None

    def _parse_stored_data(self) -> None:
        """Parse slices of the stored data for at most `TURN_SECONDS`.

        If stored data remain, the event loop calls this method again after it has served the other connections.
        """
        self._next_turn = None
        turn_end = time.perf_counter() + TURN_SECONDS
        # The conditions are checked before each slice. While a slice is parsed, an answer in another thread may begin,
        # the buffer of unread responses may become full, or a request may be refused.
        while self._unparsed and not (self._answering or self._is_blocked or self._is_refused):
            if self._transport.is_closing():
                return
            if time.perf_counter() > turn_end:
                self._next_turn = self._loop.call_soon(self._parse_stored_data)
                break
            piece = bytes(self._unparsed[:SLICE_BYTES])
            del self._unparsed[:SLICE_BYTES]
            self._parse(piece)
        self._resume_reading()

    def _resume_reading(self) -> None:
        """After stored data were parsed, pause reading, resume reading, or close the connection.

        While stored data remain, no further data are read. If no stored data remain, reading is resumed, unless the
        client does not read its responses. If the client sends no more data and all requests are answered, the
        connection is closed.
        """
        if self._transport.is_closing():
            return
        if self._unparsed:
            self._transport.pause_reading()
        elif not self._is_blocked:  # a blocked connection is continued by the method `resume_writing`
            self._transport.resume_reading()
            if self._is_half_closed and not self._answering:
                self._transport.close()

    def _new_parser(self) -> httptools.HttpRequestParser:
        """Return a new request parser, which calls the `on_...` methods of this connection."""
        parser = httptools.HttpRequestParser(self)
        # Data after the last request of a connection are ignored. They would otherwise cause an error.
        parser.set_dangerous_leniencies(lenient_data_after_close=True)
        return parser

    def _parse(self, data: bytes) -> None:
        """Parse a piece of data. If a request is still incomplete afterwards, check its size.

        The parser calls the `on_...` methods of this connection. The method `on_message_complete` answers each complete
        request.
        """
        # Set the state of the piece, which the `on_...` methods use.
        self._piece_size = len(data)
        self._unchecked_size += self._piece_size  # the bytes that `_check_incomplete_request` compares with the limit
        self._piece_begins_with_request = self._phase is Phase.IDLE
        self._piece_was_answered = False
        self._remembered_size = 0  # discards the head of the previous request, because another request may follow

        try:
            self._parser.feed_data(data)
        except httptools.HttpParserUpgrade as upgrade:
            headers_end = upgrade.args[0]  # position in the piece at which the parser has stopped
            self._parse_without_upgrade(data[headers_end:])
        except httptools.HttpParserError:
            self._refuse(refusal(400, "Invalid HTTP request received."))
        if self._phase is not Phase.IDLE and not self._is_refused:
            self._check_incomplete_request()

    def _check_incomplete_request(self) -> None:
        """Refuse an incomplete request if it is too large. Otherwise set a deadline for its headers or for its body.

        The content of the body is not counted here, because the body has its own limit. The size of the headers is
        counted. If the body is sent in chunks, the sizes of the trailers and of the chunk extensions are also counted.
        The deadline is set once for the headers and once for the body. Further pieces do not extend it.
        """
        if self._unchecked_size > self._limits.header_bytes:
            self._refuse_headers()
        elif self._timed_phase is not self._phase:  # the present deadline was set for an earlier phase
            self._timed_phase = self._phase
            if self._phase is Phase.HEADERS:
                self._set_deadline(self._limits.header_seconds)
            else:
                self._set_deadline(self._limits.body_seconds)

    def _parse_without_upgrade(self, data_after_headers: bytes) -> None:
        """Parse a request again without its header `Upgrade`.

        HTTP allows a server to ignore the header `Upgrade`. A new parser is needed, because the present parser assumes
        that the data after the headers belong to another protocol.

        Args:
            data_after_headers: Rest of the piece, which has not been parsed.
        """
        method = self._parser.get_method()
        if method == b"CONNECT":  # the parser treats this method like an upgrade
            self._refuse(refusal(400, "CONNECT: this server opens no tunnels"))
        if self._is_refused:  # refused by the statement above, or before because of too long headers
            return
        self._parser = self._new_parser()
        self._phase = Phase.IDLE
        request_line = b"%s %s HTTP/1.1" % (method, self._url)
        header_lines = [b"%s: %s" % (name, value) for name, value in self._headers if name != b"upgrade"]
        self._parse(b"\r\n".join([request_line, *header_lines, b"", data_after_headers]))

    def on_message_begin(self) -> None:
        """Reset the state of the request, because a new request begins.

        A piece of data may contain several requests. If the piece begins with a request, all bytes of the piece are
        counted for this request. For every other request, the count begins at 0, because the parser does not report
        where in the piece the request begins.
        """
        self._phase = Phase.HEADERS
        self._unchecked_size = self._piece_size if self._piece_begins_with_request else 0
        self._piece_begins_with_request = False  # the next request in the same piece begins later
        self._expects_continue = False
        self._url = b""
        self._headers = []
        self._body = bytearray()

    def on_url(self, url: bytes) -> None:
        """Append the next part of the URL in the request line."""
        self._url += url

    def on_header(self, name: bytes, value: bytes) -> None:
        """Convert the name of a header to lower case, and store the header.

        The header `Expect` also determines whether the client waits for the response `100 Continue`. Trailers, which
        are headers after the body, are ignored.
        """
        if self._phase is Phase.BODY:
            return
        lower_name = name.lower()
        if lower_name == b"expect":
            self._expects_continue = value.lower() == b"100-continue"
        self._headers.append((lower_name, value))

    def on_headers_complete(self) -> None:
        """Check the size of the complete headers, and send `100 Continue` if the client waits for this response."""
        # Computing the exact size of the headers takes time. The size is only computed if the headers may be too long.
        # If the request began in the middle of a piece, up to SLICE_BYTES bytes of its headers were not counted.
        max_possible_size = self._unchecked_size + SLICE_BYTES
        may_be_too_long = max_possible_size > self._limits.header_bytes
        self._phase = Phase.BODY
        self._unchecked_size = 0  # the headers are complete, and the body has its own limit
        if may_be_too_long and self._header_size() > self._limits.header_bytes:
            self._refuse_headers()
            return

        # A request for a protocol upgrade is parsed a second time. The response is only sent the second time.
        is_parsed_again = self._parser.should_upgrade()
        if self._expects_continue and not self._is_refused and not is_parsed_again:
            self._transport.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def on_body(self, body: bytes) -> None:
        """Store a part of the body, and refuse the request if its body is too large."""
        if self._is_refused:
            return
        self._unchecked_size = 0  # the body has its own limit, which is checked here
        self._body += body
        try:
            self._limits.check_body(len(self._body))
        except TooLarge as error:
            self._refuse(error_response(error))

    def on_message_complete(self) -> None:
        """Answer the complete request, unless it was refused.

        If the answer to an earlier request is still being computed, the new request waits for that answer. A request
        for a protocol upgrade is not answered yet, because it is parsed again without its header `Upgrade`.
        """
        if self._is_refused or self._transport.is_closing() or self._parser.should_upgrade():
            return
        self._phase = Phase.IDLE
        self.has_completed_request = True
        method = self._parser.get_method().decode("latin-1")
        is_last = not self._parser.should_keep_alive()  # the client wants to close the connection after the response
        head = Head(method, request_path(self._url), self._headers, is_last)
        self._head = head
        body = bytes(self._body)
        if self._answering:  # the responses must be sent in the order of the requests
            self._waiting.append((head, body))
        elif self._handler.may_block(head.path):
            self._answer_in_thread(head, body)
        else:
            self._piece_was_answered = True
            self._answer(head, body)

    def _answer(self, head: Head, body: bytes) -> None:
        """Answer a request at once, and send the response."""
        response = self._handler.answer(head.method, head.path, head.headers, body, self._client)
        self._write(response, head)

    def _answer_in_thread(self, head: Head, body: bytes) -> None:
        """Begin to answer a request in another thread.

        Until the response is sent, the connection has no deadline, unless the client must read earlier responses.
        """
        self._answering = self._loop.create_task(self._answer_in_order(head, body))
        self._timed_phase = Phase.IDLE
        self._set_deadline(math.inf)

    async def _answer_in_order(self, head: Head, body: bytes) -> None:
        """Answer a request in another thread, and then answer the requests that have arrived in the meantime.

        If one of the later requests also needs another thread, all requests after it wait for its answer. A refusal
        that was postponed is sent after the last answer.

        Args:
            head: Request line and headers of the request.
            body: Body of the request.
        """
        response = await asyncio.to_thread(
            self._handler.answer, head.method, head.path, head.headers, body, self._client
        )
        self._answering = None
        self._set_deadline(self._limits.idle_seconds)  # even if the connection is closing and nothing is sent
        self._write(response, head)
        while self._waiting and self._answering is None:  # _answer_in_thread sets _answering again
            next_head, next_body = self._waiting.popleft()
            if self._handler.may_block(next_head.path):
                self._answer_in_thread(next_head, next_body)
            else:
                self._answer(next_head, next_body)
        if self._answering is None:
            self._send_postponed_refusal()
        self._parse_stored_data()

    def _remember(self, data: bytes) -> None:
        """Store the head of the latest request, so that a request with the same head does not have to be parsed.

        Most clients send the same head repeatedly. If two requests have equal heads and bodies of the same size, the
        parser would return the same result for both heads. The head is stored only if the request arrived alone and in
        one piece.

        Args:
            data: The data that contain the request.
        """
        head, blank_line, body = data.partition(b"\r\n\r\n")
        if body == self._body and self._phase is Phase.IDLE:
            self._remembered_head = head + blank_line
            self._remembered_size = len(data)

    def _write(self, response: Response, head: Head) -> None:
        """Send a response, and set the deadline by which the next request must begin.

        After the last response, the connection is closed. If the client does not read its responses and more than
        `MAX_UNSENT_BYTES` bytes wait to be read, the connection is ended at once.

        Args:
            response: The response.
            head: Head of the request. Its attribute `is_last` states whether the client wants to close the connection.
        """
        if self._is_refusal_sent or self._transport.is_closing():
            return
        is_last = self._is_stopping or head.is_last
        is_head_request = head.method == "HEAD"
        self._transport.write(response_bytes(response, is_last=is_last, with_body=not is_head_request))
        if is_last:
            self._transport.close()
        elif self._is_blocked and self._transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
            self._transport.abort()  # the client sends requests but does not read the responses

        # The next deadline is for the phase `IDLE`, in which the connection waits for a request.
        self._timed_phase = Phase.IDLE
        self._set_deadline(self._limits.idle_seconds)

    def _set_deadline(self, seconds: float) -> None:
        """Set the deadline to the current time plus a given duration.

        While an answer is being computed, the connection has no deadline. While the client does not read its responses,
        the deadline is not changed.

        Args:
            seconds: Time from now to the deadline, s.
        """
        if not self._is_blocked:
            self.deadline = math.inf if self._answering else self._loop.time() + seconds

    def _header_size(self) -> int:
        """Return the total size of the URL in the request line and of the headers, bytes."""
        separator_size = len(b": \r\n")
        return len(self._url) + sum(len(name) + len(value) + separator_size for name, value in self._headers)

    def _refuse_headers(self) -> None:
        """Refuse a request whose request line and headers are too long."""
        limit = self._limits.header_bytes
        self._refuse(refusal(431, f"the request line and headers are longer than {limit} bytes"))

    def _refuse(self, response: Response) -> None:
        """Refuse the present request, and read no more requests.

        The refusal is sent at once. If the answer to an earlier request is still being computed, the refusal is sent
        after that answer.

        Args:
            response: Response that states why the request is refused.
        """
        if self._is_refused or self._transport.is_closing():
            return
        self._is_refused = True
        self._unparsed.clear()
        self._handler.count_refusal(response, self._client)
        if self._answering is None:
            self._send_refusal(response)
        else:
            self._postponed_refusal = response

    def _send_postponed_refusal(self) -> None:
        """Send the refusal that had to wait for answers to earlier requests, if there is one."""
        response = self._postponed_refusal
        if response is not None:
            self._postponed_refusal = None
            self._send_refusal(response)

    def _send_refusal(self, response: Response) -> None:
        """Send a refusal as the last response of the connection.

        The connection remains open until the client closes it, but not longer than `LINGER_SECONDS`. With TLS, the
        connection is closed as soon as the response was sent.
        """
        if self._transport.is_closing():
            return
        self._transport.write(response_bytes(response, is_last=True))
        if self._transport.can_write_eof():  # false with TLS, in which both directions can only be closed together
            self._transport.write_eof()
            self._set_deadline(LINGER_SECONDS)
        else:
            self._transport.close()


def close_overdue(connections: Iterable[Connection], now: float) -> None:
    """End all connections whose deadline has passed.

    Args:
        connections: Connections of the server.
        now: Present time on the clock of the event loop, s.
    """
    for connection in list(connections):
        if connection.deadline < now:
            connection.end_overdue()


def end_oldest_unused(connections: set[Connection]) -> bool:
    """End the oldest connection on which no complete request has arrived, in order to make room for another one.

    The oldest connection is the connection with the earliest deadline.

    Args:
        connections: Connections of the server, from which the ended connection is removed.

    Returns:
        Whether a connection was ended.
    """
    unused = [connection for connection in connections if not connection.has_completed_request]
    if not unused:
        return False
    oldest = min(unused, key=lambda connection: connection.deadline)
    connections.discard(oldest)
    oldest.abort()
    return True
