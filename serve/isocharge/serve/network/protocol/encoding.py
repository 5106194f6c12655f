"""Compressed bodies: gzip and deflate, in both directions, bounded."""

import gzip
import zlib

from isocharge.common.errors import RequestError, TooLarge, UnknownEncoding

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
        raise UnknownEncoding(f"Content-Encoding {_text(encoding)}: expected gzip, deflate or identity")
    reader = zlib.decompressobj(_WINDOW[encoding])
    try:
        plain = reader.decompress(body, limit + 1)
    except zlib.error as error:
        raise RequestError(f"the body is not {_text(encoding)}, as its Content-Encoding says: {error}") from error
    if len(plain) > limit:
        raise TooLarge(f"the body unpacks to more than {limit} bytes; send smaller batches")
    if not reader.eof or reader.unused_data:
        raise RequestError(f"the body ends before, or goes on after, the end of its {_text(encoding)} data")
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
