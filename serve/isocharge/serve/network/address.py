"""Where a server listens: a TCP address or a Unix socket; by default only this machine can connect."""

import contextlib
import errno
import ipaddress
import os
import socket
import stat
from dataclasses import dataclass
from pathlib import Path

from isocharge.common.errors import InputError, ListenError

ADVICE = {
    errno.EADDRINUSE: "another program listens there; stop it or choose another port",
    errno.EADDRNOTAVAIL: "this machine has no such address; choose one that it has",
    errno.EACCES: "this user may not listen there; choose another place, or a port above 1023",
}
"""Reason and advice for each error of the system."""


File = tuple[int, int, int]
"""Device, inode and mode of a file."""


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
            return _listen_unix(self.uds, backlog) if self.uds else _listen_tcp(self.host, self.port, backlog)
        except ListenError:
            raise
        except (OSError, UnicodeError) as error:
            why = ADVICE.get(getattr(error, "errno", None) or 0, str(error))
            raise ListenError(f"cannot listen on {self.uds or f'{self.host}:{self.port}'}: {why}") from error

    def file(self) -> File | None:
        """What tells the file of a Unix socket from another one under its path; None where there is no file."""
        if self.uds is None:
            return None
        try:
            state = self.uds.lstat()
        except OSError:
            return None
        return state.st_dev, state.st_ino, state.st_mode

    def release(self, file: File | None) -> None:
        """Remove what a Unix socket leaves behind, if it is still the `file` that was made for it."""
        if self.uds and file is not None and self.file() == file:
            self.uds.unlink(missing_ok=True)

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


def _listen_tcp(host: str, port: int, backlog: int) -> socket.socket:
    # A port whose last user was killed is free at once; a port on which a program listens stays refused.
    return socket.create_server(
        (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET, backlog=backlog
    )


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
    """Remove the socket of a server that was killed.

    Raises:
        ListenError: If the path is something else, or a server listens there.
    """
    if not path.exists():
        return
    if not stat.S_ISSOCK(path.stat().st_mode):
        raise ListenError(f"{path}: expected nothing or a left-over socket, found a file; choose another path")
    if _answers(path):
        raise ListenError(f"{path}: another server listens there; stop it or choose another path")
    path.unlink(missing_ok=True)


def _answers(path: Path) -> bool:
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return False
        return True
