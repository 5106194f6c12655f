"""Counters and log of the HTTP server and of the gRPC server.

The class `Traffic` counts requests by route and status. The class `Statistics` counts the requests to one version of a
model, their duration, and the presses with a large misfit. Clients can read the counts of both classes in the
statistics of Triton's protocol and under the path `/metrics`. The class `RequestLog` writes one line of JSON for each
request.

The log line of a request contains no text that a client has sent. The names of routes, models, statuses and errors are
defined by this server, and the address of the client comes from the operating system. A client therefore cannot forge a
log line, fill the disk with long lines, write a secret into the log, or create new counters.
"""

import logging
import threading
import time
import traceback
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import orjson

MAX_TEXT_CHARACTERS = 4000
"""Largest number of characters of a message or a traceback in a line. The middle of a longer text is left out."""

Client = tuple[str, int] | None
"""Address and port of a client. None if the client has connected through a Unix socket."""


class Exchange(NamedTuple):
    """Properties of a request and of its response, for the counters and the log.

    Attributes:
        transport: Transport of the request, which is "http" or "grpc".
        route: Name of the route, or "none" if the request could not be read.
        status: HTTP status, or name of the gRPC status.
        model: Label `name/version` of the requested model, or None if no loaded model was requested.
        error: Name of the type of the error, or None if no error occurred.
        ns: Time from the complete request to the complete response, ns; 0 if the time is unknown.
        bytes_in: Size of the body of the request, bytes.
        bytes_out: Size of the body of the response, bytes.
        client: Address and port of the client, or a text that contains both.
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
    """Log that contains one line of JSON for each request and for each message of the module `logging`.

    Args:
        write: Function that writes a line, which is given without a line feed. The function is called by several
            threads and must not wait.
        secret: Secret text, such as a token, that is replaced by `[secret]` in all messages.
    """

    def __init__(self, write: Callable[[str], object], *, secret: str | None = None) -> None:
        super().__init__()
        self._write = write
        self._secret = secret

    def write_exchange(self, exchange: Exchange) -> None:
        """Write a line about a request and its response."""
        is_internal_error = exchange.status in (500, "INTERNAL")  # the status of HTTP, and that of gRPC
        client = exchange.client
        line = {
            "time": datetime.now(UTC),
            "level": "error" if is_internal_error else "info",
            "event": "request",
            "transport": exchange.transport,
            "route": exchange.route,
            "status": exchange.status,
            "model": exchange.model,
            "error": exchange.error,
            "duration_us": exchange.ns / 1000,
            "bytes_in": exchange.bytes_in,
            "bytes_out": exchange.bytes_out,
            "client": "%s:%d" % client if isinstance(client, tuple) else client,  # noqa: UP031 - twice as fast
        }
        self._write(orjson.dumps(line).decode())

    def write_message(self, level: str, event: str, message: str) -> None:
        """Write a line about the server itself, for example when the server starts."""
        self._write_line(level, event=event, message=self._clean(message))

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line with a message of the module `logging`, and with the traceback of the message if it has one."""
        fields = {"event": "message", "logger": record.name, "message": self._clean(record.getMessage())}
        if record.exc_info and record.exc_info[0] is not None:
            fields["traceback"] = self._clean("".join(traceback.format_exception(*record.exc_info)))
        self._write_line(record.levelname.lower(), **fields)

    def _write_line(self, level: str, **fields: str) -> None:
        self._write(orjson.dumps({"time": datetime.now(UTC), "level": level} | fields).decode())

    def _clean(self, text: str) -> str:
        """Replace characters that the log must not contain, and shorten a long text.

        Characters that UTF-8 cannot encode are replaced by "?", and the secret is replaced by "[secret]". If the
        resulting text is longer than `MAX_TEXT_CHARACTERS` characters, its middle is replaced by " [...] ".
        """
        cleaned = text.encode("utf-8", "replace").decode()  # lone surrogates become "?"
        if self._secret:
            cleaned = cleaned.replace(self._secret, "[secret]")
        if len(cleaned) <= MAX_TEXT_CHARACTERS:
            return cleaned
        half = MAX_TEXT_CHARACTERS // 2
        return f"{cleaned[:half]} [...] {cleaned[-half:]}"


class Traffic:
    """Counters of requests, which all servers of one process share. Any thread may call any method.

    Attributes:
        log: Log to which each request is written, or None if there is no log.
        open: For each transport ("http" or "grpc"), a function that returns the number of its open connections or
            calls.
        lost_lines: Function that returns the number of log lines that could not be written, or None if there is no log.
    """

    def __init__(self, log: RequestLog | None = None) -> None:
        self.log = log
        self.open: dict[str, Callable[[], int]] = {}
        self.lost_lines: Callable[[], int] | None = None
        self._requests: dict[tuple[str, str, int | str], int] = {}
        self._lock = threading.Lock()

    def count(self, transport: str, route: str, status: int | str) -> None:
        """Count a request that was answered, possibly with an error.

        Args:
            transport: Transport of the request, which is "http" or "grpc".
            route: Name of the route.
            status: HTTP status, or name of the gRPC status.
        """
        key = transport, route, status
        with self._lock:
            self._requests[key] = self._requests.get(key, 0) + 1

    def count_and_log(self, exchange: Exchange) -> None:
        """Count a request that was answered, and log the request if there is a log."""
        self.count(exchange.transport, exchange.route, exchange.status)
        if self.log is not None:
            self.log.write_exchange(exchange)

    def requests(self) -> dict[tuple[str, str, str], int]:
        """Return the number of requests by transport, route and status."""
        with self._lock:
            counts = dict(self._requests)
        return {(transport, route, str(status)): count for (transport, route, status), count in counts.items()}


STAGES = ("compute_input", "compute_infer", "compute_output")
"""Triton's names of the three stages of an inference.

In these stages, the server reads the request, runs the model, and writes the response.
"""

LATENCY_BOUNDS_NS = (
    10_000,
    20_000,
    30_000,
    50_000,
    100_000,
    200_000,
    500_000,
    1_000_000,
    2_000_000,
    5_000_000,
    20_000_000,
)
"""Upper bounds of the buckets of the latency histogram, ns.

They range from half the latency of a single press to three times the latency of the largest batch.
"""


@dataclass
class Statistics:
    """Counters of one version of a model since the start of the server. Any thread may call any method.

    Attributes:
        presses: Number of presses for which contacts were returned.
        alarms: Number of these presses whose misfit is above the limit of the model.
        answered: Number of requests that were answered.
        refused: Number of requests that were refused.
        latency: Number of answered requests in each bucket of the latency histogram. The last bucket has no upper
            bound.
        stages_ns: Total time of the answered requests in each of `STAGES`, ns.
        refused_ns: Total time of the refused requests, ns.
        last_ms: Unix time of the last response, ms.
    """

    presses: int = 0
    alarms: int = 0
    answered: int = 0
    refused: int = 0
    latency: list[int] = field(default_factory=lambda: [0] * (len(LATENCY_BOUNDS_NS) + 1))
    stages_ns: list[int] = field(default_factory=lambda: [0] * len(STAGES))
    refused_ns: int = 0
    last_ms: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock, compare=False)

    def count_answered(self, presses: int, stages_ns: tuple[int, int, int], alarms: int = 0) -> None:
        """Count a request that was answered.

        Args:
            presses: Number of presses in the request.
            stages_ns: Time that the request has spent in each of `STAGES`, ns.
            alarms: Number of presses whose misfit is above the limit.
        """
        read_ns, run_ns, write_ns = stages_ns
        # The request belongs to the first bucket whose upper bound is at least as large as the total time.
        bucket = bisect_left(LATENCY_BOUNDS_NS, read_ns + run_ns + write_ns)
        with self._lock:
            self.presses += presses
            self.alarms += alarms
            self.answered += 1
            self.latency[bucket] += 1
            # A loop over the three stages would take half a microsecond more.
            self.stages_ns[0] += read_ns
            self.stages_ns[1] += run_ns
            self.stages_ns[2] += write_ns
            self.last_ms = time.time_ns() // 1_000_000

    def count_refused(self, ns: int) -> None:
        """Count a request that was refused.

        Args:
            ns: Time from the complete request to the refusal, ns.
        """
        with self._lock:
            self.refused += 1
            self.refused_ns += ns

    def snapshot(self) -> "Statistics":
        """Return a copy of all counters. No other thread can change a counter while the counters are copied."""
        with self._lock:
            return replace(self, latency=[*self.latency], stages_ns=[*self.stages_ns], _lock=threading.Lock())

    def to_json(self) -> dict[str, Any]:
        """Return the counters as a JSON object with the names that Triton uses in its statistics."""
        counters = self.snapshot()
        durations_ns = dict(zip(STAGES, counters.stages_ns, strict=True))
        durations_ns["queue"] = 0  # no request waits in a queue
        durations_ns["success"] = sum(counters.stages_ns)
        inference_stats = {name: {"count": counters.answered, "ns": ns} for name, ns in durations_ns.items()}
        inference_stats["fail"] = {"count": counters.refused, "ns": counters.refused_ns}
        return {
            "last_inference": counters.last_ms,
            "inference_count": counters.presses,
            "execution_count": counters.answered,
            "inference_stats": inference_stats,
            "batch_stats": [],
        }
