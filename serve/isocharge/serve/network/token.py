"""The token that a server asks of its clients: `Authorization: Bearer TOKEN`, over HTTP and gRPC alike."""

import hmac

from isocharge.common.errors import InputError, TokenError


class Token:
    """A secret that clients must know; it is compared in a time that does not depend on how much of it is right."""

    def __init__(self, token: str) -> None:
        """Keep the token.

        Raises:
            InputError: If it is empty, or has characters that no header can carry.
        """
        if not token or not token.isascii() or not token.isprintable() or token != token.strip():
            raise InputError(
                "token: expected printable ASCII characters without blanks at the ends; choose another one"
            )
        self._expected = b"Bearer " + token.encode()

    def check(self, authorization: bytes) -> None:
        """Check the value of an Authorization header, empty if there was none.

        The name of the scheme has no case (RFC 9110, 11.1).

        Raises:
            TokenError: If it does not carry the token.
        """
        scheme, _, token = authorization.partition(b" ")
        given = b"Bearer " + token.lstrip(b" ") if scheme.lower() == b"bearer" else authorization
        if not hmac.compare_digest(given, self._expected):
            sent = "a wrong one" if authorization else "none"
            raise TokenError(f"expected the header `Authorization: Bearer TOKEN` with this server's token, got {sent}")
