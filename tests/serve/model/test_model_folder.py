"""The model folder: written whole or not at all, and read with suspicion.

Models are found by name, version and path, in the documented order.

Metadata are the same after a round trip through an ONNX file, and wrong ones are refused with the reason.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, ModelError, OutputExists
from isocharge.common.files import sha256_of
from isocharge.serve import ModelMetadata, check_golden, find_labelled_model, find_model, load_model, write_model
from isocharge.serve.model.golden import contact_floors, make_golden


@pytest.fixture
def own_model(models, tmp_path):
    """A copy of the model's version folder, to be damaged."""
    return shutil.copytree(models / "linear" / "1", tmp_path / "linear" / "1")


def test_existing_version_is_not_overwritten(film, tmp_path):
    film.write(tmp_path)
    before = (tmp_path / "linear/1/model.onnx").stat().st_mtime_ns
    with pytest.raises(OutputExists, match="linear/1 is already there and is not overwritten"):
        film.write(tmp_path)
    assert (tmp_path / "linear/1/model.onnx").stat().st_mtime_ns == before


def test_a_file_with_the_name_of_the_model(film, tmp_path):
    (tmp_path / "linear").write_text("mine")
    with pytest.raises(OutputExists, match="linear: expected a folder or nothing, got a file"):
        film.write(tmp_path)


def noise_text(white_pC="1", gain="0.002"):
    """The noise of a model as it stands in its metadata; the values are JSON."""
    return f'{{"name": "mine", "white_pC": {white_pC}, "gain": {gain}}}'


def write(film, folder, *, onnx=None, metadata=None, golden=None):
    metadata = metadata or film.metadata()
    onnx = film.onnx(film.metadata().to_props()) if onnx is None else onnx
    return write_model(folder, onnx, metadata, film.golden_pC() if golden is None else golden, "card")


def spoilt(film):
    """Arguments of `write` that cannot work, by what is wrong."""
    props = film.metadata().to_props()
    return {
        "no graph": {"onnx": b"not a graph"},
        "no metadata": {"onnx": film.onnx({})},
        "other metadata": {"metadata": film.metadata(probes=("circle:2.0",))},
        "other output": {"onnx": film.onnx(props, renamed={"misfit": "m"})},
        "golden too narrow": {"golden": film.golden_pC()[:, :2]},
        "no answer": {"golden": np.zeros((1, 3))},
        "no golden": {"golden": np.zeros((0, 3))},
    }


@pytest.mark.parametrize("another_version", [False, True], ids=["new folder", "folder with version 7"])
@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ("no graph", ModelError, "cannot read these 11 bytes"),
        ("no metadata", ModelError, "key 'format_version' is missing"),
        ("other metadata", ModelError, "disagree on 'probes'"),
        ("other output", ModelError, "expected the outputs"),
        ("golden too narrow", ChargeError, "'A', 'B', 'C'"),
        ("no answer", ModelError, "answers contact = .*nan"),
        ("no golden", ModelError, "expected a list of lists, 1 or more"),
    ],
)
def test_unusable_model_leaves_nothing_behind(film, tmp_path, wrong, error, said, another_version):
    if another_version:
        film.write(tmp_path, version=7)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(error, match=said):
        write(film, tmp_path / "linear", **spoilt(film)[wrong])
    assert sorted(tmp_path.rglob("*")) == before


def test_interrupted_writing_leaves_nothing_behind(film, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("isocharge.serve.model.model_folder.check_golden", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write(film, tmp_path / "linear")
    assert list(tmp_path.iterdir()) == []


def test_golden_vectors_are_checked_before_a_version_appears(film, tmp_path, monkeypatch):
    def wrong(*arguments):
        golden = make_golden(*arguments)
        golden.outputs["contact"][0] += 1.0
        return golden

    monkeypatch.setattr("isocharge.serve.model.model_folder.make_golden", wrong)
    with pytest.raises(ModelError, match=r"contact\[0, .\] is"):
        write(film, tmp_path / "linear")
    assert list(tmp_path.iterdir()) == []


def test_floors_of_golden_answers_grow_with_area_and_force_and_are_no_less_than_the_error(film):
    usual, wide, noisy = (
        np.array(contact_floors(film.metadata(working_area_mm=((r, 0.0), (0.0, r), (-r, 0.0)), **changes)))
        for r, changes in (
            (20.0, {}),
            (60.0, {"force_range_N": (0.05, 10.0)}),
            (5.0, {"force_range_N": (0.05, 1.0), "errors": {"position_rms_mm": 4.0}}),
        )
    )
    np.testing.assert_allclose([wide / usual, noisy], [[3.0, 3.0, 5.0], [4.0, 4.0, usual[2]]])


def test_folder_and_model_have_one_name(film, tmp_path):
    with pytest.raises(ModelError, match="expected a folder named 'linear'"):
        write(film, tmp_path / "other")


def test_other_electrodes_need_another_name(film, make_film, tmp_path):
    film.write(tmp_path)
    with pytest.raises(ModelError, match=r"config.pbtxt: describes a model other than .*'D'"):
        make_film(4).write(tmp_path, version=2)


@pytest.mark.parametrize(
    "spoilt",
    [
        lambda _: b"",
        lambda _: b"\x00" * 100,
        lambda _: b"PK\x03\x04 not ONNX",
        lambda data: data[:200],
        lambda data: data.replace(b'["A"', b'[\xff\xff"'),
        lambda data: data.replace(b"misfit", b"misfi\xff"),
    ],
    ids=["empty", "zeros", "zip", "half", "metadata are no text", "a name is no text"],
)
def test_not_a_model_is_chained_from_its_cause(own_model, spoilt):
    path, golden = own_model / "model.onnx", own_model / "golden.json"
    data = spoilt(path.read_bytes())
    golden.write_text(golden.read_text().replace(sha256_of(path.read_bytes()), sha256_of(data)))
    path.write_bytes(data)
    with pytest.raises(ModelError, match=f"these {len(data)} bytes") as caught:
        load_model(own_model)
    assert caught.value.__cause__ is not None


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda _: "{", "golden.json: expected JSON, got"),
        (lambda _: "{}", "golden.json: key 'sha256' is missing; the file is damaged"),
        (lambda _: "[]", "golden.json: expected a table"),
        (lambda table: json.dumps(table | {"inputs": {"charge_pC": [[1.0, 2.0]]}}), r"charges of shape \(n, 3\)"),
    ],
)
def test_damaged_golden(own_model, spoil, said):
    golden = own_model / "golden.json"
    golden.write_text(spoil(json.loads(golden.read_text())))
    with pytest.raises(ModelError, match=said):
        load_model(own_model)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        ({"renamed": {"contact": "touch"}}, "expected the outputs contact"),
        ({"renamed": {"charge_pC": "x"}}, "expected the input charge_pC"),
        ({"batch": 1}, "expected the input"),
    ],
)
def test_other_interface_is_refused(film, own_model, spoil, said):
    data = film.onnx(film.metadata().to_props(), **spoil)
    golden = own_model / "golden.json"
    golden.write_text(json.dumps(json.loads(golden.read_text()) | {"sha256": sha256_of(data)}))
    (own_model / "model.onnx").write_bytes(data)
    with pytest.raises(ModelError, match=said):
        load_model(own_model)


def test_golden_check_sees_a_change_of_2e_5(own_model):
    golden = own_model / "golden.json"
    content = json.loads(golden.read_text())
    content["outputs"]["contact"][3][0] += 2e-5 * max(1.0, abs(content["outputs"]["contact"][3][0]))
    golden.write_text(json.dumps(content))
    with pytest.raises(ModelError, match=r"contact\[3, 0\] is .*golden.json says"):
        check_golden(load_model(own_model))


@pytest.fixture
def roots(tmp_path, monkeypatch):
    """Three repositories - given, from the environment, of the working folder - and nothing shipped."""
    given, variable, current = (tmp_path / name for name in ("given", "variable", "work/models"))
    monkeypatch.setenv("ISOCHARGE_MODELS", str(variable))
    current.mkdir(parents=True)
    given.mkdir()
    monkeypatch.chdir(current.parent)
    monkeypatch.setattr("isocharge.serve.model.model_folder._shipped", lambda: tmp_path / "shipped")
    return {"given": given, "variable": variable, "current": current, "shipped": tmp_path / "shipped"}


def put(root: Path, name: str = "m", version: str = "1") -> Path:
    folder = root / name / version
    folder.mkdir(parents=True)
    (folder / "model.onnx").touch()
    return folder.resolve()


def test_first_repository_wins(roots):
    first = []
    for name in ("shipped", "current", "variable", "given"):
        put(roots[name])
        first.append(find_model("m", roots["given"]).resolve().parents[1])
    assert first == [roots[name].resolve() for name in ("shipped", "current", "variable", "given")]


def test_highest_version_is_by_number(roots):
    for version in ("1", "10", "9", "011", "draft", ".11.abcd"):
        put(roots["given"], version=version)
    assert [find_model(name, roots["given"]).name for name in ("m", "m/1")] == ["10", "1"]


def test_path_of_every_kind(roots):
    folder = put(roots["given"])
    for path in (folder.parent, folder, folder / "model.onnx"):
        assert find_model(path) == find_model(str(path)) == folder


def test_path_beside_us_is_found_when_no_model_has_the_name(roots):
    folder = put(roots["current"].parent, "mine")
    assert find_model("mine").resolve() == folder
    shadow = put(roots["current"], "mine")
    assert [find_model(to).resolve() for to in ("mine", "./mine", Path("mine"))] == [shadow, folder, folder]


def test_missing_name_says_where_and_what(roots):
    put(roots["given"], "three")
    with pytest.raises(ModelError, match=r"no model 'four'.*/given \(three\).*/variable \(no models\)"):
        find_model("four", roots["given"])


def test_missing_path_says_what_was_expected(roots):
    with pytest.raises(ModelError, match=r"nowhere/model.onnx: no model; expected a model folder"):
        find_model("nowhere/model.onnx", roots["given"])


def test_repository_that_was_named_must_be_there(roots):
    put(roots["current"])
    with pytest.raises(ModelError, match="nope: expected a folder of models"):
        find_model("m", roots["given"] / "nope")


def test_label_is_found_in_the_repositories_alone(roots):
    """A recording of somebody else names the model by its label, and must not choose a folder of the file system."""
    folder = put(roots["given"])
    put(roots["current"].parent, "mine")
    assert find_labelled_model("m/1", roots["given"]) == folder
    with pytest.raises(ModelError, match="no model 'mine/1'; looked in"):
        find_labelled_model("mine/1", roots["given"])


@pytest.mark.parametrize(
    "label", ["m", "/m/1", "../m/1", "m/../1", "m/1/", "m/01", "m/1\n", ".m/1", "m/model.onnx", ""]
)
def test_text_that_is_no_label_is_refused(roots, label):
    put(roots["given"])
    with pytest.raises(ModelError, match="expected the label NAME/VERSION"):
        find_labelled_model(label, roots["given"])


WHERE = "models/linear/1/model.onnx"


def test_props_round_trip_and_foreign_ones_are_left_alone(film):
    props = film.metadata().to_props() | {"author": "not JSON"}
    assert ModelMetadata.from_props(props, WHERE) == film.metadata()


def test_other_format_version(film):
    said = (
        rf"^{WHERE}: metadata format 2 is not supported \(this version reads 1\); export it again or upgrade isocharge$"
    )
    with pytest.raises(ModelError, match=said):
        ModelMetadata.from_props(film.metadata().to_props() | {"format_version": "2"}, WHERE)


@pytest.mark.parametrize(
    "key", ["format_version", "name", "sensor", "electrodes", "working_area_mm", "errors", "made_with"]
)
def test_missing_key_is_named(film, key):
    props = film.metadata().to_props()
    del props[key]
    with pytest.raises(ModelError, match=f"^{WHERE}: metadata: key '{key}' is missing; export the model again$"):
        ModelMetadata.from_props(props, WHERE)


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("name", '""', "expected letters, digits, '-', '_' and '.', got ''"),
        ("version", "0", "expected a whole number from 1, got 0"),
        ("version", "true", "got True"),
        ("sensor", "{}", "key 'sensor.name' is missing"),
        ("sensor", '{"name": 3}', "sensor.name: expected a text, got 3"),
        ("electrodes", '["A", "A"]', "expected names that differ, got .'A', 'A'"),
        ("electrodes", "[]", r"expected a list of texts, 1 or more, got \[\]"),
        ("working_area_mm", "[[0, 0], [1, 0]]", "expected a list of lists, 3 or more"),
        ("working_area_mm", "[[0, 0], [1, 0], [1]]", r"expected a list of 2 numbers, got \[1\]"),
        ("force_range_N", "[2.0, 0.05]", r"expected a smaller and a larger number, got \[2.0, 0.05\]"),
        ("force_range_N", "[0.05]", "expected a list of 2 numbers"),
        ("errors", '{"position_mm": NaN}', "errors: expected JSON"),
        ("probes", '"circle:1.0"', "expected a list of texts, 1 or more, got 'circle"),
        ("noise", "{", "noise: expected JSON, got '{' "),
        ("noise", "[" * 100_000, "noise: expected JSON"),
        ("noise", "{}", "key 'noise.name' is missing"),
        ("noise", '{"name": "mine", "gain": 0.002}', "key 'noise.white_pC' is missing"),
        ("noise", '{"name": "mine", "white_pC": 1.0}', "key 'noise.gain' is missing"),
        ("noise", noise_text(white_pC="-1"), "noise.white_pC: expected a number from 0, .*, got -1"),
        ("noise", noise_text(white_pC="NaN"), "noise: expected JSON"),
        ("noise", noise_text(white_pC='"loud"'), "noise.white_pC: expected a number from 0, .*, got 'loud'"),
        ("noise", noise_text(white_pC="[1, 1, -1]"), "noise.white_pC"),
        ("noise", noise_text(gain="[0.1, 0.1]"), r"noise.gain: expected one number for each of 3 electrodes, got .0.1"),
        ("noise", noise_text(gain="null"), "noise.gain: expected a number from 0, .*, got None"),
    ],
)
def test_wrong_value_is_shown(film, key, text, said):
    with pytest.raises(ModelError, match=rf"^{WHERE}: metadata: (?=.*{key}).*{said}.*; export the model again$"):
        ModelMetadata.from_props(film.metadata().to_props() | {key: text}, WHERE)


@pytest.mark.parametrize("extra", ["", ', "tau_s": 3.0'])
def test_noise_of_each_electrode_and_of_older_models_is_read(film, extra):
    text = f'{{"name": "rig", "white_pC": [1, 2, 3], "gain": 0.002{extra}}}'
    noise = ModelMetadata.from_props(film.metadata().to_props() | {"noise": text}, WHERE).noise
    variance = noise.variance(np.array([[100.0, 0.0, -50.0]]))
    np.testing.assert_allclose(variance, [[1.0 + 0.04, 4.0, 9.0 + 0.01]])


@pytest.mark.parametrize("value", [{"median_mm": float("nan")}, {"median_mm": object()}])
def test_what_is_not_json_is_not_written(film, value):
    with pytest.raises(ModelError, match="'errors': expected a JSON value"):
        film.metadata(errors=value).to_props()
