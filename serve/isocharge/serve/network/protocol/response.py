"""HTTP responses, decompression of requests, and error messages for HTTP and gRPC."""

import logging
import zlib
from typing import Any, NamedTuple

import orjson

from isocharge.common.errors import IsochargeError, RequestError, shown

log = logging.getLogger(__name__)


def refusal(error: Exception) -> tuple[int, str]:
    """Return the HTTP status and the message that report an error to the client.

    Every error other than an IsochargeError is unexpected, and its message may contain secrets. An unexpected error is
    therefore written to the log, and the client receives a general message.
    """
    if isinstance(error, IsochargeError):
        return error.status, str(error)
    log.exception("a request failed", exc_info=error)
    return 500, "internal error; the server's log says more"


Header = tuple[bytes, bytes]
"""Name of a header in lower case, and its value."""


class Response(NamedTuple):
    """HTTP response.

    Attributes:
        status: Status code.
        headers: The headers.
        body: The body.
    """

    status: int
    headers: list[Header]
    body: bytes


def response_of(status: int, content_type: bytes, body: bytes, *headers: Header) -> Response:
    """Return a response that has the headers `content-type` and `content-length`.

    Args:
        status: Status code.
        content_type: Value of the header `content-type`.
        body: Body of the response.
        *headers: Further headers.
    """
    return Response(status, [(b"content-type", content_type), (b"content-length", b"%d" % len(body)), *headers], body)


def json_response(content: Any, status: int = 200, *headers: Header) -> Response:
    """Return a response whose body is the given value in JSON, which may contain arrays of numbers."""
    return response_of(status, b"application/json", orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY), *headers)


def decompress(body: bytes, encoding: bytes, limit: int) -> bytes:
    """Decompress the body of a request.

    Args:
        body: The body, which may be compressed.
        encoding: Value of the header Content-Encoding in lower case. It is empty if the request has no such header.
        limit: Largest size of the decompressed body, bytes. The decompression stops when this size is exceeded.

    Raises:
        RequestError: If the encoding is not gzip, deflate or identity, if the decompressed body is larger than the
            limit, if the compressed data are damaged or incomplete, or if other data follow the compressed data.
    """
    if encoding in (b"", b"identity"):
        return body
    if encoding not in (b"gzip", b"x-gzip", b"deflate"):  # the encoding `deflate` of HTTP is the zlib format
        raise RequestError(
            f"Content-Encoding: expected gzip, deflate or identity, got {shown(encoding.decode('latin-1'))}", 415
        )
    decompressor = zlib.decompressobj(zlib.MAX_WBITS | 32)  # recognises gzip and deflate
    try:
        plain_body = decompressor.decompress(body, limit + 1)  # the additional byte shows that the limit is exceeded
    except zlib.error as error:
        raise RequestError(f"the body is not compressed as its Content-Encoding states: {error}") from error
    if len(plain_body) > limit:
        raise RequestError(f"the body unpacks to more than {limit} bytes; send smaller batches", 413)
    # `eof` is False if the end of the compressed data is missing. `unused_data` are the bytes that follow this end.
    if not decompressor.eof or decompressor.unused_data:
        raise RequestError("the body ends before, or goes on after, the end of its compressed data")
    return plain_body
