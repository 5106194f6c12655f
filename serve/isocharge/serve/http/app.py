"""The protocol's handler as an ASGI application: reads a bounded body, checks the token, sends one answer."""

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from isocharge.errors import TooLarge
from isocharge.serve.token import Token
from isocharge.serve.v2 import Handler, Response
from isocharge.serve.v2.handler import error_response

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]

OPEN = ("/v2/health/live", "/v2/health/ready")
"""Paths that need no token: what starts and watches servers has none."""


class App:
    """An ASGI application for HTTP requests."""

    def __init__(self, handler: Handler, token: Token | None = None) -> None:
        """Without a token, everybody is answered."""
        self._handler, self._token = handler, token

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request."""
        try:
            body = await self._body(receive)
        except ConnectionResetError:
            return  # nobody is there to answer
        except TooLarge as error:  # the rest of the body is still on its way: no further request can follow it
            response = error_response(error)
            response.headers.append((b"connection", b"close"))
        else:
            response = await self._answer(scope, body)
        await send({"type": "http.response.start", "status": response.status, "headers": response.headers})
        await send({"type": "http.response.body", "body": response.body})

    async def _body(self, receive: Receive) -> bytes:
        """The whole body, or as much of it as shows that it is too large."""
        message = await receive()
        body: bytes = message.get("body", b"")
        while message.get("more_body", False) and message["type"] == "http.request":
            if len(body) > self._handler.limits.body_bytes:
                break
            message = await receive()
            body += message.get("body", b"")
        if message["type"] == "http.disconnect":
            raise ConnectionResetError
        if len(body) > self._handler.limits.body_bytes:
            raise TooLarge(f"the body is larger than the {self._handler.limits.body_bytes} bytes that are read")
        return body

    async def _answer(self, scope: Message, body: bytes) -> Response:
        method, path, headers = scope["method"], scope["path"], scope["headers"]
        if self._token is not None and path not in OPEN:
            try:
                self._token.check(dict(headers).get(b"authorization", b""))
            except PermissionError as error:
                return error_response(error)
        if self._handler.blocks(path):
            return await asyncio.to_thread(self._handler.answer, method, path, headers, body)
        return self._handler.answer(method, path, headers, body)
