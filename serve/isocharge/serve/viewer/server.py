"""Server of the live page: files and the description of the film over HTTP, samples over WebSocket.

The server is based on the package `websockets`, which answers one HTTP request for each connection. The package limits
the size of the request line and headers (8 KiB for each line, 128 lines), the time for a request, and the size of a
message. The package also sends pings to each viewer. This module limits the number of viewers, the rate at which they
send data, and the time for which they read nothing.

A browser sends no Authorization header with a WebSocket. The page therefore sends its token as a subprotocol,
`bearer.TOKEN` in base64url. Other clients send the header. The module `isocharge.serve.network.browser_check` refuses
requests from pages of other sites.
"""

import asyncio
import base64
import binascii
import contextlib
import json
import logging
import secrets
import socket
import ssl
import time
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from http import HTTPStatus
from pathlib import Path

from websockets import http11
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.typing import Subprotocol

from isocharge.common.errors import RequestError, TooMany, UnknownPath
from isocharge.common.structs import parse_json
from isocharge.serve.flags import MEANINGS
from isocharge.serve.network.address import Token
from isocharge.serve.network.browser_check import BrowserCheck
from isocharge.serve.network.protocol import Response
from isocharge.serve.network.protocol.page import PAGE_HEADERS
from isocharge.serve.network.protocol.response import error_response, json_response, response_of
from isocharge.serve.viewer.hub import Hub, Viewer
from isocharge.serve.viewer.messages import FLAG_BITS, confirmed_number

PROTOCOL = "isocharge.live.1"
"""Subprotocol of the page."""

BEARER = "bearer."
"""Beginning of the subprotocol that contains the token."""


class Access:
    """Checks whether a request for data may be answered.

    Args:
        token: Token that requests must contain; None if no token is needed.
        host: Name or address on which the page is served.
    """

    def __init__(self, token: Token | None = None, host: str = "127.0.0.1") -> None:
        """Set up the checks. The class describes the arguments."""
        self._token = token
        self._browser_check = BrowserCheck(host, any_host=token is not None)

    def check(self, headers: Mapping[bytes, bytes], subprotocols: Iterable[str] = ()) -> None:
        """Check a request for data.

        Args:
            headers: Values by name in lower case.
            subprotocols: Subprotocols that a WebSocket offers.

        Raises:
            OriginError: If a page of another site sent the request.
            TokenError: If the request does not contain the token.
        """
        self._browser_check.check("GET", headers)
        if self._token is not None:
            self._token.check(headers.get(b"authorization", b"") or _bearer(subprotocols))


def _bearer(subprotocols: Iterable[str]) -> bytes:
    """Return the Authorization header that corresponds to the subprotocol with the token; empty if there is none.

    A browser cannot set headers when it opens a WebSocket. The page therefore sends the token as a subprotocol, encoded
    in base64 for URLs without padding.
    """
    for subprotocol in subprotocols:
        if subprotocol.startswith(BEARER):
            text = subprotocol.removeprefix(BEARER)
            padding = "=" * (-len(text) % 4)  # the decoder needs a multiple of four characters
            try:
                return b"Bearer " + base64.b64decode(text + padding, altchars=b"-_", validate=True)
            except (binascii.Error, ValueError):
                return b"Bearer"  # a header without a token, which is refused as a wrong token
    return b""


SESSION_PATH = "/session.json"
"""Path of the description of the film."""

LIVE_PATH = "/live"
"""Path of the WebSocket."""

MAX_VIEWERS = 32
"""Largest number of viewers."""

MAX_BURST_BYTES = 1 << 16
"""Largest amount of data that a connection may send at once, bytes. No request of the page is larger."""

MAX_BYTES_PER_S = 1 << 14
"""Largest mean rate at which a connection may send data, bytes/s. The page sends about 1 kB/s."""

MAX_MESSAGE_BYTES = 1 << 12
"""Largest size of a message from a viewer, bytes."""

REQUEST_TIMEOUT_S = 10.0
"""Longest time for an HTTP request, s."""

PING_INTERVAL_S = 20.0
"""Time between two pings, and longest time until the response to a ping, s."""

SEND_TIMEOUT_S = 30.0
"""Longest time for which a viewer may read nothing, s."""

CLOSE_TIMEOUT_S = 2.0
"""Longest time for closing a connection, s."""

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
"""Content security policy: a browser may load only the files of this server."""

SILENT_LOGGER = logging.getLogger("isocharge.serve.viewer.websockets")
"""Logger for the package `websockets`. Errors of clients are sent to the clients and not logged."""
SILENT_LOGGER.setLevel(logging.CRITICAL)


class RateLimit:
    """Limit of the data that a client may send (token bucket).

    Args:
        burst_bytes: Largest amount of data at once, bytes.
        bytes_per_s: Largest mean rate, bytes/s.
        now_s: Present time on a clock that does not jump, s.
    """

    def __init__(self, burst_bytes: float, bytes_per_s: float, now_s: float) -> None:
        """Begin with the full amount of data. The class describes the arguments."""
        self._burst_bytes = burst_bytes
        self._bytes_per_s = bytes_per_s
        self._available_bytes = burst_bytes
        self._latest_s = now_s

    def allows(self, count: int, now_s: float) -> bool:
        """Count received data, and return whether their amount is within the limit.

        The limit is a token bucket: an allowance of bytes grows at a constant rate up to a largest value, and received
        data reduce it.

        Args:
            count: Size of the data, bytes.
            now_s: Time on a monotonic clock, s.
        """
        elapsed_s = max(now_s - self._latest_s, 0.0)
        refilled_bytes = min(self._burst_bytes, self._available_bytes + elapsed_s * self._bytes_per_s)
        self._available_bytes = refilled_bytes - count
        self._latest_s = now_s
        return self._available_bytes >= 0.0


class PageConnection(ServerConnection):
    """A connection that is ended if its client sends too much data. The data include control frames such as pings."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Create the data limit of the connection when the connection begins."""
        self._rate_limit = RateLimit(MAX_BURST_BYTES, MAX_BYTES_PER_S, time.monotonic())
        super().connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Process received data, or end the connection if the client sends too much.

        While the client does not read the responses, writing is paused. Reading is then paused, too, because the
        responses to further data would fill the memory.
        """
        if not self._rate_limit.allows(len(data), time.monotonic()):
            self.transport.abort()
            return
        super().data_received(data)
        if self.paused:  # writing is paused
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        """Resume reading when the client reads again."""
        super().resume_writing()
        self.transport.resume_reading()


class PageServer:
    """Serves the files of the page, the description of the film, and the samples.

    Args:
        hub: The stream.
        access: Checks the requests for the description and the samples.
    """

    def __init__(self, hub: Hub, access: Access) -> None:
        """Read the files of the page. The class describes the arguments."""
        self._hub = hub
        self._access = access
        self._files = page_files()
        self._id = secrets.token_hex(8)

    @contextlib.asynccontextmanager
    async def listening(
        self, listening: socket.socket, tls_context: ssl.SSLContext | None = None
    ) -> AsyncIterator[None]:
        """Answer requests on a listening socket while the block runs.

        Args:
            listening: The socket.
            tls_context: TLS context of the server; None for no TLS.
        """
        async with serve(
            self._serve_viewer,
            sock=listening,
            ssl=tls_context,
            process_request=self._http_response,
            select_subprotocol=_select_subprotocol,
            compression=None,
            server_header=None,
            open_timeout=REQUEST_TIMEOUT_S,
            ping_interval=PING_INTERVAL_S,
            ping_timeout=PING_INTERVAL_S,
            close_timeout=CLOSE_TIMEOUT_S,
            max_size=MAX_MESSAGE_BYTES,
            logger=SILENT_LOGGER,
            create_connection=PageConnection,
        ):
            yield

    def _http_response(self, _connection: ServerConnection, request: http11.Request) -> http11.Response | None:
        """Return the response to an HTTP request; None if the request opens a WebSocket.

        The files of the page need no token. The description of the session and the WebSocket need the token, which is
        either in the Authorization header or, from a browser that opens a WebSocket, in a subprotocol.

        Args:
            _connection: Connection of the request, which is not used.
            request: The request, of which only the path and the headers are known.
        """
        try:
            path = request.path.partition("?")[0]
            if path in self._files:
                return _last_response(self._files[path])
            if path not in (SESSION_PATH, LIVE_PATH):
                raise UnknownPath(f"nothing is served under {path[:200]!r}; the page is /")
            items = request.headers.raw_items()
            headers = {name.lower().encode(): value.encode("ascii", "surrogateescape") for name, value in items}
            # The subprotocols may be in several headers, and each header may list several of them.
            subprotocol_list = ",".join(request.headers.get_all("Sec-WebSocket-Protocol"))
            subprotocols = [subprotocol.strip() for subprotocol in subprotocol_list.split(",")]
            self._access.check(headers, subprotocols)
            if path == SESSION_PATH:
                return _last_response(self._session())
            if len(self._hub.viewers) >= MAX_VIEWERS:
                raise TooMany(f"all {MAX_VIEWERS} places for viewers are taken; close a page that nobody looks at")
            return None  # the connection becomes a WebSocket
        except Exception as error:  # every error is sent to the client; unexpected errors are also logged
            return _last_response(error_response(error))

    def _session(self) -> Response:
        """Return the description of the stream, which the page reads before the first sample."""
        response = json_response(
            {
                "id": self._id,
                "is_replay": self._hub.is_recording,
                "film": self._hub.description,
                "flags": [{"word": word, "bit": FLAG_BITS[word], "says": says} for word, says in MEANINGS.items()],
            }
        )
        response.headers.append((b"cache-control", b"no-store"))
        return response

    async def _serve_viewer(self, connection: ServerConnection) -> None:
        """Send samples to a viewer and carry out its requests until it disconnects."""
        viewer = Viewer(self._hub)
        self._hub.viewers.add(viewer)
        sender = asyncio.create_task(self._send(viewer, connection))
        try:
            async for message in connection:
                await self._handle_message(viewer, connection, message)
        except ConnectionClosed:  # the viewer has disconnected
            pass
        finally:
            self._hub.viewers.discard(viewer)
            sender.cancel()

    async def _send(self, viewer: Viewer, connection: ServerConnection) -> None:
        """Send messages to a viewer until the stream ends. A viewer that does not read is disconnected.

        Args:
            viewer: The viewer, whose event `wake` is set when there may be something to send.
            connection: Connection of the viewer.
        """
        try:
            while not self._hub.has_ended:
                await viewer.wake.wait()
                viewer.wake.clear()
                async with asyncio.timeout(SEND_TIMEOUT_S):
                    for message in viewer.messages(time.time()):
                        await connection.send(message)
            await connection.close(CloseCode.SERVICE_RESTART, "the stream has ended")
        except TimeoutError:  # the viewer does not read
            connection.transport.abort()
        except ConnectionClosed:  # the viewer has disconnected
            pass

    async def _handle_message(self, viewer: Viewer, connection: ServerConnection, message: str | bytes) -> None:
        """Handle a confirmation or a request of the page. The response to an invalid message is the error.

        Args:
            viewer: The viewer that has sent the message.
            connection: Connection of the viewer.
            message: Bytes for a confirmation, text for a request.
        """
        try:
            if isinstance(message, bytes):
                viewer.confirm(confirmed_number(message))  # the page has drawn the samples of this message
                return
            request = parse_json(message, "", RequestError, self._hub.request_type)
            if not self._hub.handle(request, viewer):
                raise RequestError("the stream has ended, or does not answer")
        except RequestError as error:
            await connection.send(json.dumps({"error": str(error)}))


def _select_subprotocol(_connection: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    """Return the subprotocol of the page if the client offers it."""
    return Subprotocol(PROTOCOL) if PROTOCOL in offered else None


def _last_response(response: Response) -> http11.Response:
    """Convert a response to the type of the package `websockets`. The connection is closed after this response."""
    headers = Headers([(name.decode(), value.decode()) for name, value in response.headers])
    headers["Connection"] = "close"
    return http11.Response(response.status, HTTPStatus(response.status).phrase, headers, response.body)


def page_files() -> dict[str, Response]:
    """Return the response to each path of the page. The path `/` is the page itself."""
    folder = Path(__file__).with_name("page")
    paths = [path for path in folder.rglob("*") if path.is_file()]
    responses = {f"/{path.relative_to(folder).as_posix()}": _file_response(path) for path in paths}
    responses["/"] = responses["/index.html"]
    return responses


def _file_response(path: Path) -> Response:
    """Return the response with the content of a file of the page."""
    response = response_of(200, CONTENT_TYPES[path.suffix], path.read_bytes())
    response.headers.append((b"content-security-policy", CONTENT_SECURITY_POLICY))
    response.headers.append((b"cache-control", b"no-cache"))
    for name, value in PAGE_HEADERS:
        if name != b"content-security-policy":  # this page has its own policy
            response.headers.append((name, value))
    return response
