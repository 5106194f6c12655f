"""Whatever bytes arrive: an answer of the protocol, or an error object with a status below 500, and at once."""

import json

import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol import Handler

INFER = "/v2/models/linear/infer"
SETTINGS = settings(max_examples=60, derandomize=True, deadline=None)


@pytest.fixture(scope="module")
def handler(models):
    return Handler(open_model_store(models))


def check(response):
    """An answer of the protocol, or why there is none."""
    assert response.status < 500
    headers = dict(response.headers)
    length = int(headers.get(b"inference-header-content-length", len(response.body)))
    if headers.get(b"content-encoding") is None:
        content = orjson.loads(response.body[:length])
        assert ("error" in content) == (response.status != 200)
    return response.status


@SETTINGS
@given(st.lists(st.floats(width=32), min_size=3, max_size=3), st.integers(0, 20), st.sampled_from(["FP32", "FP64"]))
def test_binary_numbers(handler, charges, size, datatype):
    raw = np.float32(charges).tobytes()[:size]
    tensor = {"name": "charge_pC", "datatype": datatype, "shape": [1, 3], "parameters": {"binary_data_size": size}}
    text = json.dumps({"inputs": [tensor]}).encode()
    status = check(handler.answer("POST", INFER, [(b"inference-header-content-length", b"%d" % len(text))], text + raw))
    assert (status == 200) == (datatype == "FP32" and size == 12 and bool(np.isfinite(charges).all()))


@SETTINGS
@given(st.binary(max_size=300), st.sampled_from(["gzip", "deflate", "identity", "br", "GZIP, gzip", ""]))
def test_any_bytes_in_any_encoding(handler, body, encoding):
    check(handler.answer("POST", INFER, [(b"content-encoding", encoding.encode())], body))


@SETTINGS
@given(st.text(max_size=8), st.text(max_size=80), st.binary(max_size=50))
def test_any_method_and_path(handler, method, path, body):
    check(handler.answer(method, path, [], body))
    check(handler.answer("POST", "/v2/repository/index", [], body))
    check(handler.answer("POST", f"/v2/repository/models/{path}/unload", [], body))


TENSOR = b'{"inputs":[{"name":"charge_pC","datatype":"FP32","shape":'
BOMBS = {
    "lists": b"[" * 1_000_000,
    "objects": b'{"a":' * 200_000,
    "inputs": b'{"inputs":' + b"[" * 500_000,
    "data": b'{"inputs":[{"name":"charge_pC","datatype":"FP32","shape":[1,3],"data":'
    + b"[" * 1000
    + b"]" * 1000
    + b"}]}",
    "wide": b'{"inputs":[{"name":"charge_pC","datatype":"FP32","shape":[4096,3],"data":['
    + b"[]," * 300_000
    + b"[]]}]}",
    "keys": b"{" + b",".join(b'"%d":0' % n for n in range(100_000)) + b"}",
    "shape": TENSOR + b"[" + b"1," * 300_000 + b"3]}]}",
    "number": TENSOR + b"[" + b"9" * 500_000 + b",3]}]}",
    "text": b'{"id":"' + b"\\u0000" * 150_000 + b'"}',
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_bombs(handler, bomb):
    response = handler.answer("POST", INFER, [], BOMBS[bomb])
    assert response.status in (400, 413)
    assert len(response.body) < 2000
    check(response)
