"""Check of the access to a server: its token, and protection against requests from web pages of other sites.

If the server has a token, the class `AccessCheck` refuses requests that do not contain the token. The class also
refuses requests from web pages of other sites.

A page in a browser can send requests to every address that the browser can reach, including the loopback address. If
the page sends a form, or a `fetch` with `mode: "no-cors"`, the page cannot read the response, but the server executes
the request. An attacker can also use DNS rebinding. After the browser has loaded the attacker's page, the attacker
changes the DNS entry of the page's host name to the address of this machine. The browser then treats the attacker's
page as a page of this server, and the page can also read the responses.

The server recognises requests from pages of other sites by the following headers, which pages cannot change.

- The header `Host` contains the host name that the browser has requested. After DNS rebinding, `Host` contains neither
  an IP address nor a name of this server.
- The header `Origin` contains the site of the page that has sent the request.
- The header `Sec-Fetch-Site` states whether the page belongs to the same site. Browsers send `Sec-Fetch-Site` even with
  requests that have no header `Origin`.

Programs other than browsers send neither `Origin` nor `Sec-Fetch-Site`. In the requests of such programs, the server
therefore checks only the header `Host`.
"""

import hmac
import re
from collections.abc import Iterable
from functools import lru_cache
from urllib.parse import urlsplit

from isocharge.common.errors import InputError, RequestError, shown
from isocharge.serve.network.address import ip_address

Headers = dict[bytes, bytes]
"""Value of each header of a request by the name of the header in lower case."""


class AccessCheck:
    """Filter that refuses requests from web pages of other sites, and requests without the token of the server.

    Args:
        host: Host name or address on which the server listens.
        allowed_hosts: Further host names of the server, for example the name of a reverse proxy. Pages of these hosts
            may also send requests. A single text is treated as one name.
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
        """Check and store the names of the server and the token; the docstring of the class describes the arguments."""
        names = [allowed_hosts] if isinstance(allowed_hosts, str) else allowed_hosts
        self._allowed_names = frozenset(map(host_name, names))  # checked, in lower case
        self._host_names = self._allowed_names | {"localhost", host.lower()}  # also the own names of the server
        # Printable ASCII characters (from the blank to ~) without %, and no blank at the beginning and at the end
        if token is not None and not re.fullmatch(r"(?! )[ -$&-~]+(?<! )", token):
            raise InputError(
                "token: expected printable ASCII characters without blanks at the ends, and no %, which has another "
                "meaning in the address of a page; choose another one"
            )
        self._token = token
        # A server with a token accepts every host name, because a page of another site does not have the token.
        self._any_host = any_host or token is not None

    def check(self, method: str, headers: Headers, *, needs_token: bool = True) -> None:
        """Check the headers of a request, and raise an error if the request is refused.

        Args:
            method: Method in capitals.
            headers: Headers of the request.
            needs_token: Whether the request must contain the token, if the server has one.

        Raises:
            RequestError: If a page of another site has sent the request, if `Host` is not a name of this server, or if
                the token is missing or wrong.
        """
        host = headers.get(b"host", b"").decode("latin-1").lower()
        name = _name_in(host)
        is_own_name = self._any_host or name in self._host_names or ip_address(name) is not None
        if host and not is_own_name:  # HTTP/1.0 does not require the header, but browsers always send it
            raise RequestError(
                f"Host: expected an IP address or one of {', '.join(sorted(self._host_names))}, got {shown(host)}; use "
                "the server's address, or name the host by --allow-host (allowed_hosts of asgi_app)",
                403,
            )

        origin = headers.get(b"origin", b"").decode("latin-1").lower()
        if origin and not self._is_own_page(origin, host):
            raise RequestError(
                f"Origin: expected a page of this server, got a page of {shown(origin)}; open {shown(host)} "
                "itself, or allow a page of another host name (not of another port) by --allow-host (allowed_hosts of "
                "asgi_app)",
                403,
            )

        # Without `Origin`, `Sec-Fetch-Site` decides. Browsers send `same-origin` if a page of this server sends the
        # request, and `none` if the user has typed the address. Other programs do not send the header, which is then
        # treated as `none`. A link on another site may open a page of this server, because the other site cannot read
        # the response.
        fetch_site = headers.get(b"sec-fetch-site", b"none").decode("latin-1")
        is_link = headers.get(b"sec-fetch-dest") == b"document" and method in ("GET", "HEAD")
        if not (origin or is_link or fetch_site in ("same-origin", "none")):
            raise RequestError(
                f"Sec-Fetch-Site: expected a request by a page of this server, got {shown(fetch_site)}; open the page "
                f"of {shown(host)}",
                403,
            )

        if needs_token:
            self.check_token(headers.get(b"authorization", b""))

    def check_token(self, authorization: bytes) -> None:
        """Check the token that a client has sent. If the server has no token, every client is accepted.

        Args:
            authorization: Value of the header or the gRPC metadata `authorization`, such as b"Bearer TOKEN"; empty if
                the client has sent none. The word `Bearer` may be in upper case or lower case (RFC 9110, 11.1).

        Raises:
            RequestError: If the token is missing or wrong.
        """
        if self._token is None:
            return
        scheme, _, token = authorization.partition(b" ")
        # The duration of this comparison does not depend on the number of correct characters. A client therefore cannot
        # use it to guess the token character by character.
        is_correct = hmac.compare_digest(token.lstrip(b" "), self._token.encode())
        if scheme.lower() != b"bearer" or not is_correct:
            received = "a wrong one" if authorization else "none"
            raise RequestError(
                "expected `Authorization: Bearer TOKEN` with this server's token, in a header or in the metadata of "
                f"gRPC, got {received}",
                401,
                (b"www-authenticate", b"Bearer"),
            )

    def _is_own_page(self, origin: str, host: str) -> bool:
        """Return whether the page that has sent a request belongs to this server.

        A page belongs to this server in two cases:

        - Its origin contains the same host and the same port as the header `Host`.
        - Its host name is one of `allowed_hosts`, and a reverse proxy has changed the header `Host`. Such a header
          contains another name than the origin, or the same name without the port.

        Args:
            origin: Value of the header `Origin`, which is the origin of the page, such as "http://localhost:8000".
            host: Value of the header `Host`, for example "localhost:8000".
        """
        scheme, _, page_address = origin.partition("://")  # the address is the host name and, if given, the port
        default_port = ":443" if scheme == "https" else ":80"  # which proxies may add
        if host in (page_address, page_address + default_port):
            return True
        # If the names are equal and both have a port, the page belongs to another server on the same machine.
        page_name = _name_in(page_address)  # the host name without the port
        is_port_removed = page_address.startswith(f"{host}:")
        is_host_changed = is_port_removed or page_name != _name_in(host)  # by a reverse proxy
        return page_name in self._allowed_names and is_host_changed


def header_values(headers: Iterable[tuple[bytes, bytes]]) -> Headers:
    """Return the value of each header by its name. If a header is repeated, the last value of the header is returned.

    Args:
        headers: Pairs of the name of a header in lower case and its value.

    Raises:
        RequestError: If `Host` (RFC 9112, 3.2) or `Origin` is repeated. A proxy could have checked the other value.
    """
    values: Headers = {}
    for name, value in headers:
        if name in values and name in (b"host", b"origin"):
            raise RequestError(f"{name.decode()}: expected one header, got {shown(values[name])} and {shown(value)}")
        values[name] = value
    return values


def host_name(text: str) -> str:
    """Check a value of --allow-host or `allowed_hosts`, and return the host name in lower case.

    Args:
        text: Host name or IP address. An IPv6 address may be in square brackets.

    Raises:
        InputError: If the text is not a host name or an IP address, for example because it also contains a scheme, a
            port or a path.
    """
    name = text.strip().lower().strip("[]")
    if not re.fullmatch(r"[a-z0-9_-][a-z0-9_.-]*", name) and ip_address(name) is None:
        raise InputError(
            "--allow-host (allowed_hosts of asgi_app): expected a host name without scheme, port and path, "
            f"got {text!r:.100}"
        )
    return name.removesuffix(".")  # "example.org." is the same host as "example.org"


@lru_cache
def _name_in(host: str) -> str:
    """Return the host name without the port, or "?" if the text contains no host name.

    Args:
        host: Value of the header `Host`, or the part of the header `Origin` after the scheme.
    """
    try:
        return (urlsplit(f"//{host}").hostname or "?").removesuffix(".")
    except ValueError:
        return "?"
