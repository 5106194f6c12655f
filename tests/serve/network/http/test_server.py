"""The HTTP server on real sockets: limits, slow clients, TLS, token, and finishing requests at the stop."""

import asyncio
import http.client
import json
import re
import select
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager, suppress
from threading import Event

import numpy as np
import orjson
import pytest

from infer_requests import BODY, INFER, infer_request
from isocharge.serve.network.address import ServerLimits, Tls
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.network.http.server import Connection
from isocharge.serve.network.protocol.handler import Handler

LOAD = b"POST /v2/repository/models/linear/load HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n"
LAST = b"Connection: close\r\n"


def infer(headers=b"", body=BODY):
    head = b"POST %s HTTP/1.1\r\nHost: localhost\r\n%sContent-Length: %d\r\n\r\n"
    return head % (INFER.encode(), headers, len(body)) + body


def connect(server):
    host, port = server.url.split("//")[1].split(":")
    return socket.create_connection((host, int(port)), timeout=60)


def everything(connection):
    """Return all bytes that the server sends until it closes or resets the connection."""
    data = bytearray()
    with suppress(ConnectionResetError):
        while piece := connection.recv(1 << 16):
            data += piece
    return bytes(data)


def send(connection, data, piece=1 << 30):
    """Send data in pieces until the server closes the connection."""
    with suppress(OSError):
        for start in range(0, len(data), piece):
            connection.sendall(data[start : start + piece])


def drip(connection, data, pause=0.0):
    """Send the same bytes a thousand times."""
    for _ in range(1000):
        connection.sendall(data)
        time.sleep(pause)


def exchange(server, data, piece=1 << 30):
    """Send data on a new connection, and return the answers until the server closes the connection."""
    with connect(server) as connection:
        send(connection, data, piece)
        return everything(connection)


def statuses(data):
    return [int(status) for status in re.findall(rb"HTTP/1\.1 (\d+)", data)]


def refused(data):
    """Return the status and the error of an answer after which the server closes the connection."""
    head, _, body = data.partition(b"\r\n\r\n")
    assert b"connection: close" in head
    return int(head.split(b" ")[1]), json.loads(body)["error"]


def is_well(server):
    return statuses(exchange(server, infer(LAST))) == [200]


def is_refused(server):
    with suppress(ConnectionRefusedError), connect(server):
        return False
    return True


def wait_until(condition):
    end = time.monotonic() + 30
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    assert condition()


@pytest.fixture
def limited(store, start_http):
    """Return a function that starts a server with given limits."""
    return lambda **limits: start_http(Handler(store, ServerLimits(**limits)))


@pytest.fixture
def server(limited):
    return limited()


def test_requests_of_a_stock_http_client(server, predictor):
    """The client sends bodies with a length and in chunks, and GET and HEAD requests, on one connection."""
    client = http.client.HTTPConnection(server.url.removeprefix("http://"), timeout=60)
    for body in (BODY, iter([BODY[:10], BODY[10:]])):
        client.request("POST", INFER, body)
        contact = json.loads(client.getresponse().read())["outputs"][0]["data"]
        np.testing.assert_array_equal(np.float32(contact), np.float32(predictor.predict([100.0, 200.0, 300.0])[:3]))
    for method, path, status, has_body in (("POST", "/nope", 404, True), ("HEAD", "/v2?a=b", 200, False)):
        client.request(method, path)
        answer = client.getresponse()
        assert (answer.status, bool(answer.read())) == (status, has_body)
        assert int(answer.headers["content-length"]) > 10
    client.close()


@pytest.mark.parametrize(
    "data",
    [
        b"\x16\x03\x01\x02\x00",
        b"GET /\xff HTTP/1.1\r\nA\x00: b\r\n\r\n",
        b"CONNECT example.org:443 HTTP/1.1\r\nHost: example.org\r\n\r\n",
    ],
)
def test_bytes_that_are_not_http_are_refused(server, data):
    assert refused(exchange(server, data))[0] == 400


@pytest.mark.parametrize("end", [b"", b"\r\n\r\n"])
@pytest.mark.parametrize(
    "head",
    [b"GET /v2 HTTP/1.1\r\nA: " + b"b" * 5000, b"GET /" + b"a" * 5000, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 900],
)
@pytest.mark.parametrize("piece", [100_000, 1000])
def test_headers_above_the_limit_are_refused(limited, head, end, piece):
    answer = refused(exchange(limited(header_bytes=4096), head + end, piece))
    assert answer == (431, "the request line and headers are longer than 4096 bytes")


def test_body_above_the_limit_is_refused(limited):
    """The first body states its length, the second body has no end, and the others state lengths that are too large."""
    server = limited(body_bytes=1000, body_seconds=0.3)
    assert b"at most 1000 bytes" in exchange(server, infer(LAST, bytes(1001)))
    chunks = b"100\r\n" + bytes(256) + b"\r\n"
    endless = b"POST /v2/repository/index HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n" + chunks * 10_000
    assert set(statuses(exchange(server, endless))) <= {413, 408}  # 408 if the client sends longer than 0.3 s
    for declared in (10**6, 10**18, 10**30):
        head = b"POST / HTTP/1.1\r\nContent-Length: %d\r\n\r\n{" % declared
        assert refused(exchange(server, head))[0] in (400, 408)


@pytest.mark.parametrize("rest", [b"", b"no chunk\r\n"])
def test_request_that_is_answered_before_its_end_gets_no_second_response(limited, rest):
    head = b"POST /v2/repository/index HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    with connect(limited(body_bytes=1000, body_seconds=0.3)) as connection:
        connection.sendall(head + b"800\r\n" + bytes(2048) + b"\r\n")
        answer = connection.recv(1000)
        connection.sendall(rest)
        assert statuses(answer + everything(connection)) == [413]


@pytest.mark.parametrize(
    ("sent", "limits", "status"),
    [
        (b"GET /v2 HTTP/1.1\r\nHost:", {"header_seconds": 0.3}, [408]),
        (b"POST / HTTP/1.1\r\nContent-Length: 10\r\n\r\n{", {"body_seconds": 0.3}, [408]),
        (b"", {"header_seconds": 0.3}, []),
    ],
)
def test_incomplete_request_gets_408_after_the_deadline(limited, sent, limits, status):
    data = exchange(limited(**limits), sent)
    assert statuses(data) == status
    assert status != [408] or "waited too long for the rest of the request" in refused(data)[1]


def test_slow_bytes_do_not_extend_the_deadline(limited):
    with connect(limited(header_seconds=0.3)) as connection, pytest.raises(OSError, match=r"reset|Broken pipe"):
        drip(connection, b"X", pause=0.05)


def test_empty_lines_do_not_extend_the_time_between_requests(limited):
    with connect(limited(idle_seconds=0.3)) as connection:
        connection.settimeout(5.0)
        connection.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
        connection.recv(1)
        connection.sendall(b"\r\n")
        everything(connection)


def test_connections_above_the_limit_are_refused(limited):
    server = limited(connections=3)
    with ExitStack() as stack:
        for _ in range(3):
            held = stack.enter_context(connect(server))
            held.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
            held.recv(1000)
            held.sendall(infer()[:-1])
        assert refused(exchange(server, b"")) == (503, "all 3 connections are taken; try again later")
    wait_until(lambda: is_well(server))


def test_connections_between_two_requests_make_room_for_new_ones(limited):
    server = limited(connections=3)
    with ExitStack() as stack:
        answered = [stack.enter_context(connect(server)) for _ in range(3)]
        for connection in answered:
            connection.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
            while not connection.recv(1000).endswith(b"}"):  # the head may arrive before the body
                pass
        assert is_well(server)
        ended, _, _ = select.select(answered, [], [], 5)  # s, less than the time allowed between two requests
        assert len(ended) == 1
        (kept, _) = {*answered} - {*ended}
        kept.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
        assert statuses(kept.recv(1000)) == [200]


def test_idle_connections_leave_open_files_for_new_connections(limited, monkeypatch):
    monkeypatch.setattr("resource.setrlimit", lambda *_: None)
    monkeypatch.setattr("resource.getrlimit", lambda _: (16, 16))
    server = limited()
    with ExitStack() as stack:
        idle = [stack.enter_context(connect(server)) for _ in range(20)]
        assert is_well(server)
        ended, _, _ = select.select(idle, [], [], 5)  # s, less than the deadline of a connection without a request
        assert ended


def test_client_that_does_not_read_is_disconnected(limited):
    server = limited(header_seconds=0.3, body_seconds=0.3)
    body = orjson.dumps(infer_request([[100.0, 200.0, 300.0]] * 4096))
    with connect(server) as connection, pytest.raises(OSError, match=r"reset|Broken pipe"):
        drip(connection, infer(body=body))
    assert is_well(server)


def test_client_that_fills_the_buffers_at_once_is_disconnected(limited, monkeypatch):
    begin = Connection.connection_made

    def begin_with_full_buffers(connection, transport):
        begin(connection, transport)
        connection.flow.pause_writing()

    monkeypatch.setattr(Connection, "connection_made", begin_with_full_buffers)
    server = limited(body_seconds=0.3)
    with connect(server) as client:
        client.settimeout(10)
        client.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
        assert everything(client) == b""


@pytest.mark.parametrize("protocol", ["h2c", "websocket"])
def test_upgrade_is_ignored_and_its_body_is_not_read_as_a_request(server, protocol):
    """HTTP allows a server to ignore the header (RFC 9110, 7.8). With a body, the error states what to do.

    Behind a proxy that forwards upgrades, a client could otherwise send requests that the proxy forbids.
    """
    upgrade = f"Connection: Upgrade\r\nUpgrade: {protocol}\r\n".encode()
    assert statuses(exchange(server, b"GET /v2 HTTP/1.1\r\nHost: localhost\r\n%s\r\n" % upgrade)) == [200]
    with connect(server) as connection:
        connection.sendall(infer(upgrade, LOAD).removesuffix(LOAD))
        answer = connection.recv(1000)
        send(connection, LOAD)
        assert statuses(answer + everything(connection)) == [400]
    assert b"set the client to HTTP/1.1" in answer


@pytest.mark.parametrize("requests", [[LOAD], [infer()], [LOAD, infer(), LOAD], [infer()] * 90])
@pytest.mark.parametrize("incomplete", [b"", infer()[:-5]])
def test_half_closed_connection_receives_its_responses(server, requests, incomplete):
    with connect(server) as connection, ThreadPoolExecutor(1) as threads:
        data = b"".join(requests) + incomplete
        threads.submit(lambda: (send(connection, data), connection.shutdown(socket.SHUT_WR)))
        assert statuses(everything(connection)) == [200] * len(requests)


@pytest.mark.parametrize(
    ("requests", "count"),
    [
        (infer() * 3000, 101),  # too many
        (infer() + b"no request\r\n\r\n", 2),  # not HTTP
        (b"POST /v2 HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nno chunk\r\n", 1),
        (b"GET /v2 HTTP/1.1\r\na: " + b"b" * 40_000, 1),  # the head is too long
    ],
)
def test_connection_is_closed_after_the_responses_to_the_requests_before_a_refused_one(server, requests, count):
    """Responses are sent in the order of the requests (RFC 9112, 9.3.2).

    Without a limit, a client could fill the memory with requests whose responses it does not read.
    """
    assert statuses(exchange(server, LOAD + requests)) == [200] * count
    assert is_well(server)


@pytest.mark.parametrize("endless", [b"0\r\n" + b"a: b\r\n" * 9000, b"0\r\na: " + b"b" * 50_000, b"1;" + b"x" * 50_000])
def test_trailers_and_chunk_extensions_have_the_limit_of_headers(server, endless):
    head = b"POST %s HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n3\r\nabc\r\n" % INFER.encode()
    with connect(server) as connection:
        connection.sendall(head)
        time.sleep(0.2)  # the bytes after the latest part of the body count
        send(connection, endless)
        assert statuses(everything(connection)) == [431]


def test_trailers_are_not_read_as_headers(server):
    head = b"POST /v2/repository/index HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n%s\r\n" % LAST
    assert statuses(exchange(server, head + b"2\r\n{}\r\n0\r\nOrigin: http://evil.example\r\n\r\n")) == [200]


@pytest.fixture
def slow_load(store, monkeypatch):
    """Let loads wait; return an event that is set when a load begins, and an event that lets the load continue."""
    began = Event()
    go_on = Event()
    load = store.load
    monkeypatch.setattr(store, "load", lambda name: (began.set(), go_on.wait(60), load(name)))
    yield began, go_on
    go_on.set()


def test_loading_a_model_delays_no_other_request(server, slow_load):
    began, go_on = slow_load
    with connect(server) as connection:
        connection.sendall(LOAD)
        assert began.wait(30)
        assert is_well(server)
        go_on.set()
        assert statuses(connection.recv(1000)) == [200]


def test_late_request_does_not_take_the_response_to_an_earlier_one(store, start_http, slow_load):
    _, go_on = slow_load
    with connect(start_http(Handler(store, ServerLimits(body_seconds=0.3)))) as connection:
        connection.sendall(LOAD + infer()[:-5])
        time.sleep(1.0)
        go_on.set()
        assert statuses(everything(connection)) == [200]


def ask_until_closed(server):
    """Send requests on one connection until a response closes it. Without a response, an exception is raised."""
    client = http.client.HTTPConnection(server.url.removeprefix("http://"), timeout=60)
    connection = None
    while connection != "close":
        client.request("HEAD", "/v2")
        with client.getresponse() as answer:
            connection = answer.headers["connection"]


def test_stop_finishes_requests_that_have_begun(server, slow_load):
    """A load, an incomplete request and requests in quick succession are finished. Idle connections are closed."""
    began, go_on = slow_load
    threads = ThreadPoolExecutor(1)
    with threads, connect(server) as loads, connect(server) as begun, connect(server) as idle:
        busy = threads.submit(ask_until_closed, server)
        loads.sendall(LOAD)
        begun.sendall(infer()[:-5])
        idle.sendall(b"GET /v2 HTTP/1.1\r\n\r\n")
        idle.recv(1000)
        assert began.wait(30)
        server.stop()
        assert idle.recv(1000) == b""
        busy.result()
        go_on.set()
        begun.sendall(infer()[-5:])
        for connection in (loads, begun):
            data = everything(connection)
            assert statuses(data) == [200]
            assert b"connection: close" in data
    wait_until(lambda: is_refused(server))


@pytest.mark.parametrize(("stops", "grace_seconds"), [(1, 0.5), (2, 10.0)])
def test_stop_refuses_unfinished_requests_and_ends_a_server_beside_at_once(store, start_http, stops, grace_seconds):
    """The server beside, such as that of gRPC, does not wait for the open requests. A second stop waits for nothing."""
    is_ending = Event()

    @asynccontextmanager
    async def beside():
        yield
        is_ending.set()
        await asyncio.sleep(60.0)

    server = start_http(Handler(store, ServerLimits(grace_seconds=grace_seconds)), beside=beside())
    with connect(server) as begun:
        begun.settimeout(5.0)
        begun.sendall(infer()[:-5])
        time.sleep(0.3)
        for _ in range(stops):
            server.stop()
            assert is_ending.wait(0.3)
        status, error = refused(everything(begun))
    assert (status, error) == (503, "the server has stopped before it could answer; send the request again")


@pytest.mark.parametrize(("certificate", "key"), [("cert.pem", "key.pem"), ("both.pem", "both.pem")])
def test_server_with_tls_and_token(store, start_http, tls_files, trusted, certificate, key):
    tls = Tls(tls_files / certificate, tls_files / key)
    server = start_http(Handler(store, access=AccessCheck(token="sesame")), tls=tls)
    assert server.url.startswith("https://127.0.0.1:")
    client = http.client.HTTPSConnection(server.url.removeprefix("https://"), context=trusted, timeout=60)
    for _ in range(2):
        client.request("POST", INFER, BODY, {"Authorization": "Bearer sesame"})
        assert client.getresponse().read().startswith(b'{"model_name":"linear"')
    server.stop()
    with socket.socket(fileno=client.sock.detach()) as connection:
        connection.settimeout(60)
        assert everything(connection) == b""  # the end of TLS would wait for the client
