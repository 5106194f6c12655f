"""The HTTP server: listening, accepting connections, TLS handshakes, and stopping."""

import asyncio
import signal
import socket
import threading
from functools import partial

import uvloop

from isocharge.serve.network.address import Address, Tls
from isocharge.serve.network.http.connection import Connection, close_overdue
from isocharge.serve.network.protocol import Handler

GRACE_SECONDS = 10.0
"""Longest time to finish the requests that have begun when the server stops, s."""

TICK_SECONDS = 0.1
"""Time between two checks of all deadlines, and pause after a failure to accept a connection, s."""

BACKLOG = 2048
"""Largest number of connections that wait to be accepted."""

SIGNALS = (signal.SIGTERM, signal.SIGINT)
"""Signals that stop the server."""


class HttpServer:
    """A server that listens from its construction until `close`. Requests are answered while `run` is executed.

    Attributes:
        url: URL for clients.
    """

    def __init__(self, handler: Handler, address: Address, *, tls: Tls | None = None) -> None:
        """Open the listening socket.

        Args:
            handler: Answers the requests. Its limits also apply to the connections.
            address: Address on which to listen.
            tls: Certificate and key; None for no TLS.

        Raises:
            InputError: If a TLS file cannot be used.
            ListenError: If the address is in use or cannot be used.
        """
        self._handler = handler
        self._address = address
        self._limits = handler.limits
        self._tls = tls.context() if tls else None
        self._connections: set[Connection] = set()
        self._handshakes: dict[asyncio.Task[None], None] = {}  # tasks of TLS handshakes: a set in order of their start
        self._is_stopped = False
        handler.traffic.open["http"] = lambda: len(self._connections)  # for the metric of open connections
        self._socket = address.listen(BACKLOG)
        self.url = address.url(self._socket, secure=tls is not None)

    def run(self) -> None:
        """Answer requests until SIGTERM, SIGINT or `stop`, and then finish the requests that have begun."""
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(self._serve())

    def stop(self) -> None:
        """Stop `run`. This method may be called from any thread."""
        self._is_stopped = True

    def close(self) -> None:
        """Close the listening socket."""
        self._socket.close()
        self._address.release()

    async def _serve(self) -> None:
        """Accept connections and answer requests until the server is stopped, and then finish the open requests."""
        # Accept connections in another task. This task checks the deadlines.
        loop = asyncio.get_running_loop()
        is_main_thread = threading.current_thread() is threading.main_thread()
        signals = SIGNALS if is_main_thread else ()  # other threads cannot handle signals
        for signal_number in signals:
            loop.add_signal_handler(signal_number, self.stop)
        accepting = loop.create_task(self._accept(loop))
        while not self._is_stopped:
            await asyncio.sleep(TICK_SECONDS)
            close_overdue(self._connections, loop.time())

        # Stop accepting, and finish the open requests.
        for signal_number in signals:
            loop.remove_signal_handler(signal_number)  # so that a second Ctrl-C ends the program at once
        for task in (accepting, *self._handshakes):
            task.cancel()
        await asyncio.gather(accepting, *self._handshakes, return_exceptions=True)
        self._socket.close()
        await self._finish(loop)

    async def _finish(self, loop: asyncio.AbstractEventLoop) -> None:
        """Finish the requests that have begun, for at most `GRACE_SECONDS`, and then end all remaining connections."""
        for connection in list(self._connections):
            connection.shutdown()
        grace_end = loop.time() + GRACE_SECONDS
        while self._connections and loop.time() < grace_end:
            await asyncio.sleep(0.5 * TICK_SECONDS)  # shorter than usual, so that the server ends soon
            close_overdue(self._connections, loop.time())
        for connection in list(self._connections):
            connection.abort()

    async def _accept(self, loop: asyncio.AbstractEventLoop) -> None:
        """Accept connections until the task is cancelled.

        Unfinished TLS handshakes count as connections. If there are too many connections, the oldest handshake is
        cancelled. Without TLS, and if there is no handshake, the new connection itself checks the limit.
        """
        self._socket.setblocking(False)
        while True:
            try:
                accepted, _ = await loop.sock_accept(self._socket)
            except OSError:  # the client has disconnected, or no file descriptor is left
                await asyncio.sleep(TICK_SECONDS)
                continue
            is_full = len(self._connections) + len(self._handshakes) >= self._limits.connections
            # A client that has not finished its handshake gives way to the new client.
            if is_full and self._tls is not None and self._handshakes:
                oldest_handshake = next(iter(self._handshakes))
                oldest_handshake.cancel()
            handshake = loop.create_task(self._connect(accepted, loop))
            self._handshakes[handshake] = None
            handshake.add_done_callback(self._handshakes.pop)  # removes the task when it ends

    async def _connect(self, accepted: socket.socket, loop: asyncio.AbstractEventLoop) -> None:
        """Create the connection of an accepted socket, after the TLS handshake if the server uses TLS.

        Args:
            accepted: The accepted socket, which is closed if the handshake fails.
            loop: Event loop of the server.
        """
        new_connection = partial(Connection, self._handler, self._connections, loop)
        timeout_s = self._limits.header_seconds if self._tls else None  # asyncio refuses a timeout without TLS
        try:
            await loop.connect_accepted_socket(new_connection, accepted, ssl=self._tls, ssl_handshake_timeout=timeout_s)
        except (OSError, asyncio.CancelledError):  # OSError includes ssl.SSLError and TimeoutError
            accepted.close()  # nothing is raised, because the failure of one client must not affect the server
