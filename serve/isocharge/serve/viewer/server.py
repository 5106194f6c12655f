"""The page's server: its files and the description of the film over HTTP, samples by WebSocket, to those who may.

The server is that of the package `websockets`, one request of HTTP for each connection. It bounds the head of a request
(8 KiB a line, 128 lines), the time for it, the size of a message, and asks each viewer for a sign of life. The rest is
bounded here: how many viewers there are, how much they send, and how long they take nothing.

A browser sends no Authorization header with a WebSocket, so the page sends its token as a subprotocol, `bearer.TOKEN`
in base64url; other clients send the header. Any page in the world may try to open a WebSocket to this machine;
`isocharge.serve.network.browser_check` refuses pages of other sites.
"""

import asyncio
import base64
import binascii
import contextlib
import json
import logging
import secrets
import socket
import time
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from http import HTTPStatus
from pathlib import Path

from websockets import http11
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
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
"""The subprotocol of the page."""

BEARER = "bearer."


class Access:
    """Checks whether a request for data may be answered.

    Args:
        token: Token that requests must carry; None answers everybody.
        host: Name or address on which the page is served.
    """

    def __init__(self, token: Token | None = None, host: str = "127.0.0.1") -> None:
        self._token = token
        self._browser_check = BrowserCheck(host, any_host=token is not None)

    def check(self, headers: Mapping[bytes, bytes], subprotocols: Iterable[str] = ()) -> None:
        """Check a request for data.

        Args:
            headers: Values by name in lower case.
            subprotocols: Subprotocols that a WebSocket offers.

        Raises:
            OriginError: If a page of another site sent the request.
            TokenError: If it does not carry the token.
        """
        self._browser_check.check("GET", headers)
        if self._token is not None:
            self._token.check(headers.get(b"authorization", b"") or _bearer(subprotocols))


def _bearer(subprotocols: Iterable[str]) -> bytes:
    """The Authorization header that a subprotocol stands for."""
    for offered in subprotocols:
        if offered.startswith(BEARER):
            text = offered.removeprefix(BEARER)
            try:
                return b"Bearer " + base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
            except (binascii.Error, ValueError):
                return b"Bearer"
    return b""


SESSION, LIVE = "/session.json", "/live"
"""Paths of the description and of the WebSocket."""

VIEWERS = 32
"""Browsers at a time."""

BYTES_AT_ONCE, BYTES_PER_S = 1 << 16, 1 << 14
"""What a connection may send at once and in the long run, 1/s: the page sends 1 kB/s, and no request is larger."""

MESSAGE_BYTES = 1 << 12
"""Largest message of a viewer."""

REQUEST_S, SIGN_OF_LIFE_S, TAKE_S, CLOSE_S = 10.0, 20.0, 30.0, 2.0
"""Time for a request; between signs of life, and for one; to take what was sent; to say goodbye, s."""

TYPES = {
    ".html": b"text/html; charset=utf-8",
    ".css": b"text/css; charset=utf-8",
    ".js": b"text/javascript; charset=utf-8",
    ".svg": b"image/svg+xml",
    ".LICENSE": b"text/plain; charset=utf-8",
}
"""Content type by the end of a file's name."""

POLICY = (
    b"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; "
    b"base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What a browser may load: our own files, and nothing from anywhere else."""

SILENT = logging.getLogger("isocharge.serve.viewer.websockets")
"""Mistakes of clients are answered, not logged."""
SILENT.setLevel(logging.CRITICAL)


class Budget:
    """How many bytes a client may still send: `at_once`, and `per_s` more each second."""

    def __init__(self, at_once: float, per_s: float, now_s: float) -> None:
        self._most = self._left = at_once
        self._per_s, self._counted_s = per_s, now_s

    def spend(self, count: int, now_s: float) -> bool:
        """Count bytes; False if they are too many."""
        self._left = min(self._most, self._left + max(now_s - self._counted_s, 0.0) * self._per_s) - count
        self._counted_s = now_s
        return self._left >= 0.0


class PageConnection(ServerConnection):
    """A connection that ends when its client sends too much: of every frame each byte counts, also of a ping."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to count."""
        self._budget = Budget(BYTES_AT_ONCE, BYTES_PER_S, time.monotonic())
        super().connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """Count, and take; no more from a client that does not read what it is sent, which would fill the memory."""
        if not self._budget.spend(len(data), time.monotonic()):
            self.transport.abort()
            return
        super().data_received(data)
        if self.paused:
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        """The client reads again."""
        super().resume_writing()
        self.transport.resume_reading()


class PageServer:
    """Answers browsers."""

    def __init__(self, hub: Hub, access: Access) -> None:
        self._hub, self._access = hub, access
        self._files = page_files()
        self._id = secrets.token_hex(8)

    @contextlib.asynccontextmanager
    async def listening(self, listening: socket.socket) -> AsyncIterator[None]:
        """Answer while the block runs."""
        async with serve(
            self._follow,
            sock=listening,
            process_request=self._answer,
            select_subprotocol=_our_protocol,
            compression=None,
            server_header=None,
            open_timeout=REQUEST_S,
            ping_interval=SIGN_OF_LIFE_S,
            ping_timeout=SIGN_OF_LIFE_S,
            close_timeout=CLOSE_S,
            max_size=MESSAGE_BYTES,
            logger=SILENT,
            create_connection=PageConnection,
        ):
            yield

    def _answer(self, _connection: ServerConnection, request: http11.Request) -> http11.Response | None:
        """A file of the page, which everybody may have, or the description of the film; None lets a viewer in."""
        try:
            path = request.path.partition("?")[0]
            if path in self._files:
                return _to_send(self._files[path])
            if path not in (SESSION, LIVE):
                raise UnknownPath(f"nothing is served under {path[:200]!r}; the page is /")
            items = request.headers.raw_items()
            headers = {name.lower().encode(): value.encode("ascii", "surrogateescape") for name, value in items}
            offered = ",".join(request.headers.get_all("Sec-WebSocket-Protocol")).split(",")
            self._access.check(headers, map(str.strip, offered))
            if path == SESSION:
                return _to_send(self._session())
            if len(self._hub.viewers) >= VIEWERS:
                raise TooMany(f"all {VIEWERS} places for viewers are taken; close a page that nobody looks at")
            return None
        except Exception as error:  # whatever it is, one request fails and the log says why
            return _to_send(error_response(error))

    def _session(self) -> Response:
        response = json_response(
            {
                "id": self._id,
                "is_replay": self._hub.is_replay,
                "film": self._hub.description,
                "flags": [{"word": word, "bit": FLAG_BITS[word], "says": says} for word, says in MEANINGS.items()],
            }
        )
        response.headers.append((b"cache-control", b"no-store"))
        return response

    async def _follow(self, connection: ServerConnection) -> None:
        """Send samples to a viewer and take its requests until it goes."""
        viewer = Viewer(self._hub)
        self._hub.viewers.add(viewer)
        sender = asyncio.create_task(self._send(viewer, connection))
        try:
            async for message in connection:
                await self._take(viewer, connection, message)
        except ConnectionClosed:
            pass
        finally:
            self._hub.viewers.discard(viewer)
            sender.cancel()

    async def _send(self, viewer: Viewer, connection: ServerConnection) -> None:
        """Send what there is; a viewer that does not take it is left."""
        try:
            while not self._hub.has_ended:
                await viewer.wake.wait()
                viewer.wake.clear()
                async with asyncio.timeout(TAKE_S):
                    for message in viewer.messages(time.time()):
                        await connection.send(message)
            await connection.close(1012, "the stream has ended")
        except TimeoutError:
            connection.transport.abort()
        except ConnectionClosed:
            pass

    async def _take(self, viewer: Viewer, connection: ServerConnection, message: str | bytes) -> None:
        """Do what the page says; what is no request is answered with the reason."""
        try:
            if isinstance(message, bytes):
                viewer.confirm(confirmed_number(message))
                return
            request = parse_json(message, "", RequestError, self._hub.requests)
            if not self._hub.do(request, viewer):
                raise RequestError("the stream has ended, or does not answer")
        except RequestError as error:
            await connection.send(json.dumps({"error": str(error)}))


def _our_protocol(_connection: ServerConnection, offered: Sequence[Subprotocol]) -> Subprotocol | None:
    return Subprotocol(PROTOCOL) if PROTOCOL in offered else None


def _to_send(response: Response) -> http11.Response:
    """A response as `websockets` sends it, the last one of its connection."""
    headers = Headers([(name.decode(), value.decode()) for name, value in response.headers])
    headers["Connection"] = "close"
    return http11.Response(response.status, HTTPStatus(response.status).phrase, headers, response.body)


def page_files() -> dict[str, Response]:
    """The answer to each path; `/` is the page."""
    folder = Path(__file__).with_name("page")
    paths = [path for path in folder.rglob("*") if path.is_file()]
    answers = {f"/{path.relative_to(folder).as_posix()}": _file_response(path) for path in paths}
    return answers | {"/": answers["/index.html"]}


def _file_response(path: Path) -> Response:
    response = response_of(200, TYPES[path.suffix], path.read_bytes())
    others = [header for header in PAGE_HEADERS if header[0] != b"content-security-policy"]
    response.headers.extend([(b"content-security-policy", POLICY), (b"cache-control", b"no-cache"), *others])
    return response
