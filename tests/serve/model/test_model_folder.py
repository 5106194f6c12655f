"""Writing, reading and finding model folders.

A version is written completely or not at all. Damaged files, wrong metadata and other interfaces are refused with the
reason. Models are found by name, version and path, in the documented order.
"""

import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import onnx
import pytest

from isocharge.common.errors import ChargeError, ModelError, OutputError, OutputExists
from isocharge.serve import ModelMetadata, find_labelled_model, find_model, load_model, write_model
from isocharge.serve.model.model_folder import model_names
from isocharge.serve.model.session import contact_floors, make_golden
from model_files import put_graph


@pytest.fixture
def own_model(models, tmp_path):
    """A copy of the model's version folder, to be damaged."""
    return shutil.copytree(models / "linear/1", tmp_path / "linear/1")


def test_existing_version_is_not_overwritten(film, tmp_path):
    film.write(tmp_path)
    before = (tmp_path / "linear/1/model.onnx").stat().st_mtime_ns
    with pytest.raises(OutputExists, match="linear/1 is already there and is not overwritten"):
        film.write(tmp_path)
    assert (tmp_path / "linear/1/model.onnx").stat().st_mtime_ns == before


def test_folder_whose_name_no_model_can_have_is_skipped(film, tmp_path):
    film.write(tmp_path)
    (tmp_path / "lost+found" / "1").mkdir(parents=True)
    assert model_names(tmp_path) == ["linear"]


def test_file_with_the_name_of_the_model_folder_is_not_overwritten(film, tmp_path):
    (tmp_path / "linear").write_text("mine")
    with pytest.raises(OutputError, match="linear is not a writable folder; choose another output"):
        film.write(tmp_path)


def noise_text(white_pC="1", gain="0.002"):
    """The noise of a model as it stands in its metadata; the values are JSON."""
    return f'{{"name": "mine", "white_pC": {white_pC}, "gain": {gain}}}'


def write(film, folder, **changes):
    metadata = film.metadata()
    arguments = {"onnx": film.onnx(metadata.to_props()), "metadata": metadata, "golden": film.golden_pC()} | changes
    return write_model(folder, *arguments.values(), "card")


def wrong_arguments(film):
    """Return arguments of `write` that must be refused, by the name of the mistake."""
    props = film.metadata().to_props()
    return {
        "no graph": {"onnx": b"not a graph"},
        "no metadata": {"onnx": film.onnx({})},
        "other metadata": {"metadata": film.metadata(probes=("circle:2.0",))},
        "more metadata": {"metadata": film.metadata(yield_force_N=0.8)},
        "other output": {"onnx": film.onnx(props, renamed={"misfit": "m"})},
        "golden too narrow": {"golden": film.golden_pC()[:, :2]},
        "no answer": {"golden": np.zeros((1, 3))},
        "no golden": {"golden": np.zeros((0, 3))},
    }


@pytest.mark.parametrize(
    ("mistake", "error", "message"),
    [
        ("no graph", ModelError, "cannot read these 11 bytes"),
        ("no metadata", ModelError, "key 'name' is missing"),
        ("other metadata", ModelError, "disagree with the stated ones: .*'probes'"),
        ("more metadata", ModelError, "disagree with the stated ones: .*'yield_force_N'"),
        ("other output", ModelError, "expected the tensors .*misfit"),
        ("golden too narrow", ChargeError, "'A', 'B', 'C'"),
        ("no answer", ModelError, "contact: expected finite outputs, got .*nan"),
        ("no golden", ModelError, "expected a list of lists, 1 or more"),
    ],
)
def test_refused_model_leaves_no_files(film, tmp_path, mistake, error, message):
    film.write(tmp_path, version=7)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(error, match=message):
        write(film, tmp_path / "linear", **wrong_arguments(film)[mistake])
    assert sorted(tmp_path.rglob("*")) == before


def test_golden_vectors_are_checked_before_a_version_appears(film, tmp_path, monkeypatch):
    def wrong(*arguments):
        golden = make_golden(*arguments)
        golden.outputs["contact"][0][0] += 1.0
        return golden

    monkeypatch.setattr("isocharge.serve.model.model_folder.make_golden", wrong)
    with pytest.raises(ModelError, match=r"contact\[0, .\]: expected"):
        write(film, tmp_path / "linear")
    assert not any(tmp_path.iterdir())


def test_tolerance_near_zero_is_that_of_a_twentieth_of_the_range(film):
    """It is at least that of 1 mm and 0.1 N."""
    assert contact_floors(film.metadata()) == (1.0, 1.0, 0.1)
    large = film.metadata(working_area_mm=((36.0, 0.0), (0.0, 36.0), (-9.0, 0.0)), force_range_N=(0.05, 3.0))
    assert contact_floors(large) == pytest.approx((1.8, 1.8, 0.15))


def test_model_in_a_folder_with_another_name_or_other_files_is_refused(film, tmp_path):
    with pytest.raises(ModelError, match="expected a folder named 'linear'"):
        write(film, tmp_path / "other")
    with pytest.raises(ModelError, match="expected a new folder or the folder of a model, got one with other files"):
        write(film, film.write(tmp_path))  # the folder of a version


def test_version_with_other_electrodes_in_the_same_model_folder_is_refused(film, tmp_path):
    film.write(tmp_path, version=2)
    (tmp_path / "linear/1").mkdir()  # a damaged version
    with pytest.raises(ModelError, match=r"config.pbtxt: describes a model other than .*'D'"):
        film.with_electrodes(4).write(tmp_path, version=3)
    with pytest.raises(ModelError, match=r"expected the electrodes .*'B', 'C'\) of its last version in this order"):
        film.write(tmp_path, version=3, electrodes=("C", "B", "A"))
    (tmp_path / "linear/config.pbtxt").write_bytes(b"\xff")
    with pytest.raises(ModelError, match=r"config.pbtxt: describes a model other than"):
        film.write(tmp_path, version=3)


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: b"",
        lambda data: data[:200],
        lambda data: data.replace(b'["A"', b'[\xff\xff"'),
        lambda data: data.replace(b"misfit", b"misfi\xff"),
    ],
)
def test_file_that_is_not_an_onnx_model_is_refused_with_its_cause(own_model, damage):
    path = own_model / "model.onnx"
    data = damage(path.read_bytes())
    put_graph(own_model, data)
    with pytest.raises(ModelError, match=f"these {len(data)} bytes") as caught:
        load_model(own_model)
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda _: "{", "golden.json: expected JSON, got"),
        (lambda _: "{}", "golden.json: key 'sha256' is missing; the file is damaged"),
        (lambda _: "[]", "golden.json: expected a table"),
        (lambda table: json.dumps(table | {"inputs": {"charge_pC": [[1.0, 2.0]] * 8}}), r"charges of shape \(n, 3\)"),
    ],
)
def test_damaged_golden_json_is_refused(own_model, damage, message):
    golden = own_model / "golden.json"
    golden.write_text(damage(json.loads(golden.read_text())))
    with pytest.raises(ModelError, match=message):
        load_model(own_model)


def test_version_folder_that_may_not_be_searched_is_refused(own_model, monkeypatch):
    """The error of the operating system is simulated, because the superuser may search every folder."""
    monkeypatch.setattr(Path, "stat", Mock(side_effect=PermissionError(13, "Permission denied")))
    with pytest.raises(ModelError, match=r"golden.json: cannot be read \(Permission denied\)"):
        load_model(own_model)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"renamed": {"contact": "touch"}}, "expected the tensors .*'touch'"),
        ({"renamed": {"charge_pC": "x"}}, "expected the tensors .*'x'"),
        ({"batch": 1}, "expected the tensors .*1, 3"),
    ],
)
def test_graph_with_other_inputs_or_outputs_is_refused(film, own_model, changes, message):
    data = film.onnx(film.metadata().to_props(), **changes)
    put_graph(own_model, data)
    with pytest.raises(ModelError, match=message):
        load_model(own_model)


def test_graph_that_loads_its_numbers_from_another_file_is_refused(own_model):
    path = own_model / "model.onnx"
    graph = onnx.load(path)
    onnx.save_model(graph, path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    put_graph(own_model, path.read_bytes())
    with pytest.raises(ModelError, match="external data"):
        load_model(own_model)


@pytest.fixture
def roots(tmp_path, monkeypatch):
    """The four repositories that are searched; the folder of released models is empty."""
    given = tmp_path / "given"
    variable = tmp_path / "variable"
    current = tmp_path / "work/models"
    monkeypatch.setenv("ISOCHARGE_MODELS", str(variable))
    current.mkdir(parents=True)
    given.mkdir()
    monkeypatch.chdir(current.parent)
    monkeypatch.setattr("isocharge.serve.model.model_folder._released_models", lambda: tmp_path / "shipped")
    return {"given": given, "variable": variable, "current": current, "shipped": tmp_path / "shipped"}


def put(root, name="m", version="1"):
    """Create a version folder with an empty model file in a repository."""
    folder = root / name / version
    folder.mkdir(parents=True)
    (folder / "model.onnx").touch()
    return folder.resolve()


def test_find_model_searches_the_repositories_in_the_documented_order(roots):
    for name in ("shipped", "current", "variable", "given"):  # from the last repository to the first
        put(roots[name])
        assert find_model("m", roots["given"]).resolve().parents[1] == roots[name].resolve(), name


def test_find_model_takes_a_name_a_version_or_a_path_and_returns_the_numerically_highest_version(roots):
    for version in ("1", "10", "9", "011", "draft", ".11.abcd"):
        put(roots["given"], version=version)
    folder = roots["given"] / "m"
    for path in (folder, folder / "10", folder / "10/model.onnx"):
        assert find_model(path) == find_model(str(path)) == folder / "10", path
    assert find_model("m", roots["given"]) == folder / "10"
    assert find_model("m/1", str(roots["given"])) == folder / "1"
    (folder / "10/card.md").touch()
    with pytest.raises(ModelError, match="no model; expected"):
        find_model(folder / "10/card.md")


def test_text_is_taken_as_a_path_if_no_model_has_the_name(roots):
    folder = put(roots["current"].parent, "mine")
    assert find_model("mine").resolve() == folder

    named = put(roots["current"], "mine")
    assert find_model("mine").resolve() == named
    assert find_model("./mine").resolve() == folder
    assert find_model(Path("mine")).resolve() == folder


def test_error_for_an_unknown_model_lists_the_searched_folders_and_their_models(roots):
    put(roots["given"], "three")
    with pytest.raises(ModelError, match=r"no model 'four'.*/given \(three\).*/variable \(no models\)"):
        find_model("four", roots["given"])


def test_label_from_a_file_is_never_taken_as_a_path(roots):
    """A recording from an untrusted source must not select a folder of the file system."""
    folder = put(roots["given"])
    put(roots["current"].parent, "mine")
    assert find_labelled_model("m/1", roots["given"]) == folder
    with pytest.raises(ModelError, match="no model 'mine/1'; looked in"):
        find_labelled_model("mine/1", roots["given"])


@pytest.mark.parametrize(
    "label", ["m", "/m/1", "../m/1", "m/../1", "m/1/", "m/01", "m/1\n", ".m/1", "m/model.onnx", ""]
)
def test_invalid_label_is_refused(roots, label):
    put(roots["given"])
    with pytest.raises(ModelError, match="expected the label NAME/VERSION"):
        find_labelled_model(label, roots["given"])


WHERE = "models/linear/1/model.onnx"


def read_metadata(film, **changed_props):
    """Read the metadata of a model with some changed texts."""
    return ModelMetadata.from_props(film.metadata().to_props() | changed_props, WHERE)


def test_metadata_props_round_trip_ignores_unknown_keys(film):
    assert read_metadata(film, author="not JSON") == film.metadata()


def test_unsupported_format_version_of_metadata_is_refused(film):
    message = (
        rf"^{WHERE}: metadata format 2 is not supported \(this version reads 1\); export it again or upgrade isocharge$"
    )
    with pytest.raises(ModelError, match=message):
        read_metadata(film, format_version="2")


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("name", '""', "expected letters, digits, '-', '_' and '.', got ''"),
        ("sensor", "{}", "sensor.name: expected a text, got None"),
        ("sensor", '{"name": 3}', "sensor.name: expected a text, got 3"),
        ("electrodes", '["A", "A"]', "expected names that differ, got .'A', 'A'"),
        ("force_range_N", "[2.0, 0.05]", r"expected a smaller and a larger number, got \[2.0, 0.05\]"),
        ("errors", '{"position_mm": NaN}', "errors: expected JSON"),
        ("noise", "{", "noise: expected JSON, got '{' "),
        ("noise", '{"name": "mine", "gain": 0.002}', "key 'noise.white_pC' is missing"),
        ("noise", noise_text(white_pC='"loud"'), "noise.white_pC: expected a number from 0, .*, got 'loud'"),
        ("noise", noise_text(gain="[0.1, 0.1]"), r"noise.gain: expected one number for each of 3 electrodes, got .0.1"),
    ],
)
def test_wrong_metadata_value_is_shown(film, key, text, message):
    with pytest.raises(ModelError, match=rf"^{WHERE}: metadata: (?=.*{key}).*{message}.*; export the model again$"):
        read_metadata(film, **{key: text})


@pytest.mark.parametrize("extra", ["", ', "tau_s": 3.0'])
def test_noise_of_each_electrode_and_of_older_models_is_read(film, extra):
    text = f'{{"name": "rig", "white_pC": [1, 2, 3], "gain": 0.002{extra}}}'
    variance = read_metadata(film, noise=text).noise.variance(np.array([[100.0, 0.0, -50.0]]))
    np.testing.assert_allclose(variance, [[1.0 + 0.04, 4.0, 9.0 + 0.01]])


@pytest.mark.parametrize("value", [{"median_mm": float("nan")}, {"median_mm": object()}])
def test_metadata_that_are_not_json_are_refused(film, value):
    with pytest.raises((TypeError, ValueError), match=r"not JSON|unsupported"):
        film.metadata(errors=value).to_props()
