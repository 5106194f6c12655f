"""The parsed head of an HTTP/1.1 request, and the conversion of a response to the bytes that are sent."""

import urllib.parse
from functools import lru_cache
from http import HTTPStatus
from typing import NamedTuple

import httptools

from isocharge.serve.network.protocol import Response

STATUS_LINES = {status.value: b"HTTP/1.1 %d %s\r\n" % (status, status.phrase.encode()) for status in HTTPStatus}
"""Status line for each status code."""

CLOSING_HEADER = b"connection: close\r\n\r\n"
"""End of the headers of the last response of a connection."""


class Head(NamedTuple):
    """Request line and headers of a complete request.

    Attributes:
        method: Method in capitals.
        path: Path without query, with percent signs decoded.
        headers: Names in lower case, and values.
        is_last: Whether the client asks to close the connection after the response.
    """

    method: str
    path: str
    headers: list[tuple[bytes, bytes]]
    is_last: bool


def response_bytes(response: Response, *, is_last: bool, with_body: bool = True) -> bytes:
    """Return a response as the bytes that are sent: status line, headers, a blank line, and the body.

    Args:
        response: The response.
        is_last: Whether the connection is closed after the response, which the headers then state.
        with_body: Whether the body is sent. The response to a HEAD request has none.
    """
    parts = [STATUS_LINES[response.status]]
    for name, value in response.headers:
        parts += (name, b": ", value, b"\r\n")
    parts.append(CLOSING_HEADER if is_last else b"\r\n")  # both end with the blank line
    if with_body:
        parts.append(response.body)
    return b"".join(parts)


@lru_cache(64)
def request_path(url: bytes) -> str:
    """Return the path in the target of a request line, after its percent-encoding is decoded."""
    path = httptools.parse_url(url).path or b"/"
    return urllib.parse.unquote_to_bytes(path).decode("utf-8", "replace")
