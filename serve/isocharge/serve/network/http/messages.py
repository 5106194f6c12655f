"""Head of an HTTP/1.1 request, and functions that decode the path of a request and encode a response."""

import urllib.parse
from functools import lru_cache
from http import HTTPStatus
from typing import NamedTuple

import httptools

from isocharge.serve.network.protocol import Response

STATUS_LINES = {status.value: b"HTTP/1.1 %d %s\r\n" % (status, status.phrase.encode()) for status in HTTPStatus}
"""Status line of a response, by status code."""

CLOSING_HEADER = b"connection: close\r\n\r\n"
"""End of the headers of the last response on a connection. It announces that the connection is closed afterwards."""


class Head(NamedTuple):
    """Head of a complete request, which consists of the request line and the headers.

    Attributes:
        method: Method in capitals.
        path: Path without the query. Its percent-encoding is decoded.
        headers: Pairs of the name of a header in lower case and its value.
        is_last: Whether the client has asked to close the connection after the response.
    """

    method: str
    path: str
    headers: list[tuple[bytes, bytes]]
    is_last: bool


def response_bytes(response: Response, *, is_last: bool, with_body: bool = True) -> bytes:
    """Encode a response as the bytes that are sent to the client.

    The bytes are the status line, the headers, a blank line and the body.

    Args:
        response: The response.
        is_last: Whether the connection is closed after the response. In this case, a header announces the end.
        with_body: Whether the body is sent. The body of a response to a HEAD request is not sent.
    """
    parts = [STATUS_LINES[response.status]]
    for name, value in response.headers:
        parts += (name, b": ", value, b"\r\n")
    parts.append(CLOSING_HEADER if is_last else b"\r\n")  # both end with the blank line after the headers
    if with_body:
        parts.append(response.body)
    return b"".join(parts)


@lru_cache(64)
def request_path(url: bytes) -> str:
    """Return the path of a request target after decoding its percent-encoding.

    Args:
        url: Target of the request line, which may also contain a query.
    """
    path = httptools.parse_url(url).path or b"/"
    return urllib.parse.unquote_to_bytes(path).decode("utf-8", "replace")
