"""Where a server listens, whom it lets in and for how much: a TCP address or Unix socket, TLS, a token, bounds.

By default only this machine can connect. Token, TLS and bounds are the same over HTTP and gRPC.
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

ADVICE = {
    errno.EADDRINUSE: "another program listens there; stop it or choose another port",
    errno.EADDRNOTAVAIL: "this machine has no such address; choose one that it has",
    errno.EACCES: "this user may not listen there; choose another place, or a port above 1023",
}
"""Reason and advice for each error of the system."""


@dataclass(frozen=True)
class Address:
    """Where to listen.

    Attributes:
        host: Name or IP address.
        port: TCP port; 0 takes a free one.
        uds: Path of a Unix socket, which counts instead of host and port; only its owner may connect.
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
        """A listening socket.

        Raises:
            ListenError: If the place is taken or impossible; the message says what to do.
        """
        try:
            if self.uds:
                return _listen_unix(self.uds, backlog)
            # A port whose last user was killed is free at once; a port on which a program listens stays refused.
            family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
            return socket.create_server((self.host, self.port), family=family, backlog=backlog)
        except ListenError:
            raise
        except (OSError, UnicodeError) as error:
            why = ADVICE.get(getattr(error, "errno", None) or 0, str(error))
            raise ListenError(f"cannot listen on {self.uds or f'{self.host}:{self.port}'}: {why}") from error

    def release(self) -> None:
        """Remove what a Unix socket leaves behind when it is closed; what listens in its place stays."""
        if self.uds:
            with contextlib.suppress(ListenError):
                _remove_stale(self.uds)

    def url(self, listening: socket.socket, *, secure: bool) -> str:
        """The URL for clients; of a Unix socket its path, as curl's `--unix-socket` takes it."""
        if self.uds:
            return f"unix:{self.uds}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if secure else 'http'}://{host}:{listening.getsockname()[1]}"


def ip_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The IP address that a host is; None for a name."""
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def check_exposure(address: Address, *, has_token: bool) -> None:
    """Refuse to serve others than this machine without a token.

    Raises:
        InputError: If the address is open to others and there is no token.
    """
    if not (address.is_private or has_token):
        raise InputError(f"{address.host} lets other machines in: give --token TOKEN, which they then must send")


def _listen_unix(path: Path, backlog: int) -> socket.socket:
    _remove_stale(path)
    before = os.umask(0o177)
    listening = socket.socket(socket.AF_UNIX)
    try:
        listening.bind(str(path))
        listening.listen(backlog)
    except OSError:
        listening.close()
        raise
    finally:
        os.umask(before)
    return listening


def _remove_stale(path: Path) -> None:
    """Remove the socket of a server that has ended.

    Raises:
        ListenError: If the path is something else, or a server listens there.
    """
    if not path.exists():
        return
    if not stat.S_ISSOCK(path.stat().st_mode):
        raise ListenError(f"{path}: expected nothing or a left-over socket, found a file; choose another path")
    with socket.socket(socket.AF_UNIX) as probe:
        if probe.connect_ex(str(path)) != errno.ECONNREFUSED:
            raise ListenError(f"{path}: another server listens there; stop it or choose another path")
    path.unlink(missing_ok=True)


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
            InputError: If it is empty, or has characters that no header, or no page's address, can carry.
        """
        if not token or not token.isascii() or not token.isprintable() or token != token.strip() or "%" in token:
            raise InputError(
                "token: expected printable ASCII characters without blanks at the ends, and no %, which means "
                "something else in the address of a page; choose another one"
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


@dataclass(frozen=True, kw_only=True)
class ServerLimits:
    """Bounds of one server; the defaults fit the largest batch of four electrodes as JSON with all digits.

    Attributes:
        batch: Presses in one request.
        body_bytes: Size of a request's body, compressed or not.
        header_bytes: Size of request line and headers together.
        header_seconds: Time from the first byte of a request, or from connecting, to the end of its headers.
        body_seconds: Time from there to the end of the body; and again until the client has taken the answer.
        idle_seconds: Time between requests.
        connections: Connections that are open at a time.
    """

    batch: int = MAX_BATCH
    body_bytes: int = 1 << 20
    header_bytes: int = 1 << 14
    header_seconds: float = 10.0
    body_seconds: float = 30.0
    idle_seconds: float = 75.0
    connections: int = 1024

    def check_body(self, size: int) -> None:
        """Check the size of a body, or of as much of it as has arrived.

        Raises:
            TooLarge: If it is above `body_bytes`.
        """
        if size > self.body_bytes:
            raise TooLarge(f"expected a body of at most {self.body_bytes} bytes, got more; send smaller batches")
