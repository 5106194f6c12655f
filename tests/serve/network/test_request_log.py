"""The log of a server: every line is JSON, one for each request, whatever clients send; and none says a secret."""

import json
import logging
import socket
from datetime import UTC, datetime

import grpc
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.network.credentials import Token
from isocharge.serve.network.grpc import grpc_server
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler
from isocharge.serve.network.traffic import LONGEST_TEXT, RequestLog, Traffic

SECRET = 'open "sesame"'
NAMES = {"time", "level", "event", "transport", "route", "status", "model", "error", "duration_us", "bytes_in"}
NAMES |= {"bytes_out", "client"}
BODY = b'{"inputs": [{"name": "charge_pC", "datatype": "FP32", "shape": [1, 3], "data": [1, 2, 3]}]}'
FORGED = '"}\n{"time": "2026", "level": "info", "event": "request", "status": 200}\n'


@pytest.fixture
def lines():
    return []


@pytest.fixture(scope="module")
def released(models):
    return open_model_store(models)


@pytest.fixture
def app(released, lines):
    return Handler(released, None, Traffic(RequestLog(lines.append, secret=SECRET)), Token(SECRET))


def bearer(token=SECRET):
    return [(b"authorization", f"Bearer {token}".encode())]


def test_a_request_is_one_line(app, lines):
    app.answer("POST", "/v2/models/linear/infer", bearer(), BODY, ("127.0.0.1", 5000))
    (line,) = map(json.loads, lines)
    assert set(line) == NAMES
    assert datetime.fromisoformat(line.pop("time")).tzinfo == UTC
    assert 0 < line.pop("duration_us") < 1e6
    assert line.pop("bytes_out") > 100
    assert line == {
        "level": "info",
        "event": "request",
        "transport": "http",
        "route": "/v2/models/{model}/infer",
        "status": 200,
        "model": "linear/1",
        "error": None,
        "bytes_in": len(BODY),
        "client": "127.0.0.1:5000",
    }


@pytest.mark.parametrize(
    ("path", "headers", "body", "expected"),
    [
        ("/v2/models/linear/infer", bearer(), b"{", (400, "linear/1", "RequestError")),
        ("/v2/models/linear/infer", bearer("x"), BODY, (401, "linear/1", "TokenError")),
        ("/v2/models/cubic/infer", bearer(), BODY, (404, None, "ModelNotFound")),
        (FORGED, bearer(), BODY, (404, None, "UnknownPath")),
    ],
)
def test_a_refused_request_says_the_kind_of_error(app, lines, path, headers, body, expected):
    app.answer("POST", path, headers, body)
    (line,) = map(json.loads, lines)
    assert (line["status"], line["model"], line["error"]) == expected


any_text = st.text(max_size=60) | st.sampled_from([FORGED, SECRET, "/v2/models/linear/infer", f"/v2/models/{SECRET}"])
any_bytes = st.binary(max_size=60) | any_text.map(lambda text: text.encode("utf-8", "surrogatepass"))


@settings(max_examples=60, deadline=None)
@given(any_text, any_text, st.lists(st.tuples(any_bytes, any_bytes)), any_bytes, st.booleans())
def test_no_client_can_forge_a_line_or_plant_a_secret(released, method, path, headers, body, knows):
    lines = []
    handler = Handler(released, None, Traffic(RequestLog(lines.append, secret=SECRET)), Token(SECRET))
    handler.answer(method, path, [*headers, *bearer()] if knows else headers, body, ("::1", 1))
    (line,) = lines
    assert len(line) < 500
    assert not set(line) & set("\n\r\u2028\x85")
    content = json.loads(line)
    assert set(content) == NAMES
    assert SECRET not in str(content)
    assert content["route"] in {"unknown", *handler._fixed} | {
        f"/v2/models/{{model}}{tail}" for tail in ("", "/infer", "/ready", "/config", "/stats")
    } | {f"/v2/repository/models/{{model}}/{verb}" for verb in ("load", "unload")}


def test_messages_of_loggers_are_lines_too(lines):
    """With tracebacks, line feeds, halves of surrogates, secrets, and far too much text."""
    log = RequestLog(lines.append, secret=SECRET)
    logger = logging.Logger("isocharge.test")
    logger.addHandler(log)
    logger.warning("two\nlines \udc80 %s", FORGED + SECRET)
    try:
        raise ValueError(f"{SECRET}\n" * 1000)
    except ValueError:
        logger.exception("a request failed")
    warning, failure = map(json.loads, lines)
    assert (warning["level"], warning["logger"]) == ("warning", "isocharge.test")
    assert warning["message"] == f"two\nlines ? {FORGED}[secret]"
    assert (failure["level"], failure["message"]) == ("error", "a request failed")
    assert "Traceback" in failure["traceback"]
    assert "ValueError" in failure["traceback"]
    assert len(failure["traceback"]) < LONGEST_TEXT + 20
    assert not any("sesame" in line for line in lines)


def test_calls_of_grpc_are_lines(app, lines):
    with (
        grpc_server(app, "127.0.0.1", 0) as url,
        grpc.insecure_channel(url.removeprefix("grpc://")) as channel,
    ):
        ready = channel.unary_unary("/inference.GRPCInferenceService/ServerReady")
        infer = channel.unary_unary("/inference.GRPCInferenceService/ModelInfer")
        ready(b"", timeout=20)
        for metadata in ([("authorization", f"Bearer {SECRET}")], [("authorization", FORGED.replace("\n", " "))]):
            with pytest.raises(grpc.RpcError):
                infer(b"\x0a\x06linear", metadata=metadata, timeout=20)  # the model's name and no tensor
    said = [(line["route"], line["status"], line["model"], line["error"]) for line in map(json.loads, lines)]
    assert said == [
        ("ServerReady", "OK", None, None),
        ("ModelInfer", "INVALID_ARGUMENT", "linear/1", "RequestError"),
        ("ModelInfer", "UNAUTHENTICATED", None, "TokenError"),
    ]
    assert all(json.loads(line)["client"].startswith("ipv4:127.0.0.1:") for line in lines)
    assert not any("sesame" in line for line in lines)


def test_what_could_not_be_read_is_a_line_too(app, lines, start_http):
    """Over a real socket: rubbish, then a request of which headers are too long."""
    place = start_http(app).url.removeprefix("http://").split(":")
    for sent in (b"rubbish\r\n\r\n", b"GET / HTTP/1.1\r\nx: " + b"a" * 20_000 + b"\r\n\r\n"):
        with socket.create_connection((place[0], int(place[1])), timeout=20) as connection:
            connection.sendall(sent)
            while connection.recv(1 << 16):
                pass
    said = [(line["route"], line["status"], line["client"][:10]) for line in map(json.loads, lines)]
    assert said == [("none", 400, "127.0.0.1:"), ("none", 431, "127.0.0.1:")]
    assert not any("rubbish" in line for line in lines)
