"""What serves, what is refused, and how one takes the other's place while requests are under way."""

import json
import os
import re
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
from isocharge.serve.network.protocol.infer import InferRequest, infer
from isocharge.serve.network.protocol.page import page


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


def a_failing_graph(version):
    """A graph that declares the right shapes and cannot be run on the golden charges."""
    model = onnx.load_from_string((version / "model.onnx").read_bytes())
    model.graph.initializer.append(numpy_helper.from_array(np.array([99], dtype=np.int64), "row 99"))
    node = next(node for node in model.graph.node if "contact" in node.output)
    node.output[0] = "inner"
    model.graph.node.append(helper.make_node("Gather", ["inner", "row 99"], ["one row"], axis=0))
    model.graph.node.append(helper.make_node("Mul", ["inner", "one row"], ["contact"]))
    put_in_place(version, model.SerializeToString())


def put_in_place(version, graph):
    """Another graph, with a checksum that fits."""
    (version / "model.onnx").write_bytes(graph)
    content = json.loads((version / "golden.json").read_text())
    (version / "golden.json").write_text(json.dumps(content | {"sha256": sha256_of(graph)}))


def unequal_lengths(version):
    content = json.loads((version / "golden.json").read_text())
    content["outputs"]["contact"].pop()
    (version / "golden.json").write_text(json.dumps(content))


def a_pipe(name):
    def spoil(version):
        (version / name).unlink()
        os.mkfifo(version / name)

    return spoil


def sparse(name):
    """Six gigabytes of which the disk has nothing."""

    def spoil(version):
        with (version / name).open("r+b") as file:
            file.truncate(6 << 30)

    return spoil


BROKEN = {
    "nested": (lambda version: (version / "golden.json").write_text("[" * 100_000), "expected JSON"),
    "unequal": (unequal_lengths, r"expected answers of shape \(8, 3\), got \(7, 3\)"),
    "pipe": (a_pipe("model.onnx"), "cannot be read .not a regular file"),
    "sparse": (sparse("model.onnx"), "cannot be read .larger than"),
    "graph": (a_failing_graph, "the model's graph fails when it is run"),
}


@pytest.mark.parametrize("how", BROKEN)
@pytest.mark.timeout(20)
def test_a_broken_folder_takes_no_other_with_it(film, tmp_path, how):
    """At the start, and when it is loaded while others serve."""
    spoil, said = BROKEN[how]
    film.write(tmp_path)
    film.write(tmp_path, name="other")
    store = open_model_store(tmp_path)
    spoil(tmp_path / "other/1")
    with pytest.raises(ModelError, match=said):
        store.load("other")
    assert store.get("other")  # with its old files
    store = open_model_store(tmp_path)
    assert [loaded.metadata.name for loaded in store.all()] == ["linear"]
    assert re.search(said, store.refusals()[0])


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
    assert [loaded.metadata.name for loaded in store.all()] == ["linear"]
    assert "<svg" not in page(store)
    assert "&lt;svg" in page(store)
