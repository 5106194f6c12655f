"""What serves, what is refused, and how one takes the other's place while requests are under way."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np
import pytest

from isocharge.errors import ModelError, ModelNotFound
from isocharge.files import sha256_of
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol.infer import InferRequest, infer


@pytest.fixture
def folder(store, tmp_path):  # noqa: ARG001
    """The folder of the model that the store holds in two versions."""
    return tmp_path / "models/linear"


def spoil(version, how):
    """Damage the files of a version."""
    model, golden = version / "model.onnx", version / "golden.json"
    content = json.loads(golden.read_text())
    if how == "bytes":
        model.write_bytes(model.read_bytes()[:-7])
    elif how == "half copied":
        golden.unlink()
    elif how == "answers":
        content["outputs"]["contact"][0][0] += 1.0
        golden.write_text(json.dumps(content))
    elif how == "not a graph":
        model.write_bytes(b"no graph")
        golden.write_text(json.dumps(content | {"sha256": sha256_of(b"no graph")}))


def states(store):
    return [(row.name, row.version, row.state) for row in store.index()]


DAMAGE = {
    "bytes": "the file is damaged or changed",
    "half copied": "golden.json: missing",
    "answers": r"contact\[0, 0\] is .*golden.json says",
    "not a graph": "cannot read these 8 bytes as a model",
}


def test_latest_is_by_number(film, tmp_path):
    for version in (2, 10, 9):
        film.write(tmp_path, version=version)
    store = open_model_store(tmp_path)
    assert store.get("linear").version == "10"
    assert store.get("linear", "9").version == "9"
    assert store.versions("linear") == ["2", "9", "10"]


@pytest.mark.parametrize(("how", "said"), DAMAGE.items())
def test_a_damaged_version_is_refused_and_others_serve(film, tmp_path, how, said):
    for version in (1, 2):
        film.write(tmp_path, version=version)
    film.write(tmp_path, name="other")
    spoil(tmp_path / "linear/2", how)
    store = open_model_store(tmp_path)
    assert store.get("linear").version == "1"
    assert states(store) == [("linear", "1", "READY"), ("linear", "2", "UNAVAILABLE"), ("other", "1", "READY")]
    (reason,) = store.refusals()
    with pytest.raises(ModelError, match=said):
        raise ModelError(reason)
    with pytest.raises(ModelNotFound, match="'linear/2' is not found; serving: linear/1, other/1"):
        store.get("linear", "2")


def test_a_model_in_another_ones_folder_is_refused(film, tmp_path):
    film.write(tmp_path)
    shutil.copytree(tmp_path / "linear", tmp_path / "other")
    shutil.copytree(tmp_path / "linear/1", tmp_path / "linear/2")
    store = open_model_store(tmp_path)
    assert [served.metadata.label for served in store.all()] == ["linear/1"]
    assert all(
        f"expected the model {name}" in reason
        for name, reason in zip(("linear/2", "other/1"), store.refusals(), strict=True)
    )


@pytest.mark.parametrize("make", [lambda root: root.mkdir(), lambda root: (root / "linear").mkdir(parents=True)])
def test_a_folder_without_models(tmp_path, make):
    make(tmp_path / "models")
    with pytest.raises(ModelError, match=r"models: expected models, <name>/<version>/model.onnx, found none"):
        open_model_store(tmp_path / "models")


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(ModelError, match="nowhere: expected a folder of models"):
        open_model_store(tmp_path / "nowhere")


def test_no_sound_model_at_all(film, tmp_path):
    spoil(film.write(tmp_path), "bytes")
    with pytest.raises(ModelError, match=r"no model can be served: .*damaged or changed"):
        open_model_store(tmp_path)


@pytest.mark.parametrize(("how", "said"), DAMAGE.items())
def test_a_damaged_swap_keeps_the_last_good(store, folder, how, said):
    before = store.get("linear")
    spoil(folder / "2", how)
    for _ in range(2):
        with pytest.raises(ModelError, match=said):
            store.load("linear")
        assert store.get("linear") is before
        assert store.get("linear", "2") is before
    assert [row.reason != "" for row in store.index()] == [False, True]
    assert states(store) == [("linear", "1", "READY"), ("linear", "2", "READY")]


def test_a_new_version_becomes_the_latest(film, store, tmp_path):
    film.write(tmp_path / "models", version=3)
    assert store.get("linear").version == "2"
    store.load("linear")
    assert store.get("linear").version == "3"


def test_a_version_that_was_removed_goes(store, folder):
    shutil.rmtree(folder / "2")
    store.load("linear")
    assert store.versions("linear") == ["1"]
    with pytest.raises(ModelNotFound):
        store.get("linear", "2")


def test_a_model_that_was_removed_serves_on(store, folder):
    shutil.rmtree(folder)
    with pytest.raises(ModelNotFound, match="'linear' is not found in the repository"):
        store.load("linear")
    assert store.get("linear").version == "2"


def test_unload_and_load(store):
    store.unload("linear")
    assert states(store) == [("linear", "1", "UNAVAILABLE"), ("linear", "2", "UNAVAILABLE")]
    assert {row.reason for row in store.index()} == {"unloaded"}
    for call in (store.get, store.unload, store.named):
        with pytest.raises(ModelNotFound, match="serving: no model"):
            call("linear")
    store.load("linear")
    assert store.get("linear").version == "2"


def test_a_model_that_came_later_can_be_loaded(film, store, tmp_path):
    film.write(tmp_path / "models", name="later")
    assert ("later", "", "UNAVAILABLE") in states(store)
    store.load("later")
    assert store.get("later").version == "1"


@pytest.mark.parametrize("name", ["", "..", "linear/1", "../models/linear", "/"])
def test_a_name_is_no_path(store, name):
    for call in (store.get, store.load, store.unload):
        with pytest.raises(ModelNotFound):
            call(name)


def test_swaps_neither_drop_nor_mix_answers(film, store, folder):
    """Two models of one name whose answers differ take turns on disk while threads ask without pause."""
    turned = type(film)(1.5 * film.directions @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    request = InferRequest("", film.golden_pC(), ("contact", "contact_std", "misfit"), frozenset())
    stop, seen = Event(), []

    def ask():
        answers = []
        while not stop.is_set():
            contact = infer(store.get("linear", "2"), request).outputs["contact"]
            answers.append((contact[0, 0], contact[7, 1]))
        return answers

    with ThreadPoolExecutor(2) as threads:
        asking = [threads.submit(ask) for _ in range(2)]
        for source in (turned, film) * 8:
            shutil.rmtree(folder / "2")
            source.write(folder.parent, version=2)
            store.load("linear")
        stop.set()
        for asked in asking:
            seen += asked.result()
    assert len(seen) > 100
    assert len(set(seen)) == 2  # both numbers of the one model, or both of the other
