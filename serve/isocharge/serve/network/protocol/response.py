"""Responses as plain values: status, headers, body; and the one body that every error has."""

from typing import Any, NamedTuple

import orjson

from isocharge.common.errors import WrongMethod
from isocharge.serve.network.protocol.status import client_message, http_status


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
