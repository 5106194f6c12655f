"""Metrics and log of the HTTP server and of the gRPC server.

The objects of the package `prometheus_client` are the only counters. A request updates them in a few microseconds.
Prometheus and the statistics of Triton's protocol read the same counters.

The log line of a request contains no text that a client has sent. The names of routes and statuses are defined by this
server, and the address of the client comes from the operating system. A client therefore cannot forge a log line, fill
the disk with long lines, or create new counters.
"""

import json
import logging
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import cache
from typing import Any, NamedTuple

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, Info, Metric, ProcessCollector

from isocharge.common.errors import package_version


class Statistics(NamedTuple):
    """Metrics of the inferences since the start of the server, for one version of a model or for all versions.

    Attributes:
        presses: Number of presses that were answered.
        alarms: Number of presses whose misfit is above the limit.
        refused: Number of requests for an inference that were refused.
        latency: Durations of all requests for an inference, s.
    """

    presses: Counter
    alarms: Counter
    refused: Counter
    latency: Histogram

    @classmethod
    def of_all_versions(cls) -> "Statistics":
        """Create the metrics of all versions, which have no values before `of` is called."""
        labels = ("model", "version")
        return cls(
            Counter("isocharge_presses", "Presses that were answered.", labels, registry=None),
            Counter("isocharge_misfit_alarms", "Presses with the flag misfit.", labels, registry=None),
            Counter(
                "isocharge_inferences_refused", "Requests for an inference that were refused.", labels, registry=None
            ),
            Histogram(
                "isocharge_inference_seconds",
                "Time to read, compute and write an inference, without the network.",
                labels,
                registry=None,
                # Upper bounds, s: from half the latency of a single press to three times that of the largest batch.
                buckets=(1e-5, 2e-5, 3e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 2e-2),
            ),
        )

    def of(self, name: str, version: int) -> "Statistics":
        """Return the metrics of a version. The metrics keep their values if the version has been loaded before."""
        return Statistics._make(metric.labels(name, version) for metric in self)

    def collect(self) -> Iterator[Metric]:
        """Yield the present values for Prometheus."""
        for metric in self:
            yield from metric.collect()

    def to_json(self) -> dict[str, Any]:
        """Return the counters of a version of a model as a JSON object with the names that Triton uses.

        An execution is an answered request, which may contain many presses.
        """
        values = {sample.name: sample.value for metric in self.collect() for sample in metric.samples}
        refused = int(values["isocharge_inferences_refused_total"])
        answered = int(values["isocharge_inference_seconds_count"]) - refused
        nanoseconds = round(1e9 * values["isocharge_inference_seconds_sum"])
        return {
            "inference_count": int(values["isocharge_presses_total"]),
            "execution_count": answered,
            "inference_stats": {
                "success": {"count": answered, "ns": nanoseconds},  # includes the time of refused requests
                "fail": {"count": refused},
            },
        }


Client = tuple[str, int] | None
"""Address and port of a client. None if the client has connected through a Unix socket."""


class RequestLog(logging.Handler):
    """Log that contains one line of JSON for each request and for each message of the module `logging`.

    Args:
        write: Function that writes a line, which is given without a line feed. The function is called by several
            threads and must not wait.
    """

    def __init__(self, write: Callable[[str], object]) -> None:
        """Create a handler of the module `logging` that writes lines with the given function."""
        super().__init__()
        self._write = write
        self.setFormatter(logging.Formatter())  # otherwise, `basicConfig` sets a format that repeats level and logger

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line with a message of the module `logging`. The line also contains the traceback, if any."""
        message = self.format(record)
        self.write_line(level=record.levelname.lower(), event="message", logger=record.name, message=message)

    def write_line(self, **properties: Any) -> None:
        """Write a line about an event, which begins with the present time."""
        self._write(json.dumps({"time": datetime.now(UTC).isoformat(), **properties}))


class Traffic:
    """Counters of requests, which all servers of one process share. Any thread may call any method.

    Attributes:
        log: Log to which each request is written, or None if there is no log.
        registry: Registry of the metrics of the requests, of the process, and of the models of a `Handler`.
        open: Number of open connections or calls, with the label "http" or "grpc".
        lost_lines: Number of log lines that could not be written.
    """

    def __init__(self, log: RequestLog | None = None) -> None:
        """Create a registry with the metrics of a server that has not received any request.

        Each metric adds itself to the registry, which is passed to the metric.

        Args:
            log: Log to which each request is written, or None if there is no log.
        """
        self.log = log
        registry = CollectorRegistry()
        self.registry = registry
        ProcessCollector(registry=registry)  # memory and processor time of the process
        Info("isocharge", "Version of the server.", registry=registry).info({"version": package_version()})

        requests = Counter(
            "isocharge_requests",
            "Requests that were answered or refused.",
            ("transport", "route", "status"),
            registry=registry,
        )
        # The method `labels` returns the counter for given values of the labels, and takes some time. Its results are
        # stored. Clients cannot choose the values of the labels, so only a few counters are stored.
        self._requests = cache(requests.labels)
        self.open = Gauge(
            "isocharge_open", "Open connections of HTTP and open calls of gRPC.", ("transport",), registry=registry
        )
        self.lost_lines = Gauge(
            "isocharge_log_lines_lost", "Lines of the log that could not be written.", registry=registry
        )

    def count(self, transport: str, route: str, status: int | str, client: Client | str, start_ns: int) -> None:
        """Count a request that has been answered or refused, and log it if there is a log.

        Args:
            transport: Transport of the request, which is "http" or "grpc".
            route: Name of the route, or "none" if the request could not be read.
            status: HTTP status, or name of the gRPC status.
            client: Address and port of the client, or a text that contains both.
            start_ns: Time at which the request began, ns, on the clock of `time.perf_counter_ns`.
        """
        self._requests(transport, route, status).inc()
        if self.log is not None:
            self.log.write_line(
                level="error" if status in (500, "INTERNAL") else "info",  # errors of the server itself
                event="request",
                transport=transport,
                route=route,
                status=status,
                duration_us=(time.perf_counter_ns() - start_ns) / 1000,
                client="%s:%d" % client if isinstance(client, tuple) else client,  # noqa: UP031 - fast
            )
