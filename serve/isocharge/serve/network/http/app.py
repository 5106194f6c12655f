"""The protocol's handler as an ASGI application: reads a bounded body, checks the token, sends one answer."""

import asyncio

from isocharge.errors import TokenError, TooLarge
from isocharge.serve.network.http.answerer import Message, Receive, Send
from isocharge.serve.network.protocol import Handler, Response
from isocharge.serve.network.protocol.handler import Headers
from isocharge.serve.network.protocol.response import error_response
from isocharge.serve.network.token import Token

OPEN = ("/v2/health/live", "/v2/health/ready")
"""Paths that need no token: programs that start and watch servers have none."""


class App:
    """The handler, behind a token: as a function, and as an ASGI application for any server."""

    def __init__(self, handler: Handler, token: Token | None = None) -> None:
        """Without a token, everybody is answered."""
        self._handler, self._token = handler, token
        self.blocks = handler.blocks

    def has_websocket(self, _path: str) -> bool:
        """There is none."""
        return False

    def answer(self, method: str, path: str, headers: Headers, body: bytes) -> Response:
        """Answer one request, as `Handler.answer` does, if it carries the token."""
        if self._token is not None and path not in OPEN:
            try:
                self._token.check(dict(headers).get(b"authorization", b""))
            except TokenError as error:
                return error_response(error)
        return self._handler.answer(method, path, headers, body)

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request, in another thread if that may take long."""
        message = await receive()
        try:
            body = await self._whole_body(message, receive) if message.get("more_body") else message.get("body", b"")
        except ConnectionResetError:
            return  # the client went away
        except TooLarge as error:  # the rest of the body is still on its way: no further request can follow it
            response = error_response(error)
            response.headers.append((b"connection", b"close"))
        else:
            request = scope["method"], scope["path"], scope["headers"], body
            slow = self.blocks(scope["path"])
            response = await asyncio.to_thread(self.answer, *request) if slow else self.answer(*request)
        await send({"type": "http.response.start", "status": response.status, "headers": response.headers})
        await send({"type": "http.response.body", "body": response.body})

    async def _whole_body(self, message: Message, receive: Receive) -> bytes:
        """A body that comes in pieces, bounded as it grows."""
        body = bytearray(message["body"])
        while message.get("more_body"):
            self._handler.limits.check_body(len(body))
            message = await receive()
            if message["type"] == "http.disconnect":
                raise ConnectionResetError
            body += message["body"]
        return bytes(body)
