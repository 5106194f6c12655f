"""The clients of Triton for HTTP and gRPC with their default settings, connected to the servers of isocharge."""

from contextlib import ExitStack

import numpy as np
import pytest
import tritonclient.grpc
import tritonclient.http
from google.protobuf.json_format import MessageToDict
from tritonclient.utils import InferenceServerException


@pytest.fixture(params=(tritonclient.http, tritonclient.grpc), ids=("http", "grpc"))
def module(request):
    return request.param


@pytest.fixture
def client(module, handler, start_http, start_grpc):
    with ExitStack() as stack:
        is_grpc = module is tritonclient.grpc
        url = stack.enter_context(start_grpc(handler)) if is_grpc else start_http(handler).url
        yield stack.enter_context(module.InferenceServerClient(url.partition("://")[2]))


def plain(answer):
    """Return an answer of a client of either kind as a JSON value."""
    return MessageToDict(answer, preserving_proto_field_name=True) if hasattr(answer, "DESCRIPTOR") else answer


def charges(film, n=5):
    return np.resize(film.golden_pC(), (n, 3)).astype(np.float32)


def tensor(module, values):
    made = module.InferInput("charge_pC", list(values.shape), "FP32")
    made.set_data_from_numpy(values)
    return made


def expected(predictor, values):
    """Return the outputs that the same model computes in this process."""
    columns = np.column_stack(predictor.predict_batch(values))
    return {"contact": columns[:, :3], "contact_std": columns[:, 3:6], "misfit": columns[:, 6:7]}


def test_tritonclient_infer_with_defaults(client, module, film, predictor):
    values = charges(film)
    answer = client.infer("linear", [tensor(module, values)], request_id="press 7")
    for name, rows in expected(predictor, values).items():
        np.testing.assert_array_equal(answer.as_numpy(name), rows)
    response = plain(answer.get_response())
    assert (response["id"], response["model_version"]) == ("press 7", "2")


@pytest.mark.parametrize("n", [1, 5])
@pytest.mark.parametrize("binary", [True, False])
def test_tritonclient_output_flags(client, module, predictor, n, binary):
    """The flags equal those computed in this process, for a press far outside and for charges that no press gives."""
    values = np.resize(np.float32([[800.0, 10.0, 10.0], [-3.0, 900.0, 900.0], [800.0, 800.0, 800.0]]), (n, 3))
    options = {} if module is tritonclient.grpc else {"binary_data": binary}
    outputs = [module.InferRequestedOutput(name, **options) for name in ("flags", "contact")]
    answer = client.infer("linear", [tensor(module, values)], outputs=outputs)
    expected_words = [",".join(words) for words in predictor.validity.batch_flags(predictor.predict_batch(values))]
    flags = [text.decode() if isinstance(text, bytes) else text for text in answer.as_numpy("flags")[:, 0]]
    assert flags == expected_words
    assert any(flags)
    np.testing.assert_array_equal(answer.as_numpy("contact"), expected(predictor, values)["contact"])


def test_tritonclient_repository_index_unload_and_load(client, module, film):
    def index():
        rows = plain(client.get_model_repository_index())
        rows = rows["models"] if isinstance(rows, dict) else rows
        return [(row["name"], row["version"], row["state"]) for row in rows]

    both = [("linear", "1"), ("linear", "2")]
    assert index() == [(*version, "READY") for version in both]
    client.unload_model("linear")
    assert index() == [(*version, "UNAVAILABLE") for version in both]
    assert not client.is_model_ready("linear")
    assert not client.is_server_ready()
    with pytest.raises(InferenceServerException, match="model 'linear' is not found"):
        client.infer("linear", [tensor(module, charges(film))])
    client.load_model("linear")
    assert index() == [(*version, "READY") for version in both]
    client.infer("linear", [tensor(module, charges(film))])


def test_tritonclient_load_refuses_a_configuration(client):
    with pytest.raises(InferenceServerException, match="put the files into the model's folder"):
        client.load_model("linear", config="{}")


def test_tritonclient_model_config(client):
    response = plain(client.get_model_config("linear"))
    assert response.get("config", response)["max_batch_size"] == 4096


def test_tritonclient_statistics(client, module, film):
    for n in (1, 4):
        client.infer("linear", [tensor(module, charges(film, n))])
    with pytest.raises(InferenceServerException):
        client.infer("linear", [tensor(module, charges(film)[:, :2])])
    first, second = plain(client.get_inference_statistics("linear")).popitem()[1]
    spent = second["inference_stats"]
    assert (int(second["inference_count"]), int(second["execution_count"])) == (5, 2)
    assert (int(spent["success"]["count"]), int(spent["fail"]["count"])) == (2, 1)
    assert 60e9 > int(spent["success"]["ns"]) > 0
    assert int(first.get("inference_count", 0)) == 0
    assert len(plain(client.get_inference_statistics()).popitem()[1]) == 2


def test_tritonclient_stream_infer(handler, film, predictor, start_grpc):
    values = charges(film)
    answers = []
    with start_grpc(handler) as url:
        client = tritonclient.grpc.InferenceServerClient(url.removeprefix("grpc://"))
        client.start_stream(lambda result, error: answers.append((result, error)))
        for name in ("linear", "cubic", "linear"):
            client.async_stream_infer(name, [tensor(tritonclient.grpc, values)])
        client.stop_stream()
        client.close()
    assert [error is None for _, error in answers] == [True, False, True]
    assert "is not found" in str(answers[1][1])
    np.testing.assert_array_equal(answers[2][0].as_numpy("contact"), expected(predictor, values)["contact"])
