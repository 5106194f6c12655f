"""The HTTP server: where it listens, who may talk to it, and how it starts and stops."""

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
"""Time that requests which have begun get when the server stops, s."""

TICK_SECONDS = 0.1
"""Time between two looks at all deadlines, and between two attempts to accept where no descriptor is left, s."""

BACKLOG = 2048
"""Connections that may wait to be accepted."""

SIGNALS = (signal.SIGTERM, signal.SIGINT)


class HttpServer:
    """A server that listens from its construction until `close`, and answers while `run` runs."""

    def __init__(self, handler: Handler, address: Address, *, tls: Tls | None = None) -> None:
        """Listen.

        Args:
            handler: Answers the requests; its limits hold for the connections, too.
            address: Where to listen.
            tls: Certificate and key; None for no TLS.

        Raises:
            InputError: If a TLS file cannot be used.
            ListenError: If the address is taken or impossible.
        """
        self._handler, self._address, self._limits = handler, address, handler.limits
        self._tls = tls.context() if tls else None
        self._connections: set[Connection] = set()
        self._handshakes: dict[asyncio.Task[None], None] = {}  # in their order
        self._is_stopped = False
        handler.traffic.open["http"] = lambda: len(self._connections)
        self._socket = address.listen(BACKLOG)
        self.url = address.url(self._socket, secure=tls is not None)

    def run(self) -> None:
        """Answer until SIGTERM, SIGINT or `stop`; then finish the requests that have begun."""
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(self._serve())

    def stop(self) -> None:
        """Tell `run` to finish; from any thread."""
        self._is_stopped = True

    def close(self) -> None:
        """Listen no more."""
        self._socket.close()
        self._address.release()

    async def _serve(self) -> None:
        loop = asyncio.get_running_loop()
        signals = SIGNALS if threading.current_thread() is threading.main_thread() else ()
        for number in signals:
            loop.add_signal_handler(number, self.stop)
        accepting = loop.create_task(self._accept(loop))
        while not self._is_stopped:
            await asyncio.sleep(TICK_SECONDS)
            close_overdue(self._connections, loop.time())
        for number in signals:
            loop.remove_signal_handler(number)  # a second Ctrl-C does not wait
        for task in (accepting, *self._handshakes):
            task.cancel()
        await asyncio.gather(accepting, *self._handshakes, return_exceptions=True)
        self._socket.close()
        await self._finish(loop)

    async def _finish(self, loop: asyncio.AbstractEventLoop) -> None:
        """Answer what has begun, for as long as the grace lasts."""
        for connection in list(self._connections):
            connection.shutdown()
        end = loop.time() + GRACE_SECONDS
        while self._connections and loop.time() < end:
            await asyncio.sleep(0.5 * TICK_SECONDS)
            close_overdue(self._connections, loop.time())
        for connection in list(self._connections):
            connection.abort()

    async def _accept(self, loop: asyncio.AbstractEventLoop) -> None:
        """Accept connections; those whose TLS handshake is not done count, too, and the oldest gives its place away."""
        self._socket.setblocking(False)
        while True:
            try:
                accepted, _ = await loop.sock_accept(self._socket)
            except OSError:  # the client has gone, or no descriptor is left
                await asyncio.sleep(TICK_SECONDS)
                continue
            is_full = len(self._connections) + len(self._handshakes) >= self._limits.connections
            if is_full and self._tls is not None and self._handshakes:
                next(iter(self._handshakes)).cancel()
            handshake = loop.create_task(self._begin(accepted, loop))
            self._handshakes[handshake] = None
            handshake.add_done_callback(self._handshakes.pop)

    async def _begin(self, accepted: socket.socket, loop: asyncio.AbstractEventLoop) -> None:
        """Hand a socket over to its connection, after the TLS handshake if there is one."""
        make = partial(Connection, self._handler, self._connections, loop)
        seconds = self._limits.header_seconds if self._tls else None
        try:
            await loop.connect_accepted_socket(make, accepted, ssl=self._tls, ssl_handshake_timeout=seconds)
        except (OSError, asyncio.CancelledError):  # ssl.SSLError, TimeoutError: the client did not want to, or too long
            accepted.close()
