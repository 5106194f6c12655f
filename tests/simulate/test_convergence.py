"""Rungs 5 and 6 of the ladder: how fast the error falls, for the energy, the deflection and the charge."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from isocharge.simulate import (
    Circle,
    Equilibrium,
    Film,
    Polygon,
    Probe,
    Resolution,
    SolveSettings,
    Theory,
    deflection,
    load_sensor,
    press,
    touch_charge,
)

ORDERS = (3, 4, 5, 6)
RECTANGLE = Polygon.rectangle(4.0, 2.0, 0.5)
PROBES = (RECTANGLE, Circle(1.0), RECTANGLE)
THEORIES = {
    "membrane": (0.025, Theory(stretching=True, bending=False, pretensioned=False)),
    "membrane + bending": (0.11, Theory(stretching=True, bending=True, pretensioned=False)),
    "plate": (1.0, Theory(stretching=False, bending=True, pretensioned=False)),
}
PLACES = np.array([(5.0, 3.0), (0.0, 0.0), (-20.0, 10.0), (0.0, 40.0)])


@pytest.fixture(scope="module", params=list(zip(PROBES, THEORIES.values(), strict=True)), ids=THEORIES.keys())
def solves(film, request) -> list[Equilibrium]:
    """One press off the centre at growing order, the last one as the reference."""
    probe, (thickness, theory) = request.param
    film = replace(film, thickness=thickness)

    def solve(order: int) -> Equilibrium:
        resolution = Resolution(order, 8, 5, 2 if theory.bending else 0)
        return press(film, probe, (5.0, 3.0), 1.0, SolveSettings(theory=theory, resolution=resolution))

    return [solve(order) for order in (*ORDERS, 7)]


def check(solves: list[Equilibrium], read: Callable[[Equilibrium], np.ndarray], digits: float, last: float) -> None:
    """What is read wins digits with every order, and has an error below `last` at the highest."""
    *values, reference = map(read, solves)
    errors = [np.abs(value - reference).max() / np.abs(reference).max() for value in values]
    assert -np.polyfit(ORDERS, np.log10(errors), 1)[0] > digits
    assert errors[-1] < last


def test_deflection_converges_exponentially_with_the_order(solves):
    check(solves, partial(deflection, points=PLACES), 0.5, 2e-5)


@pytest.mark.parametrize(("name", "readout"), [("three-25um-biaxial", "edge"), ("four-25um-uniaxial", "area")])
def test_charge_converges_exponentially_with_the_order(solves, name, readout):
    sensor = replace(load_sensor(name), film=solves[0].film, readout=readout)
    check(solves, partial(touch_charge, sensor), 0.3, 1e-4)


# Every element in half, and half again; the block round the footprint keeps its depth, so not for ever


def refined(film: Film, probe: Probe, theory: Theory, order: int, times: int) -> Equilibrium:
    resolution = Resolution(order, 8 * times, 3 * times)
    return press(film, probe, (6.0, 3.0), 1.0, SolveSettings(theory=theory, resolution=resolution, layer=0.1))


SMALL = Polygon.rectangle(2.0, 1.0, 0.5)
ROUND = Circle(1.0)


@pytest.mark.parametrize(
    ("probe", "order", "name"),
    [(SMALL, 2, "membrane"), (ROUND, 3, "membrane"), (ROUND, 2, "membrane + bending")],
)
def test_charge_converges_with_the_order_of_the_elements(film, probe, order, name):
    """Halving every element divides the error of the charge, a functional of the gradient, by at least 2^order."""
    theory = THEORIES[name][1]
    film = replace(film, thickness=0.3) if theory.bending else film
    sensor = replace(load_sensor("four-25um-uniaxial"), film=film)
    finest = press(
        film, probe, (6.0, 3.0), 1.0, SolveSettings(theory=theory, resolution=Resolution(8, 8, 6), layer=0.1)
    )
    reference = touch_charge(sensor, finest)
    coarse, fine = (
        np.abs(touch_charge(sensor, refined(film, probe, theory, order, k)) - reference).max() for k in (1, 2)
    )
    assert np.log2(coarse / fine) > order
