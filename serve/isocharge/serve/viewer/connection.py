"""WebSocket connection of a viewer of the live page, on uvicorn.

uvicorn limits the size of a message and sends pings. This module limits the rate at which a viewer may send data, and
disconnects a viewer that has not read its messages for too long.
"""

import math
import time
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from isocharge.serve.network.http.connection import TimedConnection

MAX_BURST_BYTES = 1 << 16
"""Largest amount of data that a client may send at once, bytes. No request of the page is larger."""

MAX_BYTES_PER_S = 1 << 14
"""Largest mean rate at which a client may send data, bytes/s. The page sends about 1 kB/s."""

SEND_TIMEOUT_S = 30.0
"""Longest time for which a viewer may read nothing, s."""


class RateLimit:
    """Limit on the amount of data that a client may send, implemented as a token bucket.

    Args:
        burst_bytes: Largest amount of data that the client may send at once, bytes.
        bytes_per_s: Largest mean rate at which the client may send data, bytes/s.
        now_s: Present time on a monotonic clock, s.
    """

    def __init__(self, burst_bytes: float, bytes_per_s: float, now_s: float) -> None:
        """Begin with the full allowance of `burst_bytes`. The docstring of the class describes the arguments."""
        self._burst_bytes = burst_bytes
        self._bytes_per_s = bytes_per_s
        self._available_bytes = burst_bytes
        self._latest_s = now_s

    def allows(self, received_bytes: int, now_s: float) -> bool:
        """Count received data, and return whether the client has stayed within the limit.

        The allowance of the client grows by `bytes_per_s` in each second, up to at most `burst_bytes`. Received data
        reduce the allowance. The client has exceeded the limit if the allowance becomes negative.

        Args:
            received_bytes: Size of the received data, bytes.
            now_s: Present time on the same monotonic clock, s.
        """
        elapsed_s = max(now_s - self._latest_s, 0.0)
        refilled_bytes = min(self._burst_bytes, self._available_bytes + elapsed_s * self._bytes_per_s)
        self._available_bytes = refilled_bytes - received_bytes
        self._latest_s = now_s
        return self._available_bytes >= 0.0


class ViewerConnection(WebSocketsSansIOProtocol, TimedConnection):
    """Connection of a viewer, which the server ends if the viewer sends too much data or reads nothing.

    All received data count, including control frames such as pings.
    """

    def __init__(self, **uvicorn_arguments: Any) -> None:
        """Create the limit on received data. uvicorn passes the arguments."""
        super().__init__(**uvicorn_arguments)
        self._rate_limit = RateLimit(MAX_BURST_BYTES, MAX_BYTES_PER_S, time.monotonic())
        self._write_deadline = math.inf

    def data_received(self, data: bytes) -> None:
        """Process received data, or end the connection if the client has sent too much data."""
        if self._rate_limit.allows(len(data), time.monotonic()):
            super().data_received(data)
        else:
            self.transport.abort()

    def pause_writing(self) -> None:
        """Pause reading, too, because the responses to further data would fill the memory."""
        super().pause_writing()
        self.transport.pause_reading()
        self._write_deadline = self.loop.time() + SEND_TIMEOUT_S

    def resume_writing(self) -> None:
        """Resume reading, because the viewer has read its messages."""
        super().resume_writing()
        self.transport.resume_reading()
        self._write_deadline = math.inf

    def close_if_overdue(self, now: float) -> None:
        """End the connection if the viewer has read nothing for too long."""
        if now > self._write_deadline:
            self.transport.abort()
