"""Test of `train distil`: the student of a released model is served like other models."""

import json

import pytest

from isocharge.cli.train import distil
from isocharge.simulate import Circle, ForwardMap, Sweep, load_sensor, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from kept import kept

QUICK_CONFIG = """
[network]
hidden = [16, 16]
misfit_hidden = [8, 8]
weights = "int8"

[training]
steps = 300
misfit_steps = 20
misfit_charges = 1000
batch = 256
"""


@pytest.mark.slow
def test_student_of_a_released_model_is_trained_and_served(command, tmp_path, monkeypatch):
    """The presses within the range of the model are reduced to 3,000, on a film that is solved once for all tests."""
    requested_sweeps = []

    def simulate_few_presses(sensor, probes, radius, force_range):
        requested_sweeps.append((sensor.name, probes, round(radius, 2), force_range))
        film = kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0))
        return read_dataset(write_sweep(tmp_path / "presses", (film,), Sweep(samples=3_000)))

    monkeypatch.setattr(distil, "simulated_presses", simulate_few_presses)
    config = tmp_path / "quick.toml"
    config.write_text(QUICK_CONFIG)
    student = tmp_path / "small"
    _, out, _ = command("train", "distil", "three-25um-biaxial", "-o", student, "--config", config, "--json")
    assert requested_sweeps == [("three-25um-biaxial", (Circle(1.0),), 8.0, (0.05, 2.0))]
    assert json.loads(out)["errors"]["position_median_mm"] < 1.0

    charges = tmp_path / "charges.csv"
    charges.write_text("A,B,C\n800,810,790\n")
    _, out, _ = command("serve", "predict", student, charges, "--json")
    assert json.loads(out)["model"] == "small/1"
