"""Where a server listens and whom it lets in: addresses, Unix sockets, tokens, certificate files."""

import os
import resource
import socket
import stat

import pytest

from isocharge.common.errors import InputError, ListenError, RequestError
from isocharge.serve.network.address import Address, Tls, check_exposure
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.network.http.server import HttpServer


@pytest.mark.parametrize("token", ["", " a", "a\n", "schlüssel", "100%"])
def test_invalid_tokens_are_refused(token):
    with pytest.raises(InputError, match="printable ASCII"):
        AccessCheck(token=token)


@pytest.mark.parametrize(
    ("certificate", "key"), [("none.pem", "none.pem"), ("cert.pem", "cert.pem"), ("key.pem", "cert.pem"), (".", ".")]
)
def test_tls_files_that_cannot_be_used(handler, tls_files, certificate, key):
    tls = Tls(tls_files / certificate, tls_files / key)
    with pytest.raises(InputError, match=r"(pem|tls\d+): not a certificate whose unencrypted private key is in"):
        HttpServer(handler, Address(), tls)


def test_server_on_a_unix_socket_takes_over_a_socket_left_by_a_killed_server(handler, start_http, tmp_path):
    path = tmp_path / "touch.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    assert start_http(handler, uds=path).url == f"unix:{path}"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(path))
        connection.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
        assert connection.recv(1000).startswith(b"HTTP/1.1 200")


def test_server_that_accepts_no_connection_keeps_its_unix_socket(tmp_path):
    """A blocking connection to a socket whose queue is full would wait for ever."""
    path = tmp_path / "touch.sock"
    with Address(uds=path).listen() as full, socket.socket(socket.AF_UNIX) as waiting:
        full.listen(0)
        waiting.connect(str(path))
        with pytest.raises(ListenError, match=r"touch.sock: .*in use"):
            Address(uds=path).listen()


def test_addresses_in_use_or_impossible_are_refused(handler, start_http, tmp_path):
    start_http(handler, uds=tmp_path / "touch.sock")
    (tmp_path / "file").write_text("mine")
    host, port = start_http(handler).url.removeprefix("http://").split(":")
    for address, message in [
        (Address(host, int(port)), f"cannot listen on 127.0.0.1:{port}: .*in use"),
        (Address(uds=tmp_path / "touch.sock"), "touch.sock: .*in use; choose another address"),
        (Address(uds=tmp_path / "file"), "file: .*in use"),
        (Address(uds=tmp_path / "no/such.sock"), "cannot listen on"),
        (Address("192.0.2.1"), "cannot listen on 192.0.2.1:0: "),
        (Address("no.such.host.invalid"), "cannot listen on no.such.host.invalid:0: "),
    ]:
        with pytest.raises(ListenError, match=message):
            address.listen()
    assert (tmp_path / "file").read_text() == "mine"


def test_server_may_open_as_many_files_as_the_system_permits(handler):
    """The usual limit of a process, 1,024 descriptors, is too low for 1,024 connections."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft // 2, hard))
    HttpServer(handler, Address()).close()
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (hard, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize("client", ["127.0.0.1", "::1"])
def test_server_on_all_addresses_accepts_ipv4_and_ipv6(client):
    with Address("::").listen() as listening:
        socket.create_connection((client, listening.getsockname()[1]), timeout=20).close()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "example.org"])
def test_address_of_other_machines_needs_a_token(host):
    with pytest.raises(InputError, match=f"{host} lets other machines in: give --token TOKEN"):
        check_exposure(Address(host), None)
    check_exposure(Address(host), "sesame")
    for loopback in ("127.0.0.1", "::1", "localhost"):
        check_exposure(Address(loopback), None)


def test_unix_socket_of_another_server_is_not_replaced(handler, tmp_path):
    path = tmp_path / "touch.sock"
    first = HttpServer(handler, Address(uds=path))
    path.rename(tmp_path / "old.sock")  # so that the new one cannot get its number
    second = HttpServer(handler, Address(uds=path))
    first.close()
    assert path.is_socket()
    second.close()
    assert not path.exists()


@pytest.mark.timeout(20)
def test_certificate_that_is_a_pipe_is_refused(tmp_path):
    path = tmp_path / "cert.pem"
    os.mkfifo(path)
    with pytest.raises(InputError, match="not a regular file"):
        Tls(path, path).context()


def test_token_needs_the_bearer_scheme_in_any_case():
    access = AccessCheck(token="sesame")
    for accepted in (b"Bearer sesame", b"bEaReR sesame", b"bearer  sesame"):
        access.check_token(accepted)
    for wrong in (b"Bearer sesam", b"Bearer ", b"Bearer sesame ", b"sesame", b"Basic sesame", b""):
        with pytest.raises(RequestError, match="`Authorization: Bearer TOKEN`"):
            access.check_token(wrong)
