"""The HTTP server: where it listens, who may talk to it, and how it starts and stops."""

import asyncio
import logging
import socket
import ssl
from functools import partial
from typing import Any

import uvicorn

from isocharge.serve.network.address import Address
from isocharge.serve.network.http.answerer import Answerer
from isocharge.serve.network.http.connection import bounded, close_overdue
from isocharge.serve.network.http.tls_listener import TlsListener
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.tls import Tls

GRACE_SECONDS = 10
"""Time that requests which have begun get when the server stops, s."""

BACKLOG = 2048
"""Connections that may wait to be accepted."""


class _Uvicorn(uvicorn.Server):
    """uvicorn, looking after overdue connections while it waits, and with our listener in front of TLS."""

    def __init__(self, config: uvicorn.Config, limits: ServerLimits, context: ssl.SSLContext | None) -> None:
        super().__init__(config)
        self._limits, self._context = limits, context

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup([] if self._context else sockets)
        if self._context is not None:
            make_protocol: Any = self.config.http_protocol_class
            protocol = partial(make_protocol, self.config, self.server_state, self.lifespan.state)
            connections = self.server_state.connections
            for listening in sockets or ():
                listener: Any = TlsListener(listening, self._context, self._limits, protocol, connections)
                self.servers.append(listener)

    async def on_tick(self, counter: int) -> bool:
        close_overdue(self.server_state.connections, asyncio.get_running_loop().time())
        return await super().on_tick(counter)


class HttpServer:
    """A server that listens from its construction until `close`, and answers while `run` runs."""

    def __init__(
        self,
        app: Answerer,
        address: Address,
        *,
        limits: ServerLimits,
        tls: Tls | None = None,
        websocket: type[asyncio.Protocol] | None = None,
    ) -> None:
        """Listen.

        Args:
            app: Answers the requests.
            address: Where to listen.
            limits: Bounds of requests and connections.
            tls: Certificate and key; None for no TLS.
            websocket: The protocol of the WebSockets that the application has, `bounded_websocket(limits)`.

        Raises:
            InputError: If a TLS file cannot be used.
            ListenError: If the address is taken or impossible.
        """
        context = tls.context() if tls else None
        config = uvicorn.Config(
            app,
            loop="uvloop",
            http=bounded(app, limits),
            ws=websocket or "none",
            ws_max_size=limits.message_bytes,
            ws_per_message_deflate=False,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            date_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=GRACE_SECONDS,
        )
        self._server, self._address = _Uvicorn(config, limits, context), address
        app.watch_connections(lambda: len(self._server.server_state.connections))
        self._socket = address.listen(BACKLOG)
        self._file = address.file()
        self.url = address.url(self._socket, secure=tls is not None)

    def run(self) -> None:
        """Answer until SIGTERM, SIGINT or `stop`; then finish the requests that have begun."""
        _log_no_clients()
        self._server.run([self._socket])

    async def serve(self) -> None:
        """As `run`, in a loop that does other things, too."""
        _log_no_clients()
        await self._server.serve([self._socket])

    def stop(self) -> None:
        """Tell `run` to finish; from any thread."""
        self._server.should_exit = True

    def close(self) -> None:
        """Listen no more."""
        self._socket.close()
        self._address.release(self._file)


def _log_no_clients() -> None:
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)  # mistakes of clients are answered, not logged
