"""The command `train fit` with a dataset: what it imports, and how it warns of presses without forces."""

import json
import shutil
import sys

import numpy as np
import pytest

from isocharge.cli.train import fit as fit_command
from isocharge.common.errors import PressError
from isocharge.serve import load_model
from processes import finished

SHORT_CONFIG = """
[network]
hidden = [8]
misfit_hidden = [8]
[training]
steps = 10
misfit_steps = 10
misfit_charges = 1000
"""


def test_a_training_on_a_dataset_needs_no_solver(dataset_folder, tmp_path):
    """The command runs in a new process, because other tests of this process have imported the solver."""
    (tmp_path / "short.toml").write_text(SHORT_CONFIG)
    code = """import sys
from isocharge.cli.main import main
try:
    main()
finally:
    unwanted = "isocharge.simulate.solver", "isocharge.simulate.mesh"
    print(sorted(name for name in sys.modules if name.startswith(unwanted)))
"""
    words = ("train", "fit", dataset_folder, "--config", "short.toml", "-o", "models/m")
    done = finished([sys.executable, "-c", code, *words], cwd=tmp_path)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "caution: PVDF yields beyond 0.86" in done.stderr
    version_folder = tmp_path / "models" / "m" / "1"
    metadata = load_model(version_folder).metadata
    assert metadata.yield_force_N == pytest.approx(0.866, abs=0.01)
    assert metadata.unnoticed.to_mm == pytest.approx(42.8, abs=0.01)


def test_a_measured_dataset_is_trained_as_presses_alone(dataset_folder, dataset, tmp_path, command, monkeypatch):
    """A measured dataset has no settings of a simulator."""
    shutil.copytree(dataset_folder, tmp_path / "measured")
    manifest = tmp_path / "measured" / "manifest.json"
    table = json.loads(manifest.read_text())
    del table["solver"]
    manifest.write_text(json.dumps(table))
    given = []

    def refuse(presses, sensor_name, _, *, probes):
        given.extend((presses, sensor_name, probes))
        raise PressError("no training in this test")

    monkeypatch.setattr(fit_command, "fit_presses", refuse)
    _, _, err = command("train", "fit", tmp_path / "measured", "-o", tmp_path / "model")
    assert "no training in this test" in err
    presses, sensor_name, probes = given
    np.testing.assert_array_equal(presses.charge_pC, dataset.samples.charge_pC)
    assert presses.electrodes == ("A", "B", "C")
    assert sensor_name == dataset.sensor.name
    assert probes == ("circle:1.0",)

    (tmp_path / "c.toml").write_text("[training]\nhold_out = 0.3\n")
    words = ("train", "fit", tmp_path / "measured", "--config", tmp_path / "c.toml", "-o", tmp_path / "model")
    assert "training.hold_out has no effect on measured presses" in command(*words)[2]


def test_each_caution_about_a_file_of_presses_is_printed_once(tmp_path, command):
    (tmp_path / "short.toml").write_text(SHORT_CONFIG)
    rng = np.random.default_rng(0)
    position = rng.uniform(-8.0, 8.0, (500, 2))
    charge = 100.0 * np.exp(position @ [[0.1, -0.1, 0.0], [0.0, 0.1, -0.1]]) + rng.standard_normal((500, 3))
    table = np.column_stack([position, charge])
    np.savetxt(tmp_path / "presses.csv", table, delimiter=",", header="x_mm,y_mm,p,q,r", comments="")
    words = (tmp_path / "presses.csv", "--config", tmp_path / "short.toml", "-o", tmp_path / "model")
    code, _, err = command("train", "fit", *words)
    assert code == 0, err
    assert "no press has a known force" in err
    assert err.count("caution: ") == 1
