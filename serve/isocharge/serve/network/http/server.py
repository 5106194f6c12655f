"""HTTP server on uvicorn that limits the size and the duration of requests, and that other code can stop.

uvicorn limits neither the size of headers and trailers, nor the time in which a request must arrive, nor the time in
which a client must read its response. uvicorn also queues any number of requests that a client sends without waiting
for responses. `Connection` closes connections that exceed such a limit. The server regularly calls `close_if_overdue`,
which compares the deadlines with the present time, because a timer for each request would take more time.
"""

import asyncio
import math
import resource
import socket
import time
from contextlib import AbstractAsyncContextManager, AsyncExitStack, nullcontext, suppress
from dataclasses import replace
from functools import partial
from typing import Any

import httptools
import orjson
import uvicorn
import uvloop
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from isocharge.serve.network.address import Address, ServerLimits, Tls
from isocharge.serve.network.metrics import Traffic
from isocharge.serve.network.protocol.handler import Application


class Connection(HttpToolsProtocol):
    """One connection of the server.

    Attributes:
        deadline: Time by which the client must send further data, s, on the clock of the event loop.
    """

    def __init__(self, limits: ServerLimits, traffic: Traffic, **uvicorn_arguments: Any) -> None:
        """Create the state of a new connection.

        Args:
            limits: Limits of the connection and of its requests.
            traffic: Counters, in which requests that are not passed to the application are counted.
            uvicorn_arguments: Arguments that uvicorn passes to its protocols.
        """
        super().__init__(**uvicorn_arguments)
        # Both deadlines are in s on the clock of the event loop. `deadline` is for further data from the client. The
        # client must read the sent responses by `_response_deadline`.
        self.deadline = math.inf  # no deadline
        self._response_deadline = self.loop.time() + limits.body_seconds  # this limit is also for reading responses
        self._limits = limits
        self._traffic = traffic
        # uvicorn calls a request and its response a cycle. `self.cycle` belongs to the latest request whose headers are
        # complete, and this attribute to the request before that one.
        self._previous_cycle: Any = None
        self._is_receiving = False  # whether a request has begun and is not complete
        self._is_stopping = False  # whether the next response closes the connection, because the server stops
        # Number of received bytes of an incomplete head (request line and headers), trailer or chunk extension. A
        # complete head, a part of a body and the end of a request set this number to 0.
        self._head_bytes = 0

    def _set_deadline(self, seconds: float) -> None:
        """Set the deadline for further data from the client to the present time plus `seconds`."""
        self.deadline = self.loop.time() + seconds

    def connection_made(self, transport: Any) -> None:
        """Begin the connection. If there are too many connections, end a connection that waits for a request.

        Among the connections that wait for a request, the connection with the earliest deadline is ended. A connection
        that has not sent any request has an earlier deadline than a connection whose requests were answered. If no
        other connection waits for a request, the new connection is refused.
        """
        super().connection_made(transport)
        self._set_deadline(self._limits.header_seconds)  # the TLS handshake, which is over, has a limit of its own
        if len(self.connections) <= self._limits.connections:
            return
        others: Any = self.connections - {self}  # all connections are of this class
        idle = [other for other in others if other.is_idle]
        if idle:
            min(idle, key=lambda other: other.deadline).transport.abort()
        else:
            self.refuse(503, f"all {self._limits.connections} connections are taken; try again later")

    @property
    def is_idle(self) -> bool:
        """Whether the server owes no response to this connection."""
        is_answered = self.cycle is None or (self.cycle.response_complete and not self._is_receiving)
        return is_answered and not self.transport.is_closing()

    def data_received(self, data: bytes) -> None:
        """Parse data of the client in pieces. Refuse a request whose head, trailers or chunk extensions are too long.

        `_head_bytes` counts the received bytes. The parser calls other methods of this class, which set the number to 0
        after a complete head, a part of a body and the end of a request. Bodies are therefore not limited here. If a
        piece contains the end of a request and the beginning of the next head, this beginning is not counted. Such a
        head may therefore be twice as long.
        """
        limit = self._limits.header_bytes
        while data and not self.transport.is_closing():
            # Take at most one byte more than the limit permits, which is enough to detect an excess.
            piece = data[: limit + 1 - self._head_bytes]
            data = data[len(piece) :]
            self._head_bytes += len(piece)  # the parser may set this number to 0 in the next line
            super().data_received(piece)
            if self._head_bytes > limit:
                self.refuse(431, f"the request line and headers are longer than {limit} bytes")
                return

    def eof_received(self) -> bool:  # type: ignore[override]
        """Return whether to keep the connection open after the client has stopped sending.

        An HTTP connection is kept open until all complete requests are answered. With TLS, both directions can only be
        closed together.
        """
        has_open_requests = self._close_after_owed_response()  # whether a complete request is not answered yet
        return has_open_requests and self.scheme == "http"

    def on_message_begin(self) -> None:
        """Begin a request, and refuse it if too many requests wait for the response to an earlier request."""
        if len(self.pipeline) >= self._limits.connection_requests:
            raise httptools.HttpParserError  # uvicorn calls `send_400_response`; the parser ignores all later data
        self._is_receiving = True
        self._set_deadline(self._limits.header_seconds)
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Set the deadline of the body, and discard the trailers that may follow the body (RFC 9110, 6.5.1).

        The response closes the connection if the server stops, or if the client requests an upgrade. The number of
        bytes of the head becomes 0, so that the next head is counted from its beginning.
        """
        self._head_bytes = 0
        self._set_deadline(self._limits.body_seconds)
        self._previous_cycle = self.cycle  # belongs to the request before this one
        super().on_headers_complete()  # replaces `self.cycle` by a new object for this request and its response
        self.headers = []  # uvicorn adds trailers to this list, which the request no longer uses
        # If the client requests an upgrade, the parser ignores the body, and would read its later parts as a request.
        if self._is_stopping or self.parser.should_upgrade():
            self.cycle.keep_alive = False

    def on_body(self, body: bytes) -> None:
        """Pass a part of the body to the application, which limits the size of the body."""
        self._head_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Remove the deadline, because the request is complete."""
        self._is_receiving = False
        self._head_bytes = 0
        self.deadline = math.inf
        super().on_message_complete()
        self.cycle.more_body = False  # the body is complete; uvicorn omits this if the request was already answered

    def close_if_overdue(self, now: float) -> None:
        """End the connection if a deadline has passed. If a request has begun, the client receives the reason.

        The server calls this method every 0.1 s. The method also sets the deadline of the next request, and the
        deadline until which the client must read a response.

        Args:
            now: Present time on the clock of the event loop, s.
        """
        # If all requests are answered since the previous call, limit the time until the next request. This limit
        # replaces the timer of uvicorn, which a client could stop by an empty line, with which no request begins.
        if self.is_idle and self.deadline == math.inf:
            self._set_deadline(self._limits.idle_seconds)
        # uvicorn pauses writing if the client does not read its responses. Until then, each call moves the deadline
        # for reading them. The client must read the responses within `body_seconds` after writing was paused.
        if not self.flow.write_paused:
            self._response_deadline = now + self._limits.body_seconds

        if min(self.deadline, self._response_deadline) > now:
            return
        if self._is_receiving:
            # If the client does not read the refusal in time either, a later call aborts the connection.
            self._is_receiving = False
            self.refuse(408, "waited too long for the rest of the request")
        else:  # no request has begun, or it was already refused
            self.transport.abort()

    def shutdown(self) -> None:
        """Close the connection after the response to the open request. uvicorn calls this method when the server stops.

        A connection without an open request stays open for another 0.1 s, because its client may have sent a request
        that has not been read yet. The connection is then ended without waiting for the client. A normal end of a TLS
        connection would wait for the client. This method calls itself after the 0.1 s.
        """
        if not self.is_idle or self.transport.get_write_buffer_size() > 0:
            super().shutdown()
        elif self._is_stopping:  # the second call
            self.transport.abort()
        else:
            self._is_stopping = True
            self.loop.call_later(0.1, self.shutdown)

    def _close_after_owed_response(self) -> bool:
        """Let uvicorn close the connection after the response to the latest complete request.

        If all complete requests are answered, nothing changes.

        Returns:
            Whether a complete request is not answered yet.
        """
        # uvicorn calls a request and its response a cycle. `more_body` is True until the body is complete.
        is_incomplete = self.cycle is not None and self.cycle.more_body
        cycle = self._previous_cycle if is_incomplete else self.cycle
        is_response_owed = cycle is not None and not cycle.response_complete
        if is_response_owed:
            cycle.keep_alive = False  # uvicorn closes the connection when the response is complete
            self.deadline = math.inf  # no further data are expected
        return is_response_owed

    def send_400_response(self, msg: str) -> None:
        """Refuse data that are not an HTTP request. uvicorn calls this method with a message."""
        self.refuse(400, msg)

    def refuse(self, status: int, message: str) -> None:
        """Send a refusal as the last response of the connection, and count the refusal.

        If earlier, complete requests are not answered yet, the connection is closed after their responses, and the
        refusal is neither sent nor counted. If the refused data are the rest of a request that is already answered, the
        refusal is not sent or counted either.

        Args:
            status: HTTP status.
            message: Reason of the refusal.
        """
        # If a complete request is not answered yet, the called method lets its response close the connection.
        if self.transport.is_closing() or self._close_after_owed_response():
            return
        # Do not send a second response to a request that was answered before its body was complete.
        if self.cycle is not None and self.cycle.more_body and self.cycle.response_complete:
            self.transport.close()
            return
        body = orjson.dumps({"error": message})
        head = b"content-type: application/json\r\ncontent-length: %d\r\nconnection: close\r\n\r\n" % len(body)
        # The route "none" stands for a request that could not be read. The request begins and ends at the same time.
        self._traffic.count("http", "none", status, self.client, time.perf_counter_ns())
        self.transport.write(STATUS_LINE[status] + head + body)
        self.transport.close()  # closes after the data have been sent
        self._set_deadline(self._limits.header_seconds)  # the time in which the client must have received the refusal


def _limits_for_open_files(limits: ServerLimits) -> ServerLimits:
    """Let the process open as many files as the system permits, and return the limits that the server can then keep.

    Each connection needs an open file. The number of connections is reduced if it exceeds seven eighths of the number
    of files. The remaining files are kept free, so that the server can always accept a new connection, and can then end
    an older connection.

    Args:
        limits: Requested limits of the server.
    """
    _, permitted = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(ValueError, OSError):  # macOS refuses an unlimited number
        resource.setrlimit(resource.RLIMIT_NOFILE, (permitted, permitted))
    max_open_files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if max_open_files == resource.RLIM_INFINITY:
        return limits
    return replace(limits, connections=min(limits.connections, max_open_files * 7 // 8))


class HttpServer(uvicorn.Server):
    """HTTP server of an ASGI application.

    The server begins to listen when it is created, and answers requests while the method `run` is executed. The method
    `close` releases the address of the server.

    Attributes:
        url: URL that clients use.
    """

    def __init__(self, application: Application, address: Address, tls: Tls | None = None) -> None:
        """Open the socket on which the server listens.

        Args:
            application: ASGI application that answers the requests. The limits of the application also apply to the
                connections. The counters of the application also count refused requests and open connections.
            address: Address on which to listen.
            tls: Certificate and private key for TLS, or None for a server without TLS.

        Raises:
            InputError: If a TLS file cannot be used.
            ListenError: If the address is in use or cannot be used.
        """
        # Permit more open files. If the system does not permit enough of them, the number of connections is reduced.
        limits = _limits_for_open_files(application.limits)
        tls_context = tls.context() if tls else None
        self._address = address
        self._socket = address.listen()
        config = uvicorn.Config(
            application,
            http=partial(Connection, limits, application.traffic),  # type: ignore[arg-type]
            lifespan="off",
            ws="none",
            log_config=None,
            log_level="critical",  # errors that a client causes are counted, and are sent to this client
            access_log=False,
            proxy_headers=False,
            timeout_keep_alive=86_400,  # `close_if_overdue` ends idle connections earlier
            timeout_graceful_shutdown=math.ceil(limits.grace_seconds),
            ssl_context_factory=(lambda *_: tls_context) if tls_context else None,
        )
        super().__init__(config)
        self.url = address.url(self._socket, secure=tls is not None)
        # The metric of the open connections calls this function when the metrics are requested.
        application.traffic.open.labels("http").set_function(lambda: len(self.server_state.connections))

    def run(self, beside: AbstractAsyncContextManager[Any] | None = None) -> None:  # type: ignore[override]
        """Answer requests until `stop` is called, and then finish the requests that have already begun.

        In the main thread, SIGINT and SIGTERM also stop the server, and then reach the handlers of the program.

        Args:
            beside: Context that is open until `stop` is called, such as a gRPC server in the same event loop. If `stop`
                is called again, uvicorn ends `shutdown` without waiting, and the event loop then cancels the exit of
                the context.
        """

        async def serve() -> None:
            """Open the context `beside`, which `shutdown` closes, and answer requests until the server is stopped."""
            # The method `shutdown` closes this stack, and thereby the context, before the block ends.
            async with AsyncExitStack() as self._companion_stack:
                await self._companion_stack.enter_async_context(beside or nullcontext())
                await self.serve([self._socket])

        uvloop.run(serve())

    def stop(self) -> None:
        """End the method `run` after the open requests are finished. A second call ends `run` without finishing them.

        Any thread and any signal handler may call this method.
        """
        self.force_exit = self.should_exit
        self.should_exit = True

    def close(self) -> None:
        """Close the socket on which the server listens."""
        self._socket.close()
        self._address.release()

    async def on_tick(self, counter: int) -> bool:  # noqa: ARG002
        """End overdue connections, and return whether to stop the server. uvicorn calls this method every 0.1 s.

        The method of the base class is not called. It would also update the headers `date` and `server`, which the
        responses do not need.
        """
        now = asyncio.get_running_loop().time()
        connections: Any = list(self.server_state.connections)
        for connection in connections:
            connection.close_if_overdue(now)
        return self.should_exit

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Finish the open requests within the grace period, and then cancel the remaining requests.

        Meanwhile, the context that was passed to `run` is closed.
        """
        closing = asyncio.create_task(self._companion_stack.aclose())
        self.server_state.tasks.add(closing)  # uvicorn waits for these tasks as long as for the requests
        closing.add_done_callback(self.server_state.tasks.discard)
        await super().shutdown(sockets)
