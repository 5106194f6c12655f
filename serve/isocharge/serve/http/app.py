"""The protocol's handler as an ASGI application: reads a bounded body, checks the token, sends one answer."""

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from isocharge.errors import TokenError, TooLarge
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
        message = await receive()
        try:
            body = await self._whole(message, receive) if message.get("more_body") else message.get("body", b"")
            later = self._handler.blocks(scope["path"])
            response = await asyncio.to_thread(self._answer, scope, body) if later else self._answer(scope, body)
        except ConnectionResetError:
            return  # nobody is there to answer
        except TooLarge as error:  # the rest of the body is still on its way: no further request can follow it
            response = error_response(error)
            response.headers.append((b"connection", b"close"))
        await send({"type": "http.response.start", "status": response.status, "headers": response.headers})
        await send({"type": "http.response.body", "body": response.body})

    async def _whole(self, message: Message, receive: Receive) -> bytes:
        """A body that comes in pieces, bounded as it grows."""
        body, limit = bytearray(message["body"]), self._handler.limits.body_bytes
        while message.get("more_body"):
            if len(body) > limit:
                raise TooLarge(f"the body is larger than the {limit} bytes that are read")
            message = await receive()
            if message["type"] == "http.disconnect":
                raise ConnectionResetError
            body += message["body"]
        return bytes(body)

    def _answer(self, scope: Message, body: bytes) -> Response:
        path, headers = scope["path"], scope["headers"]
        if self._token is not None and path not in OPEN:
            try:
                self._token.check(dict(headers).get(b"authorization", b""))
            except TokenError as error:
                return error_response(error)
        return self._handler.answer(scope["method"], path, headers, body)
