"""Counters and log of the HTTP server and of the gRPC server.

The class `Traffic` counts requests by route and status, for the path `/metrics`. The class `RequestLog` writes one line
of JSON for each request.

The log line of a request contains no text that a client has sent. The names of routes, models, statuses and errors are
defined by this server, and the address of the client comes from the operating system. A client therefore cannot forge a
log line, fill the disk with long lines, or create new counters.
"""

import json
import logging
import traceback
from collections.abc import Callable
from datetime import UTC, datetime
from typing import NamedTuple

import orjson
from prometheus_client import CollectorRegistry, Counter, Gauge

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
    """

    def __init__(self, write: Callable[[str], object]) -> None:
        super().__init__()
        self._write = write

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
        self._write_line(level, event=event, message=message)

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line with a message of the module `logging`, and with the traceback of the message if it has one."""
        fields = {"event": "message", "logger": record.name, "message": record.getMessage()}
        if record.exc_info and record.exc_info[0] is not None:
            fields["traceback"] = "".join(traceback.format_exception(*record.exc_info))
        self._write_line(record.levelname.lower(), **fields)

    def _write_line(self, level: str, **fields: str) -> None:
        self._write(json.dumps({"time": datetime.now(UTC).isoformat(), "level": level} | fields))


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
        self.registry = CollectorRegistry(auto_describe=False)
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

    def count(self, transport: str, route: str, status: int | str) -> None:
        """Count a request that was answered, possibly with an error.

        Args:
            transport: Transport of the request, which is "http" or "grpc".
            route: Name of the route.
            status: HTTP status, or name of the gRPC status.
        """
        self._requests.labels(transport, route, status).inc()

    def count_and_log(self, exchange: Exchange) -> None:
        """Count a request that was answered, and log the request if there is a log."""
        self.count(exchange.transport, exchange.route, exchange.status)
        if self.log is not None:
            self.log.write_exchange(exchange)
