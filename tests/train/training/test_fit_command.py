"""The command `train fit`: imports, and a release that is refused."""

import re
import sys
import tempfile
from pathlib import Path

import pytest

from isocharge.cli.train import fit as fit_command
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
from isocharge.simulate.identifiability import working_area
from isocharge.train.training import contact_training
working_area.RADIUS_STEP = contact_training.LOSS_TOLERANCE = 1.0  # to save time
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


OBSTACLES = {"m": "a file", "m/config.pbtxt": "a model of another sensor", "m/1": "the same version"}


@pytest.mark.parametrize("obstacle", OBSTACLES, ids=OBSTACLES.values())
def test_a_training_whose_release_is_refused_costs_no_model(
    obstacle, dataset_folder, fitted, tmp_path, command, monkeypatch
):
    def train_slowly(*_):
        path = tmp_path / obstacle
        path.parent.mkdir(exist_ok=True)
        path.write_text("written by another process")
        return fitted

    monkeypatch.setattr(fit_command, "fit", train_slowly)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    code, _, err = command("train", "fit", dataset_folder, "-o", tmp_path / "m")
    assert code != 0
    kept_folder = Path(re.search(r"The trained model is kept in (\S+)", err)[1])
    assert kept_folder.parts[-2:] == ("m", "1")
    assert load_model(kept_folder).metadata.name == "m"
    assert (tmp_path / obstacle).read_text() == "written by another process"


def test_a_folder_that_cannot_be_written_is_refused_before_the_training(dataset_folder, tmp_path, refused, monkeypatch):
    monkeypatch.setattr(fit_command, "fit", pytest.fail)
    (tmp_path / "models").write_text("a file")
    output = tmp_path / "models" / "m"
    refused("train", "fit", dataset_folder, "-o", output, message="models is not a writable folder", code=1)
