"""Protection against requests from web pages of other sites.

Every page in a browser can send requests to every address that the browser can reach, including the loopback address. A
form or a `fetch` with `mode: "no-cors"` cannot read the response, but the server executes the request. With DNS
rebinding, an attacker changes the address of a name to this machine after the page was loaded. The browser then treats
the page as a page of this server, and the page can also read the responses. Pages cannot change the following headers,
by which such requests are recognised.

- `Host` is the name that the browser has requested. After DNS rebinding, this name is neither an IP address nor a name
  of this server.
- `Origin` is the site of the page that sent the request.
- `Sec-Fetch-Site` states whether the page belongs to the same site. Browsers also send this header with requests that
  have no `Origin`.

Programs other than browsers send neither `Origin` nor `Sec-Fetch-Site`, so only their `Host` is checked.
"""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from urllib.parse import urlsplit

from isocharge.common.errors import InputError, OriginError
from isocharge.serve.network.address import ip_address

CACHED_REQUESTS = 256
"""Number of combinations of headers whose result is cached. Clients repeatedly send the same headers."""

LOCALHOST = "localhost"

TRUSTED_FETCH_SITES = (b"same-origin", b"none")
"""Values of `Sec-Fetch-Site` of a request by a page of the server itself, and of an address that a user typed in."""


class BrowserCheck:
    """Checks whether a request was sent by a page of another site.

    Args:
        host: Name or address on which the server listens.
        allowed_hosts: Further names by which the server is reached, for example through a reverse proxy. Pages of these
            names may send requests, too.
        any_host: Whether to accept every `Host`. DNS rebinding is harmless if requests need a token, which a page of
            another site does not have, or if the server listens on a Unix socket.
    """

    def __init__(self, host: str = LOCALHOST, allowed_hosts: Iterable[str] = (), *, any_host: bool = False) -> None:
        self._allowed_names = frozenset(map(host_name, allowed_hosts))
        self._host_names = self._allowed_names | {LOCALHOST, host.lower()}
        self._any_host = any_host
        self._problem = lru_cache(CACHED_REQUESTS)(self._find_problem)

    def check(self, method: str, headers: Mapping[bytes, bytes]) -> None:
        """Check the headers of a request.

        Args:
            method: Method in capitals.
            headers: Values by name in lower case.

        Raises:
            OriginError: If a page of another site sent the request, or `Host` is not a name of this server.
        """
        get = headers.get
        problem = self._problem(
            method,
            get(b"host", b""),
            get(b"origin"),
            get(b"sec-fetch-site"),
            get(b"sec-fetch-mode"),
            get(b"sec-fetch-dest"),
        )
        if problem is not None:
            raise OriginError(problem)

    def _find_problem(
        self,
        method: str,
        host: bytes,
        origin: bytes | None,
        fetch_site: bytes | None,
        fetch_mode: bytes | None,
        fetch_dest: bytes | None,
    ) -> str | None:
        """Return the reason why a request is refused; None if the request is accepted.

        The requested host must be one that this server has, unless every host is accepted. If the browser states the
        origin of the page that sends the request, the page must belong to this server. Otherwise the header
        `Sec-Fetch-Site` must not name another site, unless the user follows a link to a page of this server.

        Args:
            method: Method in capitals.
            host: Value of the header `Host`; empty if the request has none.
            origin: Value of `Origin`; None if the request has none.
            fetch_site: Value of `Sec-Fetch-Site`; None if the request has none.
            fetch_mode: Value of `Sec-Fetch-Mode`; None if the request has none.
            fetch_dest: Value of `Sec-Fetch-Dest`; None if the request has none.
        """
        if not (self._any_host or self._is_served(host)):
            return (
                f"Host: expected an IP address or one of {self._served_names()}, got {_quoted(host)}; use the server's "
                "address, or name the host by --allow-host of `isocharge serve http`"
            )
        if origin is not None:
            if self._is_own_page(origin, host):
                return None
            return (
                f"Origin: expected a page of this server, got a page of {_quoted(origin)}; open {_quoted(host)} "
                "itself, or name the page's host by --allow-host of `isocharge serve http`"
            )
        # Programs other than browsers send no Sec-Fetch-Site.
        if fetch_site is None or fetch_site.lower() in TRUSTED_FETCH_SITES:
            return None
        # A link on a page of another site may open this page, because that site cannot read the answer.
        is_link = method in ("GET", "HEAD") and fetch_mode == b"navigate" and fetch_dest == b"document"
        if is_link:
            return None
        return (
            f"Sec-Fetch-Site: expected a request by a page of this server, got {_quoted(fetch_site)}; open the page of "
            f"{_quoted(host)}"
        )

    def _is_served(self, host: bytes) -> bool:
        """Return whether a `Host` is an IP address or a name of this server. A missing `Host` is accepted."""
        if not host:  # HTTP/1.0 does not require the header. Browsers always send it.
            return True
        name = _name_in(f"//{host.decode('latin-1')}")
        return ip_address(name) is not None or name in self._host_names

    def _is_own_page(self, origin: bytes, host: bytes) -> bool:
        """Return whether a request was sent by a page of this server.

        The page belongs to this server if its origin is the requested host. If a proxy has replaced the `Host`, the
        page also belongs to this server if its origin is an allowed name. A page on another port of the requested host
        belongs to another server.

        Args:
            origin: Value of the header `Origin`, for example b"http://localhost:8000".
            host: Value of the header `Host`, for example b"localhost:8000".
        """
        scheme, _, page_host = origin.decode("latin-1").lower().partition("://")
        if scheme not in ("http", "https"):
            return False
        requested_host = host.decode("latin-1").lower()
        if page_host == requested_host:
            return True
        # The hosts may contain a port, the names do not. Equal names with different ports are two servers of a machine.
        page_name = _name_in(f"//{page_host}")
        requested_name = _name_in(f"//{requested_host}")
        return page_name in self._allowed_names and page_name != requested_name

    def _served_names(self) -> str:
        """Return the names of this server, separated by commas."""
        return ", ".join(sorted(self._host_names))


def host_name(text: str) -> str:
    """Check the value of the option --allow-host, and return the host name in lower case.

    Args:
        text: A host name, or an IP address. An IPv6 address may be in square brackets.

    Raises:
        InputError: If the text is not a plain host name or address; a scheme, a port or a path is refused.
    """
    name = text.strip().lower()
    is_printable_ascii = name.isascii() and name.isprintable()
    has_forbidden_character = any(character in name for character in "/@?#%* ,\\")

    is_bracketed = name.startswith("[") and name.endswith("]")
    if is_bracketed:
        name = name[1:-1]
    has_port = ":" in name and ip_address(name) is None  # the only names with colons are IPv6 addresses
    if not name or not is_printable_ascii or has_forbidden_character or has_port:
        raise InputError(f"--allow-host: expected a host name without scheme, port and path, got {text!r:.100}")
    return name.removesuffix(".")  # "example.org." is the same host as "example.org"


def _name_in(url: str) -> str:
    """Return the host name in a URL in lower case; "?" if there is none."""
    try:
        name = urlsplit(url).hostname or "?"
    except ValueError:
        return "?"
    return name.removesuffix(".")


def _quoted(value: bytes) -> str:
    """Return the value of a header as text for an error message."""
    return repr(value[:100].decode("latin-1"))
