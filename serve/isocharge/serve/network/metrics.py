"""Metrics and log of the HTTP server and of the gRPC server.

The objects of the package `prometheus_client` are the only counters. A request updates them in a few microseconds.
Prometheus reads the counters, and so do the statistics of Triton's protocol.

The log line of a request contains no text that a client has sent. The names of routes, models, statuses and errors are
defined by this server, and the address of the client comes from the operating system. A client therefore cannot forge a
log line, fill the disk with long lines, or create new counters.
"""

import json
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import onnxruntime as ort
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, ProcessCollector

from isocharge.common.errors import package_version

CONTENT_TYPE = b"text/plain; version=0.0.4; charset=utf-8"
"""Content type of the text format, which every version of Prometheus can read."""

LATENCY_BOUNDS_S = (1e-5, 2e-5, 3e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 2e-2)
"""Upper bounds of the buckets of the latency histogram, s.

They range from half the latency of a single press to three times the latency of the largest batch.
"""


class ModelMetrics:
    """Metrics of all models of one server, in a registry that also contains the metrics of the process.

    Attributes:
        registry: The registry.
    """

    def __init__(self) -> None:
        """Create the metrics, which have no values before `of` is called."""
        registry = self.registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        versions = Info("isocharge", "Versions of the server.", registry=registry)
        versions.info({"version": package_version(), "onnxruntime": ort.__version__})
        settings: dict[str, Any] = {"labelnames": ("model", "version"), "registry": registry}
        # Each name is a field of `Statistics`.
        self._metrics: dict[str, Any] = {
            "description": Info("isocharge_model", "Versions of the models.", **settings),
            "ready": Gauge("isocharge_model_ready", "Whether a version is loaded.", **settings),
            "presses": Counter("isocharge_presses", "Presses that were answered.", **settings),
            "alarms": Counter(
                "isocharge_misfit_alarms", "Presses whose misfit is above the limit of the model.", **settings
            ),
            "refused": Counter(
                "isocharge_inferences_refused", "Requests for an inference that were refused.", **settings
            ),
            "latency": Histogram(
                "isocharge_inference_seconds",
                "Time to read, compute and write an inference, without the network.",
                buckets=LATENCY_BOUNDS_S,
                **settings,
            ),
            "refused_time": Counter("isocharge_refused_seconds", "Time of refused requests.", **settings),
            "latest": Gauge("isocharge_inference_latest_seconds", "Unix time of the latest inference.", **settings),
        }

    def of(self, name: str, version: int) -> "Statistics":
        """Return the metrics of a version. The metrics keep their values if the version has been loaded before."""
        return Statistics(**{field: metric.labels(name, version) for field, metric in self._metrics.items()})

    def remove(self, name: str, version: int) -> None:
        """Remove the metrics of a version whose folder no longer exists. An alarm would otherwise never end."""
        for metric in self._metrics.values():
            metric.remove(name, version)


@dataclass(frozen=True)
class Statistics:
    """Metrics of one version of a model since the start of the server. Any thread may call any method.

    Attributes:
        description: Sensor and checksum of the version.
        ready: 1 if the version is loaded, otherwise 0.
        presses: Number of presses that were answered.
        alarms: Number of presses whose misfit is above the limit.
        refused: Number of requests for an inference that were refused.
        latency: Durations of the requests that were answered, s.
        refused_time: Total duration of the refused requests, s.
        latest: Unix time of the latest inference, s.
    """

    description: Info
    ready: Gauge
    presses: Counter
    alarms: Counter
    refused: Counter
    latency: Histogram
    refused_time: Counter
    latest: Gauge

    @contextmanager
    def measure(self) -> Iterator[None]:
        """Context manager that measures the time to read a request, to run the model and to write the response.

        The request is counted as answered or, if an error occurs, as refused.
        """
        start_s = time.perf_counter()
        try:
            yield
        except Exception:
            self.refused.inc()
            self.refused_time.inc(time.perf_counter() - start_s)
            raise
        self.latency.observe(time.perf_counter() - start_s)
        self.latest.set(time.time())

    def to_json(self) -> dict[str, Any]:
        """Return the counters as a JSON object with the names that Triton uses in its statistics."""
        values = {
            sample.name: sample.value
            for metric in vars(self).values()
            for family in metric.collect()
            for sample in family.samples
        }
        answered = int(values["isocharge_inference_seconds_count"])
        refused = int(values["isocharge_inferences_refused_total"])
        return {
            "last_inference": round(1e3 * values["isocharge_inference_latest_seconds"]),
            "inference_count": int(values["isocharge_presses_total"]),
            "execution_count": answered,
            "inference_stats": {
                "success": {"count": answered, "ns": round(1e9 * values["isocharge_inference_seconds_sum"])},
                "fail": {"count": refused, "ns": round(1e9 * values["isocharge_refused_seconds_total"])},
            },
            "batch_stats": [],
        }


Client = tuple[str, int] | None
"""Address and port of a client. None if the client has connected through a Unix socket."""


@dataclass
class Exchange:
    """Properties of a request and of its response, for the counters and the log.

    Attributes:
        transport: Transport of the request, which is "http" or "grpc".
        route: Name of the route, or "none" if the request could not be read.
        status: HTTP status, or name of the gRPC status.
        model: Label `name/version` of the requested model, or None if no loaded model was requested.
        error: Name of the type of the error, or None if no error occurred.
        duration_us: Time from the complete request to the complete response, us; 0 if the time is unknown.
        client: Address and port of the client, or a text that contains both.
    """

    transport: str
    route: str
    status: int | str
    model: str | None = None
    error: str | None = None
    duration_us: float = 0.0
    client: Client | str = None


class RequestLog(logging.Handler):
    """Log that contains one line of JSON for each request and for each message of the module `logging`.

    Args:
        write: Function that writes a line, which is given without a line feed. The function is called by several
            threads and must not wait.
    """

    def __init__(self, write: Callable[[str], object]) -> None:
        super().__init__()
        self._write = write
        self.setFormatter(logging.Formatter())  # otherwise, `basicConfig` sets a format that repeats level and logger

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line with a message of the module `logging`. The line also contains the traceback, if any."""
        properties = {"logger": record.name, "message": self.format(record)}
        self.write_line(record.levelname.lower(), "message", properties)

    def write_line(self, level: str, event: str, properties: dict[str, Any]) -> None:
        """Write a line about an event, which begins with the present time."""
        line = {"time": datetime.now(UTC).isoformat(), "level": level, "event": event, **properties}
        self._write(json.dumps(line))


class Traffic:
    """Counters of requests, which all servers of one process share. Any thread may call any method.

    Attributes:
        log: Log to which each request is written, or None if there is no log.
        registry: Registry of the metrics.
        open: Number of open connections or calls, with the label "http" or "grpc".
        lost_lines: Number of log lines that could not be written.
    """

    def __init__(self, log: RequestLog | None = None) -> None:
        """Create the metrics of a server that has not received any request."""
        self.log = log
        self.registry = CollectorRegistry()
        self._requests = Counter(
            "isocharge_requests",
            "Requests that were answered or refused.",
            ("transport", "route", "status"),
            registry=self.registry,
        )
        self.open = Gauge(
            "isocharge_open",
            "Open connections of HTTP and open calls of gRPC.",
            ("transport",),
            registry=self.registry,
        )
        self.lost_lines = Gauge(
            "isocharge_log_lines_lost", "Lines of the log that could not be written.", registry=self.registry
        )

    def count_and_log(self, exchange: Exchange) -> None:
        """Count a request that was answered, possibly with an error, and log the request if there is a log."""
        self._requests.labels(exchange.transport, exchange.route, exchange.status).inc()
        if self.log is not None:
            client = exchange.client
            client_text = "%s:%d" % client if isinstance(client, tuple) else client  # noqa: UP031 - twice as fast
            level = "error" if exchange.status in (500, "INTERNAL") else "info"  # internal errors of HTTP and of gRPC
            self.log.write_line(level, "request", vars(exchange) | {"client": client_text})
