"""A training that is stopped anywhere and goes on ends with the weights of one that was not."""

import json
import subprocess
import sys
import time
from dataclasses import replace

import onnx
import pytest
import torch

from isocharge.common.errors import OutputExists
from isocharge.common.resumable_run import resume_parts
from isocharge.simulate import Circle, Sweep, read_dataset, run_sweep
from isocharge.train import FitConfig, NetworkConfig, TrainingConfig, fit_network, train_model
from isocharge.train.training import checkpoint
from isocharge.train.training.checkpoint import Checkpoint

NOISY = FitConfig(
    NetworkConfig((12, 12), (10, 10)), TrainingConfig(steps=230, misfit_steps=210, misfit_charges=1_000, batch=64)
)
CLEAN = replace(NOISY, training=replace(NOISY.training, noise="clean", finish_steps=4))


@pytest.fixture(scope="module")
def dataset(sensor, tmp_path_factory):
    """Just enough to train on, as what is tested does not depend on it."""
    folder = tmp_path_factory.mktemp("small") / "presses"
    return read_dataset(run_sweep(folder, sensor, (Circle(1e-3),), Sweep(samples=900)))


class Killed(BaseException):
    """As sudden as a SIGKILL, but caught by the test."""


class Ticking:
    """A clock that makes every save a real one."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        self.now += 10.0
        return self.now


def stop_after(count):
    """Progress that ends the run at its count-th call."""
    left = [count]

    def progress(*_):
        left[0] -= 1
        if left[0] == 0:
            raise Killed

    return progress


def weights(fit):
    return torch.cat([parameter.flatten() for parameter in fit.network.parameters()])


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(("config", "calls"), [(NOISY, (1, 3)), (CLEAN, (1, 4, 7))], ids=["noisy", "clean"])
def test_a_stopped_run_ends_with_the_same_weights(dataset, tmp_path, config, calls):
    whole = weights(fit_network(dataset, config))
    for call in calls:
        target = tmp_path / f"after-{call}"
        with pytest.raises(Killed), resume_parts(target, {}) as draft:
            fit_network(dataset, config, stop_after(call), checkpoint=Checkpoint(draft, Ticking()))
        done = []
        with resume_parts(target, {}) as draft:
            again = fit_network(
                dataset, config, lambda step, *_, done=done: done.append(step), checkpoint=Checkpoint(draft)
            )
        assert torch.equal(weights(again), whole)
        assert call == 1 or min(done) > 200  # it did not begin anew
        assert not draft.folder.exists()


def test_states_are_written_every_few_seconds_only(tmp_path):
    now = [0.0]
    with resume_parts(tmp_path / "model", {}) as draft:
        keeper = Checkpoint(draft, lambda: now[0])
        made = []
        for second in range(10):
            now[0] = float(second)
            keeper.save("stage", lambda second=second: made.append(second) or {"step": second})
        assert made == [3, 6, 9]
        assert Checkpoint(draft).load("stage") == {"step": 9}
        assert keeper.load("another") is None


def test_a_damaged_state_is_told_of_and_made_again(tmp_path):
    said = []
    with resume_parts(tmp_path / "model", {}, warn=said.append) as draft:
        Checkpoint(draft).save("stage", lambda: {"step": 1}, now=True)
        (draft.folder / "parts" / "stage").write_bytes(b"torn")
        assert Checkpoint(draft).load("stage") is None
    assert "damaged" in said[0]


@pytest.fixture
def stopped(dataset, tmp_path, monkeypatch):
    """A model folder whose training was killed."""
    monkeypatch.setattr(checkpoint, "EVERY_S", 0.0)
    folder = tmp_path / "models" / "mine"
    with pytest.raises(Killed):
        train_model(dataset, folder, NOISY, progress=stop_after(2))
    assert [path.name for path in folder.iterdir()] == ["1.part"]
    return folder


def test_the_same_call_goes_on_and_nothing_is_left(dataset, stopped, tmp_path):
    release = train_model(dataset, stopped, NOISY)
    unbroken = train_model(dataset, tmp_path / "other" / "mine", NOISY)
    assert (release.folder / "model.onnx").read_bytes() == (unbroken.folder / "model.onnx").read_bytes()
    assert sorted(path.name for path in stopped.iterdir()) == ["1", "config.pbtxt"]


def test_a_state_of_other_settings_is_refused_and_kept_until_fresh(dataset, stopped):
    other = replace(NOISY, training=replace(NOISY.training, seed=5))
    with pytest.raises(OutputExists, match=r"other settings: config\.training\.seed is 0 there, 5 here.*--fresh"):
        train_model(dataset, stopped, other)
    assert (stopped / "1.part" / "parts" / "contact").is_file()
    assert train_model(dataset, stopped, other, fresh=True).folder == stopped / "1"
    assert not (stopped / "1.part").exists()


def test_a_state_of_another_dataset_is_refused(dataset, stopped):
    with pytest.raises(OutputExists, match="dataset_sha256 is"):
        train_model(replace(dataset, sha256="another"), stopped, NOISY)
    assert json.loads((stopped / "1.part" / "run.json").read_text())["dataset_sha256"] == dataset.sha256


@pytest.mark.slow
def test_a_killed_command_goes_on(sensor, tmp_path):
    """SIGKILL in the middle; the same command makes the same model as one that was left alone."""
    run_sweep(tmp_path / "presses", sensor, (Circle(1e-3),), Sweep(samples=3_000))
    (tmp_path / "config.toml").write_text("[training]\nsteps = 4000\nmisfit_steps = 300\nmisfit_charges = 2000\n")
    command = [sys.executable, "-m", "isocharge.cli", "train", "fit", "presses", "--config", "config.toml", "-o"]
    part = tmp_path / "broken" / "mine" / "1.part"
    with subprocess.Popen([*command, "broken/mine"], cwd=tmp_path, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120.0
        while not (part / "parts" / "contact.sha256").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        process.kill()
    assert part.is_dir()
    assert not (tmp_path / "broken" / "mine" / "1").exists()
    for folder in ("broken", "whole"):
        subprocess.run([*command, f"{folder}/mine"], cwd=tmp_path, check=True, capture_output=True, timeout=200)
    broken, whole = (onnx.load(tmp_path / name / "mine" / "1" / "model.onnx").graph for name in ("broken", "whole"))
    assert broken == whole
    assert not part.exists()
