"""The scripts of the gallery run, and find what they say; `make docs` runs all of them and draws their pictures."""

import re
import runpy
import sys
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
import pytest

from isocharge.simulate import ForwardMap
from kept import ROOT, kept


@pytest.fixture
def run(monkeypatch, capsys):
    """A function that runs a script without a window: what it printed. It draws one picture."""
    monkeypatch.setattr(plt, "show", lambda: None)

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [str(ROOT / script), *map(str, arguments)])
        plt.close("all")
        runpy.run_path(str(ROOT / script), run_name="__main__")
        assert len(plt.get_fignums()) == 1
        plt.close("all")
        return capsys.readouterr().out

    return run


def numbers(line):
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", line)]


def test_a_press_charges_the_nearest_electrode_most(run):
    charges = {line[0]: numbers(line)[0] for line in run("simulate/examples/press.py").splitlines()}
    assert charges["A"] > charges["B"] > charges["C"] > 600.0  # by distance


def test_a_thicker_and_a_tauter_film_give_less_charge(run):
    rows = np.array([numbers(line) for line in run("simulate/examples/thickness.py").splitlines()[1:]])
    by_thickness = rows[:, 2].reshape(3, 5)
    assert (np.diff(by_thickness, axis=0) < 0.0).all()
    assert (np.diff(by_thickness, axis=1) < 0.0).all()


@pytest.mark.slow  # tests/test_pages.py calibrates the same film by the command
def test_a_film_is_calibrated(run, tmp_path):
    said = run("train/examples/calibrate.py", tmp_path)
    released, calibrated = (numbers(line)[0] for line in said.splitlines()[-2:])
    assert calibrated < 0.1 * released
    assert (tmp_path / "film/sensor.toml").is_file()


def test_a_lamp_is_switched_by_each_hard_press(run, monkeypatch):
    monkeypatch.setattr(ForwardMap, "build", partial(kept, ForwardMap.build))
    lines = run("serve/examples/lamp.py").splitlines()
    assert [line.split()[0] for line in lines] == ["on", "off", "on", "off", "on"]
    assert min(numbers(line)[0] for line in lines) >= 0.5


def test_frames_that_nobody_described_are_read(run):
    assert "400 of 400 frames are read" in run("serve/examples/foreign_board.py")


@pytest.mark.slow  # tests of executors compare the same in every run
def test_any_executor_gives_the_same_dataset(tmp_path, monkeypatch, capsys):
    distributed = pytest.importorskip("distributed")
    script = ROOT / "simulate/examples/sweep_on_executors.py"
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path), cluster.scheduler_address])
        runpy.run_path(str(script), run_name="__main__")
    assert "the same charges: True" in capsys.readouterr().out
