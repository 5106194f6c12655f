"""Who may follow a film: the token, and pages of this server."""

import base64

import pytest

from isocharge.common.errors import OriginError, TokenError
from isocharge.serve.network.credentials import Token
from isocharge.serve.viewer.access import Access


def bearer(token):
    return "bearer." + base64.urlsafe_b64encode(token.encode()).decode().rstrip("=")


@pytest.mark.parametrize("host", [b"127.0.0.1:8001", b"localhost:8001", b"[::1]:8001", b"192.168.1.7"])
def test_this_machine_s_page_is_answered(host):
    Access().check({b"host": host, b"origin": b"http://" + host})


@pytest.mark.parametrize(
    "origin", [b"http://evil.example", b"null", b"http://127.0.0.1:9999", b"http://[", b"file://", b"\xff\xfe"]
)
def test_another_site_s_page_is_refused(origin):
    with pytest.raises(OriginError):
        Access().check({b"host": b"127.0.0.1:8001", b"origin": origin})


def test_a_name_that_points_here_is_refused():
    """DNS rebinding: the page and the server then have the same name, and it is not ours."""
    headers = {b"host": b"evil.example:8001", b"origin": b"http://evil.example:8001"}
    with pytest.raises(OriginError, match="this machine's address"):
        Access().check(headers)
    Access(host="evil.example").check(headers)  # that is the name on which it was told to listen
    Access(Token("secret")).check(headers | {b"authorization": b"Bearer secret"})  # nobody has it by accident


def test_token_by_header_or_subprotocol():
    access, headers = Access(Token("s3cret?>~")), {b"host": b"127.0.0.1:1"}
    access.check(headers | {b"authorization": b"Bearer s3cret?>~"})
    access.check(headers, ["isocharge.live.1", bearer("s3cret?>~")])
    for offered in ([], ["isocharge.live.1"], [bearer("other")], ["bearer.***"], ["bearer."], ["bearer.\u00e9"]):
        with pytest.raises(TokenError):
            access.check(headers, offered)
