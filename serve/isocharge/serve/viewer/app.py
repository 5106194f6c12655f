"""The page's server as an application: its files and the description of its films over HTTP, samples by WebSocket."""

import asyncio
import json
import secrets
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from isocharge.common.errors import IsochargeError, RequestError, TooMany, UnknownPath, WrongMethod
from isocharge.serve.flags import MEANINGS
from isocharge.serve.network.http.answerer import Message, Receive, Send
from isocharge.serve.network.protocol import Response
from isocharge.serve.network.protocol.handler import Headers
from isocharge.serve.network.protocol.response import error_response, json_response
from isocharge.serve.network.request_log import Client
from isocharge.serve.viewer.access import PROTOCOL, Access
from isocharge.serve.viewer.hub import Hub, Viewer
from isocharge.serve.viewer.messages import confirmed_number, parse_request
from isocharge.serve.viewer.sample import FLAG_BITS
from isocharge.serve.viewer.static_files import page_files

SESSION, LIVE = "/session.json", "/live"
"""Paths of the description and of the WebSocket."""

VIEWERS = 32
"""Browsers at a time."""

MESSAGES_PER_S = 300.0
"""Messages of a viewer for each film, in the long run and at once, 1/s; the page sends some 60."""


class PageApp:
    """Answers browsers."""

    def __init__(self, hub: Hub, access: Access) -> None:
        self._hub, self._access = hub, access
        self._files = page_files()
        self._id = secrets.token_hex(8)

    def blocks(self, _path: str) -> bool:
        """No answer takes long."""
        return False

    def has_websocket(self, path: str) -> bool:
        """Whether a path is that of the samples."""
        return path == LIVE

    def watch_connections(self, _count: Callable[[], int]) -> None:
        """Nobody counts them: the page has no metrics."""

    def refused(self, _response: Response, _client: Client = None) -> None:
        """Nobody takes note: the page has no log of requests."""

    def answer(self, method: str, path: str, headers: Headers, _body: bytes, _client: Client = None) -> Response:
        """A file of the page, which everybody may have, or the description of the films."""
        try:
            if path != SESSION and path not in self._files:
                raise UnknownPath(f"nothing is served under {path!r}; the page is /")
            if method not in ("GET", "HEAD"):
                raise WrongMethod(f"expected GET, got {method}", "GET")
            if path != SESSION:
                return self._files[path]
            self._access.check(dict(headers))
            return self._session()
        except Exception as error:  # whatever it is, one request fails and the log says why
            return error_response(error)

    def _session(self) -> Response:
        response = json_response(
            {
                "id": self._id,
                "is_replay": self._hub.is_replay,
                "films": [film.description for film in self._hub.films],
                "flags": [{"word": word, "bit": FLAG_BITS[word], "says": says} for word, says in MEANINGS.items()],
            }
        )
        response.headers.append((b"cache-control", b"no-store"))
        return response

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """A WebSocket: check who asks, then send samples and take requests."""
        assert scope["type"] == "websocket"
        await receive()
        try:
            self._access.check(dict(scope["headers"]), scope["subprotocols"])
            if self._hub.viewers >= VIEWERS:
                raise TooMany(f"all {VIEWERS} places for viewers are taken; close a page that nobody looks at")
        except IsochargeError as error:
            await _refuse(send, error_response(error))
            return
        accepted = PROTOCOL if PROTOCOL in scope["subprotocols"] else None
        await send({"type": "websocket.accept", "subprotocol": accepted})
        viewer = self._hub.join()
        sender = asyncio.create_task(self._send(viewer, send))
        try:
            await self._take(viewer, receive, send)
        finally:
            self._hub.leave(viewer)
            sender.cancel()

    async def _send(self, viewer: Viewer, send: Send) -> None:
        with suppress(OSError):  # the client has gone
            while True:
                await viewer.wake.wait()
                viewer.wake.clear()
                for message in viewer.messages(self._hub.clock()):
                    kind = "text" if isinstance(message, str) else "bytes"
                    await send({"type": "websocket.send", kind: message})

    async def _take(self, viewer: Viewer, receive: Receive, send: Send) -> None:
        """Take what the page says until it goes; what is no request is answered with the reason."""
        budget = Budget(MESSAGES_PER_S * len(self._hub.films), self._hub.clock())
        while (message := await receive())["type"] == "websocket.receive":
            if not budget.spend(self._hub.clock()):
                await send({"type": "websocket.close", "code": 1008, "reason": "too many messages"})
                return
            try:
                self._do(viewer, message)
            except RequestError as error:
                with suppress(OSError):
                    await send({"type": "websocket.send", "text": json.dumps({"error": str(error)})})

    def _do(self, viewer: Viewer, message: Message) -> None:
        data: bytes | None = message.get("bytes")
        if data is not None:
            viewer.confirm(confirmed_number(data))
            return
        request = parse_request(message["text"], self._hub.actions, len(self._hub.films))
        if not self._hub.do(request, viewer):
            raise RequestError(f"{request.action}: the stream has ended, or does not answer")


class Budget:
    """How many messages a viewer may still send: `per_s` at once, and as many more each second."""

    def __init__(self, per_s: float, now_s: float) -> None:
        self._per_s = self._left = per_s
        self._counted_s = now_s

    def spend(self, now_s: float) -> bool:
        """Count one message; False if it is too many."""
        self._left = min(self._per_s, self._left + max(now_s - self._counted_s, 0.0) * self._per_s)
        self._counted_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


async def _refuse(send: Send, response: Response) -> None:
    """Answer the handshake of a WebSocket with an error."""
    start: dict[str, Any] = {"status": response.status, "headers": response.headers}
    await send({"type": "websocket.http.response.start", **start})
    await send({"type": "websocket.http.response.body", "body": response.body})
