"""What serves, what is refused, and how one takes the other's place while requests are under way."""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from isocharge.common.errors import ModelError, ModelNotFound
from isocharge.common.files import sha256_of
from isocharge.serve.network.model_store import open_model_store
from isocharge.serve.network.protocol.infer import infer
from isocharge.serve.network.protocol.page import page


@pytest.fixture
def folder(store, tmp_path):  # noqa: ARG001
    """The folder of the model that the store holds in two versions."""
    return tmp_path / "models/linear"


def states(store):
    return [(row["name"], row["version"], row["state"]) for row in store.index()]


def labels(store):
    return [loaded.metadata.label for loaded in store.all()]


def put_in_place(version, graph):
    """Another graph, with a checksum that fits."""
    (version / "model.onnx").write_bytes(graph)
    content = json.loads((version / "golden.json").read_text())
    (version / "golden.json").write_text(json.dumps(content | {"sha256": sha256_of(graph)}))


def a_failing_graph(version):
    """A graph that declares the right shapes and cannot be run on the golden charges."""
    model = onnx.load_from_string((version / "model.onnx").read_bytes())
    model.graph.initializer.append(numpy_helper.from_array(np.array([99], dtype=np.int64), "row 99"))
    node = next(node for node in model.graph.node if "contact" in node.output)
    node.output[0] = "inner"
    model.graph.node.append(helper.make_node("Gather", ["inner", "row 99"], ["one row"], axis=0))
    model.graph.node.append(helper.make_node("Mul", ["inner", "one row"], ["contact"]))
    put_in_place(version, model.SerializeToString())


def other_answers(version):
    content = json.loads((version / "golden.json").read_text())
    content["outputs"]["contact"][0][0] += 1.0
    (version / "golden.json").write_text(json.dumps(content))


def an_answer_less(version):
    content = json.loads((version / "golden.json").read_text())
    content["outputs"]["contact"].pop()
    (version / "golden.json").write_text(json.dumps(content))


def a_pipe(version):
    (version / "model.onnx").unlink()
    os.mkfifo(version / "model.onnx")


def six_gigabytes(version):
    """Of which the disk has nothing."""
    with (version / "model.onnx").open("r+b") as file:
        file.truncate(6 << 30)


FAULTS = {
    "cut": (lambda version: os.truncate(version / "model.onnx", 1000), "the file is damaged or changed"),
    "half copied": (lambda version: (version / "golden.json").unlink(), "golden.json: missing"),
    "answers": (other_answers, r"contact\[0, 0\] is .*golden.json says"),
    "unequal": (an_answer_less, r"expected answers of shape \(8, 3\), got \(7, 3\)"),
    "no graph": (lambda version: put_in_place(version, b"no graph"), "cannot read these 8 bytes as a model"),
    "failing graph": (a_failing_graph, "the model's graph fails when it is run"),
    "nested": (lambda version: (version / "golden.json").write_text("[" * 100_000), "expected JSON"),
    "pipe": (a_pipe, "cannot be read .not a regular file"),
    "sparse": (six_gigabytes, "cannot be read .larger than"),
}


@pytest.mark.parametrize("how", FAULTS)
@pytest.mark.timeout(60)
def test_a_broken_version_takes_no_other_with_it(film, store, folder, how):
    """While it is loaded, its old files serve on; at the start, the others serve."""
    spoil, said = FAULTS[how]
    film.write(folder.parent, name="other")
    before = store.get("linear")
    spoil(folder / "2")
    for _ in range(2):
        with pytest.raises(ModelError, match=said):
            store.load("linear")
        assert store.get("linear") is store.get("linear", "2") is before
    assert [(row["state"], row["reason"] != "") for row in store.known()] == [("READY", False), ("READY", True)]

    store = open_model_store(folder.parent)
    assert states(store) == [("linear", "1", "READY"), ("linear", "2", "UNAVAILABLE"), ("other", "1", "READY")]
    assert store.get("linear").version == "1"
    with pytest.raises(ModelNotFound, match=rf"'linear/2' is not found; serving: linear/1, other/1; .*{said}"):
        store.get("linear", "2")


def test_latest_is_by_number(film, tmp_path):
    for version in (2, 10, 9):
        film.write(tmp_path, version=version)
    store = open_model_store(tmp_path)
    assert store.get("linear").version == "10"
    assert store.get("linear", "9").version == "9"
    assert [loaded.version for loaded in store.named("linear")] == ["2", "9", "10"]


def test_a_model_in_another_ones_folder_is_refused(film, tmp_path):
    film.write(tmp_path)
    shutil.copytree(tmp_path / "linear", tmp_path / "other")
    shutil.copytree(tmp_path / "linear/1", tmp_path / "linear/2")
    store = open_model_store(tmp_path)
    assert labels(store) == ["linear/1"]
    for name, why in zip(("linear/2", "other/1"), store.refusals(), strict=True):
        assert f"expected the model {name}" in why


def test_folders_without_a_sound_model(film, tmp_path):
    (tmp_path / "models/linear").mkdir(parents=True)
    with pytest.raises(ModelError, match=r"models: expected models, <name>/<version>/model.onnx, found none"):
        open_model_store(tmp_path / "models")
    (film.write(tmp_path) / "golden.json").unlink()
    with pytest.raises(ModelError, match=r"no model can be served: .*golden.json: missing"):
        open_model_store(tmp_path)


def test_versions_and_models_that_come_and_go(film, store, folder):
    film.write(folder.parent, version=3)
    film.write(folder.parent, name="later")
    assert ("later", "", "UNAVAILABLE") in states(store)
    assert store.get("linear").version == "2"
    for name in ("linear", "later"):
        store.load(name)
    assert labels(store) == ["later/1", "linear/1", "linear/2", "linear/3"]
    shutil.rmtree(folder / "2")
    store.load("linear")
    assert labels(store) == ["later/1", "linear/1", "linear/3"]
    shutil.rmtree(folder)
    with pytest.raises(ModelNotFound, match="'linear' is not found in the repository"):
        store.load("linear")
    assert store.get("linear").version == "3"  # nobody unloaded it


def test_unload_and_load(store):
    store.unload("linear")
    assert states(store) == [("linear", "1", "UNAVAILABLE"), ("linear", "2", "UNAVAILABLE")]
    assert {row["reason"] for row in store.index()} == {"unloaded"}
    for call in (store.get, store.unload, store.named):
        with pytest.raises(ModelNotFound, match="serving: no model"):
            call("linear")
    store.load("linear")
    assert store.get("linear").version == "2"
    assert store.unready(full=True) == ""


@pytest.mark.parametrize("name", ["", "..", "linear/1", "../models/linear", "/"])
def test_a_name_is_no_path(store, name):
    for call in (store.get, store.load, store.unload):
        with pytest.raises(ModelNotFound):
            call(name)


def test_swaps_neither_drop_nor_mix_answers(film, store, folder):
    """Two models of one name whose answers differ take turns on disk while threads ask without pause."""
    turned = type(film)(1.5 * film.directions @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    stop, seen = Event(), set()

    def ask():
        while not stop.is_set():
            contact = infer(store.get("linear", "2"), film.golden_pC(), ("contact",))[0]["contact"]
            seen.add((contact[0, 0], contact[7, 1]))

    with ThreadPoolExecutor(2) as threads:
        asking = [threads.submit(ask) for _ in range(2)]
        for source in (turned, film) * 4:
            shutil.rmtree(folder / "2")
            source.write(folder.parent, version=2)
            store.load("linear")
        stop.set()
        for asked in asking:
            asked.result()
    assert len(seen) == 2  # both numbers of the one model, or both of the other


def test_names_that_no_model_has(film, tmp_path):
    """They would stand in pages and messages: the model is refused, and its folder's name escaped."""
    film.write(tmp_path)
    name = '"><svg onload=alert(1)>'
    folder = tmp_path / name / "1"
    shutil.copytree(tmp_path / "linear/1", folder)
    model = onnx.load_from_string((folder / "model.onnx").read_bytes())
    next(prop for prop in model.metadata_props if prop.key == "name").value = json.dumps(name)
    put_in_place(folder, model.SerializeToString())
    store = open_model_store(tmp_path)
    assert labels(store) == ["linear/1"]
    assert "<svg" not in page(store)
    assert "&lt;svg" in page(store)
