"""Rungs 5 and 6 of the ladder: how fast the error falls, for the energy, the deflection and the charge."""

import numpy as np
import pytest

from isocharge.simulate import Circle, Equilibrium, Resolution, load_sensor, press, touch_charge
from isocharge.simulate.membrane import Geometry, Membrane
from isocharge.simulate.template import template

ORDERS = (3, 4, 5, 6, 7, 8)
PRESSES = ((5e-3, 3e-3), (9e-3, -1e-3))
"""Off centre; the second with its footprint on electrode A of four."""


@pytest.fixture(scope="module", params=PRESSES, ids=str)
def solves(film, request) -> list[Equilibrium]:
    """One press at growing order, the last one as the reference."""
    return [press(film, Circle(1e-3), request.param, 1.0, resolution=Resolution(n, 8, 6)) for n in (*ORDERS, 10)]


def rate(errors: list[float]) -> float:
    """Digits won per order, by least squares."""
    return float(-np.polyfit(ORDERS, np.log10(errors), 1)[0])


def test_deflection_converges_exponentially_with_the_order(solves):
    points = np.array([solves[0].at, (0.0, 0.0), (-20e-3, 10e-3), (0.0, 40e-3)])
    *values, reference = (solved.deflection(points) for solved in solves)
    errors = [np.abs(value / reference - 1.0).max() for value in values]
    assert rate(errors) > 0.9
    assert errors[1] < 3e-5
    assert errors[-1] < 1e-8


@pytest.mark.parametrize("name", ["three-25um-biaxial", "four-25um-uniaxial"])
def test_charge_converges_exponentially_with_the_order(solves, name):
    *values, reference = (touch_charge(load_sensor(name), solved) for solved in solves)
    errors = [np.abs(value / reference - 1.0).max() for value in values]
    assert rate(errors) > 0.9
    assert errors[1] < 3e-4
    assert errors[-1] < 1e-7


@pytest.mark.parametrize("order", [2, 3])
def test_energy_converges_with_twice_the_order_of_the_elements(film, order):
    """Halving every element divides the error of the energy by 2^(2 order): the known rate of a smooth problem."""

    def energy(resolution: Resolution) -> float:
        solved = press(film, Circle(4e-3), (12e-3, 0.0), 1.0, resolution=resolution)
        geometry = Geometry.build(template(resolution), solved.placement)
        return Membrane(geometry, solved.groups).energy(solved.field)

    reference = energy(Resolution(9, 8, 4))
    coarse, fine = (abs(energy(Resolution(order, 8 * k, 4 * k)) - reference) for k in (1, 2))
    assert np.log2(coarse / fine) == pytest.approx(2 * order, abs=0.8)
