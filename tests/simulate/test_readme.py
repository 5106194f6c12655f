"""What simulate/README.md and the docstring of the package show is true: examples, measured tables, list of files."""

import re
import tomllib
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

import isocharge.simulate
from isocharge.simulate import STANDARD, built_in_sensors, press, sensor_from_dict, touch_charge
from isocharge.simulate.dataset import COLUMNS
from isocharge.simulate.template import template

SIMULATE = Path(__file__).parents[2] / "simulate"
README = (SIMULATE / "README.md").read_text("utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=["one press", "many presses", "a dataset"])
def test_example_runs(example, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "simulate/README.md", "exec"), {})
    assert capsys.readouterr().out


def test_example_of_the_package():
    """The docstring's five lines give three charges of some hundred pC."""
    lines = isocharge.simulate.__doc__.split("\n\n", 1)[1]
    scope = {}
    exec(compile(lines, "isocharge.simulate", "exec"), scope)
    assert scope["charge"].shape == (3,)
    assert np.all((scope["charge"] > 500e-12) & (scope["charge"] < 1600e-12))


def test_everything_public_exists():
    for name in isocharge.simulate.__all__:
        assert hasattr(isocharge.simulate, name)


def test_every_module_is_listed():
    modules = {path.name for path in (SIMULATE / "isocharge/simulate").glob("*.py")} - {"__init__.py"}
    assert modules == set(re.findall(r"^\| `(\w+\.py)`", README, re.MULTILINE))


def test_accuracy_table(reference_cases):
    """Every figure is what the solver gives now, to the last digit shown."""
    measured = defaultdict(lambda: [0.0, 0.0, 0.0])
    for case in reference_cases(25.0):
        solved = press(case.film, case.probe, case.at, case.force)
        charge = max(np.abs(touch_charge(case.sensor(k), solved) / q - 1.0).max() for k, q in case.charges.items())
        deflection = abs(solved.deflection([case.at])[0] / case.deflection - 1.0)
        row = measured[case.force]
        row[:] = np.maximum(row, [charge, deflection, solved.estimated_error])
    rows = re.findall(r"^\| ([\d.]+) N \| ([\d.]+) % \| ([\d.]+) % \| ([\d.]+) % \|$", README, re.MULTILINE)
    shown = {float(force): [0.01 * float(value) for value in values] for force, *values in rows}
    assert shown.keys() == measured.keys()
    for force, values in shown.items():
        np.testing.assert_allclose(measured[force], values, atol=0.6e-4)


def test_size_of_the_standard_mesh():
    mesh = template(STANDARD)
    assert f"({mesh.n_element} elements, {3 * mesh.n_free:,} unknowns)" in README
    assert f"**{STANDARD.order}, {STANDARD.around}, {STANDARD.rings}** (standard)" in README


def test_sensor_file_can_be_read():
    (text,) = re.findall(r"```toml\n(.*?)```", README, re.DOTALL)
    sensor = sensor_from_dict(tomllib.loads(text))
    assert sensor.electrode_names == ("A", "B")
    assert sensor.calibration.gain == {"A": 1.02}
    keys = {"name", "readout", "surface", "radius_mm", "pretension_MPa", "d33", "pyro_uC_per_m2_K", "rotation_deg"}
    assert keys <= set(re.findall(r"^(\w+) =", text, re.MULTILINE))


def test_names_are_complete():
    for name in built_in_sensors():
        assert f"`{name}`" in README
    for column in COLUMNS:
        assert f"`{column}`" in README
