"""What the pages of simulate and the docstring of the package show is true: measured tables, files, names."""

import re
import tomllib
from pathlib import Path
from textwrap import dedent

import numpy as np

import isocharge.simulate
from isocharge.simulate import (
    built_in_sensors,
    load_amplifier,
    noise_model,
    press,
    sensor_from_dict,
    touch_charge,
)
from isocharge.simulate.dataset.card import COLUMNS

DOCS = Path(__file__).parents[2] / "simulate" / "docs"
ACCURACY, DATASETS, FILES = ((DOCS / f"{name}.md").read_text("utf-8") for name in ("accuracy", "datasets", "files"))
TABLES = re.findall(r"```toml\n(.*?)```", FILES, re.DOTALL)


def test_example_of_the_package():
    """The docstring's five lines give three charges of some hundred pC."""
    lines = dedent(isocharge.simulate.__doc__.split("press.\n\n", 1)[1])
    scope = {}
    exec(compile(lines, "isocharge.simulate", "exec"), scope)
    assert scope["charge"].shape == (3,)
    assert np.all((scope["charge"] > 500e-12) & (scope["charge"] < 1600e-12))


def test_everything_public_exists():
    for name in isocharge.simulate.__all__:
        assert hasattr(isocharge.simulate, name)


def errors(case) -> tuple[float, float]:
    """Of a press's charges, over the largest, and of its deflection."""
    solved = press(case.film, case.probe, case.at, case.force)
    charges = [
        np.abs(touch_charge(case.sensor(k), solved) - q).max() / np.abs(q).max() for k, q in case.charges.items()
    ]
    return max(charges), float(abs(solved.deflection([case.at])[0] / case.deflection - 1.0))


def test_accuracy_table(reference_cases, further_cases):
    """Every figure is what the solver gives now, to a digit: figures this small differ between libraries."""
    sources = {"collocation, dolfinx": reference_cases, "scikit-fem": further_cases}
    rows = re.findall(r"^\| (.+) \| (\d+) um \| (\d+) \| ([\d.]+) % \| ([\d.]+) % \|$", ACCURACY, re.MULTILINE)
    assert len(rows) == 8
    for source, thickness, count, *shown in rows:
        cases = sources[source](float(thickness))
        assert len(cases) == int(count)
        np.testing.assert_allclose(
            np.max([errors(case) for case in cases], axis=0), 0.01 * np.array(shown, dtype=float), atol=2e-5
        )


def test_sensor_file_can_be_read():
    (text,) = (block for block in TABLES if "[film]" in block)
    sensor = sensor_from_dict(tomllib.loads(text))
    assert sensor.electrode_names == ("A", "B")
    assert sensor.calibration.gain == {"A": 1.02}
    keys = {"name", "readout", "surface", "radius_mm", "pretension_MPa", "d33", "pyro_uC_per_m2_K", "rotation_deg"}
    assert keys <= set(re.findall(r"^(\w+) =", text, re.MULTILINE))


def test_names_are_complete():
    for name in built_in_sensors():
        assert f"`{name}`" in FILES
    for column in COLUMNS:
        assert f"`{column}`" in DATASETS


def test_noise_file_can_be_read(tmp_path):
    (text,) = (block for block in TABLES if "white_pC" in block)
    (tmp_path / "mine.toml").write_text(text)
    assert noise_model(str(tmp_path / "mine.toml")).gain == 0.001
    assert load_amplifier(str(tmp_path / "mine.toml")).tau == 5.0
