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


@pytest.fixture(scope="module", params=[(Circle(1.0), 0.11), (RECTANGLE, 1.0)])
def solves(film, request) -> list[Equilibrium]:
    """Equilibria of one press for elements of increasing order. The last equilibrium is the reference."""
    probe, thickness = request.param
    film = replace(film, thickness=thickness)

    def solve(order: int) -> Equilibrium:
        settings = SolveSettings(theory=Theory(bending=True), resolution=Resolution(order, 8, 5, 2))
        return press(film, probe, (5.0, 3.0), 1.0, settings)

    return [solve(order) for order in (*ORDERS, 7)]


def charges(solved: Equilibrium) -> np.ndarray:
    """Return the touch charges of a built-in sensor with the film of an equilibrium."""
    return touch_charge(replace(load_sensor("four-25um-uniaxial"), film=solved.film), solved)


OUTPUTS = {
    "deflection": (partial(deflection, points=PLACES), 0.5, 2e-5),
    "charges": (charges, 0.3, 1e-4),
}
"""Function of an equilibrium, smallest number of decimal digits that each order adds, and largest relative error for
the highest order of `ORDERS`."""


@pytest.mark.parametrize(("output", "digits_per_order", "final_error"), OUTPUTS.values(), ids=OUTPUTS)
def test_deflection_and_charges_converge_exponentially_with_the_order(solves, output, digits_per_order, final_error):
    *values, reference = map(output, solves)
    errors = [relative_error(value, reference) for value in values]
    assert -np.polyfit(ORDERS, np.log10(errors), 1)[0] > digits_per_order
    assert errors[-1] < final_error
