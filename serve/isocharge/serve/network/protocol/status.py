"""What an error is to a client: the one place where the exception tree becomes status codes."""

from isocharge.errors import InputError, ModelNotFound, TokenError, TooLarge, UnknownEncoding, UnknownPath, WrongMethod

_STATUS: tuple[tuple[type[Exception], int, str], ...] = (
    (ModelNotFound, 404, "NOT_FOUND"),
    (UnknownPath, 404, "NOT_FOUND"),
    (WrongMethod, 405, "UNIMPLEMENTED"),
    (TooLarge, 413, "RESOURCE_EXHAUSTED"),
    (UnknownEncoding, 415, "INVALID_ARGUMENT"),
    (TokenError, 401, "UNAUTHENTICATED"),
    (InputError, 400, "INVALID_ARGUMENT"),
)
"""The first class that fits counts."""

INTERNAL = "internal error; the server's log says more"
"""What a client is told about an error that is none of ours."""


def http_status(error: Exception) -> int:
    """The HTTP status of an error; 500 for one that is not the client's."""
    return next((code for kind, code, _ in _STATUS if isinstance(error, kind)), 500)


def grpc_status(error: Exception) -> str:
    """The name of the gRPC status of an error."""
    return next((name for kind, _, name in _STATUS if isinstance(error, kind)), "INTERNAL")
