"""Charges of layouts by stress fields, compared with the forward map."""

from dataclasses import replace

import numpy as np

from isocharge.simulate import Circle, SolveSettings, load_sensor, press
from isocharge.simulate.layout.stress_fields import COLUMNS, _stress_and_derivatives, charges_and_derivatives
from isocharge.simulate.mesh.blocks import Resolution
from solved_charges import relative_error


def test_charges_and_derivatives_of_a_uniaxial_film_are_those_of_the_forward_map(fields, three_map):
    """The shear stress of the press contributes, because d31 and d32 differ."""
    uniaxial = load_sensor("four-25um-uniaxial")
    forward_map = replace(three_map, sensor=uniaxial)
    contact = np.array([[3.0, 1.0, 1.0], [-1.0, 2.5, 1.0], [0.3, -0.4, 1.0], [-2.0, -3.0, 1.0]])
    rows = charges_and_derivatives(fields[uniaxial.name], contact[:, :2], uniaxial.electrodes)
    charge = forward_map.charges(contact)
    np.testing.assert_allclose(rows[..., 0], charge, rtol=1e-3)
    assert relative_error(rows[..., 1:4], forward_map.derivatives(contact)) <= 4e-4


def test_derivatives_nearer_to_the_centre_than_the_step_are_those_beside_it(sensor):
    """The press is moved across the centre, so that its direction is reversed. The step is 0.02 mm."""
    settings = SolveSettings(resolution=Resolution(order=4, around=8, rings=4))
    near, beside = (
        _stress_and_derivatives(press(sensor.film, Circle(1.0), (distance, 0.0), 1.0, settings), "middle")
        for distance in (0.01, 0.03)
    )
    x_derivative = beside[:, :, COLUMNS.index("x")]
    difference = near[:, :, COLUMNS.index("x")] - x_derivative
    assert np.linalg.norm(difference) < 0.5 * np.linalg.norm(x_derivative)
