"""Addresses, TLS certificates and limits of servers.

The HTTP server, the gRPC server and the live page use the classes of this module. By default, a server listens on the
loopback address, to which only programs on the same machine can connect.
"""

import errno
import ipaddress
import socket
import ssl
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from isocharge.common.errors import InputError, ListenError
from isocharge.common.files import read_whole


@dataclass(frozen=True)
class Address:
    """Address on which a server listens.

    Attributes:
        host: Host name or IP address. At `::`, the server also accepts IPv4 clients, as a gRPC server does.
        port: TCP port. The port 0 selects a free port.
        uds: Path of a Unix socket, to which only its owner can connect. If the path is given, the socket replaces host
            and port.
    """

    host: str = "127.0.0.1"
    port: int = 0
    uds: Path | None = None

    def listen(self) -> socket.socket:
        """Open a Unix socket or a TCP socket that listens on this address, and return the socket.

        Raises:
            ListenError: If the address is in use or cannot be used. The message states what to do.
        """
        try:
            if self.uds is not None:
                self.release()  # removes the file that a server has left behind if it did not end normally
                return _listen_unix(self.uds)
            # create_server sets SO_REUSEADDR. The port of an earlier server can therefore be used again at once.
            family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
            return socket.create_server((self.host, self.port), family=family, dualstack_ipv6=self.host == "::")
        except (OSError, ValueError) as error:  # a ValueError if the host name cannot be encoded, or without IPv6
            place = self.uds or f"{self.host}:{self.port}"
            raise ListenError(f"cannot listen on {place}: {error}; choose another address or port") from error

    def release(self) -> None:
        """Remove the file of the Unix socket if no server listens on the socket any more.

        If the address is not a Unix socket, or the file is not a socket or does not exist, the function does nothing.
        """
        if self.uds is None or not self.uds.is_socket():
            return
        with socket.socket(socket.AF_UNIX) as client:
            client.setblocking(False)  # a server that hangs does not accept the connection
            error_number = client.connect_ex(str(self.uds))  # 0 if a server accepts the connection
        if error_number == errno.ECONNREFUSED:  # the system refuses a connection only if no server listens
            self.uds.unlink(missing_ok=True)

    def url(self, listening: socket.socket, *, secure: bool) -> str:
        """Return the URL that clients use, or `unix:PATH` if the address is a Unix socket.

        Args:
            listening: Socket that `listen` has returned.
            secure: Whether the server uses TLS, so that the URL begins with `https`.
        """
        if self.uds:
            return f"unix:{self.uds}"
        _, port, *_ = listening.getsockname()  # the actual port, even if the system has chosen it
        return f"{'https' if secure else 'http'}://{url_host(self.host)}:{port}"


@dataclass(frozen=True)
class Tls:
    """PEM files that contain the certificate chain and the private key of a server.

    Attributes:
        certificate: File with the certificate chain.
        key: File with the private key, which may be the file of the certificate.
    """

    certificate: Path
    key: Path

    def context(self) -> ssl.SSLContext:
        """Create the TLS context of a server from its certificate and its private key.

        Raises:
            InputError: If a file cannot be read, or if the certificate and the key do not belong together.
        """
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        try:
            for path in (self.certificate, self.key):
                read_whole(path)  # raises an error if the path is a pipe, from which load_cert_chain might wait forever
            # With the empty password, an encrypted key causes an error. Without a password, OpenSSL would ask the user.
            context.load_cert_chain(self.certificate, self.key, password=lambda: "")
        except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
            raise InputError(
                f"{self.certificate}: not a certificate whose unencrypted private key is in {self.key}, both in PEM "
                f"files that can be read ({error})"
            ) from error
        return context


@dataclass(frozen=True, kw_only=True)
class ServerLimits:
    """Limits of one server.

    With the default limits, a server accepts the largest batch of presses of a film with four electrodes. This is true
    even if the batch is sent as JSON and each number has all its digits.

    Attributes:
        body_bytes: Largest size of the body of a request, bytes. The limit applies before and after the body is
            decompressed.
        header_bytes: Largest total size of the request line and the headers, bytes.
        header_seconds: Longest time in which the headers of a request must arrive, s. The time begins with the
            connection or with the first byte of the request.
        body_seconds: Longest time from the end of the headers to the end of the body, s. The client must also read the
            response within this time.
        idle_seconds: Longest time between two requests of a connection, s.
        grace_seconds: Longest time for which a stopping server waits for the requests that have begun, s.
        connections: Largest number of open connections.
        connection_requests: Largest number of requests of a connection that wait for the response to an earlier request
            (HTTP), and of open calls of a connection (gRPC). HTTP/2 recommends at least 100.
    """

    body_bytes: int = 1 << 20
    header_bytes: int = 1 << 14
    header_seconds: float = 10.0
    body_seconds: float = 30.0
    idle_seconds: float = 75.0
    grace_seconds: float = 10.0
    connections: int = 1024
    connection_requests: int = 100


def url_host(host: str) -> str:
    """Return a host name or an address in the form that a URL needs: an IPv6 address is put in square brackets."""
    return f"[{host}]" if ":" in host else host


@lru_cache
def ip_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Parse the text of an IP address, and return the address, or None if the text is not an IP address."""
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def check_exposure(address: Address, token: str | None) -> None:
    """Check that a server without a token is not reachable from other machines.

    Args:
        address: Address on which the server listens.
        token: Token that clients must send; None if the server has no token.

    Raises:
        InputError: If other machines can connect, but the server has no token.
    """
    ip = ip_address(address.host)
    is_loopback = address.host == "localhost" or (ip is not None and ip.is_loopback)
    if token is None and address.uds is None and not is_loopback:
        raise InputError(f"{address.host} lets other machines in: give --token TOKEN, which they then must send")


def _listen_unix(path: Path) -> socket.socket:
    """Open a listening Unix socket that only its owner can use, and return the socket.

    Args:
        path: Path of the socket, where no file exists.

    Raises:
        OSError: If the socket cannot be created.
    """
    listening = socket.socket(socket.AF_UNIX)
    try:
        listening.bind(str(path))
        path.chmod(0o600)  # before `listen`, the system refuses all connections
        listening.listen()
    except OSError:
        listening.close()
        raise
    return listening
