"""Shares of faulty presses with and without a flag, measured on new presses and compared with the pages."""

import re

import pytest

from isocharge.cli.shared.forward_maps import simulated_presses
from isocharge.serve import Predictor
from isocharge.simulate import Circle, load_sensor
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train import fit, release
from kept import ROOT, kept
from press_faults import fault_shares, film_map, whole_film_shares

PAGE = (ROOT / "serve/docs/unnoticed.md").read_text("utf-8")

PRESSES = 1500
SEED = 7

TOLERANCE = 4.0
"""Largest difference of a share from the page, percentage points: three standard deviations and rounding."""


def column(table_name, model):
    """Return the shares of a table's column, in %, by row: flagged, unnoticed, and on a whole film also mirrored."""
    lines = re.search(rf"^\| {table_name} \|.*?\n\n", PAGE, re.DOTALL | re.MULTILINE)[0].splitlines()
    header, _, *rows = [[cell.strip(" `") for cell in line.split("|")] for line in lines if line]
    position = header.index(model)
    shares = {}
    for row in rows:
        numbers = re.findall(r"[\d.]+", row[position])
        if numbers:
            shares[row[1]] = tuple(float(number) for number in numbers)
    return shares


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("model", ["three-25um-biaxial", "four-25um-biaxial", "four-25um-uniaxial"])
def test_shares_of_flagged_and_unnoticed_faults_are_those_of_the_page(model):
    results = fault_shares(model, kept(film_map), {}, PRESSES, SEED)
    page = column("fault", model)
    for fault, shares in results.items():
        # Only presses with large charges reach the amplifier's limit, and too few of them are drawn here.
        if not fault.startswith("clipped"):
            assert page[fault] == pytest.approx((shares.flagged, shares.unnoticed), abs=TOLERANCE), fault


@pytest.mark.slow
@pytest.mark.parametrize("model", ["three-25um-biaxial", "four-25um-biaxial-15mm"])
def test_shares_of_presses_on_the_whole_film_are_those_of_the_page(model):
    rings = whole_film_shares(model, 500, SEED, (15.0, 20.0, 40.0, 43.0))
    page = column("distance", model)
    for ring in ("inside the working area", "15 to 20 mm", "40 to 43 mm"):
        shares = rings[ring]
        expected = (shares.flagged, shares.unnoticed, shares.mirrored)
        assert page[ring] == pytest.approx(expected, abs=2.0 * TOLERANCE), ring
    assert rings["inside the working area"].flagged < 1.0


@pytest.mark.slow
def test_a_trained_model_with_an_electrode_in_the_centre_notices_presses_anywhere_on_the_film(tmp_path):
    """Without this electrode, most presses outside the working area are answered wrongly without a flag."""
    table = sensor_to_dict(load_sensor("four-25um-biaxial"))
    table["electrodes"]["E"] = [0.0, 0.0]
    sensor = sensor_from_dict(table | {"name": "five"})
    dataset = simulated_presses(sensor, [Circle(1.0)], 8.0)
    model = release(fit(dataset), tmp_path / "five")
    rings = whole_film_shares(str(model.folder), 500, SEED, (8.0, 15.0, 20.0, 30.0, 43.0))
    assert rings["inside the working area"].flagged < 1.0
    assert rings["whole film"].unnoticed < 1.0
    _, share_of_four, _ = column("distance", "four-25um-biaxial")["whole film"]
    assert share_of_four > 70.0


@pytest.mark.parametrize(
    "model", ["three-25um-biaxial", "four-25um-biaxial", "four-25um-uniaxial", "four-25um-biaxial-15mm"]
)
def test_models_state_the_share_of_unnoticed_presses_outside_the_working_area(model):
    unnoticed = Predictor(model).metadata.unnoticed
    _, share_on_page, _ = column("distance", model)["all outside the working area"]
    assert 100.0 * unnoticed.total_share == pytest.approx(share_on_page, abs=TOLERANCE)


def test_the_page_names_released_models_only():
    models = set(re.findall(r"`((?:three|four)-[\w-]+)`", PAGE))
    assert models
    for model in models:
        Predictor(model)
