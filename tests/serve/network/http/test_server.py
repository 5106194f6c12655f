"""The HTTP server on real sockets: bounds, slow and rude clients, token, TLS, Unix socket, a graceful stop."""

import http.client
import json
import socket
import ssl
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from threading import Event, Thread

import numpy as np
import pytest
import trustme

from isocharge.serve import Predictor
from isocharge.serve.network.address import Address
from isocharge.serve.network.credentials import Tls, Token
from isocharge.serve.network.http import HttpServer
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.protocol import Handler

INFER = "/v2/models/linear/infer"
BODY = json.dumps(
    {"inputs": [{"name": "charge_pC", "datatype": "FP32", "shape": [1, 3], "data": [100.0, 200.0, 300.0]}]}
).encode()


def place(server):
    host, port = server.url.split("//")[1].split(":")
    return host, int(port)


def connect(server):
    return socket.create_connection(place(server), timeout=20)


def post(server, body=BODY, path=INFER, **headers):
    """One request on a connection of its own: (status, content)."""
    client = http.client.HTTPConnection(*place(server), timeout=20)
    client.request("POST", path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    answer = client.getresponse()
    content = json.loads(answer.read())
    client.close()
    return answer.status, content


def everything(connection):
    """What the server says until it hangs up."""
    data = b""
    while piece := connection.recv(1 << 16):
        data += piece
    connection.close()
    return data


def drip(connection, data, count, pause=0.0):
    """Send the same again and again."""
    for _ in range(count):
        connection.sendall(data)
        time.sleep(pause)


def refused(data):
    """Status and error of one answer after which the server hung up."""
    head, _, body = data.partition(b"\r\n\r\n")
    assert b"connection: close" in head
    return int(head.split(b" ")[1]), json.loads(body)["error"]


@pytest.fixture
def limited(store, start_http):
    """Start a server with limits of the test's."""
    return lambda **limits: start_http(Handler(store, ServerLimits(**limits)))


@pytest.fixture
def server(limited):
    return limited()


def test_answers_equal_those_in_process(server, tmp_path):
    status, content = post(server)
    contact = Predictor(tmp_path / "models/linear").predict([100.0, 200.0, 300.0])
    assert status == 200
    np.testing.assert_array_equal(
        np.float32([value for output in content["outputs"] for value in output["data"]]), np.float32(contact)
    )


def test_one_connection_carries_many_requests(server):
    client = http.client.HTTPConnection(*place(server), timeout=20)
    for path, status in ((INFER, 200), ("/nope", 404), (INFER, 200)):
        client.request("POST", path, BODY)
        answer = client.getresponse()
        assert (answer.status, bool(answer.read())) == (status, True)
    client.close()


def test_head_is_get_without_the_body(server):
    client = http.client.HTTPConnection(*place(server), timeout=20)
    client.request("HEAD", "/v2")
    answer = client.getresponse()
    assert (answer.status, answer.read()) == (200, b"")
    client.close()


@pytest.mark.parametrize(
    "data",
    [b"\x16\x03\x01\x02\x00", b"HELLO\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"GET /\xff HTTP/1.1\r\nA\x00: b\r\n\r\n"],
)
def test_what_is_not_http(server, data):
    with connect(server) as connection:
        connection.sendall(data)
        assert refused(everything(connection))[0] == 400


@pytest.mark.parametrize("end", [b"", b"\r\n\r\n"])
@pytest.mark.parametrize(
    "head",
    [b"GET /v2 HTTP/1.1\r\nA: " + b"b" * 5000, b"GET /" + b"a" * 5000, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 900],
)
@pytest.mark.parametrize("piece", [100_000, 1000])
def test_long_headers(limited, head, end, piece):
    with connect(limited(header_bytes=4096)) as connection:
        try:
            for start in range(0, len(head), piece):
                connection.sendall(head[start : start + piece])
            connection.sendall(end)
        except (BrokenPipeError, ConnectionResetError):
            pass
        status, error = refused(everything(connection))
    assert (status, error) == (431, "the request line and headers are longer than 4096 bytes")


def test_a_body_that_says_it_is_too_long(limited):
    status, content = post(limited(body_bytes=1000), bytes(1001))
    assert (status, "at most 1000" in content["error"] or "1000 bytes" in content["error"]) == (413, True)


def test_a_body_that_never_ends(limited):
    with connect(limited(body_bytes=1000)) as connection:
        connection.sendall(b"POST %s HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n" % INFER.encode())
        try:
            for _ in range(10_000):
                connection.sendall(b"100\r\n" + bytes(256) + b"\r\n")
        except OSError:
            pass
        with connection:
            try:
                data = everything(connection)
            except ConnectionResetError:
                return  # it hung up on us in the middle of a piece
    assert refused(data)[0] == 413


@pytest.mark.parametrize("declared", [10**6, 10**18, 10**30])
def test_a_huge_declared_body(limited, declared):
    with connect(limited(body_seconds=0.3)) as connection:
        connection.sendall(b"POST %s HTTP/1.1\r\nContent-Length: %d\r\n\r\n{" % (INFER.encode(), declared))
        assert refused(everything(connection))[0] in (400, 408, 413)


@pytest.mark.parametrize(
    ("sent", "limits", "status"),
    [
        (b"GET /v2 HTTP/1.1\r\nHost:", {"header_seconds": 0.3}, 408),
        (b"POST / HTTP/1.1\r\nContent-Length: 10\r\n\r\n{", {"body_seconds": 0.3}, 408),
        (b"", {"header_seconds": 0.3}, None),
        (b"GET /v2 HTTP/1.1\r\n\r\n", {"idle_seconds": 0.3}, 200),
    ],
    ids=["headers", "body", "nothing at all", "idle"],
)
def test_time_runs_out(limited, sent, limits, status):
    with connect(limited(**limits)) as connection:
        connection.sendall(sent)
        data = everything(connection)
    assert data[9:12] == (b"" if status is None else b"%d" % status)
    assert status != 408 or "waited too long for the end of the" in refused(data)[1]


def test_drops_that_keep_coming_do_not_buy_time(limited):
    with connect(limited(header_seconds=0.5)) as connection, pytest.raises(OSError, match=r"reset|Broken pipe"):
        drip(connection, b"X", 200, pause=0.05)


def test_too_many_connections(limited):
    server = limited(connections=3)
    with ExitStack() as stack:
        for _ in range(3):
            held = stack.enter_context(connect(server))
            held.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
            held.recv(1000)
        status, error = refused(everything(connect(server)))
    assert (status, error) == (503, "all 3 connections are taken; try again later")
    end = time.monotonic() + 10
    while post(server)[0] != 200 and time.monotonic() < end:
        time.sleep(0.02)
    assert post(server)[0] == 200


def test_200_slow_clients_hold_nobody_up(server):
    """They never finish a request; others are answered as ever, and afterwards the server still has its wits."""
    parts = (b"", b"PO", b"POST %s HTTP/1.1\r\nHo" % INFER.encode(), b"POST / HTTP/1.1\r\nContent-Length: 99\r\n\r\n{")
    with ExitStack() as stack:
        for number in range(200):
            stack.enter_context(connect(server)).sendall(parts[number % 4])
        assert [post(server)[0] for _ in range(20)] == [200] * 20
    assert post(server)[0] == 200


def test_a_client_that_does_not_read(limited, film):
    server = limited(body_seconds=0.5)
    tensor = {"name": "charge_pC", "datatype": "FP32", "shape": [4096, 3]}
    tensor["data"] = np.resize(film.golden_pC(), 4096 * 3).tolist()
    body = json.dumps({"inputs": [tensor]}).encode()
    request = b"POST %s HTTP/1.1\r\nContent-Length: %d\r\n\r\n%s" % (INFER.encode(), len(body), body)
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.settimeout(20)
        connection.connect(place(server))
        with pytest.raises(OSError, match=r"reset|Broken pipe"):
            drip(connection, request, 100)
    assert post(server)[0] == 200


@pytest.mark.parametrize("token", [None, Token("open sesame")])
def test_trailers_without_end(store, start_http, token):
    """They are refused as headers are, before any token is looked at, and cost no memory."""
    server = start_http(Handler(store, token=token))
    head = b"POST %s HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n" % INFER.encode()
    for endless in (b"a: b\r\n", b"a: " + b"b" * 1000):
        with connect(server) as connection:
            with suppress(OSError):
                connection.sendall(head + endless * (10_000_000 // len(endless)))
            with suppress(ConnectionResetError):
                assert refused(everything(connection))[0] == 431


def test_a_token(store, start_http):
    server = start_http(Handler(store, token=Token("open sesame")))
    assert post(server, Authorization="Bearer open sesame")[0] == 200
    for headers in ({}, {"Authorization": "Bearer open"}, {"Authorization": "open sesame"}):
        status, content = post(server, **headers)
        assert (status, "expected the header `Authorization: Bearer TOKEN`" in content["error"]) == (401, True)
    client = http.client.HTTPConnection(*place(server), timeout=20)
    client.request("GET", "/v2/health/ready")
    assert client.getresponse().status == 200
    client.close()


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    """A certificate authority and the files of a certificate for 127.0.0.1: (authority, certificate, key)."""
    folder, made = tmp_path_factory.mktemp("tls"), trustme.CA()
    issued = made.issue_cert("127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(folder / "cert.pem")
    issued.private_key_pem.write_to_path(folder / "key.pem")
    issued.private_key_and_cert_chain_pem.write_to_path(folder / "both.pem")
    return made, folder


@pytest.mark.parametrize("files", [("cert.pem", "key.pem"), ("both.pem", None)])
def test_tls(store, start_http, authority, files):
    made, folder = authority
    certificate, key = (name and folder / name for name in files)
    server = start_http(Handler(store), tls=Tls(certificate, key))
    assert server.url.startswith("https://")
    context = ssl.create_default_context()
    made.configure_trust(context)
    client = http.client.HTTPSConnection(*place(server), context=context, timeout=20)
    client.request("POST", INFER, BODY)
    assert client.getresponse().status == 200
    client.close()


def test_stopping_finishes_what_is_in_flight(handler, store, monkeypatch):
    """A load that takes a second is answered although the server is told to stop meanwhile; no request comes after."""
    began, load = Event(), store.load

    def slow(name):
        began.set()
        time.sleep(1.0)
        load(name)

    monkeypatch.setattr(store, "load", slow)
    server = HttpServer(handler, Address())
    thread = Thread(target=server.run)
    thread.start()
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(post, server, b"", "/v2/repository/models/linear/load")
        assert began.wait(10)
        server.stop()
        assert asked.result() == (200, {})
    thread.join(20)
    server.close()
    assert not thread.is_alive()
    with pytest.raises(ConnectionRefusedError):
        connect(server)


def test_answers_come_in_the_order_of_requests(server, store, monkeypatch):
    """What is answered on the spot does not overtake what takes long, on one connection."""
    load = store.load
    monkeypatch.setattr(store, "load", lambda name: (time.sleep(0.3), load(name)))
    requests = ("POST /v2/repository/models/linear/load", "GET /v2/health/live", "GET /nope", "GET /v2/health/ready")
    with connect(server) as connection:
        for request in requests:
            connection.sendall(f"{request} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        connection.sendall(b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n")
        answers = everything(connection).split(b"HTTP/1.1 ")[1:]
    bodies = [answer.partition(b"\r\n\r\n")[2] for answer in answers]
    assert [answer[:3] for answer in answers] == [b"200", b"200", b"404", b"200", b"200"]
    assert (bodies[0], bodies[1], bodies[3]) == (b"{}", b'{"live":true}', b'{"ready":true}')


def test_a_client_that_asks_whether_to_go_on(server):
    with connect(server) as connection:
        head = b"POST %s HTTP/1.1\r\nExpect: 100-continue\r\nConnection: close\r\nContent-Length: %d\r\n\r\n"
        connection.sendall(head % (INFER.encode(), len(BODY)))
        assert connection.recv(100) == b"HTTP/1.1 100 Continue\r\n\r\n"
        connection.sendall(BODY)
        assert everything(connection).startswith(b"HTTP/1.1 200")


def test_stopping_waits_for_a_request_that_has_begun(handler):
    server = HttpServer(handler, Address())
    thread = Thread(target=server.run)
    thread.start()
    with connect(server) as begun, connect(server) as idle:
        request = b"POST %s HTTP/1.1\r\nContent-Length: %d\r\n\r\n%s" % (INFER.encode(), len(BODY), BODY)
        begun.sendall(request[:-5])
        idle.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
        idle.recv(1000)
        server.stop()
        assert idle.recv(1000) == b""
        begun.sendall(request[-5:])
        data = everything(begun)
    thread.join(20)
    server.close()
    assert data.startswith(b"HTTP/1.1 200")
    assert b"connection: close" in data


def test_a_load_holds_nobody_up(server, store, monkeypatch):
    began, go_on, load = Event(), Event(), store.load

    def slow(name):
        began.set()
        go_on.wait(20)
        load(name)

    monkeypatch.setattr(store, "load", slow)
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(post, server, b"", "/v2/repository/models/linear/load")
        assert began.wait(10)
        assert post(server)[0] == 200
        go_on.set()
        assert asked.result()[0] == 200
