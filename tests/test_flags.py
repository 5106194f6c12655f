"""What flags can see, and what they cannot: the figures of the pages, on fresh presses of every released sensor."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from isocharge.serve import Predictor
from isocharge.serve.flags import STRESS
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from kept import kept

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
PAGE = (ROOT / "serve" / "docs" / "predictions.md").read_text("utf-8")
PRESSES = 1500
WIDEST = 15.001
"""Radius of the film that is solved for all sensors, which lie on the same, mm."""

TOLERANCE = 3.0
"""Percentage points: three standard deviations of a share of so many presses, and rounding."""


def column(sensor):
    """The page's shares for a sensor, in %, by fault."""
    lines = re.search(r"^\| fault \|.*?\n\n", PAGE, re.DOTALL | re.MULTILINE)[0].splitlines()
    header, _, *rows = [[cell.strip(" `") for cell in line.split("|")] for line in lines if line]
    return {row[1]: float(row[header.index(sensor)].removesuffix(" %")) for row in rows}


def shares(name):
    """Shares of presses with a flag, in %, by fault; hard presses that dent the film are no fault."""

    def share_of(charge_pC):
        flags = predictor.validity.batch_flags(predictor.predict_batch(charge_pC))
        return 100.0 * np.mean([bool(set(words) - {STRESS}) for words in flags])

    predictor, rng = Predictor(name), np.random.default_rng(7)
    reach, names = 0.999 * predictor.validity.reach_mm, predictor.metadata.electrodes
    forward_map = replace(
        kept(ForwardMap.build, load_sensor("three-25um-biaxial"), Circle(1.0), radius=WIDEST),
        sensor=load_sensor(name),
    )
    radius, angle = reach * np.sqrt(rng.random(PRESSES)), 2.0 * np.pi * rng.random(PRESSES)
    force = np.exp(rng.uniform(np.log(0.5), np.log(2.0), PRESSES))
    clean = forward_map.charges(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), force]))
    charge_pC = noise_model("reference").add(clean, rng)

    def share(*gains):
        one = np.eye(len(names), dtype=bool)
        return np.mean([share_of(charge_pC * np.where(electrode, gain, 1.0)) for gain in gains for electrode in one])

    return {
        "none": share(1.0),
        "one gain 5 % off": share(0.95, 1.05),
        "one gain 20 % off": share(0.8, 1.2),
        "one electrode dead": share(0.0),
        "A and B swapped": share_of(charge_pC[:, [1, 0, *range(2, len(names))]]),
    }


@pytest.mark.parametrize("sensor", ["three-25um-biaxial", "four-25um-biaxial", "four-25um-uniaxial"])
def test_figures_of_what_is_flagged(sensor):
    measured = shares(sensor)
    assert column(sensor) == pytest.approx(measured, abs=TOLERANCE)
    in_readme = [float(share) for share in re.findall(r"(\d+) %(?: of presses| with four)", README)]
    assert in_readme[sensor.startswith("four")] == pytest.approx(measured["one gain 20 % off"], abs=TOLERANCE)
    assert measured["one electrode dead"] > 99.9  # "always"
