"""Charges for the training of the misfit network: pairs of presses, and presses outside the working area."""

import numpy as np
import pytest

from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from isocharge.train.data.misfit_charges import PAIR_EXPONENTS, ExampleOptions, combined_charge, draw_outside_examples
from kept import kept
from membrane_solver import Membrane, Touch, solve_touches

NOISE = noise_model("reference")
SENSOR = load_sensor("four-25um-biaxial")
PAIRS = (
    (Touch(3.0, 4.0, 0.5), Touch(-4.0, -3.0, 0.3)),
    (Touch(7.0, -1.0, 0.2), Touch(-2.0, 5.0, 0.9)),
)


def solved_charges(touches):
    """Return the charges of touches at the same time from the independent solver, shape (n_electrode,), pC."""
    solution = solve_touches(Membrane(), touches)
    piezo = SENSOR.piezo
    corners = [np.array(electrode.corners) for electrode in SENSOR.electrodes]
    return np.array([solution.charge(pad_corners, piezo.d31, piezo.d32) for pad_corners in corners])


def test_two_presses_at_one_place_are_a_press_with_the_sum_of_the_forces():
    """On a slack membrane, the charge grows with the force to the power 2/3."""
    charge_at_1_N = np.array([[300.0, 100.0, -20.0]])
    first = charge_at_1_N * 0.3 ** (2.0 / 3.0)
    second = charge_at_1_N * 0.5 ** (2.0 / 3.0)
    np.testing.assert_allclose(combined_charge(first, second, 1.5), charge_at_1_N * 0.8 ** (2.0 / 3.0))
    np.testing.assert_allclose(combined_charge(first, second, 1.0), first + second)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("pair", PAIRS, ids=["apart", "near the edge"])
def test_charges_of_pairs_lie_between_those_of_the_two_exponents(pair):
    """The pairs are solved with both loads at once by an independent solver."""
    smallest_exponent, largest_exponent = PAIR_EXPONENTS
    first, second = (solved_charges([touch])[None] for touch in pair)
    both = solved_charges(pair)[None]
    assert (both < 0.95 * combined_charge(first, second, smallest_exponent)).all()
    assert (both > 0.98 * combined_charge(first, second, largest_exponent)).all()
    np.testing.assert_allclose(combined_charge(first, second, 1.5), both, rtol=0.1)


def test_the_independent_solver_agrees_with_the_simulator_for_one_touch():
    simulated = kept(ForwardMap.build, SENSOR, Circle(1.0), 9.0, (0.05, 2.0)).charges(np.array([[3.0, 4.0, 0.5]]))[0]
    np.testing.assert_allclose(solved_charges([Touch(3.0, 4.0, 0.5)]), simulated, rtol=0.005)


def test_examples_of_presses_outside_the_working_area_have_the_exact_misfit():
    """Presses inside have the same charge on all electrodes, and the press outside has 900 pC on one electrode.

    The nearest contact of the press outside therefore has the same charge on all electrodes.
    """

    class ProportionalMap:
        electrodes = ("A", "B", "C")
        domain = kept(ForwardMap.build, SENSOR, Circle(1.0), 9.0, (0.05, 2.0)).domain

        def charges(self, contact):
            return 100.0 * np.tile(contact[:, 2:], 3)

        def derivatives(self, contact):
            slopes = np.zeros((len(contact), 3, 3))
            slopes[:, :, 2] = self.charges(contact)
            return slopes

    outside = np.array([[100.0, 100.0, 900.0]])
    charge, residual = draw_outside_examples(
        outside, ProportionalMap(), NOISE, 400, 1, options=ExampleOptions(candidates=64)
    )
    assert np.all(np.abs(charge / outside - 1.0) < 0.12)
    nearest_charge = charge - residual * NOISE.sigma(charge)
    np.testing.assert_allclose(nearest_charge, nearest_charge[:, :1] * np.ones(3), rtol=1e-3)
