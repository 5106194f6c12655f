"""HTTP responses, decompression of requests, and statuses of errors for HTTP and gRPC."""

import logging
import zlib
from typing import Any, NamedTuple

import orjson

from isocharge.common import errors

log = logging.getLogger(__name__)

_STATUSES = (
    (errors.ModelNotFound, 404, "NOT_FOUND"),
    (errors.UnknownPath, 404, "NOT_FOUND"),
    (errors.WrongMethod, 405, "UNIMPLEMENTED"),
    (errors.TooLarge, 413, "RESOURCE_EXHAUSTED"),
    (errors.TooMany, 429, "RESOURCE_EXHAUSTED"),
    (errors.UnknownEncoding, 415, "INVALID_ARGUMENT"),
    (errors.TokenError, 401, "UNAUTHENTICATED"),
    (errors.OriginError, 403, "PERMISSION_DENIED"),
    (errors.InputError, 400, "INVALID_ARGUMENT"),
    (Exception, 500, "INTERNAL"),
)
"""Each row contains a class of errors, their HTTP status and their gRPC status.

For a given error, the first row with a matching class is used.
"""


def refusal(error: Exception) -> tuple[int, str, str]:
    """Return the HTTP status, the name of the gRPC status and the message that report an error to the client.

    Every error other than an IsochargeError is unexpected, and its message may contain secrets. An unexpected error is
    therefore written to the log, and the client receives a general message.
    """
    message = str(error)
    if not isinstance(error, errors.IsochargeError):
        log.exception("a request failed", exc_info=error)
        message = "internal error; the server's log says more"
    return next(
        (http_status, grpc_status, message)
        for error_class, http_status, grpc_status in _STATUSES
        if isinstance(error, error_class)
    )


class Response(NamedTuple):
    """HTTP response.

    Attributes:
        status: Status code.
        headers: Pairs of the name of a header in lower case and its value.
        body: The body.
        error: Name of the type of the error, for the log. None if no error occurred.
    """

    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes
    error: str | None = None


def response_of(status: int, content_type: bytes, body: bytes) -> Response:
    """Return a response that has the headers `content-type` and `content-length`.

    Args:
        status: Status code.
        content_type: Value of the header `content-type`.
        body: Body of the response.
    """
    headers = [(b"content-type", content_type), (b"content-length", b"%d" % len(body))]
    return Response(status, headers, body)


def json_response(content: Any, status: int = 200) -> Response:
    """Return a response whose body is the given value in JSON. The body of a refusal is {"error": message}."""
    return response_of(status, b"application/json", orjson.dumps(content))


def error_response(error: Exception) -> Response:
    """Return the response to a request that could not be answered because of an error.

    The body of the response contains the message of the error. If the HTTP method is wrong, the header `Allow` contains
    the allowed method. If the token is missing or wrong, the header `WWW-Authenticate` contains the required kind of
    authentication.
    """
    http_status, _, message = refusal(error)  # the status of gRPC is not needed
    response = json_response({"error": message}, http_status)
    if isinstance(error, errors.WrongMethod):
        response.headers.append((b"allow", error.allowed.encode()))
    if isinstance(error, errors.TokenError):
        response.headers.append((b"www-authenticate", b"Bearer"))
    return response._replace(error=type(error).__name__)


def decompress(body: bytes, encoding: bytes, limit: int) -> bytes:
    """Decompress the body of a request.

    Args:
        body: The body, which may be compressed.
        encoding: Value of the header Content-Encoding in lower case. It is empty if the request has no such header.
        limit: Largest size of the decompressed body, bytes. The decompression stops when this size is exceeded.

    Raises:
        UnknownEncoding: If the encoding is not gzip, deflate or identity.
        TooLarge: If the decompressed body is larger than the limit.
        RequestError: If the compressed data are damaged or incomplete, or if other data follow them.
    """
    if encoding in (b"", b"identity"):
        return body
    if encoding not in (b"gzip", b"x-gzip", b"deflate"):  # the encoding `deflate` of HTTP is the zlib format
        name = errors.shown(encoding.decode("latin-1"))
        raise errors.UnknownEncoding(f"Content-Encoding: expected gzip, deflate or identity, got {name}")
    decompressor = zlib.decompressobj(zlib.MAX_WBITS | 32)  # recognises gzip and deflate
    try:
        plain_body = decompressor.decompress(body, limit + 1)  # the additional byte shows that the limit is exceeded
    except zlib.error as error:
        raise errors.RequestError(f"the body is not compressed as its Content-Encoding states: {error}") from error
    if len(plain_body) > limit:
        raise errors.TooLarge(f"the body unpacks to more than {limit} bytes; send smaller batches")
    # `eof` is False if the end of the compressed data is missing. `unused_data` are the bytes that follow this end.
    if not decompressor.eof or decompressor.unused_data:
        raise errors.RequestError("the body ends before, or goes on after, the end of its compressed data")
    return plain_body
