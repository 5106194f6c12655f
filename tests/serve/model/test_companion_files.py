"""The file beside a model: its checksum, and the series that it contains."""

import json

import numpy as np
import pytest

from isocharge.common.errors import ModelError
from isocharge.common.files import sha256_of
from isocharge.serve import load_model, write_model
from isocharge.serve.model.chebyshev_series import Series, position_degrees
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


def test_file_that_the_model_was_not_written_with_is_refused(folder):
    (folder / "other.npz").write_bytes(b"content")
    with pytest.raises(ModelError, match=r"other\.npz: expected sha256 no such file"):
        read_companion_file(folder, "other.npz", ADVICE)


def test_model_without_checksums_of_companion_files_is_refused(folder):
    golden = json.loads((folder / "golden.json").read_text("utf-8"))
    del golden["files"]
    (folder / "golden.json").write_text(json.dumps(golden), "utf-8")
    with pytest.raises(ModelError, match=r"golden\.json: key 'files' is missing.*copy or export the model again"):
        read_companion_file(folder, "charges.npz", ADVICE)


def test_missing_file_is_named(folder):
    with pytest.raises(ModelError, match=r"other\.npz: cannot be read .*train again"):
        read_companion_file(folder, "other.npz", ADVICE)


@pytest.mark.parametrize("shape", [(1, 1, 1, 2), (1, 1, 3, 2), (3, 3, 1, 2), (2, 2, 2, 2), (4, 4, 3, 2)])
def test_derivatives_of_a_chebyshev_series_are_its_finite_differences_also_for_degree_zero(shape):
    rng = np.random.default_rng(0)
    coefficients = np.zeros(shape)
    terms = position_degrees(shape[0] - 1)
    coefficients[terms] = rng.standard_normal(coefficients[terms].shape)
    series = Series(coefficients)
    coordinates = rng.uniform(-0.9, 0.9, (5, 3))
    derivatives = series.values_and_derivatives(coordinates)[:, 1:]
    step = 1e-5
    for axis in range(3):
        change = step * np.eye(3)[axis]
        values_above = series.values_and_derivatives(coordinates + change)[:, 0]
        values_below = series.values_and_derivatives(coordinates - change)[:, 0]
        expected = (values_above - values_below) / (2.0 * step)
        np.testing.assert_allclose(derivatives[:, axis], expected, atol=1e-8)
