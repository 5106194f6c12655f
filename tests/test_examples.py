"""The scripts of the gallery run, and their results agree with their texts.

`make docs` runs all scripts of the gallery and draws their pictures.
"""

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
    """Function that runs a script without a window and returns its stdout. The script must draw one picture."""
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
    """Return the numbers in a line of text."""
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", line)]


def test_the_nearest_electrode_has_the_largest_charge(run):
    charges = {line[0]: numbers(line)[0] for line in run("simulate/examples/press.py").splitlines()}
    assert charges["A"] > charges["B"] > charges["C"] > 600.0  # A is the nearest electrode, and C the farthest


def test_the_charge_decreases_with_thickness_and_pretension(run):
    rows = np.array([numbers(line) for line in run("simulate/examples/thickness.py").splitlines()[1:]])
    charge = rows[:, 2].reshape(3, 5)
    assert (np.diff(charge, axis=0) < 0.0).all()
    assert (np.diff(charge, axis=1) < 0.0).all()


@pytest.mark.slow
def test_effects_of_the_bench_agree_with_an_independent_linear_inverse(run):
    """The position errors by a closed cavity and by a warmer film are those of another solver."""
    lines = run("simulate/examples/bench_effects.py").splitlines()
    cavity_errors = [float(re.search(r": ([\d.]+) mm", line)[1]) for line in lines if "cavity" in line]
    warming_errors = [float(re.search(r": ([\d.]+) mm", line)[1]) for line in lines if "warmer" in line]
    np.testing.assert_allclose(cavity_errors, [1.4, 3.2, 5.1], atol=0.06)
    np.testing.assert_allclose(warming_errors, [0.24, 1.7, 0.9], rtol=0.2)


def test_a_lamp_is_switched_by_each_hard_press(run, monkeypatch):
    monkeypatch.setattr(ForwardMap, "build", partial(kept, ForwardMap.build))
    lines = run("serve/examples/lamp.py").splitlines()
    assert [line.split()[0] for line in lines] == ["on", "off", "on"]
    assert min(numbers(line)[0] for line in lines) >= 0.5


def test_frames_of_an_unknown_format_are_read(run):
    assert "400 of 400 frames are read" in run("serve/examples/foreign_board.py")
