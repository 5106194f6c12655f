"""The scripts of the gallery run, and their results agree with their texts.

`make docs` runs all scripts of the gallery and draws their pictures.
"""

import re
import runpy
import sys
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from isocharge.simulate import ForwardMap
from kept import ROOT, kept
from processes import finished


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


TYPED_PROGRAM = ROOT / "serve/examples/typed_program.py"
CHECKERS = {"mypy": ["mypy", "--strict"], "pyright": ["pyright", "--pythonpath", sys.executable]}


def test_the_program_with_types_counts_the_touches_and_reads_a_file(tmp_path):
    (tmp_path / "frames.txt").write_text("0,0,0\n" * 400 + "942.9,910.4,690.8\n" * 100 + "0,0,0\n" * 200)
    for words, touches in (([], ["0.50", "1.00"]), ([tmp_path / "frames.txt"], ["1.00"])):
        done = finished([sys.executable, TYPED_PROGRAM, *words])
        assert re.findall(r"at most (\S+) N", done.stdout) == touches


@pytest.mark.slow
@pytest.mark.parametrize("checker", CHECKERS)
def test_type_checkers_accept_the_program_with_types_and_find_a_misspelt_field(checker, tmp_path):
    program, *options = CHECKERS[checker]
    misspelt = tmp_path / "misspelt.py"
    misspelt.write_text("# pyright: strict\n" + TYPED_PROGRAM.read_text("utf-8").replace("touch.frames", "touch.frame"))
    correct = tmp_path / "correct.py"
    correct.write_text("# pyright: strict\n" + TYPED_PROGRAM.read_text("utf-8"))
    for path, code in ((correct, 0), (misspelt, 1)):
        words = [Path(sys.executable).with_name(program), *options, path]
        done = finished(words)
        assert done.returncode == code, done.stdout
