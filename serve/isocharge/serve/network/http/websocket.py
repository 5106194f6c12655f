"""A WebSocket within the server's bounds: one of its connections, which no silence ends but that of a client that died.

uvicorn asks each client for a sign of life every 20 s, and closes the connection if there is none in 20 s more.
"""

import asyncio
import math
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from isocharge.serve.network.limits import ServerLimits


class BoundedWebSocket(WebSocketsSansIOProtocol):
    """One WebSocket; has what the server asks of its connections."""

    limits = ServerLimits()
    has_asked = True  # its request was complete: it need not make room

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.deadline = math.inf  # the loop's time, s

    def pause_writing(self) -> None:
        """The client does not read; it has `body_seconds` to go on."""
        self.deadline = self.loop.time() + self.limits.body_seconds
        super().pause_writing()

    def resume_writing(self) -> None:
        """The client has read what was waiting."""
        self.deadline = math.inf
        super().resume_writing()

    def overdue(self) -> None:
        """End the connection."""
        self.transport.abort()


def bounded_websocket(limits: ServerLimits) -> type[asyncio.Protocol]:
    """The protocol with these limits."""
    return type("BoundedWebSocket", (BoundedWebSocket,), {"limits": limits})
