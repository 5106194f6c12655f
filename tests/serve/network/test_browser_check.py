"""Check of Host, Origin and Sec-Fetch-Site, which refuses requests of browsers for pages of other sites."""

from contextlib import nullcontext

import pytest

from isocharge.common.errors import InputError, RequestError
from isocharge.serve.network.browser_check import AccessCheck, host_name
from isocharge.serve.network.protocol.handler import Handler


def headers_of(**headers):
    """Return headers as bytes. An underscore in a name stands for a hyphen."""
    return {name.replace("_", "-").encode(): value.encode() for name, value in headers.items()}


SERVED = [
    {"host": "127.0.0.1:8000"},
    {"host": "[::1]:8000"},
    {"host": "192.168.1.7:8000"},
    {"host": "LocalHost:8000"},
    {"host": "localhost.:8000"},
    {},  # HTTP/1.0
    {"host": "localhost:8000", "origin": "http://localhost:8000", "sec_fetch_site": "same-origin"},
    {"host": "localhost:8000", "sec_fetch_site": "none", "sec_fetch_mode": "navigate"},  # the address was typed
]

REFUSED = [
    ({"host": "evil.example:8000"}, "Host"),
    ({"host": "evil.example", "origin": "http://evil.example"}, "Host"),
    ({"host": "localhost.evil.example"}, "Host"),
    ({"host": "localhost@evil.example"}, "Host"),  # a user name
    ({"host": "127.1:8000"}, "Host"),
    ({"host": "[::1"}, "Host"),
    ({"host": "127.0.0.1:8000", "origin": "https://evil.example"}, "Origin"),
    ({"host": "127.0.0.1:8000", "origin": "http://127.0.0.1:3000"}, "Origin"),
    ({"host": "127.0.0.1:8000", "origin": "null"}, "Origin"),  # a page in a sandbox
    ({"host": "127.0.0.1:8000", "origin": "file://"}, "Origin"),
    ({"host": "127.0.0.1:8000", "sec_fetch_site": "cross-site"}, "Sec-Fetch-Site"),
    ({"host": "127.0.0.1:8000", "sec_fetch_site": "same-site"}, "Sec-Fetch-Site"),
    ({"host": "127.0.0.1:8000", "sec_fetch_site": "new-value"}, "Sec-Fetch-Site"),
]


@pytest.mark.parametrize("headers", SERVED)
def test_clients_and_own_pages_are_served(headers):
    AccessCheck().check("POST", headers_of(**headers))


@pytest.mark.parametrize(("headers", "header"), REFUSED)
def test_pages_of_other_sites_are_refused(headers, header):
    for method in ("GET", "POST"):
        with pytest.raises(RequestError, match=f"^{header}: expected"):
            AccessCheck().check(method, headers_of(**headers))


def test_repeated_host_and_repeated_origin_are_refused(handler):
    """A second Host or Origin could be the one that a proxy has not checked."""
    own, other = (b"host", b"localhost"), (b"host", b"127.0.0.1")
    origins = [(b"origin", b"http://localhost"), (b"origin", b"http://evil.example")]
    for headers, status in [([own], 200), ([own, other], 400), ([own, own], 400), ([own, *origins], 400)]:
        for order in (headers, headers[::-1]):
            assert handler.answer("GET", "/v2", order, b"").status == status


def test_link_on_another_site_is_accepted():
    link = headers_of(
        host="127.0.0.1:8000", sec_fetch_site="cross-site", sec_fetch_mode="navigate", sec_fetch_dest="document"
    )
    AccessCheck().check("GET", link)
    for method, changes in (("POST", {}), ("GET", {b"sec-fetch-dest": b"iframe"})):
        with pytest.raises(RequestError, match="Sec-Fetch-Site"):
            AccessCheck().check(method, link | changes)


@pytest.mark.parametrize(
    ("host", "origin", "message"),
    [
        ("robot.example", "https://robot.example", None),
        ("127.0.0.1:8000", "https://robot.example:8443", None),  # the proxy replaces the name
        ("robot.example", "https://robot.example:8443", None),  # nginx: proxy_set_header Host $host
        ("robot.example:443", "https://robot.example", None),  # nginx: proxy_set_header Host $host:$server_port
        ("other.example", "", r"Host: .*0\.0\.0\.0, localhost, robot\.example, .*\(allowed_hosts of asgi_app\)"),
        ("robot.example:8000", "http://robot.example:3000", "Origin: expected a page of this server"),
        ("robot.example:443", "https://robot.example.evil.example:1", "Origin: expected a page of this server"),
        ("robot.example:443", "http://robot.example", "Origin: expected a page of this server"),
    ],
)
def test_allow_host_accepts_pages_behind_a_proxy_and_none_of_another_port(host, origin, message):
    expected = pytest.raises(RequestError, match=message) if message else nullcontext()
    for allowed_hosts in (["Robot.Example"], "Robot.Example"):
        with expected:
            AccessCheck("0.0.0.0", allowed_hosts).check("POST", headers_of(host=host, origin=origin))


@pytest.mark.parametrize(
    "name", ["", " ", ".", "http://robot", "robot:8000", "robot/path", "*", "a b", "ro\nbot", "roböt"]
)
def test_allow_host_expects_a_plain_name(name):
    with pytest.raises(
        InputError, match=r"\(allowed_hosts of asgi_app\): expected a host name without scheme, port and path"
    ):
        host_name(name)


def test_with_a_token_any_host_name_is_served(store):
    handler = Handler(store, access=AccessCheck(token="sesame"))
    headers = [(b"host", b"inference.cluster.local"), (b"authorization", b"Bearer sesame")]
    assert handler.answer("GET", "/v2", headers, b"").status == 200
    assert handler.answer("GET", "/v2", [*headers, (b"origin", b"http://evil.example")], b"").status == 403
