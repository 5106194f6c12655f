"""Tests of calibration.json: round trips, and damaged files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import PressError
from isocharge.simulate import Circle, NoiseModel, load_sensor
from isocharge.train import CalibrationProblem, FilmEstimate
from isocharge.train.calibration.folder import film_table, json_text, read_film

PROBLEM = CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))


def random_film(seed):
    """An estimate with random values within the bounds, and a random covariance in which some unknowns are fixed."""
    rng = np.random.default_rng(seed)
    layout = PROBLEM.prior.layout
    values = rng.standard_normal(layout.coefficients.stop)
    low, high = layout.prior.bounds
    values[layout.film] = np.clip(values[layout.film], low, high)
    root = rng.standard_normal((len(values), rng.integers(1, 200))) * np.exp(
        2.0 * rng.standard_normal((len(values), 1))
    )
    root[rng.random(len(values)) < 0.1] = 0.0
    return FilmEstimate(layout, values, root @ root.T, NoiseModel("presses", 1.0, rng.uniform(0.001, 0.1)))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_written_films_are_read_again(tmp_path_factory, seed):
    path = tmp_path_factory.getbasetemp() / "calibration.json"
    film = random_film(seed)
    path.write_text(json_text(film_table(PROBLEM, film)))
    read = read_film(path, PROBLEM)
    np.testing.assert_array_equal(read.values, film.values)
    largest = film.covariance.max()
    np.testing.assert_allclose(read.covariance, film.covariance, rtol=0.0, atol=1e-4 * largest)
    assert read.noise == film.noise
    assert np.linalg.eigvalsh(read.covariance)[0] > -1e-9 * largest


REMOVED = None
"""Value of an entry that is missing."""

FAULTS = {
    "older": ("format_version", 5, "format_version: expected 6, got 5; .* calibrate again with its presses"),
    "no version": ("format_version", REMOVED, "key 'format_version' is missing; .* calibrate again with its presses"),
    "sensor": ("described_sensor.name", "mine", "expected the sensor file .*, got one with another name"),
    "probe": ("probe", "circle:2", "probe: expected circle:1"),
    "radius": ("radius_mm", 10.0, "radius_mm: expected 8"),
    "missing": ("unknowns.young", REMOVED, "unknowns: expected pretension, young, .*, got pretension"),
    "bounds": (
        "unknowns.pretension",
        {"value": -1.0, "std": 0.1},
        r"unknowns\.pretension\.value: expected 0 to",
    ),
    "negative": ("unknowns.young", {"value": 0.0, "std": -0.1}, r"unknowns\.young\.std: expected a number from 0"),
    "rows": ("correlations", [[], [0.1, 0.2]], "correlations: expected 151 rows of 0 to 150 numbers"),
    "large": ("correlations", [[1.0 - 2.0 * (i == 2)] * i for i in range(151)], "positive semidefinite"),
    "beyond": ("correlations", [[1.5] * i for i in range(151)], r"correlations\[1\]\[0\]: expected"),
}
"""Key of an entry, joined by dots, its changed value, and the message that names the fault."""


def test_sensor_file_of_the_earlier_calibration_is_required(tmp_path):
    """With the calibrated sensor of the same name, each change from the sensor file would count twice."""
    path = tmp_path / "calibration.json"
    film = random_film(1)
    path.write_text(json_text(film_table(PROBLEM, film)))
    sensor, _ = PROBLEM.prior.layout.prior.film(film.film_values)
    for other, words in ((sensor, "film, piezo, calibration"), (load_sensor("three-25um-biaxial"), "name, electrodes")):
        with pytest.raises(PressError, match=f"another {words}; give that file, not the calibrated"):
            read_film(path, replace(PROBLEM, sensor=other))


@pytest.mark.parametrize(("key", "value", "message"), FAULTS.values(), ids=FAULTS)
def test_damaged_files_are_refused_with_the_key(tmp_path, key, value, message):
    table = json.loads(json_text(film_table(PROBLEM, PROBLEM.film_before)))
    *parents, last = key.split(".")
    entries = table[parents[0]] if parents else table
    entries[last] = value
    if value is REMOVED:
        del entries[last]
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(table))
    with pytest.raises(PressError, match=f"calibration.json: .*{message}"):
        read_film(path, PROBLEM)
