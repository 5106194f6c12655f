"""The files and names on the pages of simulate and in the docstring of its package exist."""

import re
import tomllib
from textwrap import dedent

import numpy as np

import isocharge.simulate
from isocharge.simulate import load_amplifier, noise_model
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from kept import ROOT

DOCS = ROOT / "simulate/docs"
DATASETS, FILES = ((DOCS / f"{name}.md").read_text("utf-8") for name in ("datasets", "files"))
TABLES = re.findall(r"```toml\n(.*?)```", FILES, re.DOTALL)


def test_example_of_the_package():
    """The five lines of code in the docstring print three charges of several hundred pC."""
    lines = dedent(isocharge.simulate.__doc__.split("Example:\n\n", 1)[1])
    scope = {}
    exec(compile(lines, "isocharge.simulate", "exec"), scope)
    assert scope["charge"].shape == (3,)
    assert np.all((scope["charge"] > 500.0) & (scope["charge"] < 1600.0))


def test_sensor_file_can_be_read():
    (text,) = (block for block in TABLES if "[film]" in block)
    sensor = sensor_from_dict(tomllib.loads(text))
    assert sensor.electrode_names == ("A", "B", "C")
    assert sensor.calibration.gain == {"A": 1.02}


def test_noise_file_can_be_read(tmp_path):
    (text,) = (block for block in TABLES if "white_pC" in block)
    (tmp_path / "mine.toml").write_text(text)
    assert noise_model(str(tmp_path / "mine.toml")).gain == 0.001
    assert load_amplifier(str(tmp_path / "mine.toml")).tau == 5.0
