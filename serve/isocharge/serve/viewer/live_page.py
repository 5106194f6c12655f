"""Live page, which shows the samples of a stream in browsers.

The page is an HTTP server in a thread of the program that reads the stream. The server sends the files of the page
and, under `SESSION_PATH`, the description of the film. A browser regularly posts a request to `REQUEST_PATH`. A request
is a JSON object, such as {"do": "marker", "text": "here"}. Each kind of request is a class in this module. The value of
`do` is the class name in lower case.

The request `Read` asks for the samples that the browser does not have yet. If there are more samples than a browser can
show, several samples are coalesced into one sample. A slow browser therefore receives fewer samples, and no queue of
messages for a slow browser exists.
"""

import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from threading import Lock, Thread
from typing import Annotated, Any

from msgspec import Meta, Struct

from isocharge.common.errors import RequestError, is_printable
from isocharge.common.structs import Finite, WrongKey, parse_json
from isocharge.serve.flags import MEANINGS
from isocharge.serve.network.address import Address, ServerLimits, Tls
from isocharge.serve.network.browser_check import AccessCheck, Headers
from isocharge.serve.network.http.server import HttpServer
from isocharge.serve.network.metrics import Traffic
from isocharge.serve.network.protocol.handler import Application, check_method
from isocharge.serve.network.protocol.response import Response, json_response, response_of
from isocharge.serve.record.record import PredictionRecord
from isocharge.serve.viewer.tape import (
    FLAG_BITS,
    HISTORY_S,
    MAX_DRAWN_SAMPLES,
    RecordedTape,
    Tape,
    coalesce,
    sample_type,
    sample_values,
)

SESSION_PATH = "/session.json"
"""Path of the description of the stream and its film."""

REQUEST_PATH = "/request"
"""Path to which a browser posts its requests."""

PAGE_LIMITS = ServerLimits(body_bytes=1 << 12, connections=64)
"""Limits of the server of the page. A browser uses one or two connections, and its requests are short."""

MAX_MARKERS = 200
"""Largest number of markers that the page shows. The page shows the latest markers."""

MAX_MARKER_CHARACTERS = 80
"""Largest number of characters in the text of a marker."""


class PageRequest(Struct, forbid_unknown_fields=True, tag_field="do", tag=str.lower):
    """Base class of all requests that a browser can send."""


class Read(PageRequest):
    """Request for samples.

    Attributes:
        first: Number of the first sample that the browser does not have. By default, the samples of the last
            `HISTORY_S` seconds are returned.
        until_s: Time since the start of a recording, s. Later samples are not returned.
        version: Version of the state that the browser has.
        most: Largest number of samples to return.
    """

    first: Annotated[int, Meta(ge=0, le=1 << 53)] | None = None
    until_s: Finite | None = None
    version: int = -1
    most: Annotated[int, Meta(ge=1, le=MAX_DRAWN_SAMPLES)] = MAX_DRAWN_SAMPLES


class Tare(PageRequest):
    """Request to measure the tare again."""


class Record(PageRequest):
    """Request to begin or end a recording.

    Attributes:
        on: True to begin a recording, and False to end the present recording.
    """

    on: bool


class Marker(PageRequest):
    """Request to add a marker with a text at the present time of the stream."""

    text: str = ""

    def __post_init__(self) -> None:
        """Check the text, which is shown on the page and stored in the recording.

        Raises:
            WrongKey: If the text is too long, or contains characters that are not printable.
        """
        if len(self.text) > MAX_MARKER_CHARACTERS or not is_printable(self.text):
            raise WrongKey("text", f"at most {MAX_MARKER_CHARACTERS} printable characters", self.text)


Action = Tare | Record | Marker
"""Requests that change the stream."""


class LivePage(Application):
    """Live page of one stream, which stores the samples and answers the requests of browsers.

    The thread that reads the stream calls `add`. The thread of the server calls `answer`. Any thread may call `update`.

    Attributes:
        tape: The stored samples of the stream.
        act: Function that carries out the requests that change the stream. None if such requests are refused.
    """

    limits = PAGE_LIMITS

    def __init__(self, description: dict[str, Any], access: AccessCheck, *, is_recording: bool = False) -> None:
        """Create a page without samples.

        For a recording, all samples are stored, and each browser may select a position in the recording. For a live
        stream, only the latest samples are stored.

        Args:
            description: Description of the film, as `describe_film` returns it.
            access: Check of the token, and of the web page that has sent a request.
            is_recording: Whether the stream is a recording.
        """
        self._electrodes = description["electrodes"]
        dtype = sample_type(self._electrodes)
        self.tape: Tape = RecordedTape(dtype) if is_recording else Tape(dtype)
        self.act: Callable[[Action], None] | None = None  # carries out the requests of browsers; None refuses them
        self.traffic = Traffic()  # counts the requests, for the server
        self._access = access
        self._state: dict[str, Any] = {}
        self._state_lock = Lock()  # the thread of the stream and the thread of the server change the state
        self._version = 0  # number of times that the state has changed
        self._files = _page_files()
        self._session = {
            "id": secrets.token_hex(8),  # a browser that connects again recognises another stream
            "is_replay": is_recording,
            "film": description,
            "columns": dtype.names,
            "flags": [{"word": flag, "bit": FLAG_BITS[flag], "says": meaning} for flag, meaning in MEANINGS.items()],
        }

    def add(self, record: PredictionRecord) -> None:
        """Store the sample of a record."""
        self.tape.append(sample_values(record, self._electrodes))

    def update(self, **values: Any) -> None:
        """Replace values of the state, such as counters. The page shows the state beside the samples."""
        with self._state_lock:
            self._state = self._state | values
            self._version += 1

    def add_marker(self, marker: tuple[float, str]) -> None:
        """Add a marker to the markers that the page shows. A marker consists of a Unix time (s) and a text."""
        earlier_markers = self._state.get("markers", [])
        self.update(markers=[*earlier_markers, tuple(marker)][-MAX_MARKERS:])  # JSON accepts no named tuple

    def _check_and_answer(self, method: str, path: str, headers: Headers, body: bytes) -> Response:
        """Check whether a request is allowed, and return the response. The files of the page need no token.

        Raises:
            IsochargeError: If the request is refused.
        """
        if path in self._files:
            return self._files[path]
        self._access.check(method, headers)
        if path == SESSION_PATH:
            return json_response(self._session)
        if path != REQUEST_PATH:
            raise RequestError(f"nothing is served under {path[:200]!r}; the page is /", 404)
        check_method(path, method, "POST")
        # The empty text would be the name of a file in the messages of errors.
        request = parse_json(body, "", RequestError, Read | Action)  # type: ignore[arg-type]
        if isinstance(request, Read):
            return json_response(self._read(request))
        if self.act is None:
            raise RequestError("expected the request read, because a recording cannot be changed")
        self.act(request)
        return json_response({})

    def _read(self, request: Read) -> dict[str, Any]:
        """Return the samples that a browser does not have yet, and the state of the stream if the state has changed.

        If the request does not state the first sample, the samples of the last `HISTORY_S` seconds are returned. At
        most `request.most` samples are returned. Samples are numbered from the beginning of the stream.
        """
        tape = self.tape
        version = self._version  # read before the state, so that a change in the meantime is sent with the next request
        stop_number = tape.total  # number after that of the last sample to return
        oldest_time_s, end_s = tape.span()  # unix times of the oldest and the latest sample
        if request.until_s is not None:  # the browser shows an earlier part of a recording
            end_s = oldest_time_s + request.until_s
            stop_number = tape.first_number_after(end_s)
        first_number = tape.first_number_after(end_s - HISTORY_S) if request.first is None else request.first
        samples = coalesce(tape.samples(first_number, stop_number), request.most)
        content: dict[str, Any] = {
            "first": stop_number,  # number of the first sample of the next request
            "missed": max(tape.oldest - first_number, 0),  # overwritten before the browser asked for them
            "sent_s": time.time(),
            "samples": samples.tolist(),
        }
        if version != request.version:
            # `extent` describes a recording, and is empty for a live stream.
            content |= {"version": version, "state": self._state | tape.extent()}
        return content


@contextmanager
def serve_page(page: LivePage, address: Address, tls: Tls | None = None) -> Iterator[str]:
    """Context manager that serves a page in a separate thread, and yields the URL of the page.

    Args:
        page: The page.
        address: Address on which the server listens.
        tls: Certificate and private key for TLS, or None to serve the page without TLS.

    Raises:
        InputError: If the TLS files cannot be used.
        ListenError: If the address is in use or cannot be used.
    """
    with closing(HttpServer(page, address, tls)) as server:
        thread = Thread(target=server.run, name="live page", daemon=True)
        thread.start()
        try:
            yield server.url
        finally:
            server.stop()
            thread.join()


CONTENT_TYPES = {
    ".html": b"text/html; charset=utf-8",
    ".css": b"text/css; charset=utf-8",
    ".js": b"text/javascript; charset=utf-8",
    ".svg": b"image/svg+xml",
    ".LICENSE": b"text/plain; charset=utf-8",
}
"""Content type by the suffix of a file name."""

PAGE_HEADERS = [
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self'; "
        b"base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    (b"cache-control", b"no-cache"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
]
"""Headers of every file of the page. With the content security policy, a browser loads only files of this server."""


def _page_files() -> dict[str, Response]:
    """Return the response for each file of the page, by the path of the file. The path `/` is the HTML file."""
    folder = Path(__file__).with_name("page")
    responses = {}
    for path in folder.rglob("*"):
        if path.suffix in CONTENT_TYPES:  # other files belong to the operating system, such as .DS_Store
            response = response_of(200, CONTENT_TYPES[path.suffix], path.read_bytes(), *PAGE_HEADERS)
            responses[f"/{path.relative_to(folder).as_posix()}"] = response
    responses["/"] = responses["/index.html"]
    return responses
