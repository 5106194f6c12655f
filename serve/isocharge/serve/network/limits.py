"""The bounds of a server on requests, connections and time; default numbers are in `isocharge.common.defaults`."""

from dataclasses import dataclass

from isocharge.common.defaults import BODY_BYTES, CONNECTIONS, HEADER_SECONDS, IDLE_SECONDS, MAX_BATCH
from isocharge.common.errors import TooLarge


@dataclass(frozen=True, kw_only=True)
class ServerLimits:
    """Bounds of one server; the defaults fit the largest batch of four electrodes as JSON with all digits.

    Attributes:
        batch: Presses in one request.
        body_bytes: Size of a request's body, compressed or not.
        header_bytes: Size of request line and headers together.
        header_seconds: Time from the first byte of a request, or from connecting, to the end of its headers.
        body_seconds: Time from there to the end of the body; and again until the client has taken the answer.
        idle_seconds: Time between requests.
        connections: Connections that are open at a time.
        message_bytes: Size of a client's message over a WebSocket.
    """

    batch: int = MAX_BATCH
    body_bytes: int = BODY_BYTES
    header_bytes: int = 1 << 14
    header_seconds: float = HEADER_SECONDS
    body_seconds: float = 30.0
    idle_seconds: float = IDLE_SECONDS
    connections: int = CONNECTIONS
    message_bytes: int = 1 << 12

    def check_body(self, size: int) -> None:
        """Check the size of a body, or of as much of it as has arrived.

        Raises:
            TooLarge: If it is above `body_bytes`.
        """
        if size > self.body_bytes:
            raise TooLarge(f"expected a body of at most {self.body_bytes} bytes, got more; send smaller batches")
