"""Convergence of the deflection and of the charges with the order of the elements."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from isocharge.simulate import (
    Circle,
    Equilibrium,
    Polygon,
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
PLACES = np.array([(5.0, 3.0), (0.0, 0.0), (-20.0, 10.0), (0.0, 40.0)])


CASES = [
    # Other tests compare membranes with closed forms and with a collocation.
    pytest.param((RECTANGLE, 0.025, Theory(bending=False)), marks=pytest.mark.slow, id="membrane"),
    pytest.param((Circle(1.0), 0.11, Theory(bending=True)), id="membrane + bending"),
    pytest.param((RECTANGLE, 1.0, Theory(bending=True)), id="plate"),
]
"""Probe, thickness of the film, mm, and theory."""


@pytest.fixture(scope="module", params=CASES)
def solves(film, request) -> list[Equilibrium]:
    """Equilibria of one press for elements of increasing order. The last equilibrium is the reference."""
    probe, thickness, theory = request.param
    film = replace(film, thickness=thickness)

    def solve(order: int) -> Equilibrium:
        resolution = Resolution(order, 8, 5, 2 if theory.bending else 0)
        return press(film, probe, (5.0, 3.0), 1.0, SolveSettings(theory=theory, resolution=resolution))

    return [solve(order) for order in (*ORDERS, 7)]


def charges(solved: Equilibrium, name: str, readout: str) -> np.ndarray:
    """Return the touch charges of a built-in sensor with the film of an equilibrium and the given readout."""
    return touch_charge(replace(load_sensor(name), film=solved.film, readout=readout), solved)


OUTPUTS = {
    "deflection": (partial(deflection, points=PLACES), 0.5, 2e-5),
    "edge": (partial(charges, name="three-25um-biaxial", readout="edge"), 0.3, 1e-4),
    "area": (partial(charges, name="four-25um-uniaxial", readout="area"), 0.3, 1e-4),
}
"""Function of an equilibrium, smallest number of decimal digits that each order adds, and largest relative error for
the highest order of `ORDERS`."""


@pytest.mark.parametrize(("output", "digits_per_order", "final_error"), OUTPUTS.values(), ids=OUTPUTS)
def test_deflection_and_charges_converge_exponentially_with_the_order(solves, output, digits_per_order, final_error):
    *values, reference = map(output, solves)
    errors = [relative_error(value, reference) for value in values]
    assert -np.polyfit(ORDERS, np.log10(errors), 1)[0] > digits_per_order
    assert errors[-1] < final_error
