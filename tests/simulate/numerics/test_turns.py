"""Directions and rotations of the solved presses of a family."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import Circle, Ellipse, Polygon, load_sensor
from isocharge.simulate.forward.family import DEFAULT_HARMONICS
from isocharge.simulate.numerics.interpolation import Turns

EVEN = load_sensor("three-25um-biaxial").film
UNEVEN = replace(EVEN, pretension=1.0, deviator=(0.3, 0.1))
IRREGULAR = Polygon.of(np.array([(0.0, 0.0), (3.0, 0.0), (1.0, 2.0)]))


@pytest.mark.parametrize(
    ("probe", "solves"),
    [(Circle(1.0), 7), (IRREGULAR, 39), (Ellipse(4.0, 2.0), 21), (Polygon.triangle(4.0), 13)],
)
def test_fewer_turns_are_solved_than_all_pairs_of_angles(probe, solves):
    """All pairs would be 7, 63, 35 and 21: seven directions times the rotations, of which the symmetry saves some."""
    assert len(Turns.spread(DEFAULT_HARMONICS, probe.period, has_directions=True).solved) == solves


@pytest.mark.parametrize("probe", [Ellipse(4.0, 2.0), Polygon.triangle(4.0), Polygon.rectangle(3.0, 3.0)])
def test_rotation_by_a_period_of_the_probe_is_the_same_press(probe):
    """Both angles increase by the period. Directions that differ by half a turn are equal."""
    turns = Turns.spread(DEFAULT_HARMONICS, probe.period, has_directions=True)
    n_solved = len(turns.solved)
    np.testing.assert_allclose(turns.rotation[n_solved:] - turns.rotation[:-n_solved], probe.period)
    change = turns.direction[n_solved:] - turns.direction[:-n_solved] - probe.period
    np.testing.assert_allclose(np.sin(change), 0.0, atol=1e-12)
