"""HTTP on one connection, bounded: uvicorn's httptools protocol bounds neither headers nor the time they take.

A timer for each request would cost as much as parsing it. So a connection only notes by when it must have done its next
step, and the server looks through the connections now and then (`close_overdue`). A request that arrives in one piece,
as nearly all do, needs no note but the one for the pause after it.
"""

import asyncio
import math
from collections.abc import Iterable
from enum import Enum
from typing import Any

import orjson
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from isocharge.serve.limits import Limits


class Phase(Enum):
    """What a connection waits for."""

    IDLE = "a request"
    HEADERS = "the end of the headers"
    BODY = "the end of the body"
    ANSWER = "our answer"


class BoundedProtocol(HttpToolsProtocol):
    """One connection; subclasses carry the limits, because uvicorn makes protocols from their class."""

    limits = Limits()

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.by = math.inf  # the loop's time, s
        self._phase = self._timed = Phase.IDLE
        self._chunk = self._fed = 0  # bytes of this piece, and of all since the request began

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a connection, or say that there are too many."""
        super().connection_made(transport)
        self._allow(self.limits.header_seconds)
        if len(self.connections) > self.limits.connections:
            self._refuse(503, f"all {self.limits.connections} connections are taken; try again later")

    def data_received(self, data: bytes) -> None:
        """Parse; what is then still unfinished is counted and timed."""
        if self.transport.is_closing():
            return
        self._chunk = len(data)
        self._fed += self._chunk
        super().data_received(data)
        if self._phase is Phase.HEADERS or self._phase is Phase.BODY:
            self._unfinished()

    def on_message_begin(self) -> None:
        """A request begins, somewhere in this piece of data."""
        self._phase, self._fed = Phase.HEADERS, self._chunk
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """The headers are all there; they are measured if they can be too long at all."""
        self._phase = Phase.BODY
        if self._fed > self.limits.header_bytes and self._header_bytes() > self.limits.header_bytes:
            self._refuse_headers()
        else:
            super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """A piece of the body, unless its request was refused."""
        if not self.transport.is_closing():
            super().on_body(body)

    def on_message_complete(self) -> None:
        """The whole request is there."""
        if not self.transport.is_closing():
            self._phase = Phase.ANSWER
            self._allow(math.inf)
            super().on_message_complete()

    def on_response_complete(self) -> None:
        """Go on with the next request, or wait for it; as in uvicorn, without its timer."""
        self.server_state.total_requests += 1
        if self.transport.is_closing():
            return
        self._phase = self._timed = Phase.IDLE if self._phase is Phase.ANSWER else self._phase
        self._allow(self.limits.idle_seconds)
        self.flow.resume_reading()
        if self.pipeline:
            self._start_asgi_task(*self.pipeline.pop())

    def pause_writing(self) -> None:
        """The client does not take its answer; it has so long to go on."""
        self._allow(self.limits.body_seconds)
        super().pause_writing()

    def resume_writing(self) -> None:
        """The client has taken what there was."""
        super().resume_writing()
        self._allow(self.limits.idle_seconds)

    def send_400_response(self, msg: str) -> None:
        """What cannot be parsed at all."""
        self._refuse(400, msg)

    def overdue(self) -> None:
        """End a connection that took too long: with words to one that is sending, without to one that is not."""
        if self._phase in (Phase.HEADERS, Phase.BODY):
            self._refuse(408, f"waited too long for {self._phase.value}")
        self.transport.abort()

    def _unfinished(self) -> None:
        if self._phase is Phase.HEADERS and self._fed > self.limits.header_bytes:
            self._refuse_headers()
        if self._timed is not self._phase:
            self._timed = self._phase
            self._allow(self.limits.header_seconds if self._phase is Phase.HEADERS else self.limits.body_seconds)

    def _allow(self, seconds: float) -> None:
        if not self.flow.write_paused:  # an answer that is not taken leaves no time for anything else
            self.by = self.loop.time() + seconds

    def _header_bytes(self) -> int:
        return len(self.url) + sum(len(name) + len(value) + 4 for name, value in self.headers)

    def _refuse_headers(self) -> None:
        self._refuse(431, f"the request line and headers are longer than {self.limits.header_bytes} bytes")

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
