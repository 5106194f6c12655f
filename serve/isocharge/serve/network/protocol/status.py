"""HTTP and gRPC statuses of errors: the one place where the exception tree becomes status codes and messages."""

import logging

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
