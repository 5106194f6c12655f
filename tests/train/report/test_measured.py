"""Tests of a report on measured presses, which are tested on held-out presses and never on simulated ones."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.measured import measured_presses

from isocharge.common.errors import ModelError, PressError
from isocharge.serve import Predictor, check_presses, find_model
from isocharge.simulate import (
    Circle,
    Domain,
    ForwardMap,
    load_sensor,
    noise_model,
    virtual_film,
)
from isocharge.train.data.presses import dataset_of, draw_contacts, position_ranks
from isocharge.train.report import QUICK, write_report

NAME = "three-25um-biaxial"
PROBE = Circle(1.0)
PRESS_COUNT = 300


@pytest.fixture(scope="module")
def presses():
    """Presses on a film that differs from the sensor file so much that the released model errs by tenths of a mm."""
    forward_map = ForwardMap.build(*virtual_film(load_sensor(NAME), PROBE, 4), 8.1, (0.05, 2.0))
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
    assert "expected at least 448 presses" in section["left_out"][0]  # too few for least squares
    assert released["position_rms_mm"] == pytest.approx(position_rms_mm, rel=1e-3)
    assert released["force_rms_percent"] == pytest.approx(force_rms_percent, rel=1e-3)
    assert released["position_median_mm"] > 0.3  # it is 0.07 mm on simulated presses of the described film


@pytest.fixture
def uniform_presses():
    """Presses with the same charge on all electrodes."""
    contact = draw_contacts(np.random.default_rng(6), Domain(7.8, (0.06, 1.9)), PRESS_COUNT)
    return measured_presses(contact, np.full((PRESS_COUNT, 3), 500.0))


def test_too_few_presses_within_the_forces_of_the_model_are_refused(uniform_presses, tmp_path):
    contact = uniform_presses.contact.copy()
    contact[:260] = [1.0, 1.0, 30.0]
    dataset = dataset_of(replace(uniform_presses, contact=contact), load_sensor(NAME), PROBE)
    with pytest.raises(PressError, match=r"at least 50 presses .* got 40 of 300"):
        write_report(tmp_path / "out", [(dataset, find_model(NAME))], QUICK)
    assert not list(tmp_path.iterdir())


def test_model_with_other_electrodes_is_refused(uniform_presses, tmp_path):
    dataset = dataset_of(uniform_presses, load_sensor(NAME), PROBE)
    with pytest.raises(ModelError, match="with the electrodes A, B, C, got a model with another"):
        write_report(tmp_path / "out", [(dataset, find_model("four-25um-biaxial"))], QUICK)
    assert not list(tmp_path.iterdir())
