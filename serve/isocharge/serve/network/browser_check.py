"""Check of the access to a server: its token, and protection against requests from web pages of other sites.

The class `AccessCheck` refuses a request if the server has a token and the request does not contain it. The class also
refuses requests from web pages of other sites.

A page in a browser can send requests to every address that the browser can reach, including the loopback address. If
the page sends a form, or a `fetch` with `mode: "no-cors"`, it cannot read the response, but the server executes the
request. An attacker can also use DNS rebinding. After the browser has loaded the attacker's page, the attacker changes
the DNS entry of the page's host name to the address of this machine. The browser then treats the attacker's page as a
page of this server, and the page can also read the responses.

The server recognises requests from pages of other sites by the following headers, which pages cannot change.

- The header `Host` contains the host name that the browser has requested. After DNS rebinding, `Host` contains neither
  an IP address nor a name of this server.
- The header `Origin` contains the site of the page that has sent the request. Browsers send it with every POST request.

Browsers omit `Origin` in some GET requests, for example when the user follows a link. GET requests change nothing, and
a page of another site cannot read the responses. Programs other than browsers do not send `Origin` either. In requests
without `Origin`, the server therefore checks only the header `Host`.
"""

import hmac
import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from urllib.parse import urlsplit

from isocharge.common.errors import InputError, OriginError, TokenError
from isocharge.serve.network.address import ip_address

_TOKEN_PATTERN = re.compile(r"(?! )[ -$&-~]+(?<! )")
"""Accepted token: printable ASCII characters without blanks at the ends and without the percent sign."""


class AccessCheck:
    """Filter that refuses requests from web pages of other sites, and requests without the token of the server.

    Args:
        host: Host name or address on which the server listens.
        allowed_hosts: Further host names of the server, for example the name of a reverse proxy. Pages of these hosts
            may also send requests. A text is one name.
        token: Token that requests must contain; None if requests need no token. With a token, every value of the header
            `Host` is accepted. DNS rebinding is then harmless, because a page of another site does not have the token.
        any_host: Whether to accept every value of the header `Host` even without a token. This is harmless if the
            server listens on a Unix socket.

    Raises:
        InputError: If a host name cannot be used, or if the token is empty or contains characters that a header or a
            URL cannot contain.
    """

    def __init__(
        self,
        host: str = "localhost",
        allowed_hosts: Iterable[str] = (),
        *,
        token: str | None = None,
        any_host: bool = False,
    ) -> None:
        names = [allowed_hosts] if isinstance(allowed_hosts, str) else allowed_hosts
        self._allowed_names = frozenset(map(host_name, names))
        self._host_names = self._allowed_names | {"localhost", host.lower()}
        if token is not None and not _TOKEN_PATTERN.fullmatch(token):
            raise InputError(
                "token: expected printable ASCII characters without blanks at the ends, and no %, which has another "
                "meaning in the address of a page; choose another one"
            )
        self._token = None if token is None else token.encode()
        self._any_host = any_host or token is not None

    def check(self, headers: Mapping[bytes, bytes], *, needs_token: bool = True) -> None:
        """Check the headers of a request, and raise an error if the request is refused.

        Args:
            headers: Value of each header by the name of the header in lower case.
            needs_token: Whether the request must contain the token, if the server has one.

        Raises:
            OriginError: If a page of another site has sent the request, or if `Host` is not a name of this server.
            TokenError: If the token is missing or wrong.
        """
        host = headers.get(b"host", b"")
        name = _name_in(host)
        is_served = self._any_host or name in self._host_names or ip_address(name) is not None
        if host and not is_served:  # HTTP/1.0 does not require the header, but browsers always send it
            raise OriginError(
                f"Host: expected an IP address or one of {', '.join(sorted(self._host_names))}, got {_quoted(host)}; "
                "use the server's address, or name the host by --allow-host (allowed_hosts of asgi_app)"
            )

        # A reverse proxy may change the header `Host`, or remove its port. The name of a page of `allowed_hosts` is
        # therefore sufficient.
        origin = headers.get(b"origin")
        _, _, page_host = (origin or b"").lower().partition(b"://")
        is_own_page = page_host == host.lower() or _name_in(page_host) in self._allowed_names
        if origin is not None and not is_own_page:
            raise OriginError(
                f"Origin: expected a page of this server, got a page of {_quoted(origin)}; open {_quoted(host)} "
                "itself, or name the page's host by --allow-host (allowed_hosts of asgi_app)"
            )
        if needs_token:
            self.check_token(headers.get(b"authorization", b""))

    def check_token(self, authorization: bytes) -> None:
        """Check the token that a client has sent. If the server has no token, every client is accepted.

        Args:
            authorization: Value of the header or the gRPC metadata `authorization`, such as b"Bearer TOKEN"; empty if
                the client has sent none. The word `Bearer` may be in upper case or lower case (RFC 9110, 11.1).

        Raises:
            TokenError: If the token is missing or wrong.
        """
        if self._token is None:
            return
        scheme, _, token = authorization.partition(b" ")
        # The duration of this comparison does not depend on the number of correct characters. A client therefore cannot
        # use it to guess the token character by character.
        is_correct = hmac.compare_digest(token.lstrip(b" "), self._token)
        if scheme.lower() != b"bearer" or not is_correct:
            received = "a wrong one" if authorization else "none"
            raise TokenError(
                "expected `Authorization: Bearer TOKEN` with this server's token, in a header or in the metadata of "
                f"gRPC, got {received}"
            )


_HOST_NAME_PATTERN = re.compile(r"[a-z0-9_-][a-z0-9_.-]*")
"""Host name, or IPv4 address, in lower case."""


def host_name(text: str) -> str:
    """Check a value of --allow-host or `allowed_hosts`, and return the host name in lower case.

    Args:
        text: Host name or IP address. An IPv6 address may be in square brackets.

    Raises:
        InputError: If the text is not a host name or an IP address, for example because it also contains a scheme, a
            port or a path.
    """
    name = text.strip().lower().strip("[]")
    if not _HOST_NAME_PATTERN.fullmatch(name) and ip_address(name) is None:
        raise InputError(
            "--allow-host (allowed_hosts of asgi_app): expected a host name without scheme, port and path, "
            f"got {text!r:.100}"
        )
    return name.removesuffix(".")  # "example.org." is the same host as "example.org"


@lru_cache
def _name_in(host: bytes) -> str:
    """Return the host name in lower case, without the port, or "?" if the bytes contain no host name.

    Args:
        host: Value of the header `Host`, or the part of the header `Origin` after the scheme.
    """
    try:
        name = urlsplit(b"//" + host).hostname or b"?"
    except ValueError:
        return "?"
    return name.decode("latin-1").removesuffix(".")


def _quoted(value: bytes) -> str:
    """Return the value of a header as a quoted text for an error message. Long values are shortened."""
    return repr(value[:100].decode("latin-1"))
