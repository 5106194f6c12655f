"""Server of the live page.

The server sends the files of the page and the description of the film over HTTP. It sends the samples over a WebSocket.

The server is uvicorn with the limits of `isocharge.serve.network.http` and of `ViewerConnection`. This module limits
the number of viewers.

A browser cannot send an Authorization header when it opens a WebSocket. The page therefore sends its token as a
subprotocol that consists of `bearer.` and the token in base64url. Other clients send the Authorization header. The
module `isocharge.serve.network.browser_check` refuses requests from pages of other sites.
"""

import asyncio
import base64
import binascii
import contextlib
import json
import secrets
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from isocharge.common.errors import RequestError, TooMany, UnknownPath
from isocharge.common.structs import parse_json
from isocharge.serve.flags import MEANINGS
from isocharge.serve.network.address import Token
from isocharge.serve.network.browser_check import BrowserCheck, header_values
from isocharge.serve.network.http.application import Message, Receive, Send
from isocharge.serve.network.protocol import Response
from isocharge.serve.network.protocol.response import PAGE_HEADERS, error_response, json_response, response_of
from isocharge.serve.viewer.hub import Hub, Viewer
from isocharge.serve.viewer.messages import FLAG_BITS, confirmed_number

PROTOCOL = "isocharge.live.1"
"""WebSocket subprotocol of the live page."""

BEARER = "bearer."
"""Prefix of the subprotocol that contains the token."""


class Access:
    """Check of requests for the description of the film and for samples.

    Args:
        token: Token that requests must contain, or None if requests need no token.
        host: Name or address on which the page is served.
        allowed_hosts: Further host names of the page.
    """

    def __init__(self, token: Token | None = None, host: str = "127.0.0.1", allowed_hosts: Iterable[str] = ()) -> None:
        """Store the token, and create the filter of requests from browsers.

        The docstring of the class describes the arguments.
        """
        self._token = token
        self._browser_check = BrowserCheck(host, allowed_hosts, any_host=token is not None)

    def check(self, headers: Mapping[bytes, bytes], subprotocols: Iterable[str] = ()) -> None:
        """Check whether a request may be answered.

        Args:
            headers: Value of each header by the name of the header in lower case.
            subprotocols: Subprotocols that the client offers if the request opens a WebSocket.

        Raises:
            OriginError: If the request was sent by a page of another site.
            TokenError: If the request does not contain the token.
        """
        self._browser_check.check("GET", headers)
        if self._token is not None:
            self._token.check(headers.get(b"authorization", b"") or _authorization_from(subprotocols))


def _authorization_from(subprotocols: Iterable[str]) -> bytes:
    """Convert the subprotocol that contains the token to the value of an Authorization header.

    A browser cannot set headers when it opens a WebSocket. The page therefore sends the token as a subprotocol, which
    consists of `BEARER` and the token in base64url without padding characters.

    Args:
        subprotocols: Subprotocols that the client offers.

    Returns:
        The value of the header. It is empty if no subprotocol contains a token, and `Bearer` without a token if the
        token is not valid base64url.
    """
    for subprotocol in subprotocols:
        if subprotocol.startswith(BEARER):
            encoded_token = subprotocol.removeprefix(BEARER)
            padding = "=" * (-len(encoded_token) % 4)  # the decoder needs a multiple of four characters
            try:
                return b"Bearer " + base64.b64decode(encoded_token + padding, altchars=b"-_", validate=True)
            except (binascii.Error, ValueError):
                return b"Bearer"  # a header without a token is refused in the same way as a wrong token
    return b""


SESSION_PATH = "/session.json"
"""Path under which the server sends the description of the stream and its film."""

LIVE_PATH = "/live"
"""Path under which a client opens a WebSocket."""

MAX_VIEWERS = 32
"""Largest number of viewers that are connected at the same time."""

SERVICE_RESTART = 1012
"""Code with which the server closes the WebSockets when the stream has ended. The page then connects again."""

CONTENT_TYPES = {
    ".html": b"text/html; charset=utf-8",
    ".css": b"text/css; charset=utf-8",
    ".js": b"text/javascript; charset=utf-8",
    ".svg": b"image/svg+xml",
    ".LICENSE": b"text/plain; charset=utf-8",
}
"""Content type by the suffix of a file name."""

CONTENT_SECURITY_POLICY = (
    b"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; "
    b"base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page. With this policy, a browser loads only files of this server."""


class PageApplication:
    """ASGI application that serves the files of the page, the description of the film, and the samples.

    Args:
        hub: Hub of the stream that the page shows.
        access: Object that checks the requests for the description of the film and for samples.
    """

    def __init__(self, hub: Hub, access: Access) -> None:
        """Read the files of the page into memory. The docstring of the class describes the arguments."""
        self._hub = hub
        self._access = access
        self._files = page_files()
        self._id = secrets.token_hex(8)

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer an HTTP request, or serve a viewer that opens a WebSocket.

        Args:
            scope: Kind, path and headers of the request.
            receive: Function that returns the next message of the viewer.
            send: Function that sends a message to the viewer.
        """
        is_websocket = scope["type"] == "websocket"
        response = self._response(scope)
        if is_websocket:
            await receive()  # the message `websocket.connect`
        if response is None:
            await self._serve_viewer(scope, receive, send)
            return
        prefix = "websocket.http" if is_websocket else "http"
        await send({"type": f"{prefix}.response.start", "status": response.status, "headers": response.headers})
        await send({"type": f"{prefix}.response.body", "body": response.body})

    def _response(self, scope: Message) -> Response | None:
        """Return the response to a request, or None if the request may open a WebSocket.

        A request for a file of the page needs no token. If the page has a token, a request for the description of the
        stream or for a WebSocket must contain the token in its Authorization header. When a browser opens a WebSocket,
        it sends the token in a subprotocol instead.
        """
        try:
            path = scope["path"]
            if path in self._files:
                return self._files[path]
            if path not in (SESSION_PATH, LIVE_PATH):
                raise UnknownPath(f"nothing is served under {path[:200]!r}; the page is /")
            self._access.check(header_values(scope["headers"]), scope.get("subprotocols", ()))
            if path == SESSION_PATH:
                return self._session()
            if scope["type"] != "websocket":
                raise RequestError(f"{LIVE_PATH}: expected a WebSocket, got a request without an upgrade")
            if len(self._hub.viewers) >= MAX_VIEWERS:
                raise TooMany(f"all {MAX_VIEWERS} places for viewers are taken; close a page that nobody looks at")
            return None
        except Exception as error:  # every error is sent to the client; unexpected errors are also logged
            return error_response(error)

    def _session(self) -> Response:
        """Return the response with the description of the stream, which the page reads before the first sample."""
        flags = [{"word": flag, "bit": FLAG_BITS[flag], "says": meaning} for flag, meaning in MEANINGS.items()]
        response = json_response(
            {
                "id": self._id,
                "is_replay": self._hub.is_recording,
                "film": self._hub.description,
                "flags": flags,
            }
        )
        response.headers.append((b"cache-control", b"no-store"))
        return response

    async def _serve_viewer(self, scope: Message, receive: Receive, send: Send) -> None:
        """Send samples to a viewer and carry out requests of the viewer until the viewer disconnects."""
        viewer = Viewer(self._hub)
        self._hub.viewers.add(viewer)
        subprotocol = PROTOCOL if PROTOCOL in scope["subprotocols"] else None
        await send({"type": "websocket.accept", "subprotocol": subprotocol})
        sender = asyncio.create_task(self._send(viewer, send))
        try:
            while (message := await receive())["type"] == "websocket.receive":
                await self._handle_message(viewer, send, message)
        finally:
            self._hub.viewers.discard(viewer)
            sender.cancel()

    async def _send(self, viewer: Viewer, send: Send) -> None:
        """Send messages to a viewer until the stream ends or the viewer disconnects.

        Args:
            viewer: The viewer. Its event `wake` is set when there may be messages to send.
            send: Function that sends a message to the viewer.
        """
        with contextlib.suppress(OSError):  # the viewer has disconnected
            while not self._hub.has_ended:
                await viewer.wake.wait()
                viewer.wake.clear()  # before the messages are collected, so that no later event is missed
                for message in viewer.messages(time.time()):
                    kind = "bytes" if isinstance(message, bytes) else "text"
                    await send({"type": "websocket.send", kind: message})
            await send({"type": "websocket.close", "code": SERVICE_RESTART, "reason": "the stream has ended"})

    async def _handle_message(self, viewer: Viewer, send: Send, message: Message) -> None:
        """Handle a confirmation or a request of the page. If this is impossible, send the reason to the page.

        Args:
            viewer: The viewer that has sent the message.
            send: Function that sends a message to the viewer.
            message: The message. A confirmation has the key `bytes`, and a request has the key `text`.
        """
        try:
            if message.get("text") is None:
                viewer.confirm(confirmed_number(message["bytes"]))  # the page has drawn the samples of this message
                return
            request = parse_json(message["text"], "", RequestError, self._hub.request_type)
            if not self._hub.handle(request, viewer):
                raise RequestError("the stream has ended, or does not answer")
        except RequestError as error:
            await send({"type": "websocket.send", "text": json.dumps({"error": str(error)})})


def page_files() -> dict[str, Response]:
    """Return the response for each file of the page, by the path of the file.

    The path `/` is the HTML file.
    """
    folder = Path(__file__).with_name("page")
    paths = [path for path in folder.rglob("*") if path.is_file()]
    response_of_path = {f"/{path.relative_to(folder).as_posix()}": _file_response(path) for path in paths}
    response_of_path["/"] = response_of_path["/index.html"]
    return response_of_path


def _file_response(path: Path) -> Response:
    """Return the response that contains a file of the page."""
    response = response_of(200, CONTENT_TYPES[path.suffix], path.read_bytes())
    response.headers.append((b"content-security-policy", CONTENT_SECURITY_POLICY))
    response.headers.append((b"cache-control", b"no-cache"))
    response.headers.extend(PAGE_HEADERS)
    return response
