"""What server and client prove themselves with: TLS from certificate files, and a token, over HTTP and gRPC alike."""

import hmac
import ssl
from dataclasses import dataclass
from pathlib import Path

from isocharge.common.errors import InputError, TokenError
from isocharge.common.files import read_whole


@dataclass(frozen=True)
class Tls:
    """Certificate chain and private key, PEM files; the key may be in the certificate's file."""

    certificate: Path
    key: Path | None = None

    def context(self) -> ssl.SSLContext:
        """A server's TLS context.

        Raises:
            InputError: If a file cannot be read, or they do not belong together.
        """
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            for file in filter(None, (self.certificate, self.key)):
                read_whole(file)  # a pipe would be waited for without end
            context.load_cert_chain(self.certificate, self.key, password=lambda: "")
        except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
            files = f"{self.certificate}" + (f" and {self.key}" if self.key else "")
            raise InputError(
                f"{files}: not a certificate and its unencrypted private key in PEM files that can be read ({error})"
            ) from error
        return context

    def pair(self) -> tuple[bytes, bytes]:
        """The key and the certificate, as gRPC takes them.

        Raises:
            InputError: As `context`.
        """
        self.context()
        return read_whole(self.key or self.certificate), read_whole(self.certificate)


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

    def fits(self, authorization: bytes) -> bool:
        """Whether the value of an Authorization header, empty if there was none, carries the token.

        The name of the scheme has no case (RFC 9110, 11.1).
        """
        scheme, _, token = authorization.partition(b" ")
        given = b"Bearer " + token.lstrip(b" ") if scheme.lower() == b"bearer" else authorization
        return hmac.compare_digest(given, self._expected)

    def check(self, authorization: bytes) -> None:
        """Check the value of an Authorization header.

        Raises:
            TokenError: If it does not carry the token.
        """
        if not self.fits(authorization):
            sent = "a wrong one" if authorization else "none"
            raise TokenError(f"expected the header `Authorization: Bearer TOKEN` with this server's token, got {sent}")
