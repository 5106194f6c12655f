"""Convergence of the deflection and of the charges with the order and the size of the elements."""

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
from solved_charges import relative_error

ORDERS = (3, 4, 5, 6)
RECTANGLE = Polygon.rectangle(4.0, 2.0, 0.5)
PROBES = (RECTANGLE, Circle(1.0), RECTANGLE)
THEORIES = {
    "membrane": (0.025, Theory(bending=False)),
    "membrane + bending": (0.11, Theory(bending=True)),
    "plate": (1.0, Theory(bending=True)),
}
PLACES = np.array([(5.0, 3.0), (0.0, 0.0), (-20.0, 10.0), (0.0, 40.0)])


CASES = [
    # Membranes are also solved with bending, and the order of their elements is tested below.
    pytest.param((probe, theory), marks=[pytest.mark.slow] if name == "membrane" else [], id=name)
    for probe, (name, theory) in zip(PROBES, THEORIES.items(), strict=True)
]


@pytest.fixture(scope="module", params=CASES)
def solves(film, request) -> list[Equilibrium]:
    """Equilibria of one press for elements of increasing order. The last equilibrium is the reference."""
    probe, (thickness, theory) = request.param
    film = replace(film, thickness=thickness)

    def solve(order: int) -> Equilibrium:
        resolution = Resolution(order, 8, 5, 2 if theory.bending else 0)
        return press(film, probe, (5.0, 3.0), 1.0, SolveSettings(theory=theory, resolution=resolution))

    return [solve(order) for order in (*ORDERS, 7)]


def check(
    solves: list[Equilibrium], output: Callable[[Equilibrium], np.ndarray], digits_per_order: float, final_error: float
) -> None:
    """Check the exponential convergence of an output.

    Args:
        solves: Equilibria for increasing orders, the last one for the reference.
        output: Function of an equilibrium.
        digits_per_order: Smallest number of decimal digits that each order adds.
        final_error: Largest relative error for the highest order of `ORDERS`.
    """
    *values, reference = map(output, solves)
    errors = [relative_error(value, reference) for value in values]
    assert -np.polyfit(ORDERS, np.log10(errors), 1)[0] > digits_per_order
    assert errors[-1] < final_error


def test_deflection_converges_exponentially_with_the_order(solves):
    check(solves, partial(deflection, points=PLACES), 0.5, 2e-5)


@pytest.mark.parametrize(("name", "readout"), [("three-25um-biaxial", "edge"), ("four-25um-uniaxial", "area")])
def test_charge_converges_exponentially_with_the_order(solves, name, readout):
    sensor = replace(load_sensor(name), film=solves[0].film, readout=readout)
    check(solves, partial(touch_charge, sensor), 0.3, 1e-4)


# Convergence with the size of the elements


def refined(film: Film, probe: Probe, theory: Theory, order: int, times: int) -> Equilibrium:
    """Solve a press on a mesh whose elements are divided by a factor in both directions.

    The depth of the ring of elements next to the footprint does not change, so the factor must remain small.
    """
    resolution = Resolution(order, 8 * times, 3 * times)
    return press(film, probe, (6.0, 3.0), 1.0, SolveSettings(theory=theory, resolution=resolution, layer=0.1))


SMALL = Polygon.rectangle(2.0, 1.0, 0.5)
ROUND = Circle(1.0)


@pytest.mark.parametrize(
    ("probe", "order", "name"),
    [(SMALL, 2, "membrane"), (ROUND, 3, "membrane"), (ROUND, 2, "membrane + bending")],
)
def test_charge_converges_with_the_order_of_the_elements(film, probe, order, name):
    """Elements of half the size divide the error of the charge by at least 2^order.

    This is the rate for a linear functional of the gradient.
    """
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
