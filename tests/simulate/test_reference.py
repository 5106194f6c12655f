"""Charges and deflections compared with independent solvers.

`film_cases.json`: axisymmetric collocation (1e-8) and dolfinx P3 (about 1e-4), errors below 3e-4.
`film_cases_skfem.json`: scikit-fem P3 (3e-5), with off-centre polygons, ellipses, fingers, presses near the rim and
thick films.
"""

import json
import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from isocharge.simulate import (
    Circle,
    Ellipse,
    Equilibrium,
    Film,
    Finger,
    Polygon,
    Probe,
    Sensor,
    deflection,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.solver.error_estimate import estimated_error

HERE = Path(__file__).parent


ACCURACY = (HERE.parents[1] / "simulate" / "docs" / "accuracy.md").read_text("utf-8")


@dataclass(frozen=True)
class ReferenceCase:
    """A press that an independent solver solved, with bending."""

    source: str
    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    deflection: float
    charges: dict[str, np.ndarray]

    def sensor(self, key: str) -> Sensor:
        """The sensor of a key such as "three-biaxial-area"."""
        layout, kind, readout = key.split("-")
        return replace(load_sensor(f"{layout}-25um-{kind}"), film=self.film, readout=readout)

    def __str__(self) -> str:
        film = self.film
        x, y = self.at
        turn = f"@{np.rad2deg(self.probe.angle):.0f}" if self.probe.angle else ""
        scene = f"{film.thickness * 1e3:.0f}um-{film.pretension:g}MPa-{self.probe.notation}{turn}"
        return f"{scene}-at({x:.0f},{y:.0f})-{self.force:g}N"


def read(name: str, source: str) -> list[ReferenceCase]:
    document = json.loads((HERE.parent / "data" / name).read_text("utf-8"))
    radius, young, poisson = (document["film"][key] for key in ("radius_mm", "young_GPa", "poisson"))
    return [
        ReferenceCase(
            source,
            Film(radius, case["thickness_um"] * 1e-3, young * 1e3, poisson, case["pretension_MPa"]),
            probe_of(case["probe"]),
            tuple(case["at_mm"]),
            case["force_N"],
            case["deflection_mm"],
            {key: np.array(list(charges.values())) for key, charges in case["touch_charge_pC"].items()},
        )
        for case in document["cases"]
    ]


def probe_of(about: dict) -> Probe:
    angle = np.deg2rad(about.get("turn_deg", 0.0))
    if about["shape"] == "circle":
        return Circle(about["radius_mm"])
    if about["shape"] == "finger":
        return Finger(about["radius_mm"])
    if about["shape"] == "ellipse":
        return Ellipse(about["width_mm"], about["height_mm"], angle)
    if about["shape"] == "rectangle":
        return Polygon.rectangle(about["width_mm"], about["height_mm"], angle)
    return Polygon.triangle(about["side_mm"], angle)


CASES = [*read("film_cases.json", "collocation, dolfinx"), *read("film_cases_skfem.json", "scikit-fem")]

NEAR = 4.0
"""An electrode counts as near the probe if its edge is closer to the footprint's than this (mm)."""


@cache
def solve(film, probe, at, force) -> Equilibrium:
    """Each press once; all layouts, coefficients and readouts are read from it."""
    return press(film, probe, at, force)


def allowed(case, sensor) -> np.ndarray:
    """Relative error that each electrode may have: 0.1 %; 0.2 % from 1 mm thickness on and near the probe."""
    gap = [
        np.hypot(*(np.clip(case.at, low, high) - case.at)) - case.probe.reach
        for low, high in ((np.min(e.corners, axis=0), np.max(e.corners, axis=0)) for e in sensor.electrodes)
    ]
    loose = (np.array(gap) < NEAR) | (case.film.thickness >= 1.0)
    return np.where(loose, 2e-3, 1e-3)


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (i % 9 > 0), id=str(case)) for i, case in enumerate(CASES)]
)
def test_charges_and_deflection(case):
    """Every charge of every layout, piezo type and readout, with the theory that the press gets by itself.

    The second solver states its errors relative to the press's largest charge. The estimated error is a bound for the
    worst charge, beyond what the reference itself may be off.
    """
    solved = solve(case.film, case.probe, case.at, case.force)
    worst = 0.0
    assert len(case.charges) in (4, 8)
    for key, expected in case.charges.items():
        sensor = case.sensor(key)
        error = np.abs(touch_charge(sensor, solved) - expected)
        scale = np.abs(expected).max() if case.source == "scikit-fem" else np.abs(expected)
        assert np.all(error < allowed(case, sensor) * scale), (key, error / scale)
        if key.endswith("area"):
            worst = max(worst, float(error.max() / np.abs(expected).max()))
    assert deflection(solved, np.array([case.at]))[0] == pytest.approx(case.deflection, rel=1e-3)
    assert worst <= estimated_error(solved) + 3e-4


def worst_errors(case) -> tuple[float, float]:
    """Error of a press's charges relative to the largest, and of its deflection."""
    solved = solve(case.film, case.probe, case.at, case.force)
    charges = [
        np.abs(touch_charge(case.sensor(k), solved) - q).max() / np.abs(q).max() for k, q in case.charges.items()
    ]
    return max(charges), float(abs(deflection(solved, [case.at])[0] / case.deflection - 1.0))


@pytest.mark.slow
def test_accuracy_table_equals_the_errors_of_the_solver():
    """Every figure of simulate/docs/accuracy.md, to a digit: figures this small differ between libraries."""
    rows = re.findall(r"^\| (.+) \| (\d+) um \| (\d+) \| ([\d.]+) % \| ([\d.]+) % \|$", ACCURACY, re.MULTILINE)
    assert len(rows) == 9
    for source, thickness, count, *shown in rows:
        cases = [case for case in CASES if (case.source, f"{1e3 * case.film.thickness:.0f}") == (source, thickness)]
        assert len(cases) == int(count)
        np.testing.assert_allclose(
            np.max([worst_errors(case) for case in cases], axis=0), 0.01 * np.array(shown, dtype=float), atol=2e-5
        )
