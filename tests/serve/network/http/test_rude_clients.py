"""Clients that keep to HTTP and still ask for much: thousands at once, other protocols, half of a connection."""

import json
import re
import socket
import ssl
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
import trustme

from isocharge.serve.network.credentials import Tls
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.protocol import Handler

BODY = json.dumps(
    {"inputs": [{"name": "charge_pC", "datatype": "FP32", "shape": [1, 3], "data": [100.0, 200.0, 300.0]}]}
).encode()
INFER = b"POST /v2/models/linear/infer HTTP/1.1\r\nHost: x\r\n%sContent-Length: %d\r\n\r\n%s"
LOAD = b"POST /v2/repository/models/linear/load HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n\r\n"


def infer(headers=b"", body=BODY):
    return INFER % (headers, len(body), body)


def connect(server):
    host, port = server.url.split("//")[1].split(":")
    return socket.create_connection((host, int(port)), timeout=20)


def everything(connection):
    data = bytearray()
    while piece := connection.recv(1 << 16):
        data += piece
    return bytes(data)


def statuses(data):
    return re.findall(rb"HTTP/1\.1 (\d+)", data)


@pytest.fixture
def server(handler, start_http):
    return start_http(handler)


@pytest.mark.parametrize("piece", [1 << 30, 70_000, 4096, 1000])
def test_many_requests_at_once(server, piece):
    """However they are cut into pieces, each is answered."""
    count = 10_000 if piece > 4096 else 1000
    requests = infer() * (count - 1) + infer(b"Connection: close\r\n")
    with connect(server) as connection:
        sender = threading.Thread(
            target=lambda: [connection.sendall(requests[at : at + piece]) for at in range(0, len(requests), piece)]
        )
        sender.start()
        answered = statuses(everything(connection))
        sender.join()
    assert answered == [b"200"] * count


def test_a_client_that_sends_thousands_lets_others_go_first(server):
    """Another's request waits for a turn, not for all of them."""
    requests = infer() * 20_000
    with connect(server) as greedy, connect(server) as patient:
        greedy.settimeout(20)

        def read():
            try:
                while greedy.recv(1 << 20):
                    pass
            except OSError:
                pass

        threads = [threading.Thread(target=read), threading.Thread(target=lambda: _send(greedy, requests))]
        for thread in threads:
            thread.start()
        waits = []
        for _ in range(50):
            began = time.perf_counter()
            patient.sendall(infer())
            assert statuses(patient.recv(1 << 16)) == [b"200"]
            waits.append(time.perf_counter() - began)
        greedy.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join()
    assert sorted(waits)[25] < 0.02, sorted(waits)


def _send(connection, data):
    with suppress(OSError):
        connection.sendall(data)


@pytest.mark.parametrize("protocol", ["h2c", "websocket", "TLS/1.3"])
@pytest.mark.parametrize("piece", [1 << 20, 7])
def test_an_upgrade_is_ignored(server, protocol, piece):
    """As HTTP lets a server do (RFC 9110, 7.8): the request is answered, and so is the next one."""
    upgrade = f"Connection: Upgrade, HTTP2-Settings\r\nUpgrade: {protocol}\r\nHTTP2-Settings: AAMAAABkAAQAAP__\r\n"
    bodiless = b"GET /v2 HTTP/1.1\r\nHost: x\r\n%s\r\n" % upgrade.encode()
    requests = infer(upgrade.encode()) + bodiless + infer(b"Connection: close, upgrade\r\nUpgrade: h2c\r\n")
    with connect(server) as connection:
        for at in range(0, len(requests), piece):
            connection.sendall(requests[at : at + piece])
        assert statuses(everything(connection)) == [b"200"] * 3


def test_a_tunnel_is_refused(server):
    with connect(server) as connection:
        connection.sendall(b"CONNECT example.org:443 HTTP/1.1\r\nHost: example.org\r\n\r\n")
        assert statuses(everything(connection)) == [b"400"]


@pytest.mark.parametrize("requests", [[LOAD], [infer()], [LOAD, infer(), LOAD], [infer()] * 3000])
def test_half_a_connection_is_enough_for_answers(server, requests):
    with connect(server) as connection:
        sender = threading.Thread(
            target=lambda: (connection.sendall(b"".join(requests)), connection.shutdown(socket.SHUT_WR))
        )
        sender.start()
        assert statuses(everything(connection)) == [b"200"] * len(requests)
        sender.join()


@pytest.fixture
def certificate(tmp_path):
    authority = trustme.CA()
    issued = authority.issue_cert("127.0.0.1")
    issued.private_key_and_cert_chain_pem.write_to_path(tmp_path / "both.pem")
    return authority, Tls(tmp_path / "both.pem")


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_half_handshakes_are_bounded(store, start_http, certificate):
    """In number and in time; a client that finishes its own is served meanwhile."""
    authority, tls = certificate
    server = start_http(Handler(store, ServerLimits(connections=20, header_seconds=1.0)), tls=tls)
    trusted = ssl.create_default_context()
    authority.configure_trust(trusted)
    hello = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"

    def is_answered():
        with trusted.wrap_socket(connect(server), server_hostname="127.0.0.1") as secure:
            secure.sendall(infer(b"Connection: close\r\n"))
            return statuses(everything(secure)) == [b"200"]

    assert is_answered()  # so the server has opened what it needs
    with ExitStack() as stack:
        before = open_files()
        half = [stack.enter_context(connect(server)) for _ in range(60)]
        for number, connection in enumerate(half):
            _send(connection, hello[: number % 11])
        began = time.monotonic()
        while open_files() - before > 60 + 20:
            assert time.monotonic() - began < 5.0
            time.sleep(0.02)
        for connection in half:
            with suppress(ConnectionResetError):
                assert b"HTTP" not in everything(connection)
        assert time.monotonic() - began < 10.0
        assert is_answered()
    while open_files() > before:
        assert time.monotonic() - began < 20.0
        time.sleep(0.02)


def test_a_request_with_the_last_byte_of_the_handshake(store, start_http, certificate):
    """It comes before the connection is known to be up, and is not lost."""
    authority, tls = certificate
    server = start_http(Handler(store), tls=tls)
    trusted = ssl.create_default_context()
    authority.configure_trust(trusted)
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = trusted.wrap_bio(incoming, outgoing, server_hostname="127.0.0.1")
    with connect(server) as connection:
        while True:
            try:
                client.do_handshake()
                break
            except ssl.SSLWantReadError:
                connection.sendall(outgoing.read())
                incoming.write(connection.recv(1 << 16))
        client.write(infer(b"Connection: close\r\n"))
        connection.sendall(outgoing.read())  # the end of the handshake and the request in one piece
        data = b""
        while b"200 OK" not in data:
            piece = connection.recv(1 << 16)
            assert piece
            incoming.write(piece)
            try:
                data += client.read(1 << 16)
            except ssl.SSLWantReadError:
                continue


def test_who_never_asks_makes_room(store, start_http):
    """When all places are taken, the oldest connection without one complete request gives its own."""
    server = start_http(Handler(store, ServerLimits(connections=20)))
    with ExitStack() as stack:
        silent = [stack.enter_context(connect(server)) for _ in range(20)]
        for number, connection in enumerate(silent):
            connection.sendall(infer()[: number * 7])
        for _ in range(5):
            with connect(server) as good:
                good.sendall(infer(b"Connection: close\r\n"))
                assert statuses(everything(good)) == [b"200"]
