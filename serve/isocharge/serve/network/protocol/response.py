"""Responses as plain values, and the one place where the exception tree becomes statuses and messages, of gRPC too.

Bodies may be compressed, gzip and deflate, in both directions, bounded.
"""

import gzip
import logging
import zlib
from typing import Any, NamedTuple

import orjson

from isocharge.common import errors

log = logging.getLogger(__name__)

_STATUS: tuple[tuple[type[Exception], int, str], ...] = (
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
"""Error, HTTP status, gRPC status; the first class that fits counts."""

INTERNAL = "internal error; the server's log says more"
"""The message of an error that isocharge did not raise on purpose."""


def statuses(error: Exception) -> tuple[int, str]:
    """The HTTP status of an error, and the name of its gRPC status."""
    return next((code, name) for kind, code, name in _STATUS if isinstance(error, kind))


def client_message(error: Exception) -> str:
    """The message that a client gets; an error that isocharge did not raise on purpose goes into the log instead."""
    if isinstance(error, errors.IsochargeError):
        return str(error)
    log.exception("a request failed", exc_info=error)
    return INTERNAL


class Response(NamedTuple):
    """An answer: status, headers, body; and the kind of the error, if it is one."""

    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes
    error: str | None = None


def response_of(status: int, content_type: bytes, body: bytes, error: str | None = None) -> Response:
    """A response with the headers that each one has."""
    return Response(status, [(b"content-type", content_type), (b"content-length", b"%d" % len(body))], body, error)


def json_response(content: Any) -> Response:
    """A value as a response in JSON."""
    return response_of(200, b"application/json", orjson.dumps(content))


def refusal(status: int, message: str, error: str | None = None) -> Response:
    """The response to a request that is not answered: {"error": message}."""
    return response_of(status, b"application/json", orjson.dumps({"error": message}), error)


def error_response(error: Exception) -> Response:
    """The response to a request that raised an error."""
    response = refusal(statuses(error)[0], client_message(error), type(error).__name__)
    if isinstance(error, errors.WrongMethod):
        response.headers.append((b"allow", error.allowed.encode()))
    if isinstance(error, errors.TokenError):
        response.headers.append((b"www-authenticate", b"Bearer"))
    return response


WORTH_BYTES = 1024
"""Size from which an answer is compressed, bytes: to send a shorter one is faster than to set up a compressor."""

_WINDOW = {b"gzip": 31, b"x-gzip": 31, b"deflate": 15}
"""zlib's `wbits` of each encoding; HTTP's deflate is the zlib format."""


def decompress(body: bytes, encoding: bytes, limit: int) -> bytes:
    """Undo the Content-Encoding of a request.

    Args:
        body: As it came.
        encoding: Value of the header, lower case.
        limit: Largest size of the result; nothing beyond it is ever unpacked.

    Raises:
        UnknownEncoding: If it is neither gzip, deflate nor identity.
        TooLarge: If the result is larger than the limit.
        RequestError: If the data are damaged, cut short, or go on after their end.
    """
    if encoding in (b"", b"identity"):
        return body
    if encoding not in _WINDOW:
        raise errors.UnknownEncoding(f"Content-Encoding {_text(encoding)}: expected gzip, deflate or identity")
    reader = zlib.decompressobj(_WINDOW[encoding])
    try:
        plain = reader.decompress(body, limit + 1)
    except zlib.error as error:
        raise errors.RequestError(
            f"the body is not {_text(encoding)}, as its Content-Encoding says: {error}"
        ) from error
    if len(plain) > limit:
        raise errors.TooLarge(f"the body unpacks to more than {limit} bytes; send smaller batches")
    if not reader.eof or reader.unused_data:
        raise errors.RequestError(f"the body ends before, or goes on after, the end of its {_text(encoding)} data")
    return plain


def compress(body: bytes, accepted: bytes) -> tuple[bytes, bytes]:
    """Compress an answer if its client takes that and it is worth it.

    Args:
        body: As it is.
        accepted: The request's Accept-Encoding.

    Returns:
        The body and its Content-Encoding, empty if it stays as it is.
    """
    names = _accepted(accepted) if len(body) >= WORTH_BYTES else ()
    if b"gzip" in names:
        return gzip.compress(body, compresslevel=1, mtime=0), b"gzip"
    if b"deflate" in names:
        return zlib.compress(body, level=1), b"deflate"
    return body, b""


def _accepted(header: bytes) -> set[bytes]:
    """Names in an Accept-Encoding that are not weighted zero."""
    parts = [part.replace(b" ", b"").lower().partition(b";q=") for part in header.split(b",")]
    return {name for name, _, weight in parts if weight.strip(b"0.") or not weight}


def _text(encoding: bytes) -> str:
    return repr(encoding.decode("latin-1"))[:50]
