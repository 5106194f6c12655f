"""Spline approximations compared with the forward map."""

from dataclasses import replace

import numpy as np

from isocharge.simulate import ChargeSpline
from isocharge.simulate.numerics.disk import sunflower
from kept import kept
from solved_charges import relative_error, with_piezo

RADIUS = 5.0


def spread(count: int) -> np.ndarray:
    at = RADIUS * sunflower(count)
    force = 0.3 * (1.0 / 0.3) ** np.linspace(0.02, 0.98, count)
    return np.column_stack([at, force])


def test_spline_charges_equal_those_of_the_forward_map(near_map, near_spline):
    contact = spread(300)
    charge = near_map.charges(contact)
    error = relative_error(near_spline.charges(contact), charge)
    assert error < 6e-4
    assert relative_error(ChargeSpline.of(near_map, spacing=0.6).charges(contact), charge) > 2.0 * error


def test_spline_includes_the_charge_of_contact_pressure(near_map):
    """The charges of d33 are proportional to the force, while those of the stress depend on the squared amplitude.

    The slope of these charges has a kink where the edge of the footprint meets a corner of an electrode. The error of
    the spline is therefore 1.1 % with knots every 0.5 mm, and 0.2 % with knots every 0.25 mm.
    """
    contact = spread(100)
    pressed = replace(near_map, sensor=with_piezo(near_map.sensor, d33=-30.0))
    with_d33, without = (kept(ChargeSpline.of, each, spacing=0.5) for each in (pressed, near_map))
    extra = pressed.charges(contact) - near_map.charges(contact)
    assert np.abs(extra).max() > 10.0
    difference = with_d33.charges(contact) - without.charges(contact)
    assert relative_error(difference, extra) <= 0.015
    # The power of the force differs from that of the stress, so more forces are needed.
    assert without.force.size == near_map.family.force.size < with_d33.force.size
