"""Responses as plain values, and the one place where the exception tree becomes statuses and messages, of gRPC too."""

import logging
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
