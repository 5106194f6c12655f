"""TLS handshakes within the server's bounds: a connection counts from its first byte, and has little time.

uvicorn would have its event loop shake hands, and know a connection only afterwards: clients that begin a handshake and
fall silent would be bounded neither in number nor in time.
"""

import asyncio
import ssl
from typing import Any

from isocharge.serve.network.http.connection import BoundedProtocol


class HandshakeProtocol(asyncio.Protocol):
    """A connection whose TLS handshake is not done; subclasses carry the context and the protocol that comes then."""

    context: ssl.SSLContext
    inner: type[BoundedProtocol]

    def __init__(self, **uvicorn: Any) -> None:
        """Take what uvicorn gives to each protocol; the inner one gets it too."""
        self._uvicorn, self._connections = uvicorn, uvicorn["server_state"].connections
        self._loop = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self._early = bytearray()
        self.deadline = self._loop.time() + self.inner.limits.header_seconds

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin the handshake, unless there are too many connections."""
        self._transport = transport
        if len(self._connections) >= self.inner.limits.connections:
            transport.abort()
            return
        self._connections.add(self)
        transport.pause_reading()  # until TLS listens
        self._task = self._loop.create_task(self._shake_hands())

    def data_received(self, data: bytes) -> None:
        """A request that came with the end of the handshake waits for the inner protocol."""
        self._early += data

    async def _shake_hands(self) -> None:
        try:
            transport = await self._loop.start_tls(self._transport, self, self.context, server_side=True)
        except (OSError, RuntimeError):  # ssl.SSLError is an OSError; RuntimeError: the client is already gone
            self._transport.abort()
            return
        finally:
            self._connections.discard(self)
        if transport is None or transport.is_closing():
            return
        protocol = self.inner(**self._uvicorn)
        transport.set_protocol(protocol)
        protocol.connection_made(transport)
        if self._early:
            protocol.data_received(bytes(self._early))

    def shutdown(self) -> None:
        """The server stops: nobody has asked anything here."""
        self.overdue()

    def overdue(self) -> None:
        """End a handshake that took too long."""
        self._connections.discard(self)  # its place is free at once
        if self._task is not None:
            self._task.cancel()
        self._transport.abort()


def behind_tls(inner: type[BoundedProtocol], context: ssl.SSLContext) -> type[HandshakeProtocol]:
    """The protocol that shakes hands and then becomes the inner one."""
    return type("HandshakeProtocol", (HandshakeProtocol,), {"inner": inner, "context": context})
