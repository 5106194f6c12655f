"""Tests of a report on measured presses, which are tested on held-out presses and never on simulated ones."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from tests.train.measured import measured_presses

from isocharge.common.errors import PressError
from isocharge.serve import Predictor, check_presses, find_model, load_model
from isocharge.serve.presses.table_file import csv_text
from isocharge.simulate import Calibration, Circle, Domain, load_sensor, noise_model
from isocharge.train.data.presses import dataset_of, draw_contacts, position_ranks
from isocharge.train.report import QUICK, write_report
from isocharge.train.report.evaluation import split_presses

NAME = "three-25um-biaxial"
PROBE = Circle(1.0)
PRESS_COUNT = 300


@pytest.fixture(scope="module")
def presses(film):
    """Presses on a film whose electrodes are shifted so far that the released model errs by tenths of a mm."""
    shifted = replace(film.sensor, calibration=Calibration(shift=(0.5, -0.3)))
    forward_map = replace(film, sensor=shifted)
    rng = np.random.default_rng(6)
    contact = draw_contacts(rng, Domain(7.8, (0.06, 1.9)), PRESS_COUNT)
    charge = noise_model("reference").add(forward_map.charges(contact), rng)
    return measured_presses(contact, charge)


@pytest.fixture(scope="module")
def section(presses, tmp_path_factory):
    """The section of a quick report on the measured presses."""
    out = tmp_path_factory.mktemp("report") / "out"
    dataset = dataset_of(presses, load_sensor(NAME), PROBE)
    record = write_report(out, [(dataset, find_model(NAME))], QUICK)
    return record["datasets"][0]


@pytest.mark.slow  # the report runs every method; `serve check` on measured presses is tested in every run
def test_errors_equal_those_of_serve_check_on_the_held_out_presses(section, presses):
    held_out_presses = presses[position_ranks(presses.contact) < 0.2]
    check = check_presses(Predictor(find_model(NAME)), held_out_presses)
    position_rms_mm = np.sqrt(np.mean(check.errors.position_error_mm**2))
    force_rms_percent = 100.0 * np.sqrt(np.mean(check.errors.error[:, 2] ** 2))
    released = section["methods"][0]["errors"]
    assert section["test_presses"] == len(held_out_presses)
    assert section["limits"] == {}
    assert len(section["left_out"]) == 1
    assert "expected at least 448 presses" in section["left_out"][0]  # too few for least squares
    assert released["position_rms_mm"] == pytest.approx(position_rms_mm, rel=1e-3)
    assert released["force_rms_percent"] == pytest.approx(force_rms_percent, rel=1e-3)
    assert released["position_median_mm"] > 0.3  # it is 0.07 mm on simulated presses of the described film


def test_presses_of_the_calibrations_of_a_model_are_not_held_out(presses, tmp_path):
    model_folder = tmp_path / NAME / "1"
    shutil.copytree(find_model(NAME), model_folder)
    dataset = dataset_of(presses, load_sensor(NAME), PROBE)
    held_out = presses[position_ranks(presses.contact) < 0.2]

    (model_folder / "presses.csv").write_text(csv_text(held_out[np.arange(50)].columns))
    model = load_model(model_folder).metadata
    _, tested = split_presses(dataset, model_folder, model)
    np.testing.assert_array_equal(tested.charge, held_out.charge_pC[50:])

    earlier_version = tmp_path / NAME / "2"  # a calibration continues the earlier ones
    earlier_version.mkdir()
    (earlier_version / "presses.csv").write_text(csv_text(held_out.columns))
    with pytest.raises(PressError, match="measure more presses"):
        split_presses(dataset, model_folder, model)
