"""Protection against requests from web pages of other sites.

A page in a browser can send requests to every address that the browser can reach, including the loopback address. If
the page sends a form, or a `fetch` with `mode: "no-cors"`, it cannot read the response, but the server executes the
request. An attacker can also use DNS rebinding. After the browser has loaded the attacker's page, the attacker changes
the DNS entry of the page's host name to the address of this machine. The browser then treats the attacker's page as a
page of this server, and the page can also read the responses.

The server recognises requests from pages of other sites by the following headers, which pages cannot change.

- The header `Host` contains the host name that the browser has requested. After DNS rebinding, `Host` contains neither
  an IP address nor a name of this server.
- The header `Origin` contains the site of the page that has sent the request.
- The header `Sec-Fetch-Site` states whether the page belongs to the same site. Browsers send `Sec-Fetch-Site` even with
  requests that have no header `Origin`.

Programs other than browsers send neither `Origin` nor `Sec-Fetch-Site`. In the requests of such programs, the server
therefore checks only the header `Host`.
"""

from collections.abc import Iterable, Mapping
from functools import lru_cache
from urllib.parse import urlsplit

from isocharge.common.errors import InputError, OriginError, RequestError
from isocharge.serve.network.address import ip_address

CACHED_REQUESTS = 256
"""Number of combinations of headers for which the result of the check is cached.

Clients send the same headers again and again.
"""

LOCALHOST = "localhost"

TRUSTED_FETCH_SITES = (b"same-origin", b"none")
"""Values of the header `Sec-Fetch-Site` that are accepted.

Browsers send `same-origin` if a page of this server sends the request, and `none` if the user has typed in the address.
"""


class BrowserCheck:
    """Filter that refuses requests from web pages of other sites.

    Args:
        host: Host name or address on which the server listens.
        allowed_hosts: Further host names of the server, for example the name of a reverse proxy. Pages of these hosts
            may also send requests.
        any_host: Whether to accept every value of the header `Host`. DNS rebinding is harmless if requests must contain
            a token, because a page of another site does not have the token. It is also harmless if the server listens
            on a Unix socket.
    """

    def __init__(self, host: str = LOCALHOST, allowed_hosts: Iterable[str] = (), *, any_host: bool = False) -> None:
        self._allowed_names = frozenset(map(host_name, allowed_hosts))
        self._host_names = self._allowed_names | {LOCALHOST, host.lower()}
        self._any_host = any_host
        self._cached_reason = lru_cache(CACHED_REQUESTS)(self._refusal_reason)

    def check(self, method: str, headers: Mapping[bytes, bytes]) -> None:
        """Check the headers of a request, and raise an error if the request is refused.

        Args:
            method: Method in capitals.
            headers: Value of each header by the name of the header in lower case.

        Raises:
            OriginError: If a page of another site has sent the request, or if `Host` is not a name of this server.
        """
        get = headers.get
        reason = self._cached_reason(
            method,
            get(b"host", b""),
            get(b"origin"),
            get(b"sec-fetch-site"),
            get(b"sec-fetch-mode"),
            get(b"sec-fetch-dest"),
        )
        if reason is not None:
            raise OriginError(reason)

    def _refusal_reason(
        self,
        method: str,
        host: bytes,
        origin: bytes | None,
        fetch_site: bytes | None,
        fetch_mode: bytes | None,
        fetch_dest: bytes | None,
    ) -> str | None:
        """Return the reason why a request is refused, or None if the request is accepted.

        First, the header `Host` must contain a name or an address of this server, unless every host is accepted.
        Second, if the request has a header `Origin`, it must contain the origin of a page of this server. Third, if the
        request has no header `Origin`, the header `Sec-Fetch-Site` must not state that another site has sent the
        request. As an exception, the user may follow a link on another site to a page of this server.

        Args:
            method: Method in capitals.
            host: Value of the header `Host`. It is empty if the request has no such header.
            origin: Value of the header `Origin`, or None if the request has no such header.
            fetch_site: Value of the header `Sec-Fetch-Site`, or None if the request has no such header.
            fetch_mode: Value of the header `Sec-Fetch-Mode`, or None if the request has no such header.
            fetch_dest: Value of the header `Sec-Fetch-Dest`, or None if the request has no such header.
        """
        is_accepted_host = self._any_host or self._is_served(host)
        if not is_accepted_host:
            return (
                f"Host: expected an IP address or one of {self._served_names()}, got {_quoted(host)}; use the server's "
                "address, or name the host by --allow-host"
            )
        if origin is not None:
            if self._is_own_page(origin, host):
                return None
            return (
                f"Origin: expected a page of this server, got a page of {_quoted(origin)}; open {_quoted(host)} "
                "itself, or name the page's host by --allow-host"
            )
        # Programs other than browsers do not send the header Sec-Fetch-Site.
        if fetch_site is None or fetch_site.lower() in TRUSTED_FETCH_SITES:
            return None
        # A link on another site may open a page of this server, because the other site cannot read the response.
        is_link = method in ("GET", "HEAD") and fetch_mode == b"navigate" and fetch_dest == b"document"
        if is_link:
            return None
        return (
            f"Sec-Fetch-Site: expected a request by a page of this server, got {_quoted(fetch_site)}; open the page of "
            f"{_quoted(host)}"
        )

    def _is_served(self, host: bytes) -> bool:
        """Return whether the header `Host` contains an IP address or a name of this server.

        A missing header is accepted.
        """
        if not host:  # HTTP/1.0 does not require the header, but browsers always send it
            return True
        name = _name_in(f"//{host.decode('latin-1')}")
        return ip_address(name) is not None or name in self._host_names

    def _is_own_page(self, origin: bytes, host: bytes) -> bool:
        """Return whether the page that has sent a request belongs to this server.

        A page belongs to this server in two cases:

        - Its origin contains the same host and the same port as the header `Host`.
        - Its host name is one of `allowed_hosts` and differs from the name in the header `Host`. The names differ if a
          reverse proxy has replaced the header `Host`.

        Args:
            origin: Value of the header `Origin`, which is the origin of the page, such as b"http://localhost:8000".
            host: Value of the header `Host`, for example b"localhost:8000".
        """
        scheme, _, page_host = origin.decode("latin-1").lower().partition("://")
        if scheme not in ("http", "https"):
            return False
        requested_host = host.decode("latin-1").lower()
        if page_host == requested_host:
            return True
        # The following names contain no ports. If the names are equal, only the ports of the page and of the requested
        # host differ. The page then belongs to another server on the same machine.
        page_name = _name_in(f"//{page_host}")
        requested_name = _name_in(f"//{requested_host}")
        return page_name in self._allowed_names and page_name != requested_name

    def _served_names(self) -> str:
        """Return the host names of this server in alphabetical order, separated by commas."""
        return ", ".join(sorted(self._host_names))


def header_values(headers: Iterable[tuple[bytes, bytes]]) -> dict[bytes, bytes]:
    """Return the value of each header by its name. The values of a repeated header are joined (RFC 9110, 5.3).

    Args:
        headers: Pairs of the name of a header in lower case and its value.

    Raises:
        RequestError: If the header `Host` is repeated (RFC 9112, 3.2). A proxy could have checked the other value.
    """
    pairs = list(headers)
    values = dict(pairs)
    if len(values) == len(pairs):  # no header is repeated
        return values
    values = {}
    for name, value in pairs:
        if name not in values:
            values[name] = value
        elif name == b"host":
            raise RequestError(f"Host: expected one header, got {_quoted(values[name])} and {_quoted(value)}; send one")
        else:
            values[name] += b", " + value
    return values


def host_name(text: str) -> str:
    """Check a value of the option --allow-host, and return the host name in lower case.

    Args:
        text: Host name or IP address. An IPv6 address may be in square brackets.

    Raises:
        InputError: If the text is not a host name or an IP address, for example because it also contains a scheme, a
            port or a path.
    """
    name = text.strip().lower()
    is_printable_ascii = name.isascii() and name.isprintable()
    has_forbidden_character = any(character in name for character in "/@?#%* ,\\")  # no host name contains these

    is_bracketed = name.startswith("[") and name.endswith("]")
    if is_bracketed:
        name = name[1:-1]
    has_port = ":" in name and ip_address(name) is None  # the only names with colons are IPv6 addresses
    if not name or not is_printable_ascii or has_forbidden_character or has_port:
        raise InputError(f"--allow-host: expected a host name without scheme, port and path, got {text!r:.100}")
    return name.removesuffix(".")  # "example.org." is the same host as "example.org"


def _name_in(url: str) -> str:
    """Return the host name in a URL in lower case, or "?" if the URL contains no host name."""
    try:
        name = urlsplit(url).hostname or "?"
    except ValueError:
        return "?"
    return name.removesuffix(".")


def _quoted(value: bytes) -> str:
    """Return the value of a header as a quoted text for an error message. Long values are shortened."""
    return repr(value[:100].decode("latin-1"))
