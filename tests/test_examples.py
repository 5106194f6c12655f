"""The examples run as a reader would run them, and find what they should."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(script, *arguments, timeout=280):
    words = [sys.executable, ROOT / script, *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def numbers(line):
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", line)]


def test_a_thicker_and_a_tauter_film_give_less_charge():
    rows = [numbers(line) for line in run("simulate/examples/parameter_study.py").splitlines()[1:]]
    assert [row[2] for row in rows] == sorted((row[2] for row in rows), reverse=True)


def test_a_layout_s_limit_is_largest_at_its_rim():
    *line, area = run("simulate/examples/layout_limits.py").splitlines()
    errors = [numbers(row)[2] for row in line]
    assert errors[-1] == max(errors)
    assert 0.02 < errors[0] < 0.1  # the Cramer-Rao limit of such layouts, four electrodes at 1 N
    assert "up to 8 mm" in area


@pytest.mark.slow  # tests of executors compare the same in every run
def test_any_executor_gives_the_same_dataset(tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        said = run("simulate/examples/sweep_on_executors.py", tmp_path, cluster.scheduler_address)
    assert "the same charges: True" in said


@pytest.mark.slow
def test_a_network_is_fitted_inspected_and_released(tmp_path):
    (tmp_path / "quick.toml").write_text("[training]\nsteps = 400\nmisfit_steps = 100\nmisfit_charges = 2000\n")
    said = run("train/examples/fit_inspect_release.py", tmp_path, tmp_path / "quick.toml")
    x, y, force = numbers(said.splitlines()[-1].partition("estimated")[2])
    assert (x, y, force) == pytest.approx((3.0, -2.0, 1.0), abs=0.5)
    assert (tmp_path / "models/mine/1/model.onnx").is_file()


def test_a_film_is_calibrated(tmp_path):
    said = run("train/examples/calibrate.py", tmp_path / "film")
    assert "left by not knowing the film" in said
    assert (tmp_path / "film/sensor.toml").is_file()


@pytest.mark.slow
def test_a_control_loop_follows_touches(start_command, tmp_path):
    port = tmp_path / "film"
    start_command("serve", "virtual", "three-25um-biaxial", "--link", port, "--seconds", "60")
    said = run("serve/examples/control_loop.py", port, "three-25um-biaxial", 5)
    assert numbers(said.splitlines()[-1])[0] >= 1
