"""The file beside a model: its checksum, and the series that it contains."""

import json

import pytest

from isocharge.common.errors import ModelError
from isocharge.common.files import sha256_of
from isocharge.serve import load_model, write_model
from isocharge.serve.model.golden import read_companion_file

ADVICE = "train again"


@pytest.fixture
def folder(film, tmp_path):
    """The version folder of a model that was written with a companion file."""
    metadata = film.metadata()
    graph = film.onnx(metadata.to_props())
    return write_model(
        tmp_path / "models" / metadata.name, graph, metadata, film.golden_pC(), "card", {"charges.npz": b"content"}
    )


def test_file_that_was_written_with_the_model_is_read(folder):
    assert read_companion_file(folder, "charges.npz", ADVICE) == b"content"
    assert load_model(folder).golden.companion_sha256 == {"charges.npz": sha256_of(b"content")}


def test_file_of_another_model_is_refused(folder):
    (folder / "charges.npz").write_bytes(b"content of another model")
    with pytest.raises(ModelError, match=r"charges\.npz: expected sha256 .* belongs to another model.*train again"):
        read_companion_file(folder, "charges.npz", ADVICE)


def test_model_without_checksums_of_companion_files_is_refused(folder):
    golden = json.loads((folder / "golden.json").read_text("utf-8"))
    del golden["files"]
    (folder / "golden.json").write_text(json.dumps(golden), "utf-8")
    with pytest.raises(ModelError, match=r"golden\.json: key 'files' is missing.*copy or export the model again"):
        read_companion_file(folder, "charges.npz", ADVICE)


def test_missing_file_is_named(folder):
    with pytest.raises(ModelError, match=r"other\.npz: cannot be read .*train again"):
        read_companion_file(folder, "other.npz", ADVICE)
