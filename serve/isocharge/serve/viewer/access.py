"""Who may follow and command a film: the token, and pages of this server only.

A browser sends no Authorization header with a WebSocket, so the page sends its token as a subprotocol,
`bearer.TOKEN` in base64url; other clients send the header.

Any page in the world may try to open a WebSocket to this machine; the browser says from which page. A page of a name
that somebody else has made point here (DNS rebinding) is of the same name as the server it asks: without a token, only
names that nobody else can give count: addresses, localhost, and the host that this server was told to listen on.
"""

import base64
import binascii
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from isocharge.common.errors import OriginError
from isocharge.serve.network.address import ip_address
from isocharge.serve.network.credentials import Token

PROTOCOL = "isocharge.live.1"
"""The subprotocol of the page."""

BEARER = "bearer."


@dataclass(frozen=True)
class Access:
    """What a request must show.

    Attributes:
        token: The secret; None for no secret.
        host: Where the server listens.
    """

    token: Token | None = None
    host: str = "127.0.0.1"

    def check(self, headers: Mapping[bytes, bytes], subprotocols: Iterable[str] = ()) -> None:
        """Check a request for data.

        Args:
            headers: Names in lower case.
            subprotocols: That a WebSocket offers.

        Raises:
            OriginError: If it comes from a page of another site.
            TokenError: If it does not carry the token.
        """
        self._check_origin(headers)
        if self.token is not None:
            self.token.check(headers.get(b"authorization", b"") or _bearer(subprotocols))

    def _check_origin(self, headers: Mapping[bytes, bytes]) -> None:
        host = headers.get(b"host", b"").decode("latin-1").lower()
        name = _name(f"//{host}")
        if self.token is None and not (ip_address(name) or name in ("localhost", self.host.lower(), "")):
            raise OriginError(f"expected a request to this machine's address, got one to {host!r}; open the address")
        origin = headers.get(b"origin")
        if origin is not None and origin.decode("latin-1").lower().partition("://")[2] != host:
            raise OriginError(f"expected a page of this server, got one of {origin.decode('latin-1')!r}; open {host}")


def _name(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return "?"


def _bearer(subprotocols: Iterable[str]) -> bytes:
    """The Authorization header that a subprotocol stands for."""
    for offered in subprotocols:
        if offered.startswith(BEARER):
            text = offered.removeprefix(BEARER)
            try:
                return b"Bearer " + base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)
            except (binascii.Error, ValueError):
                return b"Bearer"
    return b""
