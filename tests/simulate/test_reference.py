"""Rung 8: charges and deflections of independent solvers, with bending, which the membrane leaves out.

`tests/data/film_cases.json`: axisymmetric collocation (1e-8) and dolfinx P3 (about 1e-4), errors below 3e-4.
"""

from functools import cache

import numpy as np

from isocharge.simulate import Equilibrium, press, touch_charge
from isocharge.simulate.equilibrium import bending_share
from isocharge.simulate.forward import TOO_THICK


@cache
def solve(film, probe, at, force) -> Equilibrium:
    """Each case once."""
    return press(film, probe, at, force)


def worst(case) -> tuple[float, float, float]:
    """Largest relative error of a charge, of one 4.5 mm or more from the probe's centre, and of the deflection."""
    solved, everywhere, away = solve(case.film, case.probe, case.at, case.force), 0.0, 0.0
    for key, expected in case.charges.items():
        sensor = case.sensor(key)
        error = np.abs(touch_charge(sensor, solved) / expected - 1.0)
        distance = np.hypot(*(np.array([e.centre for e in sensor.electrodes]) - case.at).T)
        everywhere, away = max(everywhere, error.max()), max(away, error[distance > 4.5e-3].max())
    deflection = solved.deflection(np.array([case.at]))[0]
    return everywhere, away, abs(deflection / case.deflection - 1.0)


def test_all_cases_in_scope_are_there(reference_cases):
    assert len(reference_cases(25.0)) == 28
    assert sum(case.film.pretension > 0.0 for case in reference_cases(25.0)) == 2


def test_charges_and_deflection(case):
    """Every charge of every layout, piezo type and readout; from 1 N on tighter, for bending matters less there."""
    assert len(case.charges) == 8
    charge, _, deflection = worst(case)
    assert charge < (5e-3 if case.force >= 1.0 else 1.5e-2)
    assert deflection < (3e-3 if case.force >= 1.0 else 8e-3)


def test_estimated_error_is_a_bound(case):
    """For every charge, the probe on an electrode included, and not an idle one: a third of it is reached."""
    everywhere, _, _ = worst(case)
    estimate = solve(case.film, case.probe, case.at, case.force).estimated_error
    assert everywhere <= estimate < 3.5 * everywhere


def test_estimated_error_of_a_thicker_film(thicker_case):
    """110 um: a bound away from the probe while bending is a small correction, its size beyond."""
    _, away, _ = worst(thicker_case)
    solved = solve(thicker_case.film, thicker_case.probe, thicker_case.at, thicker_case.force)
    small = bending_share(solved.film, solved.groups.amplitude2) < TOO_THICK
    assert away <= solved.estimated_error * (1.0 if small else 1.2)
    assert solved.estimated_error < 4.0 * away
