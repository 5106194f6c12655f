"""Counters and log of the servers.

`Traffic` counts requests by route and status, and open connections. `Statistics` counts the requests to a model, their
time and its misfit alarms, for Triton's statistics and for `/metrics`. `RequestLog` writes one line of JSON for each
request.

A line of the log contains no text that a client has sent. Routes, models, statuses and types of errors are names of
this server, and the address of the client comes from the operating system. A client therefore cannot forge a line, fill
the disk with long lines, write a secret into the log, or create counters.
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
"""Largest number of characters of a message or traceback in a line. Of longer texts, the middle is left out."""

Client = tuple[str, int] | None
"""Address and port of a client; None on a Unix socket."""


class Exchange(NamedTuple):
    """One request and its response.

    Attributes:
        transport: "http" or "grpc".
        route: Name of the route; "none" if the request could not be read.
        status: HTTP status, or name of the gRPC status.
        model: Label `name/version` of the requested model; None if the request names no model.
        error: Type of the error; None if there was no error.
        ns: Time from the complete request to the complete response, ns; 0 if unknown.
        bytes_in: Size of the body of the request, bytes.
        bytes_out: Size of the body of the response, bytes.
        client: Address of the client.
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
    """Log in JSON, with one line for each request and one line for each message of the module `logging`.

    Args:
        write: Function that takes a line without a line feed. It is called from any thread and must not block.
        secret: Text that is replaced by `[secret]` in all messages.
    """

    def __init__(self, write: Callable[[str], object], *, secret: str | None = None) -> None:
        super().__init__()
        self._write = write
        self._secret = secret

    def exchange(self, exchange: Exchange) -> None:
        """Write a line about a request."""
        transport, route, status, model, error, ns, bytes_in, bytes_out, client = exchange
        is_internal_error = status in (500, "INTERNAL")
        line = {
            "time": datetime.now(UTC),
            "level": "error" if is_internal_error else "info",
            "event": "request",
            "transport": transport,
            "route": route,
            "status": status,
            "model": model,
            "error": error,
            "duration_us": ns / 1000,
            "bytes_in": bytes_in,
            "bytes_out": bytes_out,
            "client": "%s:%d" % client if isinstance(client, tuple) else client,  # noqa: UP031 - twice as fast
        }
        self._write(orjson.dumps(line).decode())

    def message(self, level: str, event: str, message: str) -> None:
        """Write a line about the server itself."""
        self._write_line(level, event=event, message=self._clean(message))

    def emit(self, record: logging.LogRecord) -> None:
        """Write a message of the module `logging`, and its traceback if there is one."""
        fields = {"event": "message", "logger": record.name, "message": self._clean(record.getMessage())}
        if record.exc_info and record.exc_info[0] is not None:
            fields["traceback"] = self._clean("".join(traceback.format_exception(*record.exc_info)))
        self._write_line(record.levelname.lower(), **fields)

    def _write_line(self, level: str, **fields: str) -> None:
        self._write(orjson.dumps({"time": datetime.now(UTC), "level": level} | fields).decode())

    def _clean(self, text: str) -> str:
        """Return a text as valid UTF-8 without the secret.

        If the text has more than `MAX_TEXT_CHARACTERS` characters, its middle is replaced by " [...] ".
        """
        cleaned = text.encode("utf-8", "replace").decode()  # lone surrogates cannot be encoded and become "?"
        if self._secret:
            cleaned = cleaned.replace(self._secret, "[secret]")
        if len(cleaned) <= MAX_TEXT_CHARACTERS:
            return cleaned
        half = MAX_TEXT_CHARACTERS // 2
        return f"{cleaned[:half]} [...] {cleaned[-half:]}"


class Traffic:
    """Counters of the servers of one process. All methods may be called from any thread.

    Attributes:
        log: Log to which each request is written; None if there is no log.
        open: Function for each transport that returns the number of its open connections or calls.
        lost_lines: Function that returns the number of log lines that could not be written; None if there is no log.
    """

    def __init__(self, log: RequestLog | None = None) -> None:
        self.log = log
        self.open: dict[str, Callable[[], int]] = {}
        self.lost_lines: Callable[[], int] | None = None
        self._requests: dict[tuple[str, str, int | str], int] = {}
        self._lock = threading.Lock()

    def count(self, transport: str, route: str, status: int | str) -> None:
        """Count a request that was answered. The answer may be an error."""
        key = transport, route, status
        with self._lock:
            self._requests[key] = self._requests.get(key, 0) + 1

    def note(self, exchange: Exchange) -> None:
        """Count a request that was answered, and write it to the log."""
        self.count(exchange.transport, exchange.route, exchange.status)
        if self.log is not None:
            self.log.exchange(exchange)

    def requests(self) -> dict[tuple[str, str, str], int]:
        """Return the numbers of requests by transport, route and status."""
        with self._lock:
            counts = dict(self._requests)
        return {(transport, route, str(status)): count for (transport, route, status), count in counts.items()}


STAGES = ("compute_input", "compute_infer", "compute_output")
"""Triton's names of the three stages of an inference: reading the request, running the model, writing the response."""

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
"""Upper bounds of the latency histogram, ns: from half the time of one press to three times that of a full batch."""


@dataclass
class Statistics:
    """Counters of one version of a model since the start of the server. All methods may be called from any thread.

    Attributes:
        presses: Number of presses that were answered.
        unchecked: Number of these presses whose misfit was not computed.
        alarms: Number of these presses whose misfit is above the limit of the model.
        answered: Number of requests that were answered.
        refused: Number of requests that were refused.
        latency: Number of answered requests in each bucket of the histogram. The last bucket has no upper bound.
        stages_ns: Total time of the answered requests in each of `STAGES`, ns.
        refused_ns: Total time of the refused requests, ns.
        last_ms: Time of the last response, Unix time, ms.
    """

    presses: int = 0
    unchecked: int = 0
    alarms: int = 0
    answered: int = 0
    refused: int = 0
    latency: list[int] = field(default_factory=lambda: [0] * (len(LATENCY_BOUNDS_NS) + 1))
    stages_ns: list[int] = field(default_factory=lambda: [0] * len(STAGES))
    refused_ns: int = 0
    last_ms: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock, compare=False)

    def succeeded(self, presses: int, stages_ns: tuple[int, int, int], unchecked: int = 0, alarms: int = 0) -> None:
        """Count a request that was answered.

        Args:
            presses: Number of its presses.
            stages_ns: Its time in each of `STAGES`, ns.
            unchecked: Number of presses whose misfit was not computed.
            alarms: Number of presses whose misfit is above the limit.
        """
        read_ns, run_ns, write_ns = stages_ns
        # Index of the first bucket of the latency histogram whose upper bound is not below the total time.
        bucket = bisect_left(LATENCY_BOUNDS_NS, read_ns + run_ns + write_ns)
        with self._lock:
            self.presses += presses
            self.unchecked += unchecked
            self.alarms += alarms
            self.answered += 1
            self.latency[bucket] += 1
            # Three statements take half a microsecond less than a loop.
            self.stages_ns[0] += read_ns
            self.stages_ns[1] += run_ns
            self.stages_ns[2] += write_ns
            self.last_ms = time.time_ns() // 1_000_000

    def failed(self, ns: int) -> None:
        """Count a request that was refused, and add the time that it took, ns."""
        with self._lock:
            self.refused += 1
            self.refused_ns += ns

    @property
    def checked(self) -> int:
        """Number of presses whose misfit was computed."""
        return self.presses - self.unchecked

    def snapshot(self) -> "Statistics":
        """Return a copy of all counters, which are read at the same moment."""
        with self._lock:
            return replace(self, latency=[*self.latency], stages_ns=[*self.stages_ns], _lock=threading.Lock())

    def to_json(self) -> dict[str, Any]:
        """Return the counters under the names of Triton's statistics."""
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
