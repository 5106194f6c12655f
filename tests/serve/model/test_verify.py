"""`isocharge verify`: damaged, mixed and renamed model folders are recognised, and servers refuse them as well."""

import json
import shutil

import pytest

from isocharge.common.errors import ModelError
from isocharge.serve import load_checked_model, write_model


@pytest.fixture
def folder(film, tmp_path):
    """The version folder of a model that has a charge map."""
    metadata = film.metadata()
    graph = film.onnx(metadata.to_props())
    files = {"charges.npz": b"charge map"}
    return write_model(tmp_path / "models" / metadata.name, graph, metadata, film.golden_pC(), "card", files)


def verify(command, folder):
    """Return the exit code of `isocharge verify --json`, and its checks by their names."""
    code, out, _ = command("verify", folder, "--json")
    report = json.loads(out)
    assert report["fits"] == (code == 0)
    return code, {check["name"]: check for check in report["checks"]}


def test_unchanged_folder_fits_and_each_check_has_a_sentence(command, folder):
    code, checks = verify(command, folder)
    assert (code, list(checks)) == (0, ["graph", "origin", "version", "charge map", "golden vectors"])
    assert "charges.npz" in checks["charge map"]["message"]
    assert command("verify", folder)[1].splitlines() == [f"{name}: {one['message']}" for name, one in checks.items()]


def flip_a_byte(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def change_an_output(path):
    golden = json.loads(path.read_text("utf-8"))
    golden["outputs"]["contact"][0][0] += 1.0
    path.write_text(json.dumps(golden), "utf-8")


FAULTS = {
    "graph": lambda folder: flip_a_byte(folder / "model.onnx"),
    "golden vectors": lambda folder: change_an_output(folder / "golden.json"),
    "charge map": lambda folder: flip_a_byte(folder / "charges.npz"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_changed_file_does_not_fit_and_is_refused_when_it_is_loaded(command, folder, fault):
    FAULTS[fault](folder)
    code, checks = verify(command, folder)
    wrong = {name: check["message"] for name, check in checks.items() if not check["fits"]}
    assert (code, list(wrong)) == (1, [fault])
    assert "again" in wrong[fault]  # the advice
    assert f"{fault} does not fit: {wrong[fault]}" in command("verify", folder)[1]
    with pytest.raises(ModelError) as refused:
        load_checked_model(folder)
    assert str(refused.value) == wrong[fault]


def test_folder_that_was_renamed_and_a_charge_map_of_another_model_do_not_fit(command, folder):
    other = shutil.copytree(folder, folder.parent / "17")
    (other / "other.npz").write_bytes(b"map")
    code, checks = verify(command, other)
    assert (code, checks["version"]["fits"], checks["charge map"]["fits"]) == (1, False, False)
    assert "expected version 17" in checks["version"]["message"]


def test_missing_model_is_wrong_input(refused):
    refused("verify", "./no-such-model", message="no-such-model: no model")
