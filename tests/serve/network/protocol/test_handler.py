"""The protocol without a transport: routes, tensors, compression and errors. Outputs are compared with onnxruntime.

schemathesis creates valid and invalid requests from the OpenAPI document, and compares the answers with the document.
"""

import gzip
import re
import tracemalloc
import zlib

import jsonschema_rs
import numpy as np
import onnxruntime
import orjson
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
)

from infer_requests import INFER, infer_request
from isocharge.common.errors import InputError
from isocharge.serve.network.protocol import routes
from isocharge.serve.network.protocol.response import decompress


@pytest.fixture
def ask(handler):
    """Return a function that sends a request to the handler, and returns the status, the headers and the body."""

    def ask(method, path, body=b"", **headers):
        sent_headers = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
        status, received_headers, body = handler.answer(method, path, sent_headers, body)
        assert dict(received_headers)[b"content-length"] == b"%d" % len(body)
        return status, {name.decode(): value.decode() for name, value in received_headers}, body

    return ask


@pytest.fixture
def bare(tmp_path, store):  # noqa: ARG001
    """Return a function that computes the outputs of the same model by onnxruntime alone, by their names."""
    session = onnxruntime.InferenceSession(tmp_path / "models/linear/2/model.onnx", providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    return lambda charges: dict(zip(names, session.run(None, {"charge_pC": np.float32(charges)}), strict=True))


def refusal(answer):
    """Return the status and the message of an answer that is an error."""
    status, headers, body = answer
    assert headers["content-type"] == "application/json"
    content = orjson.loads(body)
    assert list(content) == ["error"]
    return status, content["error"]


def routes_of(model, version):
    """Return the method and the path of each route, with and without the version."""
    return {
        (route.method, route.path.format(model=model, version=part))
        for route in routes.ROUTES
        for part in ("", f"/versions/{version}")
    }


@pytest.mark.parametrize(("method", "path"), sorted(routes_of("linear", "1")))
def test_every_route_answers_its_method_only(ask, method, path):
    answer = ask("DELETE", path)
    assert refusal(answer) == (405, f"{path}: expected the method {method}, got DELETE")
    assert answer[1]["allow"] == method


@pytest.mark.parametrize("n", [1, 2, 100, 4096])
@pytest.mark.parametrize("datatype", ["FP32", "FP64"])
@pytest.mark.parametrize(
    "form",
    [np.ravel, np.asarray, lambda rows: np.where(rows == rows.min(), 1, rows).astype(int).ravel()],
)
def test_outputs_equal_those_of_onnxruntime(ask, bare, film, n, datatype, form):
    data = form(np.resize(film.golden_pC(), (n, 3)))
    charges = data.reshape(n, 3)
    sent = infer_request(np.zeros((n, 3)), datatype, id="a")
    sent["inputs"][0]["data"] = data.tolist()
    status, _, body = ask("POST", INFER, orjson.dumps(sent))
    content = orjson.loads(body)
    assert (status, content["id"], content["model_name"], content["model_version"]) == (200, "a", "linear", "2")
    for output in content["outputs"]:
        rows = bare(charges)[output["name"]]
        assert (output["datatype"], output["shape"]) == ("FP32", list(rows.shape))
        np.testing.assert_array_equal(np.float32(output["data"]), rows.ravel())


def binary_request(charges, **changes):
    raw = charges.astype("<f4").tobytes()
    tensor = {"name": "charge_pC", "datatype": "FP32", "shape": list(charges.shape)}
    tensor |= {"parameters": {"binary_data_size": len(raw)}} | changes.pop("tensor", {})
    text = orjson.dumps({"inputs": [tensor]} | changes)
    return text + raw, len(text)


def test_optional_fields_may_be_null(ask):
    """Older clients of KServe send null for every field that is not given."""
    null_parameters = dict.fromkeys(["binary_data", "binary_data_output", "binary_data_size", "classification"])
    body = infer_request()
    expected = ask("POST", INFER, orjson.dumps(body))
    for parameters in (None, null_parameters):
        body["inputs"][0]["parameters"] = parameters
        body |= {"id": None, "outputs": None, "parameters": parameters}
        assert ask("POST", INFER, orjson.dumps(body)) == expected
        body["outputs"] = [{"name": "contact", "parameters": parameters}]
        assert ask("POST", INFER, orjson.dumps(body))[0] == 200
    assert ask("POST", "/v2/repository/index", b'{"ready": null}')[0] == 200
    assert ask("POST", "/v2/repository/models/linear/load", b'{"parameters": null}')[0] == 200


def test_index_contains_only_loaded_versions_on_request(ask):
    def states(body):
        return [row["state"] for row in orjson.loads(ask("POST", "/v2/repository/index", body)[2])]

    assert states(b'{"ready": true}') == states(b"{}") == ["READY", "READY"]
    assert ask("POST", "/v2/repository/models/linear/unload")[0] == 200
    assert states(b'{"ready": true}') == []
    assert states(b"{}") == ["UNAVAILABLE", "UNAVAILABLE"]


@pytest.mark.parametrize(("way", "pack"), [("gzip", gzip.compress), ("deflate", zlib.compress), ("identity", bytes)])
def test_compressed_request_body(ask, film, way, pack):
    plain = orjson.dumps(infer_request(film.golden_pC()))
    assert ask("POST", INFER, pack(plain), content_encoding=way)[2] == ask("POST", INFER, plain)[2]


def test_decompression_stops_at_the_limit():
    bomb = gzip.compress(bytes(50_000_000))
    assert len(bomb) < 100_000
    tracemalloc.start()
    with pytest.raises(InputError, match="unpacks to more than 1000 bytes"):
        decompress(bomb, b"gzip", 1000)
    (_, peak), _ = tracemalloc.get_traced_memory(), tracemalloc.stop()
    assert peak < 1_000_000


PRESS = [[100.0, 200.0, 300.0]]


def changed(**changes):
    content = infer_request()
    content["inputs"][0] |= changes
    return orjson.dumps(content)


def with_data(text):
    """Return a request whose data are a text that need not be JSON."""
    return changed(data=[1, 2, 3]).replace(b"[1,2,3]", text)


BAD = {
    "nothing": (b"", "expected JSON, got b''"),
    "NaN": (with_data(b"[1,NaN,3]"), "expected JSON, got .*NaN"),
    "beyond float64": (
        with_data(b"[1,1e999,3]"),
        r"out of range - at .*data\[1\]",
    ),
    "beyond float32": (changed(data=[1, 2, 1e39]), r"finite float32 charges .* electrode 'C' \(1e\+39\)"),
    "nested data": (
        with_data(b"[" * 500 + b"]" * 500),
        r"data\[0\]\[0\]: expected a finite number, got",
    ),
    "no inputs": (b'{"inputs": []}', "inputs: expected a list with one tensor"),
    "other type": (changed(datatype="INT64"), "expected one of FP32, FP64, got 'INT64'"),
    "no rows": (changed(shape=[0, 3], data=[]), "with n > 0"),
    "too many": (changed(shape=[10**12, 3]), "at most 4096 presses in one request, got 1000000000000"),
    "ragged": (changed(shape=[2, 3], data=[[1, 2, 3], [1, 2]]), r"expected 6 numbers for the shape \[2, 3\]"),
    "yes": (changed(data=[1, 2, True]), r"data\[2\]: expected a finite number or .*, got True"),
    "too many outputs": (  # repeated outputs of a batch could fill the memory
        orjson.dumps(infer_request(outputs=[{"name": "contact"}] * 6)),
        "outputs: expected a list of at most 5 outputs, got",
    ),
    "other output": (
        orjson.dumps(infer_request(outputs=[{"name": "z"}])),
        "one of contact, contact_correlation, contact_std",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_bodies_are_refused_with_the_reason(ask, case):
    body, message = BAD[case]
    status, error = refusal(ask("POST", INFER, body))
    assert status == (413 if case == "too many" else 400)
    assert re.search(message, error)


@pytest.mark.parametrize("length", ["", "-1", "+5", "1_0", "9999", "9" * 5000, "٣"])
def test_wrong_inference_header_content_length_is_refused(ask, length):
    body, _ = binary_request(np.float32(PRESS))
    status, error = refusal(ask("POST", INFER, body, inference_header_content_length=length))
    assert status == 400
    assert "Inference-Header-Content-Length: expected a whole number up to" in error


@pytest.mark.parametrize(
    ("changes", "spoil", "message"),
    [
        ({"tensor": {"data": [1, 2, 3]}}, bytes, "of the shape (3,) and 12 bytes"),
        ({"tensor": {"shape": [2, 3]}}, bytes, "or 6 binary numbers of 4 bytes each, got an array of the shape (3,)"),
        ({}, lambda body: body[:-1], "of the shape (0,) and 11 bytes"),
        (
            {},
            lambda body: body[:-8] + np.float32(np.nan).tobytes() + body[-4:],
            "for electrode 'B' (nan)",
        ),
    ],
)
def test_binary_data_of_another_size_is_refused(ask, changes, spoil, message):
    body, length = binary_request(np.float32(PRESS), **changes)
    status, error = refusal(ask("POST", INFER, spoil(body), inference_header_content_length=str(length)))
    assert status == 400
    assert message in error


def test_output_that_is_not_finite_is_null(ask):
    """The model of the test divides by the sum of the charges. The OpenAPI document allows null instead of NaN."""
    status, _, body = ask("POST", INFER, orjson.dumps(infer_request([[0.0, 0.0, 0.0]])))
    assert (status, orjson.loads(body)["outputs"][0]["data"]) == (200, [None, None, 0.0])
    schema = orjson.loads(ask("GET", "/openapi.json")[2])["components"]["schemas"]["answer"]
    jsonschema_rs.Draft202012Validator(schema).validate(orjson.loads(body))


def test_openapi_describes_each_route(ask):
    document = orjson.loads(ask("GET", "/openapi.json")[2])
    existing = routes_of("{model}", "{version}") - {("GET", "/openapi.json")}
    assert existing == {
        (method.upper(), path) for path, item in document["paths"].items() for method in item.keys() - {"parameters"}
    }
    for method, path in sorted(existing, key=lambda row: row[1].endswith("unload")):
        responses = document["paths"][path][method.lower()]["responses"]
        assert responses["4XX"] == responses["5XX"] == {"$ref": "#/components/responses/error"}
        (kind,) = responses["200"]["content"]
        body = orjson.dumps(infer_request()) if path.endswith("/infer") else b""
        status, headers, _ = ask(method, path.format(model="linear", version=1), body)
        assert (status, headers["content-type"].partition(";")[0]) == (200, kind), path


@pytest.mark.parametrize(
    ("data", "status"), [([1, 2.5, 3], 200), ([[1, 2.5, 3]], 200), (["1", 2, 3], 400), ([None, 2, 3], 400), ("1", 400)]
)
def test_openapi_accepts_the_numbers_that_the_server_accepts(ask, data, status):
    body = changed(data=data)
    assert ask("POST", INFER, body)[0] == status
    components = orjson.loads(ask("GET", "/openapi.json")[2])["components"]
    schema = {"$ref": "#/components/schemas/InferBody", "components": components}
    assert jsonschema_rs.Draft202012Validator(schema).is_valid(orjson.loads(body)) == (status == 200)


@pytest.mark.parametrize(
    ("way", "body", "status", "message"),
    [
        ("br", b"x", 415, "expected gzip, deflate or identity"),
        ("gzip", b"no gzip", 400, "the body is not compressed as its Content-Encoding states"),
        ("gzip", gzip.compress(b"{}", mtime=0)[:-3], 400, "ends before"),
        ("deflate", zlib.compress(b"{}") + b"more", 400, "goes on after"),
    ],
)
def test_wrong_content_encoding_is_refused(ask, way, body, status, message):
    got, error = refusal(ask("POST", INFER, body, content_encoding=way))
    assert got == status
    assert message in error


def test_internal_errors_are_logged_and_not_sent(ask, store, monkeypatch, caplog):
    def fail(*_, **__):
        raise ZeroDivisionError("a secret")

    monkeypatch.setattr(store, "index", fail)
    status, error = refusal(ask("POST", "/v2/repository/index"))
    assert (status, error) == (500, "internal error; the server's log says more")
    assert "a secret" in caplog.text


CHECKS = [
    not_a_server_error,
    content_type_conformance,
    negative_data_rejection,
    response_schema_conformance,
    status_code_conformance,
]


@pytest.fixture
def operations(handler, start_http):
    """Return the operations of the OpenAPI document, except those that unload models."""
    document = orjson.loads(handler.answer("GET", "/openapi.json", [], b"").body)
    parameters = document["components"]["parameters"]
    parameters["model"]["schema"]["enum"] = ["linear"]
    parameters["version"]["schema"]["enum"] = ["1", "2"]
    api = schemathesis.openapi.from_dict(document)
    api.config.update(base_url=start_http(handler).url)
    return [result.ok() for result in api.exclude(path_regex="unload").get_all_operations()]


@pytest.mark.slow
@pytest.mark.parametrize("mode", GenerationMode)
def test_server_conforms_to_its_openapi_document(operations, mode):
    answered = set()
    for operation in operations:
        if mode is GenerationMode.NEGATIVE and not (operation.path_parameters or operation.body):
            continue  # nothing that could be wrong

        @settings(max_examples=20, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
        @given(operation.as_strategy(generation_mode=mode))
        def conforms(case):
            response = case.call()
            case.validate_response(response, checks=CHECKS)
            assert response.status_code == 200 or "error" in response.json()
            answered.add(response.status_code)

        conforms()
    assert answered & ({200} if mode is GenerationMode.POSITIVE else {400, 404})
