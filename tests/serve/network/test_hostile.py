"""Whatever bytes arrive: an answer of the protocol, or an error object with a status below 500, and at once."""

import gzip
import json
import zlib

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


numbers = st.one_of(
    st.floats(), st.integers(-(2**70), 2**70), st.booleans(), st.none(), st.text(max_size=3), st.floats(0, 2000)
)
junk = st.recursive(
    numbers,
    lambda some: st.lists(some, max_size=4) | st.dictionaries(st.text(max_size=5), some, max_size=4),
    max_leaves=8,
)
sizes = st.one_of(st.integers(0, 5), st.integers(-(2**65), 2**65), junk)
rows = st.lists(st.lists(st.floats(0, 2000), min_size=3, max_size=3), min_size=1, max_size=3)
parameters = st.dictionaries(
    st.sampled_from(["binary_data_size", "binary_data_output", "binary_data", "classification", "x"]), junk | sizes
)


@st.composite
def requests(draw):
    """A request that may be right, with some of its parts replaced by junk."""
    charges = draw(rows)
    data = draw(st.sampled_from([charges, [q for row in charges for q in row]]))
    tensor = {"name": "charge_pC", "datatype": "FP32", "shape": [len(charges), 3], "data": data}
    content = {"id": "a", "inputs": [tensor], "outputs": [{"name": "contact"}], "parameters": {}}
    for holder in (tensor, content, content["outputs"][0]):
        for key in draw(st.sets(st.sampled_from(sorted(holder)), max_size=2)):
            holder[key] = draw(st.one_of(junk, parameters, st.lists(sizes, max_size=4)))
    return content


def as_json(content):
    """JSON as bad as its content: NaN and whole numbers of any length as they are."""
    return json.dumps(content).encode()


@SETTINGS
@given(requests())
def test_requests_with_wrong_parts(handler, content):
    check(handler.answer("POST", INFER, [], as_json(content)))


@SETTINGS
@given(rows)
def test_requests_without_wrong_parts(handler, charges):
    """That the tests around this one refuse for their reasons, and not for another."""
    tensor = {"name": "charge_pC", "datatype": "FP32", "shape": [len(charges), 3], "data": charges}
    assert check(handler.answer("POST", INFER, [], as_json({"inputs": [tensor]}))) == 200


@SETTINGS
@given(requests(), st.integers(0, 400), st.binary(max_size=20))
def test_truncated_and_glued(handler, content, cut, more):
    check(handler.answer("POST", INFER, [], as_json(content)[:cut] + more))


@SETTINGS
@given(
    requests(), st.binary(max_size=60), st.one_of(st.binary(max_size=25), st.integers(-9, 500).map(lambda n: b"%d" % n))
)
def test_header_lengths(handler, content, binary, length):
    headers = [(b"inference-header-content-length", length)]
    check(handler.answer("POST", INFER, headers, as_json(content) + binary))


@SETTINGS
@given(st.lists(st.floats(width=32), min_size=3, max_size=3), st.integers(0, 20), st.sampled_from(["FP32", "FP64"]))
def test_binary_numbers(handler, charges, size, datatype):
    raw = np.float32(charges).tobytes()[:size]
    tensor = {"name": "charge_pC", "datatype": datatype, "shape": [1, 3], "parameters": {"binary_data_size": size}}
    text = as_json({"inputs": [tensor]})
    status = check(handler.answer("POST", INFER, [(b"inference-header-content-length", b"%d" % len(text))], text + raw))
    assert (status == 200) == (datatype == "FP32" and size == 12 and bool(np.isfinite(charges).all()))


@SETTINGS
@given(st.binary(max_size=300), st.sampled_from(["gzip", "deflate", "identity", "br", "GZIP, gzip", ""]))
def test_any_bytes_in_any_encoding(handler, body, encoding):
    check(handler.answer("POST", INFER, [(b"content-encoding", encoding.encode())], body))


@SETTINGS
@given(requests(), st.sampled_from([gzip.compress, zlib.compress]), st.integers(0, 300), st.integers(0, 255))
def test_compressed_and_damaged(handler, content, pack, at, byte):
    packed = bytearray(pack(as_json(content)))
    packed[at % len(packed)] = byte
    for encoding in (b"gzip", b"deflate"):
        check(handler.answer("POST", INFER, [(b"content-encoding", encoding)], bytes(packed)))


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


@pytest.mark.parametrize("pack", [gzip.compress, zlib.compress])
@pytest.mark.parametrize("layers", [1, 2])
def test_compression_bombs(handler, pack, layers):
    body = bytes(50_000_000)
    for _ in range(layers):
        body = pack(body)
    encoding = b"gzip" if pack is gzip.compress else b"deflate"
    assert check(handler.answer("POST", INFER, [(b"content-encoding", encoding)], body[: 1 << 20])) in (400, 413)
