"""Solutions of the simulator compared with closed forms and with ordinary differential equations.

For small forces, the deflection is proportional to the force, and Green's function of a clamped disk is known. The
deflection under a circular probe is an integral of this function.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import iv, ivp, kv, kvp

from axisymmetric_membrane import axisymmetric_membrane, harmonic
from isocharge.simulate import (
    Circle,
    Film,
    Probe,
    Resolution,
    SolveSettings,
    Theory,
    deflection,
    press,
    touch_stress,
)
from isocharge.simulate.mechanics.theory import rotate_stress
from solved_charges import relative_error

REFINED = Resolution(order=6, around=8, rings=6)
MEMBRANE = Theory(bending=False)
FULL = Theory(bending=True)
SLACK = Film(radius=45.0, thickness=0.025, young=3000.0, poisson=0.34)
TAUT = replace(SLACK, pretension=1.0)
THICK = replace(SLACK, thickness=1.0)
TINY = 1e-6
"""A force (N) that is too small to change the tension of a film with pretension or the shape of a plate."""


def ring(radius: float, count: int = 7) -> np.ndarray:
    """Return points on a circle about the origin, shape (count, 2)."""
    angle = 0.3 + 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def radial_and_hoop(stress: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the stress in polar coordinates about the origin, (s_r, s_theta, s_r_theta), shape (3, n)."""
    x, y = points.T
    return rotate_stress(stress, -np.arctan2(y, x)).T


def plate_stiffness(film: Film) -> float:
    """Return the bending stiffness D = E h^3 / (12 (1 - nu^2)), N mm."""
    return film.young * film.thickness**3 / (12.0 * (1.0 - film.poisson**2))


# Green's functions of the disk. Positions are complex numbers x + i y in film radii: z is the position of the
# deflection, and c is the position of the point load.


def michell(z: np.ndarray, c: complex) -> np.ndarray:
    """Return the deflection of a clamped plate, in units of F a^2 / D (Michell 1902)."""
    squared_distance = np.abs(z - c) ** 2
    log = np.log(squared_distance / np.abs(1.0 - np.conj(c) * z) ** 2)
    return ((1.0 - np.abs(z) ** 2) * (1.0 - abs(c) ** 2) + squared_distance * log) / (16.0 * np.pi)


def michell_under_a_disk(z: np.ndarray, c: complex, radius: float) -> np.ndarray:
    """Return the mean of `michell` over a disk of loads.

    A function f with lap lap f = 0 has exactly the mean f + R^2 / 8 lap f over a disk of radius R.
    """
    log = np.log(np.abs((z - c) / (1.0 - np.conj(c) * z)) ** 2)
    image = 4.0 * 2.0 * ((c - z) * np.conj(z) / (1.0 - np.conj(z) * c)).real
    laplace = -4.0 * (1.0 - np.abs(z) ** 2) + 8.0 + 4.0 * log + image
    return michell(z, c) + radius**2 / 8.0 * laplace / (16.0 * np.pi)


def read_outside(film: Film, probe: Probe, at: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return points (x, y) on the film outside the probe, mm, and the same points as complex numbers in film radii."""
    candidates = np.concatenate(
        [ring(0.5 * film.radius), ring(0.95 * film.radius), at + ring(1.1 * probe.reach), at + ring(3.0 * probe.reach)]
    )
    points = candidates[np.hypot(*(candidates - at).T) > probe.reach]
    return points, points @ np.array([1.0, 1j]) / film.radius


LINEAR_FILMS = {
    "taut membrane": (TAUT, MEMBRANE, lambda z, c, _: harmonic(z, c) / (TAUT.pretension * TAUT.thickness)),
    "clamped plate": (
        THICK,
        FULL,
        lambda z, c, radius: THICK.radius**2 / plate_stiffness(THICK) * michell_under_a_disk(z, c, radius),
    ),
}
"""Film that a small force does not stretch, its theory, and a function that returns the deflection by the force, mm/N,
outside a disk of loads.

The lengths are in film radii. Green's function of the membrane is harmonic, so that its mean over the disk is its value
at the centre."""


@pytest.mark.first_cases(6)
@pytest.mark.parametrize(
    ("at", "radius"), [((0.0, 0.0), 4.0), ((8.0, -5.0), 0.2), ((-20.0, 10.0), 4.0), ((-3.0, 36.0), 0.2)]
)
@pytest.mark.parametrize(("film", "theory", "greens_function"), LINEAR_FILMS.values(), ids=LINEAR_FILMS)
def test_linear_film_under_a_disk(film, theory, greens_function, at, radius):
    """The deflection is that of a disk of point loads."""
    probe = Circle(radius)
    solved = press(film, probe, at, TINY, SolveSettings(theory=theory))
    points, z = read_outside(film, probe, at)
    expected = TINY * greens_function(z, complex(*at) / film.radius, radius / film.radius)
    assert relative_error(deflection(solved, points), expected) <= 5e-6


@pytest.mark.parametrize("tension_MPa", [0.01, 10.0])
def test_taut_plate_under_a_centred_disk(tension_MPa):
    """The deflection is the solution of D lap lap w - N lap w = q for a pressure q on a disk.

    Inside and outside the footprint, the solution consists of a parabola, a logarithm and modified Bessel functions. At
    the edge of the footprint, the deflection and its first three derivatives are continuous.
    """
    film = replace(SLACK, thickness=0.3, pretension=tension_MPa)
    tension = film.pretension * film.thickness
    c = 0.1
    k = film.radius * np.sqrt(tension / plate_stiffness(film))

    def basis(r: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the value and three derivatives of the basis functions at a radius in film radii.

        Inside the footprint they are 1 and I0, and outside 1, ln, I0 and K0, shapes (4, 2) and (4, 4). The Bessel
        functions are divided by their values at r = c or r = 1.
        """
        i0, k0 = (np.array([k**n * derivative(0, k * r, n) for n in range(4)]) for derivative in (ivp, kvp))
        one = np.array([1.0, 0, 0, 0])
        log = np.array([np.log(r), 1 / r, -1 / r**2, 2 / r**3])
        return (
            np.stack([one, i0 / iv(0, k * c)], axis=1),
            np.stack([one, log, i0 / iv(0, k), k0 / kv(0, k * c)], axis=1),
        )

    inner, outer = basis(c)
    _, rim = basis(1.0)
    parabola = -np.array([c**2, 2 * c, 2.0, 0.0]) / (4.0 * np.pi * c**2)  # in units of F / N: q a^2 / N = 1 / pi c^2
    continuity = [inner, -outer]
    clamped_rim = [np.zeros((2, 2)), rim[:2]]
    weights = np.linalg.solve(np.block([continuity, clamped_rim]), np.concatenate([-parabola, [0.0, 0.0]]))
    scale = TINY / tension
    solved = press(
        film,
        Circle(c * film.radius),
        (0.0, 0.0),
        TINY,
        SolveSettings(theory=FULL, resolution=Resolution(7, 8, 5, 2)),
    )
    centre = deflection(solved, np.zeros((1, 2)))[0]
    assert centre == pytest.approx(scale * (weights[0] + weights[1] / iv(0, k * c)), rel=2e-5)
    for r in (0.2, 0.6, 0.95):
        expected = scale * (basis(r)[1][0] @ weights[2:])
        np.testing.assert_allclose(deflection(solved, ring(r * film.radius)), expected, atol=2e-5 * centre)


@pytest.mark.parametrize(
    ("share", "force", "poisson", "tension"),
    [
        (0.02, 1e-7, 0.34, 0.0),  # von Karman
        (0.98, 1e-7, 0.3, 0.4),
        (0.02, 5.0, 0.34, 0.0),  # Green-Lagrange, A^2 = 0.013
        (0.3, 100.0, 0.34, 0.2),  # far beyond any film: A^2 = 0.1
    ],
)
def test_axisymmetric_membrane(share, force, poisson, tension):
    squared_amplitude = np.cbrt(force / (SLACK.young * SLACK.thickness * SLACK.radius)) ** 2
    film = replace(SLACK, poisson=poisson, pretension=tension * SLACK.young * squared_amplitude)
    solved = press(
        film, Circle(share * film.radius), (0.0, 0.0), force, SolveSettings(theory=MEMBRANE, resolution=REFINED)
    )
    radii = film.radius * np.array([0.005, 0.015, 0.1, 0.4, 0.8, 0.97])
    expected = axisymmetric_membrane(film, share * film.radius, force)(radii)
    for r, (depth, along, around) in zip(radii, expected.T, strict=True):
        points = ring(r)
        radial, hoop, shear = radial_and_hoop(touch_stress(solved, points), points)
        np.testing.assert_allclose(deflection(solved, points), depth, rtol=3e-6)
        np.testing.assert_allclose(radial, along, rtol=3e-5)
        np.testing.assert_allclose(hoop, around, rtol=1e-4)
        np.testing.assert_allclose(shear, 0.0, atol=3e-5 * along)


def test_centre_of_an_orthotropic_plate_under_a_uniform_pressure():
    """The plate bends like an isotropic plate with a mean stiffness (Timoshenko and Woinowsky-Krieger 1959)."""
    film = replace(THICK, young_ratio=4.0, shear=600.0, axis=0.4, static_pressure=1e-9)
    rest = press(film, Circle(5.0), (0.0, 0.0), TINY).rest
    mixed_modulus = film.poisson + 2.0 * film.shear * (1.0 - film.poisson**2) / film.young
    mean_stiffness = plate_stiffness(film) * (3.0 * 2.0 + 2.0 * mixed_modulus + 3.0 / 2.0) / 8.0
    expected = film.static_pressure * film.radius**4 / (64.0 * mean_stiffness)
    np.testing.assert_allclose(deflection(rest, np.zeros((1, 2))), expected, rtol=1e-4)


def test_hencky():
    """The stress in the centre under a uniform pressure agrees with Hencky's series.

    A probe over the whole film exerts a uniform pressure q. Then N_r(0) = b0 / 4 (q^2 a^2 E h)^(1/3), with b0 = 1.7244
    for Poisson's ratio 0.3 (Hencky 1915; digits of Fichter 1997).
    """
    film = replace(SLACK, poisson=0.3)
    force = 1e-6
    radius = 0.9999 * SLACK.radius
    solved = press(film, Circle(radius), (0.0, 0.0), force, SolveSettings(theory=MEMBRANE, resolution=REFINED))
    pressure = force / (np.pi * radius**2)
    expected = 1.7244 / 4.0 * np.cbrt(pressure**2 * film.radius**2 * film.young * film.thickness)
    centre = touch_stress(solved, np.zeros((1, 2)))[0] * film.thickness
    np.testing.assert_allclose(centre[:2], expected, rtol=1e-4)
