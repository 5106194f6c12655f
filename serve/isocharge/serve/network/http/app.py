"""The protocol's handler as an ASGI application: reads a bounded body, checks the token, sends one answer."""

import asyncio
import time
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from isocharge.errors import TokenError, TooLarge
from isocharge.serve.network.protocol import Handler, Response
from isocharge.serve.network.protocol.handler import Headers
from isocharge.serve.network.protocol.response import error_response
from isocharge.serve.network.request_log import Client, Exchange
from isocharge.serve.network.token import Token

Message = MutableMapping[str, Any]

Receive = Callable[[], Awaitable[Message]]

Send = Callable[[Message], Awaitable[None]]

OPEN = ("/v2/health/live", "/v2/health/ready")
"""Paths that need no token: programs that start and watch servers have none."""


class App:
    """The handler, behind a token: as a function, and as an ASGI application for any server."""

    def __init__(self, handler: Handler, token: Token | None = None) -> None:
        """Without a token, everybody is answered."""
        self.handler, self._token = handler, token
        self.blocks = handler.blocks

    def answer(self, method: str, path: str, headers: Headers, body: bytes, client: Client = None) -> Response:
        """Answer one request, as `Handler.answer` does, if it carries the token; count it and log it."""
        traffic = self.handler.traffic
        if traffic.log is None:
            response = self._answer(method, path, headers, body)
            traffic.count("http", self.handler.label(path), response.status)
            return response
        began = time.perf_counter_ns()
        response = self._answer(method, path, headers, body)
        self._note(path, response, time.perf_counter_ns() - began, len(body), client)
        return response

    def refused(self, response: Response, client: Client = None) -> None:
        """Count a refusal that did not come from here, as the request could not be read to its end."""
        self._note(None, response, 0, 0, client)

    def _answer(self, method: str, path: str, headers: Headers, body: bytes) -> Response:
        if self._token is None:
            return self.handler.answer(method, path, headers, body)
        try:
            self._token.check(dict(headers).get(b"authorization", b""))
        except TokenError as error:
            if path not in OPEN:
                return error_response(error)
            return self.handler.answer(method, path, headers, body, trusted=False)
        return self.handler.answer(method, path, headers, body)

    def _note(self, path: str | None, response: Response, ns: int, bytes_in: int, client: Client) -> None:
        """Count a request, and write it into the log; without a path it could not be read."""
        route, model = ("none", None) if path is None else (self.handler.label(path), self.handler.model_label(path))
        error: str | None = getattr(response, "error", None)
        sizes = bytes_in, len(response.body)
        self.handler.traffic.note(Exchange("http", route, response.status, model, error, ns, *sizes, client))

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request, in another thread if that may take long."""
        message = await receive()
        client = scope.get("client")
        try:
            body = await self._whole_body(message, receive) if message.get("more_body") else message.get("body", b"")
        except ConnectionResetError:
            return  # the client went away
        except TooLarge as error:  # the rest of the body is still on its way: no further request can follow it
            response = error_response(error)
            response.headers.append((b"connection", b"close"))
            self.refused(response, client)
        else:
            request = scope["method"], scope["path"], scope["headers"], body, client
            slow = self.blocks(scope["path"])
            response = await asyncio.to_thread(self.answer, *request) if slow else self.answer(*request)
        await send({"type": "http.response.start", "status": response.status, "headers": response.headers})
        await send({"type": "http.response.body", "body": response.body})

    async def _whole_body(self, message: Message, receive: Receive) -> bytes:
        """A body that comes in pieces, bounded as it grows."""
        body = bytearray(message["body"])
        while message.get("more_body"):
            self.handler.limits.check_body(len(body))
            message = await receive()
            if message["type"] == "http.disconnect":
                raise ConnectionResetError
            body += message["body"]
        return bytes(body)
