"""What clients send to a server process: requests, bodies and gRPC messages with faults, other protocols."""

import json
import re
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import grpc
import pytest

from attacks.faults import mutated, with_junk
from infer_requests import infer_request
from isocharge.serve.network.grpc.service import METHODS, SERVICE
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.handler import Handler

NAME = "three-25um-biaxial"
MODELS = Path(__file__).parents[2] / "models"
PATH = f"/v2/models/{NAME}/infer"
OUTPUTS = [{"name": "contact", "parameters": {"binary_data": False}}]
BODY = json.dumps(infer_request([800.5, 700.0, 900.0], id="a", outputs=OUTPUTS)).encode()
REQUEST = b"POST %s HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n%s" % (
    PATH.encode(),
    len(BODY),
    BODY,
)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """The ports and the process of a server, which ends cleanly and writes no traceback."""
    command = [sys.executable, "-m", "isocharge.cli", "serve", "http", "--port", "0", "--grpc-port", "0"]
    with (
        (tmp_path_factory.mktemp("wire") / "stderr").open("w+") as errors,
        subprocess.Popen([*command, "--models", MODELS], stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        urls = [process.stdout.readline().strip() for _ in range(2)]
        http_place, grpc_place = (("127.0.0.1", int(url.rpartition(":")[2])) for url in urls)
        yield SimpleNamespace(http=http_place, grpc=grpc_place, pid=process.pid)
        process.terminate()
        code = process.wait(30)
        errors.seek(0)
        message = errors.read()
    assert (code, "Traceback" in message) == (0, False), message


def resident_bytes(server):
    return int(Path(f"/proc/{server.pid}/statm").read_text().split()[1]) * 4096


@pytest.fixture(autouse=True)
def bounded_memory(server):
    """No attack of this part may cost the server more than 200 MB."""
    before = resident_bytes(server)
    yield
    assert resident_bytes(server) - before < 200e6


def send(place, data, timeout=60.0):
    """What a server answers to bytes after which the client sends no more; nothing, if it hangs up."""
    answer = bytearray()
    with socket.create_connection(place, timeout=timeout) as connection, suppress(ConnectionError):
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        while piece := connection.recv(1 << 16):
            answer += piece
    return bytes(answer)


def check(answer):
    """No answer blames the server, and none is anything else than HTTP."""
    statuses = [int(status) for status in re.findall(rb"HTTP/1\.1 (\d\d\d) ", answer)]
    assert all(100 <= status < 500 for status in statuses), answer
    assert not answer or statuses, answer


REQUESTS = (
    REQUEST,
    REQUEST.replace(b"\r\n\r\n", b"\r\nExpect: 100-continue\r\n\r\n"),
    REQUEST.replace(
        b"\r\n\r\n", b"\r\nUpgrade: h2c\r\nConnection: Upgrade, HTTP2-Settings\r\nHTTP2-Settings: AAMA\r\n\r\n"
    ),
    REQUEST.replace(b"\r\n\r\n", b"\r\nContent-Encoding: gzip\r\n\r\n"),
    b'POST %s HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n5\r\n{"a":\r\n2\r\n1}\r\n0\r\n\r\n'
    % PATH.encode(),
    b"POST %s HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n2;a=b\r\n{}\r\n0\r\nA: b\r\nC: d\r\n\r\n" % PATH.encode(),
    b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /openapi.json HTTP/1.0\r\n\r\n",
    b"POST /v2/repository/index HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\n{}",
    b"POST /v2/repository/models/none/unload HTTP/1.1\r\nContent-Length: 99\r\n\r\n",
    b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\4\0\0\0\0\0",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(60),
    b"CONNECT x:1 HTTP/1.1\r\n\r\n",
)


def test_requests_with_faults(server, attack):

    def requests(rng):
        data = mutated(rng, rng.choice(REQUESTS))
        return data + REQUEST if rng.random() < 0.3 else data

    attack("wire http", lambda data: check(send(server.http, data)), requests, 30_000)
    assert b"200 OK" in send(server.http, REQUEST)


def test_requests_before_a_faulty_one_are_answered_in_their_order(server, attack):
    """A load is answered in another thread, while the server already reads the requests after it."""
    load = b"POST /v2/repository/models/number%d/load HTTP/1.1\r\nContent-Length: 0\r\n\r\n"

    def pipelines(rng):
        complete = [load % number for number in range(rng.randrange(1, 8))]
        return len(complete), b"".join(complete) + mutated(rng, rng.choice(REQUESTS))

    def read(case):
        count, data = case
        answered = [int(number) for number in re.findall(rb"number(\d)", send(server.http, data))]
        assert answered == [*range(count)]

    attack("wire pipelines", read, pipelines, 20_000)


def test_bodies_with_faults(attack):
    """Past the transport: what the handler makes of any body, with any header that says how to read it."""
    handler = Handler(ModelStore(MODELS))
    good = json.loads(BODY)
    headers = ([], [(b"content-encoding", b"gzip")], [(b"content-encoding", b"deflate")])

    def bodies(rng):
        body = mutated(rng, BODY) if rng.random() < 0.5 else json.dumps(with_junk(rng, good)).encode()
        head = rng.choice(headers) if rng.random() < 0.1 else []
        if rng.random() < 0.2:
            head = [*head, (b"inference-header-content-length", mutated(rng, b"%d" % len(body)))]
        return head, body

    def read(case):
        response = handler.answer("POST", PATH, *case)
        assert response.status < 500, response

    attack("wire bodies", read, bodies, 200_000)


def test_grpc_messages_with_faults(server, attack):
    """No status blames the server: neither INTERNAL nor UNKNOWN."""
    contents = {
        "name": "charge_pC",
        "datatype": "FP32",
        "shape": [1, 3],
        "contents": {"fp32_contents": [8.0, 7.0, 9.0]},
    }
    messages = {
        "ModelInfer": {"model_name": NAME, "id": "a", "inputs": [contents], "outputs": [{"name": "contact"}]},
        "ModelMetadata": {"name": NAME, "version": "1"},
        "ModelStatistics": {"name": NAME},
        "RepositoryIndex": {"ready": True},
        "ModelReady": {"name": NAME},
    }
    good = {name: METHODS[name][0](**fields).SerializeToString() for name, fields in messages.items()}
    with grpc.insecure_channel(f"127.0.0.1:{server.grpc[1]}") as channel:
        calls = {name: channel.unary_unary(f"/{SERVICE}/{name}") for name in good}

        def read(case):
            name, data = case
            try:
                METHODS[name][1].FromString(calls[name](data, timeout=60))
            except grpc.RpcError as error:
                if error.code().name not in ("INVALID_ARGUMENT", "NOT_FOUND", "RESOURCE_EXHAUSTED"):
                    raise

        def cases(rng):
            name = rng.choice(sorted(good))
            return name, mutated(rng, good[name])

        attack("wire grpc messages", read, cases, 20_000)
