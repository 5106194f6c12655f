"""What passes through the servers: requests by route and status, what is open, and the log as lines of JSON.

Of what a client sends, only its address is written: routes, models, statuses and kinds of errors are words of this
server. So no client can forge a line, fill the disk with a long one, put a secret into it, or invent counters. JSON
has no line feed inside a line.
"""

import logging
import threading
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from typing import NamedTuple

import orjson

LONGEST_TEXT = 4000
"""Characters of a message or traceback that a line has; of longer ones the beginning and the end."""

Client = tuple[str, int] | None
"""Address and port of a client; None on a Unix socket."""


class Exchange(NamedTuple):
    """One request and its answer.

    Attributes:
        transport: "http" or "grpc".
        route: Name of what was asked for; "none" for what could not be read.
        status: HTTP status, or name of the gRPC status.
        model: `name/version` of the model that was asked, None if there is none.
        error: Kind of the error, None without.
        ns: Time from the complete request to the complete answer, ns; 0 if it is not known.
        bytes_in, bytes_out: Sizes of the bodies.
        client: Who asked.
    """

    transport: str
    route: str
    status: int | str
    model: str | None
    error: str | None
    ns: int
    bytes_in: int
    bytes_out: int
    client: Client | str = None


class RequestLog(logging.Handler):
    """Writes lines of JSON; as a handler, the messages of Python's loggers too."""

    def __init__(
        self, write: Callable[[str], object], *, secret: str = "", now: Callable[[], datetime] | None = None
    ) -> None:
        """Set up the log.

        Args:
            write: Takes a line, without a line feed; called from any thread, and must not wait.
            secret: What no message may say; `[secret]` stands in its place.
            now: The clock.
        """
        super().__init__()
        self._write, self._secret = write, secret
        self._now = now or partial(datetime.now, UTC)

    def exchange(self, exchange: Exchange) -> None:
        """Write the line of a request."""
        transport, route, status, model, error, ns, bytes_in, bytes_out, client = exchange
        line = {
            "time": self._now(),
            "level": "error" if status in (500, "INTERNAL") else "info",
            "event": "request",
            "transport": transport,
            "route": route,
            "status": status,
            "model": model,
            "error": error,
            "duration_us": ns / 1000,
            "bytes_in": bytes_in,
            "bytes_out": bytes_out,
            "client": "%s:%d" % client if isinstance(client, tuple) else client,  # noqa: UP031 - half the time
        }
        self._write(orjson.dumps(line).decode())

    def message(self, level: str, event: str, message: str) -> None:
        """Write a line about the server itself."""
        self._line(level, event=event, message=self._cut(message))

    def emit(self, record: logging.LogRecord) -> None:
        """Write the message of a logger, its traceback too."""
        fields = {"event": "message", "logger": record.name, "message": self._cut(record.getMessage())}
        if record.exc_info and record.exc_info[0] is not None:
            fields["traceback"] = self._cut("".join(traceback.format_exception(*record.exc_info)))
        self._line(record.levelname.lower(), **fields)

    def _line(self, level: str, **fields: str) -> None:
        self._write(orjson.dumps({"time": self._now(), "level": level} | fields).decode())

    def _cut(self, text: str) -> str:
        text = text.encode("utf-8", "replace").decode()
        if self._secret:
            text = text.replace(self._secret, "[secret]")
        half = LONGEST_TEXT // 2
        return text if len(text) <= LONGEST_TEXT else f"{text[:half]} [...] {text[-half:]}"


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
        """Count an answered request, an error being an answer too."""
        key = transport, route, status
        with self._lock:
            self._requests[key] = self._requests.get(key, 0) + 1

    def note(self, exchange: Exchange) -> None:
        """Count an answered request, and write it into the log."""
        self.count(exchange.transport, exchange.route, exchange.status)
        if self.log is not None:
            self.log.exchange(exchange)

    def requests(self) -> dict[tuple[str, str, str], int]:
        """Requests so far, by transport, route and status."""
        with self._lock:
            counts = dict(self._requests)
        return {(transport, route, str(status)): count for (transport, route, status), count in counts.items()}
