"""The bounds of a server on requests, connections and time."""

from dataclasses import dataclass

from isocharge.common.defaults import MAX_BATCH
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
    """

    batch: int = MAX_BATCH
    body_bytes: int = 1 << 20
    header_bytes: int = 1 << 14
    header_seconds: float = 10.0
    body_seconds: float = 30.0
    idle_seconds: float = 75.0
    connections: int = 1024

    def check_body(self, size: int) -> None:
        """Check the size of a body, or of as much of it as has arrived.

        Raises:
            TooLarge: If it is above `body_bytes`.
        """
        if size > self.body_bytes:
            raise TooLarge(f"expected a body of at most {self.body_bytes} bytes, got more; send smaller batches")
