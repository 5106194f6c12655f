"""HTTP on one connection, bounded: uvicorn's httptools protocol bounds neither headers nor the time they take.

A timer for each request would cost as much as parsing it. So a connection only notes by when it must have done its next
step, and the server looks through the connections now and then (`close_overdue`).
"""

import asyncio
import math
from collections.abc import Iterable
from typing import Any

import orjson
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from isocharge.serve.limits import Limits


class BoundedProtocol(HttpToolsProtocol):
    """One connection; subclasses carry the limits, because uvicorn makes protocols from their class."""

    limits = Limits()

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.by = math.inf  # the loop's time, s
        self._in_headers, self._header_bytes = True, 0
        self._now = self.loop.time

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, or say that there are too many."""
        super().connection_made(transport)
        self.by = self._now() + self.limits.header_seconds
        if len(self.connections) > self.limits.connections:
            self._refuse(503, f"all {self.limits.connections} connections are taken; try again later")

    def data_received(self, data: bytes) -> None:
        """Parse, then see whether headers are still going on."""
        if self.transport.is_closing():
            return
        super().data_received(data)
        if self._in_headers:
            self._count(len(data))

    def on_message_begin(self) -> None:
        """A request begins."""
        super().on_message_begin()
        self._in_headers, self._header_bytes = True, 0
        self.by = self._now() + self.limits.header_seconds

    def on_headers_complete(self) -> None:
        """The headers are all there; what came before this call was them."""
        size = len(self.url) + sum(len(name) + len(value) + 4 for name, value in self.headers)
        self._in_headers, self._header_bytes = False, 0
        if self.limits.header_bytes < size:
            self._refuse(431, self._too_long())
        else:
            self.by = self._now() + self.limits.body_seconds
            super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """A piece of the body, unless its request was refused."""
        if not self.transport.is_closing():
            super().on_body(body)

    def on_message_complete(self) -> None:
        """The whole request is there; the answer must have been taken by then."""
        if not self.transport.is_closing():
            self.by = self._now() + self.limits.body_seconds
            super().on_message_complete()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.by = self._now() + self.limits.idle_seconds
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """What cannot be parsed at all."""
        self._refuse(400, msg)

    def overdue(self) -> None:
        """End a connection that took too long: with words to one that is sending, without to one that is not."""
        if self._in_headers and self._header_bytes:
            self._refuse(408, f"the headers took longer than {self.limits.header_seconds:g} s")
        elif self.cycle is not None and self.cycle.more_body and not self.cycle.response_started:
            self._refuse(408, f"the body took longer than {self.limits.body_seconds:g} s")
        self.transport.abort()

    def _count(self, size: int) -> None:
        self._header_bytes += size
        if self._header_bytes > self.limits.header_bytes:
            self._refuse(431, self._too_long())

    def _too_long(self) -> str:
        return f"the request line and headers are longer than {self.limits.header_bytes} bytes"

    def _refuse(self, status: int, words: str) -> None:
        """Answer without asking the application, and hang up."""
        if self.transport.is_closing():
            return
        body = orjson.dumps({"error": words})
        head = b"content-type: application/json\r\ncontent-length: %d\r\nconnection: close\r\n\r\n" % len(body)
        self.transport.write(b"".join([STATUS_LINE[status], head, body]))
        self.transport.close()


def bounded(limits: Limits) -> type[BoundedProtocol]:
    """The protocol with these limits."""
    return type("BoundedProtocol", (BoundedProtocol,), {"limits": limits})


def close_overdue(connections: Iterable[Any], now: float) -> None:
    """End every connection whose time is over."""
    for connection in [c for c in connections if c.by < now]:
        connection.overdue()
