"""Responses as plain values, and the one place where the exception tree becomes statuses and messages, of gRPC too."""

import logging
from typing import Any, NamedTuple

import orjson

from isocharge.common.errors import (
    InputError,
    IsochargeError,
    ModelNotFound,
    OriginError,
    TokenError,
    TooLarge,
    TooMany,
    UnknownEncoding,
    UnknownPath,
    WrongMethod,
)

log = logging.getLogger(__name__)

_STATUS: tuple[tuple[type[Exception], int, str], ...] = (
    (ModelNotFound, 404, "NOT_FOUND"),
    (UnknownPath, 404, "NOT_FOUND"),
    (WrongMethod, 405, "UNIMPLEMENTED"),
    (TooLarge, 413, "RESOURCE_EXHAUSTED"),
    (TooMany, 429, "RESOURCE_EXHAUSTED"),
    (UnknownEncoding, 415, "INVALID_ARGUMENT"),
    (TokenError, 401, "UNAUTHENTICATED"),
    (OriginError, 403, "PERMISSION_DENIED"),
    (InputError, 400, "INVALID_ARGUMENT"),
)
"""Error, HTTP status, gRPC status; the first class that fits counts."""

INTERNAL = "internal error; the server's log says more"
"""The message of an error that isocharge did not raise on purpose."""


def http_status(error: Exception) -> int:
    """The HTTP status of an error; 500 for one that is not the client's."""
    return next((code for kind, code, _ in _STATUS if isinstance(error, kind)), 500)


def grpc_status(error: Exception) -> str:
    """The name of the gRPC status of an error."""
    return next((name for kind, _, name in _STATUS if isinstance(error, kind)), "INTERNAL")


def client_message(error: Exception) -> str:
    """The message that a client gets; an error that isocharge did not raise on purpose goes into the log instead."""
    if isinstance(error, IsochargeError):
        return str(error)
    log.exception("a request failed", exc_info=error)
    return INTERNAL


class Response(NamedTuple):
    """An answer: status, headers, body."""

    status: int
    headers: list[tuple[bytes, bytes]]
    body: bytes


class ErrorResponse(Response):
    """The answer to a request that raised an error, and the kind of it."""

    error: str


def response_of(status: int, content_type: bytes, body: bytes) -> Response:
    """A response with the headers that each one has."""
    return Response(status, [(b"content-type", content_type), (b"content-length", b"%d" % len(body))], body)


def json_response(content: Any, status: int = 200) -> Response:
    """A value as a response in JSON."""
    return response_of(status, b"application/json", orjson.dumps(content))


def refusal(status: int, message: str) -> Response:
    """The response to a request that is not answered: {"error": message}."""
    return json_response({"error": message}, status)


def error_response(error: Exception) -> Response:
    """The response to a request that raised an error."""
    response = ErrorResponse(*refusal(http_status(error), client_message(error)))
    response.error = type(error).__name__
    if isinstance(error, WrongMethod):
        response.headers.append((b"allow", error.allowed.encode()))
    if response.status == 401:
        response.headers.append((b"www-authenticate", b"Bearer"))
    return response
