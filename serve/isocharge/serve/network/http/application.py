"""ASGI application that answers HTTP requests of the Open Inference Protocol.

The application is a bare ASGI callable without a framework. One table of routes already selects the function for a
request, derives the OpenAPI document and names the counters, so that a router, request and response classes of a
framework would only be called in addition.
"""

import asyncio
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from pathlib import Path
from typing import Any, Protocol

from isocharge.serve.network.address import ServerLimits, Token
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.network.metrics import Client
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler
from isocharge.serve.network.protocol.handler import Headers
from isocharge.serve.network.protocol.response import Response

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


def asgi_app(models: Path | None = None, *, token: str | None = None, allowed_hosts: Iterable[str] = ()) -> Application:
    """Load models, and return an ASGI application that serves them with the Open Inference Protocol.

    The limits of connections belong to the server that runs the program. The application itself limits the size of a
    request, and checks the token and the headers of browsers.

    Args:
        models: Folder of the models. By default, all repositories are searched, as `isocharge serve http` does.
        token: Secret that clients must send as `Authorization: Bearer TOKEN`. By default, requests need no token.
        allowed_hosts: Host names by which browsers reach the program, in addition to IP addresses and `localhost`. With
            a token, every host name is accepted.

    Raises:
        MissingExtra: If the extra `http` is not installed.
        InputError: If the token or a host name cannot be used.
        ModelError: If there is no model, or no version passes its checks.

    Example:
        >>> from starlette.applications import Starlette  # doctest: +SKIP
        >>> from starlette.routing import Mount  # doctest: +SKIP
        >>> app = Starlette(routes=[Mount("/touch", asgi_app(token="s3cret"))])  # doctest: +SKIP
    """
    secret = None if token is None else Token(token)
    access = AccessCheck(allowed_hosts=allowed_hosts, token=secret)
    return Application(Handler(open_model_store(models), access=access))


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
