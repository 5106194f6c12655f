"""HTTP server that accepts connections, makes TLS handshakes, and stops when it receives a signal."""

import asyncio
import errno
import signal
import socket
import threading
from functools import partial

import uvloop

from isocharge.serve.network.address import Address, Tls
from isocharge.serve.network.http.connection import Connection, close_overdue, end_oldest_unused
from isocharge.serve.network.protocol import Handler

GRACE_SECONDS = 10.0
"""Longest time to wait, when the server stops, until the requests that have already begun are finished, s."""

TICK_SECONDS = 0.1
"""Time between two checks of all deadlines, s. It is also the pause after an error in accepting a connection."""

BACKLOG = 2048
"""Largest number of connections that wait to be accepted."""

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals that stop the server, unless they are ignored, as SIGHUP is after `nohup`."""


class HttpServer:
    """HTTP server of models.

    The server begins to listen when it is created, and answers requests while the method `run` is executed. The method
    `close` releases the address of the server.

    Attributes:
        url: URL that clients use.
    """

    def __init__(self, handler: Handler, address: Address, *, tls: Tls | None = None) -> None:
        """Open the socket on which the server listens.

        Args:
            handler: Handler that answers the requests. Its limits also apply to the connections.
            address: Address on which to listen.
            tls: Certificate and private key for TLS, or None for a server without TLS.

        Raises:
            InputError: If a TLS file cannot be used.
            ListenError: If the address is in use or cannot be used.
        """
        self._handler = handler
        self._address = address
        self._limits = handler.limits
        self._tls = tls.context() if tls else None
        self._connections: set[Connection] = set()
        # Tasks that create connections and make TLS handshakes, in the order in which they began. A dictionary without
        # values is used as an ordered set.
        self._handshakes: dict[asyncio.Task[None], None] = {}
        self._is_stopped = False
        handler.traffic.open["http"] = lambda: len(self._connections)  # for the metric of open connections
        self._socket = address.listen(BACKLOG)
        self.url = address.url(self._socket, secure=tls is not None)

    def run(self) -> None:
        """Answer requests until the server is stopped, and then finish the requests that have already begun.

        The server is stopped by `SIGNALS` and by the method `stop`.
        """
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(self._serve())

    def stop(self) -> None:
        """End the method `run` soon. Any thread may call this method."""
        self._is_stopped = True

    def close(self) -> None:
        """Close the socket on which the server listens."""
        self._socket.close()
        self._address.release()

    async def _serve(self) -> None:
        """Accept connections and answer requests until the server is stopped, and then finish open requests."""
        # Another task accepts connections. The present task checks the deadlines of all connections.
        loop = asyncio.get_running_loop()
        is_main_thread = threading.current_thread() is threading.main_thread()
        signals = []
        if is_main_thread:  # other threads cannot handle signals
            signals = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
        for signal_number in signals:
            loop.add_signal_handler(signal_number, self.stop)
        accepting = loop.create_task(self._accept(loop))
        while not self._is_stopped:
            await asyncio.sleep(TICK_SECONDS)
            close_overdue(self._connections, loop.time())

        # The server was stopped. No more connections are accepted, and open requests are finished.
        for signal_number in signals:
            loop.remove_signal_handler(signal_number)  # so that a second Ctrl-C ends the program at once
        for task in (accepting, *self._handshakes):
            task.cancel()
        await asyncio.gather(accepting, *self._handshakes, return_exceptions=True)
        self._socket.close()
        await self._finish(loop)

    async def _finish(self, loop: asyncio.AbstractEventLoop) -> None:
        """Wait for open requests for at most `GRACE_SECONDS`, and then end the remaining connections."""
        for connection in list(self._connections):
            connection.shutdown()
        grace_end = loop.time() + GRACE_SECONDS
        while self._connections and loop.time() < grace_end:
            await asyncio.sleep(0.5 * TICK_SECONDS)  # shorter than usual, so that the server ends quickly
            close_overdue(self._connections, loop.time())
        for connection in list(self._connections):
            connection.abort()

    async def _accept(self, loop: asyncio.AbstractEventLoop) -> None:
        """Accept connections until the task is cancelled.

        Unfinished TLS handshakes are counted as connections. If there are too many connections, the oldest unfinished
        handshake is cancelled. If there is no unfinished handshake, or if the server does not use TLS, the class
        `Connection` enforces the limit instead.
        """
        self._socket.setblocking(False)
        while True:
            try:
                accepted, _ = await loop.sock_accept(self._socket)
            except OSError as error:  # the client has disconnected, or no file descriptor is left
                has_room = error.errno == errno.EMFILE and end_oldest_unused(self._connections)
                await asyncio.sleep(0.0 if has_room else TICK_SECONDS)
                continue
            open_count = len(self._connections) + len(self._handshakes)  # without the new connection
            is_full = open_count >= self._limits.connections
            # The connection of a client that has not finished its handshake is ended in favour of the new client.
            if is_full and self._tls is not None and self._handshakes:
                oldest_handshake = next(iter(self._handshakes))
                oldest_handshake.cancel()
            handshake = loop.create_task(self._connect(accepted, loop))
            self._handshakes[handshake] = None
            handshake.add_done_callback(self._handshakes.pop)  # removes the task when it ends

    async def _connect(self, accepted: socket.socket, loop: asyncio.AbstractEventLoop) -> None:
        """Create the connection of an accepted socket. If the server uses TLS, make the TLS handshake first.

        Args:
            accepted: The accepted socket, which is closed if the handshake fails.
            loop: Event loop of the server.
        """
        create_connection = partial(Connection, self._handler, self._connections, loop)
        timeout_s = self._limits.header_seconds if self._tls else None  # asyncio refuses a timeout without TLS
        try:
            await loop.connect_accepted_socket(
                create_connection, accepted, ssl=self._tls, ssl_handshake_timeout=timeout_s
            )
        except (OSError, asyncio.CancelledError):  # OSError includes ssl.SSLError and TimeoutError
            accepted.close()  # no error is raised, because an error of one client must not affect the server
