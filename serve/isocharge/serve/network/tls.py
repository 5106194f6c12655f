"""TLS from certificate files, for the HTTP and the gRPC server."""

import ssl
from dataclasses import dataclass
from pathlib import Path

from isocharge.errors import InputError


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
        return (self.key or self.certificate).read_bytes(), self.certificate.read_bytes()
