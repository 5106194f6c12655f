"""Accepts connections and shakes hands by TLS, within the server's bounds.

Where an event loop does both, a connection counts only after its handshake: clients that begin one and fall silent are
bounded neither in number nor in time.
"""

import asyncio
import socket
import ssl
from collections.abc import Callable, Sized

from isocharge.serve.network.limits import ServerLimits

PAUSE_SECONDS = 0.1
"""Time after which connections are accepted again when the system had no descriptor left, s."""

ACCEPTED_AT_ONCE = 64
"""Connections that are accepted before it is others' turn."""


class TlsListener:
    """Accepts from a listening socket; has the methods of asyncio's servers that uvicorn uses."""

    def __init__(
        self,
        listening: socket.socket,
        context: ssl.SSLContext,
        limits: ServerLimits,
        make_protocol: Callable[[], asyncio.Protocol],
        connections: Sized,
    ) -> None:
        """Start to accept; called in a running loop.

        Args:
            listening: The socket.
            context: Certificate and key.
            limits: Of connections, those in their handshake included, and of its time, which is that of headers.
            make_protocol: Makes the protocol of a connection.
            connections: Those whose handshake is done.
        """
        self._socket, self._context, self._limits = listening, context, limits
        self._make_protocol, self._connections = make_protocol, connections
        self._loop = asyncio.get_running_loop()
        self._handshakes: set[asyncio.Task[None]] = set()
        self._is_closed = False
        listening.setblocking(False)
        self._listen()

    def close(self) -> None:
        """Accept no more, and end the handshakes that have begun."""
        self._is_closed = True
        self._loop.remove_reader(self._socket.fileno())
        for handshake in self._handshakes:
            handshake.cancel()

    async def wait_closed(self) -> None:
        """Wait until no handshake is left."""
        await asyncio.gather(*self._handshakes, return_exceptions=True)

    def _listen(self) -> None:
        if not self._is_closed:
            self._loop.add_reader(self._socket.fileno(), self._accept)

    def _accept(self) -> None:
        for _ in range(ACCEPTED_AT_ONCE):
            try:
                connection, _ = self._socket.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError:  # no descriptor is left: to try again at once would take all of a core
                self._loop.remove_reader(self._socket.fileno())
                self._loop.call_later(PAUSE_SECONDS, self._listen)
                return
            self._begin(connection)

    def _begin(self, connection: socket.socket) -> None:
        if len(self._connections) + len(self._handshakes) >= self._limits.connections:
            connection.close()  # a reason could only be sent after a handshake
            return
        connection.setblocking(False)
        handshake = self._loop.create_task(self._shake_hands(connection))
        self._handshakes.add(handshake)
        handshake.add_done_callback(self._handshakes.discard)

    async def _shake_hands(self, connection: socket.socket) -> None:
        try:
            await self._loop.connect_accepted_socket(
                self._make_protocol,
                connection,
                ssl=self._context,
                ssl_handshake_timeout=self._limits.header_seconds,
            )
        except OSError:  # ssl.SSLError and TimeoutError are, too: the client did not want to
            connection.close()
