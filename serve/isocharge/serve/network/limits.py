"""How much a server takes from a client: the bounds on requests, connections and time."""

from dataclasses import dataclass

from isocharge.serve.model.triton_config import MAX_BATCH


@dataclass(frozen=True, kw_only=True)
class ServerLimits:
    """Bounds of one server; the defaults fit the largest batch of four electrodes as JSON with all digits.

    Attributes:
        batch: Presses in one request.
        body_bytes: Of a request, compressed or not.
        header_bytes: Request line and headers together.
        header_seconds: From the first byte of a request, or from connecting, to the end of its headers.
        body_seconds: From there to the end of the body; and again until the client has taken the answer.
        idle_seconds: Between requests.
        connections: Open at a time.
    """

    batch: int = MAX_BATCH
    body_bytes: int = 1 << 20
    header_bytes: int = 1 << 14
    header_seconds: float = 10.0
    body_seconds: float = 30.0
    idle_seconds: float = 75.0
    connections: int = 1024
