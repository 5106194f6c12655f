"""Files beside a model: those of another model, and those with numbers that nothing can be computed from."""

import json
import logging
import shutil

import numpy as np
import pytest

from attacks.companions import (
    direction_arrays,
    film_charge_arrays,
    pretension_arrays,
)
from isocharge.common.chebyshev_series import Series, position_degrees
from isocharge.common.errors import ModelError
from isocharge.common.files import sha256_of
from isocharge.serve import load_model, write_model
from isocharge.serve.model.companion_files import read_companion_file
from isocharge.serve.model.film_charges import FilmChargeSeries, read_film_charges
from isocharge.serve.model.film_directions import FilmDirections, read_film_directions
from isocharge.serve.model.pretensions import read_pretensions

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
    (folder / "pretensions.npz").write_bytes(b"content")
    with pytest.raises(ModelError, match=r"pretensions\.npz: expected sha256 no such file"):
        read_companion_file(folder, "pretensions.npz", ADVICE)


def test_file_of_a_model_without_checksums_is_read_with_a_warning(folder, caplog):
    golden = json.loads((folder / "golden.json").read_text("utf-8"))
    del golden["files"]
    (folder / "golden.json").write_text(json.dumps(golden), "utf-8")
    with caplog.at_level(logging.WARNING):
        assert read_companion_file(folder, "charges.npz", ADVICE) == b"content"
    assert "golden.json holds no checksum of this file" in caplog.text


def test_missing_file_is_named(folder):
    with pytest.raises(ModelError, match=r"films\.npz: cannot be read .*train again"):
        read_companion_file(folder, "films.npz", ADVICE)


def write_npz(folder, name, arrays):
    """Write arrays to a companion file; `golden.json` is removed, so that only the content is checked."""
    np.savez_compressed(folder / name, **{key: value for key, value in arrays.items() if value is not None})
    (folder / "golden.json").unlink(missing_ok=True)


def test_pretensions_are_read(tmp_path):
    write_npz(tmp_path, "pretensions.npz", pretension_arrays())
    assert read_pretensions(tmp_path).range_MPa == (0.2, 1.4)


def about(**changes):
    content = json.loads(str(pretension_arrays()["about"])) | changes
    return {"about": np.array(json.dumps(content))}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"w0": None}, "the array 'w0' is missing"),
        ({"w0": np.zeros((3, 5, 5))}, r"w0: expected an array of shape \(3, 4, n\)"),
        ({"b0": np.zeros((3, 6))}, r"b0: expected an array of shape \(3, 5\)"),
        ({"last": np.full((3, 5, 7), np.inf)}, "last: expected finite numbers"),
        ({"last": np.full((3, 5, 7), 1e200)}, "last: expected weights up to 1e.06"),
        ({"last": np.full((3, 5, 7), 1e5)}, "misfits that are not finite"),
        ({"node_MPa": np.array([0.2, 0.8, 1e9])}, "node_MPa: expected 2 to 50 rising pretensions up to 50 MPa"),
        ({"node_MPa": np.array([0.2, 0.8, 0.8])}, "rising pretensions"),
        ({"node_MPa": np.array([0.2, 0.8, 0.8 + 1e-9])}, "rising pretensions"),
        ({"node_MPa": np.array([0.2, 0.7, 1.4])}, "with 0.8 MPa among them"),
        ({"typical_pC": np.array([500.0, 400.0, 0.0, 200.0])}, "positive typical charges"),
        ({"typical_pC": np.array([500.0, 400.0, np.nan, 200.0])}, "expected finite numbers"),
        (about(limits_pC=[5.0, 5.0]), "rising limits"),
        (about(misfit_rms=0.0), "misfit_rms: expected a positive number"),
        (about(std_MPa=0.0), "std_MPa: expected a positive number"),
        (about(constants=["w0", "b0", "skip", "bias"]), "constants"),
        (about(constants=["w0", "b0", "w0", "b0", "skip", "bias", "last"]), "names that differ"),
        (about(format_version=2), "format 2 is not supported"),
        ({"about": np.array(5.0)}, "about: expected a text"),
    ],
)
def test_pretensions_that_nothing_can_be_computed_from_are_refused(tmp_path, change, reason):
    write_npz(tmp_path, "pretensions.npz", pretension_arrays() | change)
    with pytest.raises(ModelError, match=rf"pretensions\.npz: .*{reason}.*calibrate again"):
        read_pretensions(tmp_path)


def test_film_directions_are_read_as_they_were_written(tmp_path):
    arrays = direction_arrays()
    written = FilmDirections(arrays["series"], 8.0, (0.05, 2.0), arrays["by_pretension"])
    (tmp_path / "film_directions.npz").write_bytes(written.to_bytes())
    read = read_film_directions(tmp_path, 4)
    np.testing.assert_allclose(read.coefficients, written.coefficients, rtol=1e-6)
    np.testing.assert_array_equal(read.by_pretension, written.by_pretension)
    assert (read.radius_mm, read.force_N, read.count) == (8.0, (0.05, 2.0), 2)


def test_film_directions_of_an_earlier_version_with_another_array_are_read(tmp_path):
    write_npz(tmp_path, "film_directions.npz", direction_arrays() | {"log_charge": np.zeros((2, 2, 2, 4))})
    assert read_film_directions(tmp_path, 4).count == 2


def test_film_directions_change_the_charges_as_the_chebyshev_series_says(tmp_path):
    """The second direction of the small file is linear in x, and contacts beyond the radius are clipped to it."""
    write_npz(tmp_path, "film_directions.npz", direction_arrays())
    directions = read_film_directions(tmp_path, 4)
    log_changes = directions.log_changes(np.array([[4.0, 1.0, 0.3], [80.0, 0.0, 9.0]]))
    np.testing.assert_allclose(log_changes[:, 0], 0.01, rtol=1e-5)
    expected = np.array([0.02, -0.02, 0.01, 0.0])
    np.testing.assert_allclose(log_changes[0, 1], 0.5 * expected, rtol=1e-5)
    np.testing.assert_allclose(log_changes[1, 1], expected, rtol=1e-5)


def test_film_directions_of_degree_zero_change_all_charges_equally(tmp_path):
    series = np.full((1, 1, 1, 2, 4), 0.01)
    write_npz(tmp_path, "film_directions.npz", direction_arrays() | {"series": series})
    log_changes = read_film_directions(tmp_path, 4).log_changes(np.array([[4.0, 1.0, 0.3], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(log_changes, np.full((2, 2, 4), 0.01), rtol=1e-5)


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


def test_model_without_film_directions_has_none(tmp_path):
    directions = read_film_directions(tmp_path, 4)
    assert directions.count == 0
    assert directions.log_changes(np.array([[1.0, 2.0, 0.5]])).shape == (1, 0, 4)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"series": None}, "the array 'series' is missing"),
        ({"series": np.zeros((2, 2, 2, 2, 3))}, "expected an array of shape"),
        ({"series": np.zeros((2, 3, 2, 2, 4))}, "equal degrees in x and y"),
        ({"series": np.zeros((2, 2, 2, 50, 4)), "by_pretension": np.zeros(50)}, "up to 40 directions"),
        ({"series": np.zeros((40, 40, 2, 2, 4))}, "degrees up to 30"),
        ({"series": np.full((2, 2, 2, 2, 4), 1e3)}, "changes of ln Q up to 10"),
        ({"series": np.full((2, 2, 2, 2, 4), np.nan)}, "expected finite numbers"),
        ({"by_pretension": np.zeros(3)}, "expected an array of shape"),
        ({"by_pretension": np.full(2, 1e6)}, "changes up to 1000 per MPa"),
        ({"radius_mm": np.array(0.0)}, "expected a radius"),
        ({"force_N": np.array([1.0, 0.5])}, "got 1 and 0.5 N"),
    ],
)
def test_film_directions_that_describe_no_film_are_refused(tmp_path, change, reason):
    write_npz(tmp_path, "film_directions.npz", direction_arrays() | change)
    with pytest.raises(ModelError, match=rf"film_directions\.npz: .*{reason}.*calibrate again"):
        read_film_directions(tmp_path, 4)


def test_film_charges_are_read_as_they_were_written(tmp_path):
    arrays = film_charge_arrays()
    written = FilmChargeSeries(arrays["node_MPa"], arrays["series"], 8.0, (0.05, 2.0))
    (tmp_path / "film_charges.npz").write_bytes(written.to_bytes())
    read = read_film_charges(tmp_path, 4)
    assert read is not None
    np.testing.assert_allclose(read.coefficients, written.coefficients, rtol=1e-6)
    np.testing.assert_array_equal(read.node_MPa, written.node_MPa)
    assert (read.radius_mm, read.force_N) == (8.0, (0.05, 2.0))


def test_film_charges_are_those_of_the_chebyshev_series(tmp_path):
    """The logarithms of the charges in the small file are linear in x, y, the scaled ln F and the pretension."""
    write_npz(tmp_path, "film_charges.npz", film_charge_arrays())
    charges = read_film_charges(tmp_path, 4).interpolated(np.array([0.6, 1.5]))
    contact = np.array([[4.0, -2.0, 2.0], [0.0, 0.0, np.sqrt(0.05 * 2.0)]])
    unit_contact = np.broadcast_to(charges.unit_contact(contact), (2, 2, 3))
    charge_pC, slopes_pC = charges.charges(unit_contact)
    expected_log_charge = np.log(200.0) + np.array([0.05, -0.025, -0.05, 0.025]) + 0.7
    falls = np.array([0.5, 0.4, 0.5, 0.4])
    np.testing.assert_allclose(np.log(charge_pC[0, 0]), expected_log_charge - 0.6 * falls, rtol=1e-5)
    np.testing.assert_allclose(np.log(charge_pC[1, 1]), np.log(200.0) - 1.5 * falls, rtol=1e-5)
    np.testing.assert_allclose(slopes_pC[1, 0, :, 0], charge_pC[1, 0] * [0.1, 0.0, -0.1, 0.0], rtol=1e-5, atol=1e-9)


def test_model_of_an_earlier_version_has_no_film_charges(tmp_path):
    assert read_film_charges(tmp_path, 4) is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"series": None}, "the array 'series' is missing"),
        ({"series": np.zeros((2, 2, 2, 2, 4))}, "expected an array of shape"),
        ({"series": np.zeros((3, 2, 3, 2, 4))}, "equal degrees in x and y"),
        ({"series": np.zeros((3, 40, 40, 2, 4))}, "degrees up to 30"),
        ({"series": np.full((3, 2, 2, 2, 4), 1e3)}, "values of ln Q up to 100"),
        ({"series": np.full((3, 2, 2, 2, 4), np.nan)}, "expected finite numbers"),
        ({"node_MPa": np.array([0.5, 0.5, 2.0])}, "rising pretensions"),
        ({"node_MPa": np.array([0.5, 1.0, 1e9])}, "rising pretensions up to 50 MPa"),
        ({"radius_mm": np.array(0.0)}, "expected a radius"),
        ({"force_N": np.array([1.0, 0.5])}, "got 1 and 0.5 N"),
    ],
)
def test_film_charges_that_describe_no_film_are_refused(tmp_path, change, reason):
    write_npz(tmp_path, "film_charges.npz", film_charge_arrays() | change)
    with pytest.raises(ModelError, match=rf"film_charges\.npz: .*{reason}.*calibrate again"):
        read_film_charges(tmp_path, 4)


def test_released_models_hold_the_checksums_of_their_files(pytestconfig):
    folders = sorted((pytestconfig.rootpath / "models").glob("*/[0-9]*"))
    assert len(folders) >= 10
    for folder in folders:
        checksums = {path.name: sha256_of(path.read_bytes()) for path in folder.glob("*.npz")}
        assert load_model(folder).golden.companion_sha256 == checksums


def test_copied_model_still_reads_its_file(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "copied" / "1")
    assert read_companion_file(copied, "charges.npz", ADVICE) == b"content"
