"""Measured presses are judged as they are: by held-out presses of the film, never by simulated ones."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import ModelError, PressError
from isocharge.serve import MeasuredPresses, Predictor, check_presses, find_model
from isocharge.simulate import (
    Circle,
    Domain,
    ForwardMap,
    load_sensor,
    noise_model,
    virtual_film,
)
from isocharge.train.data.presses import dataset_of, draw_contacts, held_out
from isocharge.train.report import QUICK, write_report

NAME, PROBE = "three-25um-biaxial", Circle(1.0)

slow = pytest.mark.slow  # it measures every method; `serve check` on measured presses is tested in every run


@pytest.fixture(scope="module")
def presses():
    """On a film that is not the described one, by far: a released model errs on it by tenths of a millimetre."""
    forward_map = ForwardMap.build(*virtual_film(load_sensor(NAME), PROBE, 4), 8.1, (0.05, 2.0))
    rng = np.random.default_rng(6)
    contact = draw_contacts(rng, Domain(7.8, (0.06, 1.9)), 300)
    charge = noise_model("reference").add(forward_map.charges(contact), rng)
    stds = np.full(300, 0.05), np.full(300, 0.005)
    return MeasuredPresses(contact, charge, *stds, ("A", "B", "C"), tuple(range(2, 302)))


@pytest.fixture(scope="module")
def section(presses, tmp_path_factory):
    out = tmp_path_factory.mktemp("report") / "out"
    record = write_report(out, [(dataset_of(presses, load_sensor(NAME), PROBE), find_model(NAME))], QUICK)
    return record["datasets"][0], (out / "report.md").read_text("utf-8")


@slow
def test_the_figures_are_those_of_serve_check_on_the_held_out_presses(section, presses):
    record, _ = section
    held = presses[held_out(presses.contact)]
    check = check_presses(Predictor(find_model(NAME)), held)
    errors = check.errors.error
    released = record["methods"][0]["errors"]
    assert record["presses"]["test"] == len(held)
    rms_mm = np.sqrt(np.mean(check.errors.position_error_mm**2))
    assert released["position_rms_mm"] == pytest.approx(rms_mm, rel=1e-3)
    assert released["force_rms_percent"] == pytest.approx(100.0 * np.sqrt(np.mean(errors[:, 2] ** 2)), rel=1e-3)
    assert released["position_median_mm"] > 0.3  # 0.07 mm by the simulator of the described film


def test_too_few_presses_and_another_layout(tmp_path):
    contact, stds = draw_contacts(np.random.default_rng(6), Domain(7.8, (0.06, 1.9)), 300), [np.full(300, 0.01)] * 2
    presses = MeasuredPresses(contact, np.full((300, 3), 500.0), *stds, ("A", "B", "C"), tuple(range(2, 302)))
    strong = replace(presses, contact=np.where(np.arange(300)[:, None] < 260, [1.0, 1.0, 30.0], contact))
    sensor = load_sensor(NAME)
    with pytest.raises(PressError, match=r"at least 50 presses .* got 40 of 300"):
        write_report(tmp_path / "out", [(dataset_of(strong, sensor, PROBE), find_model(NAME))], QUICK)
    with pytest.raises(ModelError, match=r"expected the electrodes \('A', 'B', 'C'\) of the presses"):
        write_report(tmp_path / "out", [(dataset_of(presses, sensor, PROBE), find_model("four-25um-biaxial"))], QUICK)
    assert not list(tmp_path.iterdir())
