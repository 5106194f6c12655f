"""Stress at the surfaces of the film: closed forms of plates, signs, and the required theory."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SensorError
from isocharge.simulate import (
    Circle,
    Electrode,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    touch_charge,
    touch_stress,
)
from isocharge.simulate.forward.readout import stress_charge
from solved_charges import relative_error, with_squares

FINE = Resolution(7, 8, 6, 2)
FORCE = 1e-3


@pytest.fixture(scope="module")
def thick(film):
    return replace(film, thickness=1.0)


def outer(film, force: float, c: float, r: float) -> tuple[float, float]:
    """Return the bending stress (s_r, s_theta) on the touched side of a clamped plate at the radius r, MPa.

    The force acts on a disk of radius c, and r >= c. The mean of Michell's function over the disk is
    w = F / (16 pi D) (a^2 - r^2 - 2 r^2 ln(a / r) - c^2 (ln(a / r) - (1 - (r / a)^2) / 2)).
    The curvatures are w'' and w' / r, and the stress is s_r = E h / (2 (1 - nu^2)) (w'' + nu w' / r).
    """
    a = film.radius
    h = film.thickness
    nu = film.poisson
    k = force / (16.0 * np.pi * film.young * h**3 / (12.0 * (1.0 - nu**2)))
    log = np.log(a / r)
    slope = k * (-4.0 * r * log + c**2 / r - c**2 * r / a**2)
    second = k * (4.0 - 4.0 * log - c**2 / r**2 - c**2 / a**2)
    scale = 0.5 * h * film.young / (1.0 - nu**2)
    return scale * (second + nu * slope / r), scale * (slope / r + nu * second)


def pressed_in_the_centre(film, radius):
    """Solve a plate under a small force on a disk, whose radius is given in mm."""
    return press(film, Circle(radius), (0.0, 0.0), FORCE, SolveSettings(resolution=FINE))


def top_stress(solved, points: np.ndarray) -> np.ndarray:
    """Return the bending stress at the top surface: the difference from the stress in the middle of the film."""
    return touch_stress(solved, points, "top") - touch_stress(solved, points)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_bending_stress_outside_the_footprint(thick, share):
    """Radial and hoop stress of a clamped plate at the top surface, up to the rim."""
    c = share * thick.radius
    solved = pressed_in_the_centre(thick, c)
    for r in (1.5 * c, 0.6 * thick.radius, 0.99 * thick.radius):
        points = r * np.array([(0.0, 1.0), np.sqrt([0.5, 0.5])])
        radial, hoop = outer(thick, FORCE, c, r)
        mean = 0.5 * (radial + hoop)
        half = 0.5 * (radial - hoop)
        expected = [(hoop, radial, 0.0), (mean, mean, half)]
        scale = max(abs(radial), abs(hoop))
        np.testing.assert_allclose(top_stress(solved, points), expected, atol=2e-3 * scale)


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_bending_stress_under_the_centre_of_the_probe(thick, share):
    """The stress on the touched side is the compression 6 M / h^2 (Timoshenko, art. 19).

    The moment is M = F (1 + nu) / (4 pi) (ln(a / c) + c^2 / (4 a^2)).
    """
    c = share * thick.radius
    solved = pressed_in_the_centre(thick, c)
    moment = FORCE * (1.0 + thick.poisson) / (4.0 * np.pi) * (np.log(1.0 / share) + 0.25 * share**2)
    found = top_stress(solved, np.array([(1e-6, 0.0)]))[0]
    np.testing.assert_allclose(found[:2], -6.0 * moment / thick.thickness**2, rtol=1e-3)


def test_charge_of_a_surface_is_the_integral_of_its_stress(thick):
    """The charge of a small electrode is A (d31 s11 + d32 s22) with the stress at its surface."""
    electrode = Electrode.of_square("A", (12.05, 0.05), 0.1)
    sensor = replace(load_sensor("four-25um-uniaxial"), film=thick, electrodes=(electrode,))
    solved = pressed_in_the_centre(thick, 2.0)
    for surface, sign in (("top", 1.0), ("bottom", -1.0)):
        charge = touch_charge(replace(sensor, surface=surface), solved) - touch_charge(sensor, solved)
        radial, hoop = outer(thick, FORCE, 2.0, 12.05)
        assert charge[0] == pytest.approx(sign * 0.01 * (20.0 * radial + 2.0 * hoop), rel=5e-3)


@pytest.mark.parametrize("at", [(0.0, 0.0), (15.0, 0.0)])
def test_charge_of_a_surface_is_accurate_beside_the_rim_and_beside_the_probe(at):
    """The bending stress decreases within 0.1 mm from the edge of the footprint, and within 0.4 mm from the rim."""
    sensor = replace(with_squares(load_sensor("four-25um-uniaxial"), (43.37, 0.0), (13.5, 0.0)), surface="top")
    solved = press(sensor.film, Circle(1.0), at, 1.0)
    assert relative_error(touch_charge(sensor, solved), stress_charge(sensor, solved, (80, 80))) < 4e-4


def test_surface_readout_without_bending_raises_error(film):
    sensor = replace(load_sensor("three-25um-biaxial"), surface="bottom")
    solved = press(film, Circle(1.0), (0.0, 0.0), 1.0, SolveSettings(theory=Theory(bending=False)))
    with pytest.raises(SensorError, match=r"surface 'bottom' needs bending, .* solve it with SolveSettings\(theory="):
        touch_charge(sensor, solved)
