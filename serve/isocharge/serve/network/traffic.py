"""What passes through the servers: requests by route and status, and what is open at the moment.

Routes and statuses are words of this server, never words of a client: however many paths clients invent, there are only
so many counters.
"""

import threading
from collections.abc import Callable
from typing import NamedTuple

from isocharge.serve.network.request_log import Exchange, RequestLog


class Kind(NamedTuple):
    """What requests are counted by.

    Attributes:
        transport: "http" or "grpc".
        route: Name of what was asked for; "none" for what could not be read.
        status: HTTP status, or name of the gRPC status.
    """

    transport: str
    route: str
    status: str


class Traffic:
    """Counters of the servers of one process; any thread may add to them.

    Attributes:
        log: Where each request is written; None for nowhere.
        open: For each transport, what gives the number of its open connections or calls.
        lost_lines: What gives the number of log lines that nobody took.
    """

    def __init__(self, log: RequestLog | None = None) -> None:
        """Nothing has passed yet."""
        self.log = log
        self.open: dict[str, Callable[[], int]] = {}
        self.lost_lines: Callable[[], int] | None = None
        self._requests: dict[tuple[str, str, int | str], int] = {}
        self._lock = threading.Lock()

    def count(self, transport: str, route: str, status: int | str) -> None:
        """Count an answered request, an error being an answer too; arguments as in `Kind`."""
        key = transport, route, status
        with self._lock:
            self._requests[key] = self._requests.get(key, 0) + 1

    def note(self, exchange: Exchange) -> None:
        """Count an answered request, and write it into the log."""
        self.count(exchange.transport, exchange.route, exchange.status)
        if self.log is not None:
            self.log.exchange(exchange)

    def requests(self) -> dict[Kind, int]:
        """Requests so far."""
        with self._lock:
            counts = dict(self._requests)
        return {Kind(transport, route, str(status)): count for (transport, route, status), count in counts.items()}
