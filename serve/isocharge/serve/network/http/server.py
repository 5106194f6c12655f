"""The HTTP server: where it listens, who may talk to it, and how it starts and stops."""

import asyncio
import logging

import uvicorn

from isocharge.serve.network.address import Address
from isocharge.serve.network.http.app import App
from isocharge.serve.network.http.connection import bounded, close_overdue
from isocharge.serve.network.http.handshake import behind_tls
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.tls import Tls

GRACE_SECONDS = 10
"""Time that requests which have begun get when the server stops, s."""

BACKLOG = 2048
"""Connections that may wait to be accepted."""


class _Uvicorn(uvicorn.Server):
    """uvicorn, looking after overdue connections while it waits."""

    async def on_tick(self, counter: int) -> bool:
        close_overdue(self.server_state.connections, asyncio.get_running_loop().time())
        return await super().on_tick(counter)


class HttpServer:
    """A server that listens from its construction until `close`, and answers while `run` runs."""

    def __init__(self, app: App, address: Address, *, limits: ServerLimits, tls: Tls | None = None) -> None:
        """Listen.

        Raises:
            InputError: If a TLS file cannot be used.
            ListenError: If the address is taken or impossible.
        """
        protocol = bounded(app, limits)
        config = uvicorn.Config(
            app,
            loop="uvloop",
            http=behind_tls(protocol, tls.context()) if tls else protocol,
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            date_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=GRACE_SECONDS,
        )
        self._server, self._address = _Uvicorn(config), address
        self._socket = address.listen(BACKLOG)
        self._file = address.file()
        self.url = address.url(self._socket, secure=tls is not None)

    def run(self) -> None:
        """Answer until SIGTERM, SIGINT or `stop`; then finish the requests that have begun."""
        logging.getLogger("uvicorn").setLevel(logging.CRITICAL)  # mistakes of clients are answered, not logged
        self._server.run([self._socket])

    def stop(self) -> None:
        """Tell `run` to finish; from any thread."""
        self._server.should_exit = True

    def close(self) -> None:
        """Listen no more."""
        self._socket.close()
        self._address.release(self._file)
