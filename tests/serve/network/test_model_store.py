"""Store of models: broken versions, loading and unloading during requests. Log: one line of JSON for each request."""

import json
import logging
import os
import re
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import grpc
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from prometheus_client import generate_latest

from infer_requests import BODY, INFER
from isocharge.common.errors import ModelError, ModelNotFound
from isocharge.serve import load_model
from isocharge.serve.network.browser_check import AccessCheck
from isocharge.serve.network.metrics import RequestLog, Traffic
from isocharge.serve.network.model_store import ModelStore
from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.network.protocol.routes import ROUTES
from model_files import put_graph
from serve.conftest import LinearFilm
from serve.network.grpc.test_service import call
from serve.network.http.test_server import exchange


@pytest.fixture
def folder(store, tmp_path):  # noqa: ARG001
    """Return the folder of the model of the store, which has two versions."""
    return tmp_path / "models/linear"


def states(store):
    return [(row["name"], row["version"], row["state"]) for row in store.index()]


def labels(store):
    return [loaded.metadata.label for loaded in store.versions_of()]


def a_failing_graph(version):
    """Replace the graph by one that declares the right shapes, but fails with the golden charges."""
    row_99 = "row = Constant <value_ints = [99]> ()\n    sum_99 = Gather <axis = 0> (sum, row)\n    "
    changed = {"force = Div .sum, pC_per_N": f"{row_99}force = Div (sum, sum_99"}
    film = LinearFilm.with_electrodes(3)
    put_graph(version, film.onnx(load_model(version).metadata.to_props(), renamed=changed))


FAULTS = {
    "cut": (lambda version: os.truncate(version / "model.onnx", 1000), "the file is damaged or changed"),
    "half copied": (
        lambda version: (version / "golden.json").unlink(),
        r"golden.json: cannot be read \(No such file or directory\)",
    ),
    "failing graph": (a_failing_graph, "the model's graph fails when it is run"),
}


@pytest.mark.parametrize("how", FAULTS)
def test_broken_version_leaves_other_versions_available(film, store, folder, how):
    """A loaded version stays available with its old files. After a start, only the other versions are available."""
    spoil, message = FAULTS[how]
    film.write(folder.parent, name="other")
    before = store.get("linear")
    spoil(folder / "2")
    for _ in range(2):
        with pytest.raises(ModelError, match=message):
            store.load("linear")
        assert store.get("linear") is store.get("linear", "2") is before
    assert [(row["state"], row["reason"] != "") for row in store.index()[:2]] == [
        ("READY", False),
        ("READY", True),
    ]

    store = ModelStore(folder.parent)
    assert states(store) == [("linear", "1", "READY"), ("linear", "2", "UNAVAILABLE"), ("other", "1", "READY")]
    assert store.get("linear").version == "1"
    for name, reason in (("linear", f"; .*{message}"), ("other", "$")):
        with pytest.raises(ModelNotFound, match=rf"'{name}/2' is not found; serving: linear/1, other/1{reason}"):
            store.get(name, "2")


def test_a_model_in_another_ones_folder_is_refused(film, tmp_path):
    film.write(tmp_path)
    shutil.copytree(tmp_path / "linear", tmp_path / "other")
    shutil.copytree(tmp_path / "linear/1", tmp_path / "linear/2")
    store = ModelStore(tmp_path)
    assert labels(store) == ["linear/1"]
    copied_version, copied_model = store.refusals()
    assert "expected linear/2, as the folders are called, got linear/1" in copied_version
    assert "expected other/1, as the folders are called" in copied_model


def test_folder_that_cannot_be_listed_affects_no_other_model(film, tmp_path, monkeypatch):
    """The error of the operating system is simulated, because the superuser may list every folder."""
    film.write(tmp_path)
    film.write(tmp_path, name="secret")
    list_folder = Path.iterdir

    def refuse(folder):
        if folder.name == "secret":
            raise PermissionError(13, "Permission denied")
        return list_folder(folder)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", refuse)
        store = ModelStore(tmp_path)
        assert states(store) == [("linear", "1", "READY"), ("secret", "", "UNAVAILABLE")]
        with pytest.raises(ModelError, match="secret: cannot be listed"):
            store.load("secret")
    store.load("secret")
    assert labels(store) == ["linear/1", "secret/1"]
    assert store.refusals() == []


def test_load_and_unload_add_and_remove_versions(film, store, folder):
    film.write(folder.parent, version=3)
    film.write(folder.parent, name="later")
    assert ("later", "", "UNAVAILABLE") in states(store)
    assert store.get("linear").version == "2"
    for name in ("linear", "later"):
        store.load(name)
    assert labels(store) == ["later/1", "linear/1", "linear/2", "linear/3"]
    (film.write(folder.parent, version=4) / "golden.json").unlink()
    with pytest.raises(ModelError, match=r"golden\.json: cannot be read"):
        store.load("linear")
    for version in ("2", "4"):
        shutil.rmtree(folder / version)
    store.load("linear")
    assert labels(store) == ["later/1", "linear/1", "linear/3"]
    assert store.refusals() == []
    exported = re.findall(rb'_ready{model="(.*)",version="(.*)"} 1.0', generate_latest(store))
    assert sorted(exported) == [(b"later", b"1"), (b"linear", b"1"), (b"linear", b"3")]
    shutil.rmtree(folder)
    with pytest.raises(ModelNotFound, match="'linear' is not found in the repository"):
        store.load("linear")
    assert store.get("linear").version == "3"  # nobody unloaded it
    store.unload("linear")
    with pytest.raises(ModelNotFound, match="'linear' is not found in the repository"):
        store.load("linear")
    assert states(store) == [("later", "1", "READY")]
    assert b'_ready{model="linear"' not in generate_latest(store)


@pytest.mark.parametrize("name", ["", "..", "linear/1", "../models/linear", "/"])
def test_model_name_is_not_taken_as_a_path(store, name):
    for method in (store.get, store.load, store.unload):
        with pytest.raises(ModelNotFound):
            method(name)
    assert name not in store._versions


SECRET = 'open "sesame"'
BEARER = [(b"authorization", f"Bearer {SECRET}".encode())]
NAMES = {"time", "level", "event", "transport", "route", "status", "duration_us", "client"}
FORGED = '"}\n{"time": "2026", "level": "info", "event": "request", "status": 200}\n'


@pytest.fixture
def lines():
    return []


@pytest.fixture
def app(store, lines):
    """A handler that needs the token SECRET, and appends the lines of its log to a list."""
    return Handler(store, None, Traffic(RequestLog(lines.append)), AccessCheck(token=SECRET))


def test_log_has_one_line_for_each_request(app, lines):
    app.answer("POST", INFER, BEARER, BODY, ("127.0.0.1", 5000))
    (line,) = map(json.loads, lines)
    assert set(line) == NAMES
    assert datetime.fromisoformat(line.pop("time")).tzinfo == UTC
    assert 0 < line.pop("duration_us") < 1e6
    assert line == {
        "level": "info",
        "event": "request",
        "transport": "http",
        "route": "/v2/models/{model}/infer",
        "status": 200,
        "client": "127.0.0.1:5000",
    }


any_text = st.text(max_size=60) | st.sampled_from([FORGED, SECRET, "/v2/models/linear/infer", f"/v2/models/{SECRET}"])
any_bytes = st.binary(max_size=60) | any_text.map(lambda text: text.encode("utf-8", "surrogatepass"))


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(any_text, any_text, st.lists(st.tuples(any_bytes, any_bytes)), any_bytes, st.booleans())
def test_client_cannot_forge_a_log_line_or_log_a_secret(app, lines, method, path, headers, body, knows):
    app.answer(method, path, [*headers, *BEARER] if knows else headers, body, ("::1", 1))
    line = lines.pop()
    assert len(line) < 500
    assert not set(line) & set("\n\r\u2028\x85")
    content = json.loads(line)
    assert set(content) == NAMES
    assert SECRET not in str(content)
    assert content["route"] in {"unknown", *(route.path.replace("{version}", "") for route in ROUTES)}


def test_log_has_the_messages_of_python_loggers(lines):
    """The messages contain tracebacks, line feeds and single surrogates."""
    logger = logging.Logger("isocharge.test")
    logger.addHandler(RequestLog(lines.append))
    logger.warning("two\nlines \udc80 %s", FORGED)
    try:
        raise ValueError("a value")
    except ValueError:
        logger.exception("a request failed")
    assert not any("\n" in line for line in lines)
    warning, failure = map(json.loads, lines)
    assert (warning["level"], warning["logger"]) == ("warning", "isocharge.test")
    assert warning["message"] == f"two\nlines \udc80 {FORGED}"
    assert failure["level"] == "error"
    assert re.fullmatch(r"a request failed\nTraceback .*\nValueError: a value", failure["message"], re.DOTALL)


def test_log_has_a_line_for_each_grpc_call(app, lines, start_grpc):
    with_secret = [("authorization", f"Bearer {SECRET}")]
    with (
        start_grpc(app) as url,
        grpc.insecure_channel(url.removeprefix("grpc://")) as channel,
    ):
        call(channel, "ModelReady", with_secret, name="linear", version="1")
        for metadata in (with_secret, []):
            with pytest.raises(grpc.RpcError):
                call(channel, "ModelInfer", metadata, model_name="linear")
    logged = [(line["route"], line["status"]) for line in map(json.loads, lines)]
    assert logged == [
        ("ModelReady", "OK"),
        ("ModelInfer", "INVALID_ARGUMENT"),
        ("ModelInfer", "UNAUTHENTICATED"),
    ]
    assert {json.loads(line)["client"][:15] for line in lines} == {"ipv4:127.0.0.1:"}


def test_log_has_a_line_for_an_unreadable_request(app, lines, start_http):
    """The first request is not HTTP, and the headers of the second request are too long."""
    server = start_http(app)
    for sent in (b"rubbish\r\n\r\n", b"GET / HTTP/1.1\r\nx: " + b"a" * 20_000 + b"\r\n\r\n"):
        exchange(server, sent)
    logged = [(line["route"], line["status"], line["client"][:10]) for line in map(json.loads, lines)]
    assert logged == [("none", 400, "127.0.0.1:"), ("none", 431, "127.0.0.1:")]
    assert not any("rubbish" in line for line in lines)


def test_no_inference_is_lost_while_folders_are_moved_and_loaded(film, store, folder, tmp_path):
    film.write(tmp_path / "other")
    handler = Handler(store)
    has_ended = threading.Event()

    def move_folders():
        while not has_ended.is_set():
            (folder / "2").rename(tmp_path / "away")
            (folder / "1").rename(tmp_path / "old")
            (tmp_path / "old").rename(folder / "1")
            (tmp_path / "away").rename(folder / "2")
            folder.rename(tmp_path / "models/.linear")
            (tmp_path / "models/.linear").rename(folder)

    def load():
        while not has_ended.is_set():
            handler.answer("POST", "/v2/repository/models/linear/load", [], b"")

    with ThreadPoolExecutor(2) as threads:
        changes = [threads.submit(move_folders), threads.submit(load)]
        try:
            statuses = {handler.answer("POST", INFER, [], BODY).status for _ in range(1_000)}
        finally:
            has_ended.set()
    assert [change.exception() for change in changes] == [None, None]
    assert statuses == {200}
