"""ASGI application that answers HTTP requests of the Open Inference Protocol.

The application is a bare ASGI callable without a framework. One table of routes already selects the function for a
request, derives the OpenAPI document and names the counters, so that a router, request and response classes of a
framework would only be called in addition.
"""

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, Protocol

from isocharge.serve.network.address import ServerLimits
from isocharge.serve.network.protocol.handler import Headers
from isocharge.serve.network.protocol.response import Response
from isocharge.serve.network.traffic import Client

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]


class RequestHandler(Protocol):
    """Object that computes the responses: the handler of models or the live page."""

    @property
    def limits(self) -> ServerLimits:
        """Limits of the requests."""

    def may_block(self, path: str) -> bool:
        """Return whether computing the response for a path may take a long time."""

    def answer(self, method: str, path: str, headers: Headers, body: bytes, client: Client) -> Response:
        """Answer one request."""


class Application:
    """ASGI application that answers requests with a handler. It can be mounted under any path of another program.

    Attributes:
        handler: Handler that computes the answers.
    """

    def __init__(self, handler: RequestHandler) -> None:
        """Store the handler."""
        self.handler = handler

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one HTTP request. If the client disconnects before its request is complete, nothing is sent.

        Args:
            scope: Method, path, headers and client of the request.
            receive: Function that returns the next part of the request.
            send: Function that sends a part of the response.

        Raises:
            ValueError: If the scope is not an HTTP request. A server then knows that there is no ASGI lifespan.
        """
        if scope["type"] != "http":
            raise ValueError(f"expected a scope of the type 'http', got {scope['type']!r}")
        body = await _read_body(receive, self.handler.limits.body_bytes)
        if body is None:
            return
        path = scope["path"].removeprefix(scope.get("root_path", ""))  # the root path is the path of a mounted program
        request = (scope["method"], path, scope["headers"], body, scope["client"])
        if self.handler.may_block(path):
            response = await asyncio.to_thread(self.handler.answer, *request)
        else:  # most answers take only microseconds
            response = self.handler.answer(*request)
        await send({"type": "http.response.start", "status": response.status, "headers": response.headers})
        await send({"type": "http.response.body", "body": response.body})


async def _read_body(receive: Receive, max_bytes: int) -> bytes | None:
    """Read the body of a request, but stop as soon as the body is larger than allowed. The handler then refuses it.

    Args:
        receive: Function that returns the next part of the request.
        max_bytes: Largest size of a body, bytes.

    Returns:
        The body or, if it is too large, its beginning. None if the client has disconnected.
    """
    body = bytearray()
    is_complete = False
    while not is_complete and len(body) <= max_bytes:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        body += message.get("body", b"")
        is_complete = not message.get("more_body", False)
    return bytes(body)
