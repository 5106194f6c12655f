"""Settings of the HTTP and the gRPC server: address, TLS certificate, token, and limits.

By default, a server listens on the loopback address, so that only programs on the same machine can connect.
"""

import contextlib
import errno
import hmac
import ipaddress
import os
import socket
import ssl
import stat
from dataclasses import dataclass
from pathlib import Path

from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import InputError, ListenError, TokenError, TooLarge
from isocharge.common.files import read_whole

LISTEN_ERRORS = {
    errno.EADDRINUSE: "another program listens there; stop it or choose another port",
    errno.EADDRNOTAVAIL: "this machine has no such address; choose one that it has",
    errno.EACCES: "this user may not listen there; choose another place, or a port above 1023",
}
"""Cause and advice for the error numbers of the operating system when a server cannot listen."""


@dataclass(frozen=True)
class Address:
    """Address on which a server listens.

    Attributes:
        host: Name or IP address.
        port: TCP port; 0 selects a free port.
        uds: Path of a Unix socket, which is used instead of host and port. Only its owner can connect.
    """

    host: str = "127.0.0.1"
    port: int = 0
    uds: Path | None = None

    @property
    def is_private(self) -> bool:
        """Whether only this machine can connect."""
        address = ip_address(self.host)
        return self.uds is not None or self.host == "localhost" or (address is not None and address.is_loopback)

    def listen(self, backlog: int) -> socket.socket:
        """Open a Unix or TCP socket that listens on this address, and return it.

        Args:
            backlog: Largest number of connections that wait to be accepted.

        Raises:
            ListenError: If the address is in use or cannot be used. The message states what to do.
        """
        try:
            if self.uds is not None:
                return _listen_unix(self.uds, backlog)
            # create_server sets SO_REUSEADDR, so that a port can be used again right after a server was killed.
            is_ipv6 = ":" in self.host
            family = socket.AF_INET6 if is_ipv6 else socket.AF_INET
            return socket.create_server((self.host, self.port), family=family, backlog=backlog)
        except ListenError:  # from _listen_unix; its message already states what to do
            raise
        except (OSError, UnicodeError) as error:  # a host name that cannot be encoded causes a UnicodeError
            reason = str(error)
            if isinstance(error, OSError) and error.errno in LISTEN_ERRORS:
                reason = LISTEN_ERRORS[error.errno]
            place = self.uds or f"{self.host}:{self.port}"
            raise ListenError(f"cannot listen on {place}: {reason}") from error

    def release(self) -> None:
        """Remove the file of a closed Unix socket, unless another server listens on it."""
        if self.uds:
            with contextlib.suppress(ListenError):
                _remove_stale(self.uds)

    def url(self, listening: socket.socket, *, secure: bool) -> str:
        """Return the URL for clients, or `unix:PATH` for a Unix socket.

        Args:
            listening: The socket that `listen` returned.
            secure: Whether the server uses TLS.
        """
        if self.uds:
            return f"unix:{self.uds}"
        scheme = "https" if secure else "http"
        is_ipv6 = ":" in self.host
        host = f"[{self.host}]" if is_ipv6 else self.host
        _, port, *_ = listening.getsockname()  # the actual port, also if the system has chosen it
        return f"{scheme}://{host}:{port}"


def ip_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Parse an IP address; return None if the text is a name."""
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def check_exposure(address: Address, *, has_token: bool) -> None:
    """Check that a server without a token is not reachable from other machines.

    Raises:
        InputError: If other machines can connect and there is no token.
    """
    if not (address.is_private or has_token):
        raise InputError(f"{address.host} lets other machines in: give --token TOKEN, which they then must send")


def _listen_unix(path: Path, backlog: int) -> socket.socket:
    """Open a listening Unix socket that only its owner can use, and return it.

    Args:
        path: Path of the socket. A file that an earlier server left there is removed first.
        backlog: Largest number of connections that wait to be accepted.
    """
    _remove_stale(path)
    previous_mask = os.umask(0o177)  # only the owner may read and write the file that `bind` creates
    listening = socket.socket(socket.AF_UNIX)
    try:
        listening.bind(str(path))
        listening.listen(backlog)
    except OSError:
        listening.close()
        raise
    finally:
        os.umask(previous_mask)
    return listening


def _remove_stale(path: Path) -> None:
    """Remove the file of a Unix socket on which no server listens any more. If there is no file, do nothing.

    Raises:
        ListenError: If the path is another kind of file, or a server listens on the socket.
    """
    if not path.exists():
        return
    if not stat.S_ISSOCK(path.stat().st_mode):
        raise ListenError(f"{path}: expected nothing or a left-over socket, found a file; choose another path")
    with socket.socket(socket.AF_UNIX) as client:
        error_number = client.connect_ex(str(path))  # 0 if a server accepts the connection
    if error_number != errno.ECONNREFUSED:  # a connection is refused only if no server listens
        raise ListenError(f"{path}: another server listens there; stop it or choose another path")
    path.unlink(missing_ok=True)


@dataclass(frozen=True)
class Tls:
    """Certificate chain and private key of a server, as PEM files.

    Attributes:
        certificate: File of the certificate chain.
        key: File of the private key; None if the key is in the file of the certificate.
    """

    certificate: Path
    key: Path | None = None

    def context(self) -> ssl.SSLContext:
        """Create the TLS context of a server.

        Raises:
            InputError: If a file cannot be read, or certificate and key do not belong together.
        """
        paths = [self.certificate]
        if self.key is not None:
            paths.append(self.key)
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            for path in paths:
                read_whole(path)  # raises an error for a pipe, for which load_cert_chain would wait without end
            # If the key is encrypted, OpenSSL uses this empty password and fails. It would otherwise ask for one.
            context.load_cert_chain(self.certificate, self.key, password=lambda: "")
        except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
            names = " and ".join(map(str, paths))
            raise InputError(
                f"{names}: not a certificate and its unencrypted private key in PEM files that can be read ({error})"
            ) from error
        return context

    def key_and_certificate(self) -> tuple[bytes, bytes]:
        """Read the file of the key and the file of the certificate.

        The results have the order in which gRPC takes them.

        Raises:
            InputError: If a file cannot be read, or certificate and key do not belong together.
        """
        self.context()
        return read_whole(self.key or self.certificate), read_whole(self.certificate)


class Token:
    """A secret that clients must send.

    The duration of the comparison does not depend on the number of correct characters.
    """

    def __init__(self, token: str) -> None:
        """Check the characters of the token, and store the header that clients must send.

        Raises:
            InputError: If the token is empty, or has characters that are not possible in a header or in a URL.
        """
        is_printable_ascii = token.isascii() and token.isprintable()
        has_outer_blanks = token != token.strip()
        if not token or not is_printable_ascii or has_outer_blanks or "%" in token:
            raise InputError(
                "token: expected printable ASCII characters without blanks at the ends, and no %, which has another "
                "meaning in the address of a page; choose another one"
            )
        self._expected_header = b"Bearer " + token.encode()

    def check(self, authorization: bytes) -> None:
        """Check the value of an Authorization header.

        Args:
            authorization: Value of the header; empty if the request has none. The name of the scheme is compared
                without regard to case (RFC 9110, 11.1).

        Raises:
            TokenError: If the header does not contain the token.
        """
        scheme, _, token = authorization.partition(b" ")
        normalised = authorization
        if scheme.lower() == b"bearer":
            normalised = b"Bearer " + token.lstrip(b" ")
        # The duration of compare_digest does not depend on the number of correct characters.
        if not hmac.compare_digest(normalised, self._expected_header):
            received = "a wrong one" if authorization else "none"
            raise TokenError(
                f"expected the header `Authorization: Bearer TOKEN` with this server's token, got {received}"
            )


@dataclass(frozen=True, kw_only=True)
class ServerLimits:
    """Limits of one server.

    With the defaults, the largest batch of presses with four electrodes is accepted as JSON with all digits.

    Attributes:
        batch: Largest number of presses in one request.
        body_bytes: Largest size of the body of a request, compressed or not.
        header_bytes: Largest size of the request line and the headers together.
        header_seconds: Longest time from the first byte of a request, or from connecting, to the end of its headers.
        body_seconds: Longest time from the end of the headers to the end of the body, and longest time until the
            client has received the response.
        idle_seconds: Longest time between two requests.
        connections: Largest number of open connections.
    """

    batch: int = MAX_BATCH
    body_bytes: int = 1 << 20
    header_bytes: int = 1 << 14
    header_seconds: float = 10.0
    body_seconds: float = 30.0
    idle_seconds: float = 75.0
    connections: int = 1024

    def check_body(self, size: int) -> None:
        """Check the size of a complete body, or of the part that has arrived.

        Raises:
            TooLarge: If the size is above `body_bytes`.
        """
        if size > self.body_bytes:
            raise TooLarge(f"expected a body of at most {self.body_bytes} bytes, got more; send smaller batches")
