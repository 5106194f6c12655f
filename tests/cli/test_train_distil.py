"""`train distil`: a released model to a student that serves, and what it refuses."""

import json

import pytest

from isocharge.cli.train import distil
from isocharge.simulate import Circle, ForwardMap, Sweep, load_sensor, read_dataset
from isocharge.simulate.dataset.sweep import write_sweep
from kept import kept

QUICK = """
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
def test_a_student_serves(command, tmp_path, monkeypatch):
    """Of presses as MODEL knows them; 3,000 here, on a film that is solved once for all tests."""
    asked = []

    def few(sensor, probes, radius, force_range):
        asked.append((sensor.name, probes, round(radius, 2), force_range))
        film = kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0))
        return read_dataset(write_sweep(tmp_path / "presses", (film,), Sweep(samples=3_000)))

    monkeypatch.setattr(distil, "simulated_presses", few)
    (tmp_path / "quick.toml").write_text(QUICK)
    folder, settings = tmp_path / "small", str(tmp_path / "quick.toml")
    _, out, _ = command("train", "distil", "three-25um-biaxial", "-o", str(folder), "--config", settings, "--json")
    assert asked == [("three-25um-biaxial", (Circle(1.0),), 8.0, (0.05, 2.0))]
    assert json.loads(out)["errors"]["position_median_mm"] < 1.0
    (tmp_path / "charges.csv").write_text("A,B,C\n800,810,790\n")
    _, out, _ = command("serve", "predict", str(folder), str(tmp_path / "charges.csv"), "--json")
    assert json.loads(out)["model"] == "small/1"
