"""Films with uneven modulus, uneven tension or an oval clamp, compared with scikit-fem and with a closed form."""

from dataclasses import replace

import numpy as np
import pytest

from axisymmetric_membrane import harmonic
from isocharge.simulate import (
    Circle,
    Film,
    Resolution,
    SolveSettings,
    Theory,
    deflection,
    load_sensor,
    press,
    touch_charge,
)
from solved_charges import solved_charge

SENSOR = load_sensor("four-25um-biaxial")
PROBE = Circle(1.0)
AT = (3.0, -2.0)
FORCE = 0.5
ALL = Film(45.0, 0.025, 3000.0, 0.34, 1.0, (0.33, 0.2), young_ratio=1.2, axis=0.4, oval=0.02, oval_axis=-0.7)
SLACK = Film(45.0, 0.025, 3000.0, 0.34, -0.3, shear=1000.0)

BY_SCIKIT_FEM = {
    "all at once": (ALL, [574.79165, 354.29372, 356.80841, 491.15167]),
    "slack, soft in shear": (SLACK, [693.39308, 494.80579, 477.66952, 623.05922]),
}
"""Film, and charges of the press by scikit-fem 12, pC.

They were computed with P3 elements and 30 triangles around the probe by `film_skfem.py` of commit 640aecf.
"""


@pytest.mark.parametrize(("film", "expected"), BY_SCIKIT_FEM.values(), ids=BY_SCIKIT_FEM)
def test_charges_of_imperfect_films_agree_with_scikit_fem(film, expected):
    charge = solved_charge(replace(SENSOR, film=film), PROBE, AT, FORCE)
    np.testing.assert_allclose(charge, expected, rtol=8e-4)


@pytest.mark.parametrize("distance", [10.3, 36.0])
def test_deflection_of_an_oval_film_with_uneven_tension_agrees_with_greens_function(distance):
    """If T1 / T2 is the ratio of the squared half axes, Green's function of the disk holds in scaled coordinates.

    The tension along the axes is (1 +- e)^2 times a constant, and the half axes are 1 +- e times the radius.
    The rim differs from an ellipse by terms of second order in e, which matter more for presses near the rim.
    """
    e = 0.02
    tension = 2.0
    axis = 0.4
    half_difference = 2.0 * e * tension
    mean = (1.0 + e**2) * tension
    deviator = (half_difference * np.cos(2.0 * axis), half_difference * np.sin(2.0 * axis))
    film = replace(SENSOR.film, pretension=mean, deviator=deviator, oval=e, oval_axis=axis)
    at = (0.87 * distance, -0.49 * distance)
    solved = press(
        film, Circle(0.1), at, 1e-6, SolveSettings(theory=Theory(bending=False), resolution=Resolution(7, 16, 10))
    )

    def scaled(points):
        in_oval_axes = np.asarray(points) @ [1.0, 1j] * np.exp(-1j * axis) / film.radius
        return in_oval_axes.real / (1.0 + e) + 1j * in_oval_axes.imag / (1.0 - e)

    points = np.array([[-10.0, 3.0], [15.0, 12.0], [0.0, 20.0], [-30.0, -10.0]])
    z = scaled(points)
    source = scaled(at)
    expected = 1e-6 / (film.thickness * tension * (1.0 - e**2)) * harmonic(z, source)
    tolerance = 3.0 * e**2 * film.radius / (film.radius - distance)
    np.testing.assert_allclose(deflection(solved, points), expected, rtol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("at", [(0.0, -42.9), (44.5, 0.0)])
def test_presses_near_the_rim_of_an_oval_film_are_solved(at):
    """The half axes are 45.9 and 44.1 mm."""
    film = replace(SENSOR.film, pretension=1.0, oval=0.02)
    assert press(film, PROBE, at, 0.1).status == "converged"


def test_crosstalk_adds_a_share_of_the_charges_of_the_other_electrodes():
    solved = press(SENSOR.film, PROBE, AT, FORCE)
    own = touch_charge(SENSOR, solved)
    wired = replace(SENSOR, calibration=replace(SENSOR.calibration, crosstalk=0.01))
    np.testing.assert_allclose(touch_charge(wired, solved), 0.99 * own + 0.01 * own.sum(), rtol=1e-12)
