"""What passes through the servers: requests by route and status, what is open, counters of each model, the log.

The log is lines of JSON. `Statistics` counts the requests to a model, their time and its misfit alarms, for Triton's
statistics and for `/metrics`.

Of what a client sends, only its address is written: routes, models, statuses and kinds of errors are words of this
server. So no client can forge a line, fill the disk with a long one, put a secret into it, or invent counters. JSON
has no line feed inside a line.
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

    def __init__(self, write: Callable[[str], object], *, secret: str | None = None) -> None:
        """Set up the log.

        Args:
            write: Takes a line, without a line feed; called from any thread, and must not wait.
            secret: What no message may say; `[secret]` stands in its place.
        """
        super().__init__()
        self._write, self._secret = write, secret

    def exchange(self, exchange: Exchange) -> None:
        """Write the line of a request."""
        transport, route, status, model, error, ns, bytes_in, bytes_out, client = exchange
        line = {
            "time": datetime.now(UTC),
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
        self._write(orjson.dumps({"time": datetime.now(UTC), "level": level} | fields).decode())

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


STAGES = ("compute_input", "compute_infer", "compute_output")
"""Triton's names for reading the request, running the model, writing the answer."""

LATENCY_NS = (10_000, 20_000, 30_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000, 5_000_000, 20_000_000)
"""Upper bounds of the latency histogram: from half the time of one press to three times that of the largest batch."""


@dataclass
class Statistics:
    """Counters of one version of a model, from the start of the server; any thread may add to them.

    Attributes:
        presses: Rows that were answered.
        unchecked: Those of them whose misfit was not computed.
        alarms: Those of them whose misfit is above the limit of the model.
        answered, refused: Numbers of requests.
        latency: Answered requests by their time, those beyond the last of LATENCY_NS at the end.
        stages_ns: Time spent on the answered ones in each of STAGES.
        refused_ns: Time spent on the others.
        last_ms: Time of the last answer, unix time, ms.
    """

    presses: int = 0
    unchecked: int = 0
    alarms: int = 0
    answered: int = 0
    refused: int = 0
    latency: list[int] = field(default_factory=lambda: [0] * (len(LATENCY_NS) + 1))
    stages_ns: list[int] = field(default_factory=lambda: [0] * len(STAGES))
    refused_ns: int = 0
    last_ms: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock, compare=False)

    def succeeded(self, presses: int, stages_ns: tuple[int, int, int], unchecked: int = 0, alarms: int = 0) -> None:
        """Count an answered request.

        Args:
            presses: Rows of it.
            stages_ns: Its time in each of STAGES.
            unchecked: Rows whose misfit was not computed.
            alarms: Rows whose misfit is above the limit.
        """
        (read, ran, written), spent = stages_ns, self.stages_ns  # one by one: half a microsecond less than a loop
        with self._lock:
            self.presses += presses
            self.unchecked += unchecked
            self.alarms += alarms
            self.answered += 1
            self.latency[bisect_left(LATENCY_NS, read + ran + written)] += 1
            spent[0] += read
            spent[1] += ran
            spent[2] += written
            self.last_ms = time.time_ns() // 1_000_000

    def failed(self, ns: int) -> None:
        """Count a refused request and the time that it took."""
        with self._lock:
            self.refused += 1
            self.refused_ns += ns

    @property
    def checked(self) -> int:
        """Presses whose misfit was computed."""
        return self.presses - self.unchecked

    def snapshot(self) -> "Statistics":
        """A copy, all of whose counters belong to the same moment."""
        with self._lock:
            return replace(self, latency=[*self.latency], stages_ns=[*self.stages_ns], _lock=threading.Lock())

    def to_json(self) -> dict[str, Any]:
        """The counters under Triton's names; no request waits in a queue."""
        now = self.snapshot()
        spent = dict(zip(STAGES, now.stages_ns, strict=True)) | {"queue": 0, "success": sum(now.stages_ns)}
        durations = {name: {"count": now.answered, "ns": ns} for name, ns in spent.items()}
        return {
            "last_inference": now.last_ms,
            "inference_count": now.presses,
            "execution_count": now.answered,
            "inference_stats": {**durations, "fail": {"count": now.refused, "ns": now.refused_ns}},
            "batch_stats": [],
        }
