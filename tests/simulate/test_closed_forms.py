"""Rung 4 of the ladder: solutions on paper, and the axisymmetric membrane as a boundary value problem for scipy."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from isocharge.simulate import Circle, Film, Resolution, load_sensor, press, touch_charge

REFINED = Resolution(order=7, around=8, rings=6)
SLACK = Film(radius=45e-3, thickness=25e-6, young=3e9, poisson=0.34)
TAUT = replace(SLACK, pretension=1e6)


def ring(radius: float, count: int = 7) -> np.ndarray:
    """Points on a circle about the origin, shape (count, 2)."""
    angle = 0.3 + 2.0 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def radial_and_hoop(stress: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(s_r, s_theta, s_r_theta) about the origin."""
    c, s = (points / np.linalg.norm(points, axis=1, keepdims=True)).T
    s11, s22, s12 = stress.T
    return (
        c * c * s11 + s * s * s22 + 2 * c * s * s12,
        s * s * s11 + c * c * s22 - 2 * c * s * s12,
        c * s * (s22 - s11) + (c * c - s * s) * s12,
    )


# Schwerin (1929): point load, Poisson 1/3


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_schwerin_point_load(share):
    """w = k (1 - (r/a)^(2/3)), N_r = 3 F / (4 pi k) (r/a)^(-2/3), N_theta = N_r / 3, away from a small probe."""
    film, force = replace(SLACK, poisson=1.0 / 3.0), 1e-6
    solved = press(film, Circle(2e-5), (0.0, 0.0), force, resolution=Resolution(6, 8, 10))
    k = np.cbrt(3.0 / np.pi * force * film.radius**2 / (film.young * film.thickness))
    points = ring(share * film.radius)
    np.testing.assert_allclose(solved.deflection(points), k * (1.0 - share ** (2 / 3)), rtol=2e-5)
    radial, hoop, shear = radial_and_hoop(solved.touch_stress(points) * film.thickness, points)
    expected = 3.0 * force / (4.0 * np.pi * k) * share ** (-2 / 3)
    np.testing.assert_allclose(radial, expected, rtol=2e-5)
    np.testing.assert_allclose(hoop, expected / 3.0, rtol=1e-4)
    np.testing.assert_allclose(shear, 0.0, atol=1e-5 * expected)


# The linear membrane: a tension so large that the press does not change it


def green(film: Film, at: complex, points: np.ndarray) -> np.ndarray:
    """Deflection per force outside the footprint: Green's function is harmonic, so a disk pulls like a point."""
    z, c = (points[:, 0] + 1j * points[:, 1]) / film.radius, at / film.radius
    tension = film.pretension * film.thickness
    return np.log(np.abs((1.0 - np.conj(c) * z) / (z - c))) / (2.0 * np.pi * tension)


@pytest.mark.parametrize("at", [(0.0, 0.0), (8e-3, -5e-3), (-20e-3, 10e-3)])
@pytest.mark.parametrize("radius", [1e-3, 4e-3])
def test_taut_membrane_outside_the_footprint(at, radius):
    solved = press(TAUT, Circle(radius), at, 1e-6, resolution=REFINED)
    rng = np.random.default_rng(0)
    points = np.concatenate([ring(0.5 * TAUT.radius), ring(0.95 * TAUT.radius), rng.uniform(-25e-3, 25e-3, (30, 2))])
    points = points[np.hypot(*(points - at).T) > radius]
    expected = 1e-6 * green(TAUT, complex(*at), points)
    np.testing.assert_allclose(solved.deflection(points), expected, atol=1e-6 * expected.max())


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9])
def test_taut_membrane_under_a_centred_disk(share):
    """w(0) = F / (2 pi T) (ln(a / R) + 1/2)."""
    solved = press(TAUT, Circle(share * TAUT.radius), (0.0, 0.0), 1e-6, resolution=REFINED)
    expected = 1e-6 / (2.0 * np.pi * TAUT.pretension * TAUT.thickness) * (np.log(1.0 / share) + 0.5)
    assert solved.deflection(np.zeros((1, 2)))[0] == pytest.approx(expected, rel=1e-7)


# The axisymmetric membrane, von Karman's (1910) at a tiny force and Green-Lagrange's at any, integrated by scipy


@dataclass(frozen=True)
class Axisymmetric:
    """Scaled solution at the radii r / a."""

    deflection: np.ndarray
    radial: np.ndarray
    hoop: np.ndarray


def axisymmetric(share: float, amplitude2: float, poisson: float, tension: float, at: np.ndarray) -> Axisymmetric:
    """Solve for (u, phi = r S_r (1 + A^2 u'), w) in the scaled variables of isocharge.simulate.membrane, load one.

    Radial balance is phi' = S_theta (1 + A^2 u / r), vertical balance r S_r w' = - min(1, (r / R)^2) / 2 pi.
    """
    plane, start = 1.0 / (1.0 - poisson**2), 1e-4

    def fields(r: np.ndarray, u: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, ...]:
        """u', w', S_r, S_theta: one scalar equation per radius, by Newton from von Karman's answer."""
        hoop_strain = u / r + 0.5 * amplitude2 * (u / r) ** 2
        tilt = -np.minimum(1.0, (r / share) ** 2) / (2.0 * np.pi * phi)  # w' over 1 + A^2 u'
        slope = np.zeros_like(r)
        for _ in range(30):
            stretch = 1.0 + amplitude2 * slope
            radial = plane * (slope + 0.5 * amplitude2 * slope**2 + 0.5 * (tilt * stretch) ** 2 + poisson * hoop_strain)
            radial += tension
            by_slope = plane * stretch * (1.0 + amplitude2 * tilt**2)
            slope -= (radial * stretch - phi / r) / (by_slope * stretch + amplitude2 * radial)
        hoop = hoop_strain + poisson * (radial - tension) + tension
        return slope, tilt * stretch, radial, hoop

    def equations(r: np.ndarray, y: np.ndarray) -> np.ndarray:
        slope, fall, _, hoop = fields(r, y[0], y[1])
        return np.stack([slope, hoop * (1.0 + amplitude2 * y[0] / r), fall])

    def ends(inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
        """At the centre radial and hoop stretch are one; the rim is clamped."""
        slope = fields(np.array([start]), inner[:1], inner[1:2])[0][0]
        return np.array([slope - inner[0] / start, outer[0], outer[2]])

    r = np.unique(np.concatenate([np.geomspace(start, 1.0, 200), np.linspace(start, share, 50), [share]]))
    bend = np.cbrt(r**2 + share**2)
    guess = np.stack([0.1 * r * (1 - r), (0.3 / bend + tension) * r, 0.8 * (bend[-1] - bend)])
    found = solve_bvp(equations, ends, r, guess, tol=1e-9, max_nodes=100_000)
    assert found.success, found.message
    u, phi, w = found.sol(at)
    _, _, radial, hoop = fields(at, u, phi)
    return Axisymmetric(w, radial - tension, hoop - tension)


@pytest.mark.parametrize(
    ("share", "force", "poisson", "tension"),
    [
        (0.02, 1e-7, 0.34, 0.0),  # von Karman
        (0.5, 1e-7, 0.34, 0.0),
        (0.98, 1e-7, 0.3, 0.0),
        (0.02, 1e-7, 0.34, 0.4),
        (0.02, 5.0, 0.34, 0.0),  # Green-Lagrange, A^2 = 0.013
        (0.3, 100.0, 0.34, 0.2),  # far beyond any film: A^2 = 0.1
    ],
)
def test_axisymmetric_membrane(share, force, poisson, tension):
    amplitude2 = np.cbrt(force / (SLACK.young * SLACK.thickness * SLACK.radius)) ** 2
    film = replace(SLACK, poisson=poisson, pretension=tension * SLACK.young * amplitude2)
    solved = press(film, Circle(share * film.radius), (0.0, 0.0), force, resolution=REFINED)
    at = np.array([0.005, 0.015, 0.1, 0.4, 0.8, 0.97])
    expected = axisymmetric(share, amplitude2, poisson, tension, at)
    for i, r in enumerate(at):
        points = ring(r * film.radius)
        radial, hoop, shear = radial_and_hoop(solved.touch_stress(points) / (film.young * amplitude2), points)
        deflection = solved.deflection(points) / (film.radius * np.sqrt(amplitude2))
        np.testing.assert_allclose(deflection, expected.deflection[i], rtol=3e-6)
        np.testing.assert_allclose(radial, expected.radial[i], rtol=3e-5)
        np.testing.assert_allclose(hoop, expected.hoop[i], rtol=1e-4)
        np.testing.assert_allclose(shear, 0.0, atol=3e-5 * expected.radial[i])


def test_hencky():
    """A probe over the whole film is a uniform dead pressure q: N_r(0) = b0 / 4 (q^2 a^2 E h)^(1/3) with
    b0 = 1.7244 at Poisson 0.3 (Hencky 1915; digits of Fichter 1997)."""
    film, force, radius = replace(SLACK, poisson=0.3), 1e-6, 0.9999 * SLACK.radius
    solved = press(film, Circle(radius), (0.0, 0.0), force, resolution=REFINED)
    pressure = force / (np.pi * radius**2)
    expected = 1.7244 / 4.0 * np.cbrt(pressure**2 * film.radius**2 * film.young * film.thickness)
    centre = solved.touch_stress(np.zeros((1, 2)))[0] * film.thickness
    np.testing.assert_allclose(centre[:2], expected, rtol=1e-4)


def test_charge_of_a_centred_press_is_the_integral_of_the_boundary_value_problem():
    """The output itself: electrode A integrated over from scipy's stresses, no code of ours but the solve."""
    sensor, force = load_sensor("four-25um-uniaxial"), 1.0
    amplitude2 = np.cbrt(force / (SLACK.young * SLACK.thickness * SLACK.radius)) ** 2
    charge = touch_charge(sensor, press(sensor.film, Circle(1e-3), (0.0, 0.0), force, resolution=REFINED))[0]
    x, y = np.meshgrid(np.linspace(8.5e-3, 11.5e-3, 41), np.linspace(-1.5e-3, 1.5e-3, 41))
    r, c2 = np.hypot(x, y), x**2 / (x**2 + y**2)
    order = np.argsort(r.ravel())
    solution = axisymmetric(1.0 / 45.0, amplitude2, 0.34, 0.0, r.ravel()[order] / 45e-3)
    radial, hoop = np.empty(r.size), np.empty(r.size)
    radial[order], hoop[order] = solution.radial, solution.hoop
    density = 20.0 * (radial * c2.ravel() + hoop * (1 - c2.ravel())) + 2.0 * (
        radial * (1 - c2.ravel()) + hoop * c2.ravel()
    )
    simpson = np.array([1.0, *([4.0, 2.0] * 19), 4.0, 1.0]) / 120.0
    expected = 9e-6 * 1e-12 * SLACK.young * amplitude2 * (simpson @ density.reshape(41, 41) @ simpson)
    assert charge == pytest.approx(expected, rel=1e-5)
