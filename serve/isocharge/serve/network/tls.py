"""TLS from certificate files, for the HTTP and the gRPC server."""

import ssl
from dataclasses import dataclass
from pathlib import Path

from isocharge.common.errors import InputError
from isocharge.common.files import read_whole

WRONG_DATES = (9, 10)
"""OpenSSL's numbers for certificates that are not valid yet, and no more."""

TURNS = 4
"""Messages of a handshake in each direction, and to spare."""


@dataclass(frozen=True)
class Tls:
    """Certificate chain and private key, PEM files; the key may be in the certificate's file."""

    certificate: Path
    key: Path | None = None

    def context(self) -> ssl.SSLContext:
        """A server's TLS context.

        Raises:
            InputError: If a file cannot be read, they do not belong together, or the certificate is out of date.
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
        self._check_dates()
        return context

    def _check_dates(self) -> None:
        """Refuse a certificate that every client will refuse for its dates, by a handshake with ourselves in memory."""
        client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        client.check_hostname, server = False, ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        client.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # the certificate itself is the one to trust
        server.load_cert_chain(self.certificate, self.key, password=lambda: "")
        try:
            client.load_verify_locations(self.certificate)
            _shake_hands(client, server)
        except ssl.SSLCertVerificationError as error:
            if error.verify_code in WRONG_DATES:
                raise InputError(
                    f"{self.certificate}: expected a certificate that is valid today, got one of which a client says: "
                    f"{error.verify_message}; renew it"
                ) from error
        except ssl.SSLError:
            pass  # what else a client may say of it is between the client and its trust

    def pair(self) -> tuple[bytes, bytes]:
        """The key and the certificate, as gRPC takes them.

        Raises:
            InputError: As `context`.
        """
        self.context()
        return read_whole(self.key or self.certificate), read_whole(self.certificate)


def _shake_hands(client: ssl.SSLContext, server: ssl.SSLContext) -> None:
    """A TLS handshake between two contexts of this process.

    Raises:
        SSLError: If the client refuses.
    """
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(to_client, to_server),
        server.wrap_bio(to_server, to_client, server_side=True),
    ]
    for _ in range(TURNS):
        for end in list(ends):
            try:
                end.do_handshake()
                ends.remove(end)
            except ssl.SSLWantReadError:
                pass
