"""`isocharge verify`: damaged, mixed and renamed model folders are refused."""

import json
import shutil

import pytest

from isocharge.serve import write_model
from model_files import golden_fault


@pytest.fixture
def folder(film, tmp_path):
    """The version folder of a model that has a charge map."""
    metadata = film.metadata()
    graph = film.onnx(metadata.to_props())
    files = {"charges.npz": b"charge map"}
    return write_model(tmp_path / "models" / metadata.name, graph, metadata, film.golden_pC(), "card", files)


def test_unchanged_folder_is_described(command, folder):
    code, out, _ = command("verify", folder, "--json")
    facts = json.loads(out)
    assert (code, facts["model"], list(facts["sha256"])) == (0, "linear/1", ["model.onnx", "charges.npz"])
    assert "charges.npz" in command("verify", folder)[1]


def flip_a_byte(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def move_by_2e_5(golden):
    """Change the x of one press by 2e-5 of its size, or of 1 mm."""
    contact = golden["outputs"]["contact"][3]
    contact[0] += 2e-5 * max(1.0, abs(contact[0]))


FAULTS = (
    (lambda folder: flip_a_byte(folder / "model.onnx"), "model.onnx: expected sha256"),
    (golden_fault(move_by_2e_5), "contact[3, 0]: expected"),
    (golden_fault(lambda golden: golden["tolerance"]["floor"]["contact"].pop()), "and 3 floors, got an array of shape"),
    (golden_fault(lambda golden: golden["outputs"]["misfit"].pop()), "misfit: expected"),
    (golden_fault(lambda golden: golden["outputs"].pop("misfit")), "'misfit'; the file is damaged"),
    (lambda folder: flip_a_byte(folder / "charges.npz"), "charges.npz: expected sha256"),
    (lambda folder: (folder / "other.npz").write_bytes(b"map") and None, "other.npz: expected sha256 no such file"),
    (
        lambda folder: shutil.copytree(folder, folder.parent / "17"),
        "17: expected linear/17, as the folders are called, got linear/1",
    ),
    (
        lambda folder: shutil.copytree(folder, folder.parents[1] / "renamed/1"),
        "expected renamed/1, as the folders are called",
    ),
)


@pytest.mark.parametrize(("fault", "message"), FAULTS)
def test_a_changed_folder_is_refused(refused, folder, fault, message):
    """Of the commands, also those that only use a model make these checks when they start."""
    changed = fault(folder) or folder
    for words in (["verify", changed], ["serve", "predict", changed, "-"], ["serve", "stream", changed, "--port", "-"]):
        refused(*words, message=message)


def test_missing_model_is_wrong_input(refused):
    refused("verify", "./no-such-model", message="no-such-model: no model")
