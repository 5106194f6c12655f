"""HTTP server on uvicorn that limits connections, and that other code can stop.

The signals of the process are left to the program that runs the server.
"""

import asyncio
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import uvicorn
import uvloop

from isocharge.serve.network.address import Address, ServerLimits, Tls
from isocharge.serve.network.http.connection import Connection
from isocharge.serve.network.traffic import Traffic


class HttpServer:
    """HTTP server of an ASGI application.

    The server begins to listen when it is created, and answers requests while the method `run` or the coroutine `serve`
    is executed. The method `close` releases the address of the server.

    Attributes:
        url: URL that clients use.
    """

    def __init__(
        self,
        application: Any,
        address: Address,
        limits: ServerLimits | None = None,
        traffic: Traffic | None = None,
        *,
        tls: Tls | None = None,
    ) -> None:
        """Open the socket on which the server listens.

        Args:
            application: ASGI application that answers the requests.
            address: Address on which to listen.
            limits: Limits of the connections. By default, the limits of `ServerLimits`.
            traffic: Counters of refused requests and of open connections. By default, nothing is counted.
            tls: Certificate and private key for TLS, or None for a server without TLS.

        Raises:
            InputError: If a TLS file cannot be used.
            ListenError: If the address is in use or cannot be used.
        """
        limits = limits or ServerLimits()
        traffic = traffic or Traffic()
        tls_context = tls.context() if tls else None
        connection: Any = partial(Connection, limits, traffic)
        config = uvicorn.Config(
            application,
            http=connection,
            lifespan="off",
            ws="none",
            log_config=None,
            log_level="critical",  # errors that a client causes are counted, and are sent to this client
            access_log=False,
            proxy_headers=False,
            server_header=False,
            date_header=False,
            timeout_keep_alive=math.ceil(limits.idle_seconds),
            timeout_graceful_shutdown=math.ceil(limits.grace_seconds),
            ssl_context_factory=(lambda *_: tls_context) if tls_context else None,
        )
        self._server = _Server(config)
        self._address = address
        self._socket = address.listen(config.backlog)
        self.url = address.url(self._socket, secure=tls is not None)
        traffic.open.labels("http").set_function(lambda: len(self._server.server_state.connections))

    def run(self) -> None:
        """Answer requests until `stop` is called, and then finish the requests that have already begun."""
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(self.serve())

    async def serve(self) -> None:
        """Answer requests in the running event loop, as `run` does."""
        await self._server.serve([self._socket])

    def stop(self) -> None:
        """End the method `run` as soon as the open requests are finished or, if called again, without finishing them.

        Any thread and any signal handler may call this method.
        """
        self._server.force_exit = self._server.should_exit
        self._server.should_exit = True

    def close(self) -> None:
        """Close the socket on which the server listens."""
        self._socket.close()
        self._address.release()


class _Server(uvicorn.Server):
    """Server of uvicorn that does not handle signals, and ends connections whose deadline has passed."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the signals to the program that runs the server."""
        yield

    async def on_tick(self, counter: int) -> bool:
        """End overdue connections. uvicorn calls this method ten times per second until the server is stopped."""
        now = asyncio.get_running_loop().time()
        for connection in list(self.server_state.connections):
            if isinstance(connection, Connection):
                connection.close_if_overdue(now)
        return await super().on_tick(counter)
