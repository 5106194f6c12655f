"""Rung 8: charges and deflections of independent solvers.

`film_cases.json`: axisymmetric collocation (1e-8) and dolfinx P3 (about 1e-4), errors below 3e-4.
`film_cases_skfem.json`: scikit-fem P3, what neither of them has: off-centre polygons, the rim, thick films (3e-5).
"""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from isocharge.simulate import Equilibrium, Polygon, SolveSettings, Theory, deflection, load_sensor, press, touch_charge
from isocharge.simulate.solver.error_estimate import estimated_error

ACCURACY = (Path(__file__).parents[2] / "simulate" / "docs" / "accuracy.md").read_text("utf-8")

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


def test_all_cases_are_there(reference_cases):
    assert [len(reference_cases(um)) for um in (25, 110, 1000)] == [36, 26, 26]


def test_charges_and_deflection(case):
    """Every charge of every layout, piezo type and readout; the theory is what the scene gets by itself."""
    solved = solve(case.film, case.probe, case.at, case.force)
    assert len(case.charges) in (4, 8)
    for key, expected in case.charges.items():
        sensor = case.sensor(key)
        error = np.abs(touch_charge(sensor, solved) / expected - 1.0)
        assert np.all(error < allowed(case, sensor)), (key, error)
    assert deflection(solved, np.array([case.at]))[0] == pytest.approx(case.deflection, rel=1e-3)


def test_further_charges_and_deflection(further_case):
    """Errors relative to the press's largest charge, as the second solver states its own."""
    case = further_case
    solved = solve(case.film, case.probe, case.at, case.force)
    assert len(case.charges) == 4
    for key, expected in case.charges.items():
        sensor = case.sensor(key)
        error = np.abs(touch_charge(sensor, solved) - expected) / np.abs(expected).max()
        assert np.all(error < allowed(case, sensor)), (key, error)
    assert deflection(solved, np.array([case.at]))[0] == pytest.approx(case.deflection, rel=1e-3)


def test_estimated_error_is_a_bound(case):
    """For the worst charge of a press, beyond what the reference itself may be off."""
    solved, worst = solve(case.film, case.probe, case.at, case.force), 0.0
    for key, expected in case.charges.items():
        if key.endswith("area"):
            error = np.abs(touch_charge(case.sensor(key), solved) - expected).max() / np.abs(expected).max()
            worst = max(worst, float(error))
    assert worst <= estimated_error(solved) + 3e-4


def test_second_library_live(skfem, film):
    """A turned rectangle off the centre of a 40 um film under 0.3 MPa: no closed form, no symmetry; both solve it."""
    sensor = load_sensor("three-25um-uniaxial")
    film = replace(film, thickness=0.04, pretension=0.3)
    sensor = replace(sensor, film=film)
    at, force = (4.0, -3.0), 0.3
    probe = Polygon.rectangle(5.0, 2.0, 0.6)
    corners = at + np.stack([probe.outline.real, probe.outline.imag], axis=1)
    other = skfem.solve(film.thickness, film.pretension, corners, force, 1.0)
    for theory in ("auto", Theory(stretching=True, bending=True, pretensioned=True)):
        solved = press(film, probe, at, force, SolveSettings(theory=theory))
        for readout in ("area", "edge"):
            charge = touch_charge(replace(sensor, readout=readout), solved)
            d31, d32 = sensor.piezo.d31, sensor.piezo.d32
            expected = [
                other.charge(np.array(e.corners), d31, d32)
                if readout == "area"
                else other.edge_charge(e.centre, 3.0, d31, d32)
                for e in sensor.electrodes
            ]
            np.testing.assert_allclose(charge, expected, rtol=0.0, atol=1e-3 * np.max(expected))
        points = np.array([at, (0.0, 0.0), (20.0, 10.0), (-30.0, 5.0)])
        expected = [other.deflection(point) for point in points]
        np.testing.assert_allclose(deflection(solved, points), expected, rtol=5e-4)


def worst_errors(case) -> tuple[float, float]:
    """Error of a press's charges relative to the largest, and of its deflection."""
    solved = solve(case.film, case.probe, case.at, case.force)
    charges = [
        np.abs(touch_charge(case.sensor(k), solved) - q).max() / np.abs(q).max() for k, q in case.charges.items()
    ]
    return max(charges), float(abs(deflection(solved, [case.at])[0] / case.deflection - 1.0))


def test_accuracy_table_is_what_the_solver_gives(reference_cases, further_cases):
    """Every figure of simulate/docs/accuracy.md, to a digit: figures this small differ between libraries."""
    sources = {"collocation, dolfinx": reference_cases, "scikit-fem": further_cases}
    rows = re.findall(r"^\| (.+) \| (\d+) um \| (\d+) \| ([\d.]+) % \| ([\d.]+) % \|$", ACCURACY, re.MULTILINE)
    assert len(rows) == 8
    for source, thickness, count, *shown in rows:
        cases = sources[source](float(thickness))
        assert len(cases) == int(count)
        np.testing.assert_allclose(
            np.max([worst_errors(case) for case in cases], axis=0), 0.01 * np.array(shown, dtype=float), atol=2e-5
        )
