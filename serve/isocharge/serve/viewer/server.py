"""Server of the live page.

The server sends the files of the page and the description of the film over HTTP. It sends the samples over a WebSocket.

The server is based on the package `websockets`, which answers one HTTP request on each connection. The package limits
the size of each line of a request to 8 KiB, the number of lines to 128, the duration of a request, and the size of a
message. It also sends pings to each viewer. This module limits the number of viewers and the rate at which a viewer may
send data. It also disconnects a viewer that has not read its messages for too long.

A browser cannot send an Authorization header when it opens a WebSocket. The page therefore sends its token as a
subprotocol that consists of `bearer.` and the token in base64url. Other clients send the Authorization header. The
module `isocharge.serve.network.browser_check` refuses requests from pages of other sites.
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
from isocharge.serve.network.browser_check import BrowserCheck, header_values
from isocharge.serve.network.protocol import Response
from isocharge.serve.network.protocol.page import PAGE_HEADERS
from isocharge.serve.network.protocol.response import error_response, json_response, response_of
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

MAX_BURST_BYTES = 1 << 16
"""Largest amount of data that a client may send at once, bytes. No request of the page is larger."""

MAX_BYTES_PER_S = 1 << 14
"""Largest mean rate at which a client may send data, bytes/s. The page sends about 1 kB/s."""

MAX_MESSAGE_BYTES = 1 << 12
"""Largest size of a message from a viewer, bytes."""

REQUEST_TIMEOUT_S = 10.0
"""Longest time in which a client must complete its HTTP request, s."""

PING_INTERVAL_S = 20.0
"""Time between two pings, s. It is also the longest time within which a viewer must answer a ping."""

SEND_TIMEOUT_S = 30.0
"""Longest time for which a viewer may read nothing, s."""

CLOSE_TIMEOUT_S = 2.0
"""Longest time to wait while a connection is being closed, s."""

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

SILENT_LOGGER = logging.getLogger("isocharge.serve.viewer.websockets")
"""Logger for the package `websockets`. The errors that a client causes are sent to this client and are not logged."""
SILENT_LOGGER.setLevel(logging.CRITICAL)


class RateLimit:
    """Limit on the amount of data that a client may send, implemented as a token bucket.

    Args:
        burst_bytes: Largest amount of data that the client may send at once, bytes.
        bytes_per_s: Largest mean rate at which the client may send data, bytes/s.
        now_s: Present time on a monotonic clock, s.
    """

    def __init__(self, burst_bytes: float, bytes_per_s: float, now_s: float) -> None:
        """Begin with the full allowance of `burst_bytes`. The docstring of the class describes the arguments."""
        self._burst_bytes = burst_bytes
        self._bytes_per_s = bytes_per_s
        self._available_bytes = burst_bytes
        self._latest_s = now_s

    def allows(self, received_bytes: int, now_s: float) -> bool:
        """Count received data, and return whether the client has stayed within the limit.

        The allowance of the client grows by `bytes_per_s` in each second, up to at most `burst_bytes`. Received data
        reduce the allowance. The client has exceeded the limit if the allowance becomes negative.

        Args:
            received_bytes: Size of the received data, bytes.
            now_s: Present time on the same monotonic clock, s.
        """
        elapsed_s = max(now_s - self._latest_s, 0.0)
        refilled_bytes = min(self._burst_bytes, self._available_bytes + elapsed_s * self._bytes_per_s)
        self._available_bytes = refilled_bytes - received_bytes
        self._latest_s = now_s
        return self._available_bytes >= 0.0


class PageConnection(ServerConnection):
    """Connection of a client, which the server ends if the client sends too much data.

    All received data count, including control frames such as pings.
    """

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Create the limit on received data when the connection begins."""
        self._rate_limit = RateLimit(MAX_BURST_BYTES, MAX_BYTES_PER_S, time.monotonic())
        super().connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Process received data, or end the connection if the client has sent too much data.

        If the client does not read the responses, asyncio pauses writing. The method then also pauses reading, because
        the responses to further data would fill the memory. `resume_writing` resumes reading.
        """
        if not self._rate_limit.allows(len(data), time.monotonic()):
            self.transport.abort()
            return
        super().data_received(data)
        if self.paused:  # asyncio has paused writing
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        """Resume reading, because the client has read the responses."""
        super().resume_writing()
        self.transport.resume_reading()


class PageServer:
    """Server that sends the files of the page, the description of the film, and the samples.

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

    @contextlib.asynccontextmanager
    async def answering(
        self, listening_socket: socket.socket, tls_context: ssl.SSLContext | None = None
    ) -> AsyncIterator[None]:
        """Return an asynchronous context manager that answers requests on a socket until its block ends.

        Args:
            listening_socket: Socket on which the server accepts connections.
            tls_context: TLS context of the server, or None for HTTP without TLS.
        """
        async with serve(
            self._serve_viewer,
            sock=listening_socket,
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
        """Return the response to an HTTP request, or None if the request may open a WebSocket.

        A request for a file of the page needs no token. If the page has a token, a request for the description of the
        stream or for a WebSocket must contain the token in its Authorization header. When a browser opens a WebSocket,
        it sends the token in a subprotocol instead.

        Args:
            _connection: Connection of the request, which is not used.
            request: The request, of which only the path and the headers are known.
        """
        try:
            path, _, _query = request.path.partition("?")
            if path in self._files:
                return _last_response(self._files[path])
            if path not in (SESSION_PATH, LIVE_PATH):
                raise UnknownPath(f"nothing is served under {path[:200]!r}; the page is /")
            headers = header_values(
                (name.lower().encode(), value.encode("ascii", "surrogateescape"))
                for name, value in request.headers.raw_items()
            )
            # A request may have several headers with subprotocols, and each header may list several subprotocols.
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

    async def _serve_viewer(self, connection: ServerConnection) -> None:
        """Send samples to a viewer and carry out requests of the viewer until the viewer disconnects."""
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
        """Send messages to a viewer until the stream ends. If the viewer does not read the messages, disconnect it.

        Args:
            viewer: The viewer. Its event `wake` is set when there may be messages to send.
            connection: Connection of the viewer.
        """
        try:
            while not self._hub.has_ended:
                await viewer.wake.wait()
                viewer.wake.clear()  # before the messages are collected, so that no later event is missed
                async with asyncio.timeout(SEND_TIMEOUT_S):
                    for message in viewer.messages(time.time()):
                        await connection.send(message)
            await connection.close(CloseCode.SERVICE_RESTART, "the stream has ended")
        except TimeoutError:  # the viewer does not read
            connection.transport.abort()
        except ConnectionClosed:  # the viewer has disconnected
            pass

    async def _handle_message(self, viewer: Viewer, connection: ServerConnection, message: str | bytes) -> None:
        """Handle a confirmation or a request of the page. If this is impossible, send the reason to the page.

        Args:
            viewer: The viewer that has sent the message.
            connection: Connection of the viewer.
            message: The message. A confirmation is of the type bytes, and a request is text.
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
    """Return the subprotocol of the page if the client offers it, and None otherwise."""
    return Subprotocol(PROTOCOL) if PROTOCOL in offered else None


def _last_response(response: Response) -> http11.Response:
    """Convert a response to the response type of the package `websockets`.

    The connection is closed after the response.
    """
    headers = Headers([(name.decode(), value.decode()) for name, value in response.headers])
    headers["Connection"] = "close"
    return http11.Response(response.status, HTTPStatus(response.status).phrase, headers, response.body)


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
