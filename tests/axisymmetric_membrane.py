"""Membranes with which the finite elements are compared: Green's function, and boundary value problems of SciPy."""

import numpy as np
from scipy.integrate import solve_bvp

from isocharge.simulate import Film


def harmonic(z: np.ndarray, c: complex) -> np.ndarray:
    """Return Green's function of a clamped disk, in units of F / T with the tension T: the load and its image.

    The positions z of the deflection and c of the point load are complex numbers x + i y in film radii.
    """
    return np.log(np.abs((1.0 - np.conj(c) * z) / (z - c))) / (2.0 * np.pi)


def axisymmetric_membrane(film: Film, probe_radius: float, force: float):
    """Solve a membrane under a force on a disk at its centre, N.

    The unknowns are u, phi = r S_r (1 + A^2 u') and w in the scaled variables of mechanics.energy, for the load one.
    The radial balance is phi' = S_theta (1 + A^2 u / r). The vertical balance is r S_r w' = -L(r) / 2 pi with the load
    L within the radius r.

    Returns:
        Function from distances from the centre, shape (n,), mm, to the deflection, mm, and the changes of the radial
        and of the hoop stress, MPa, shape (3, n).
    """
    share = probe_radius / film.radius
    squared_amplitude = np.cbrt(force / (film.young * film.thickness * film.radius)) ** 2
    poisson = film.poisson
    plane = 1.0 / (1.0 - poisson**2)
    tension = film.pretension / (film.young * squared_amplitude)
    start = 1e-4

    def fields(r: np.ndarray, u: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return u', w', S_r and S_theta, shapes (n,).

        The slope u' is the solution of one equation for each radius. Newton's method begins at u' = 0.
        """
        load = np.minimum(1.0, (r / share) ** 2)
        hoop_strain = u / r + 0.5 * squared_amplitude * (u / r) ** 2
        tilt = -load / (2.0 * np.pi * phi)  # w' over 1 + A^2 u'
        slope = np.zeros_like(r)
        for _ in range(30):
            stretch = 1.0 + squared_amplitude * slope
            radial = plane * (
                slope + 0.5 * squared_amplitude * slope**2 + 0.5 * (tilt * stretch) ** 2 + poisson * hoop_strain
            )
            radial += tension
            by_slope = plane * stretch * (1.0 + squared_amplitude * tilt**2)
            slope -= (radial * stretch - phi / r) / (by_slope * stretch + squared_amplitude * radial)
        hoop = hoop_strain + poisson * (radial - tension) + tension
        return slope, tilt * stretch, radial, hoop

    def equations(r: np.ndarray, y: np.ndarray) -> np.ndarray:
        slope, fall, _, hoop = fields(r, y[0], y[1])
        return np.stack([slope, hoop * (1.0 + squared_amplitude * y[0] / r), fall])

    def ends(inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
        """Return the residuals of the boundary conditions.

        At the centre, the radial and the hoop stretch are equal. The rim is clamped.
        """
        slope = fields(np.array([start]), inner[:1], inner[1:2])[0][0]
        return np.array([slope - inner[0] / start, outer[0], outer[2]])

    r = np.unique(np.concatenate([np.geomspace(start, 1.0, 200), np.linspace(start, share, 50), [share]]))
    bend = np.cbrt(r**2 + share**2)
    guess = np.stack([0.1 * r * (1 - r), (0.3 / bend + tension) * r, 0.8 * (bend[-1] - bend)])
    found = solve_bvp(equations, ends, r, guess, tol=1e-9, max_nodes=100_000)
    assert found.success, found.message

    def at(distance_mm: np.ndarray) -> np.ndarray:
        scaled = np.maximum(distance_mm / film.radius, start)
        u, phi, w = found.sol(scaled)
        _, _, radial, hoop = fields(scaled, u, phi)
        stresses = film.young * squared_amplitude * (np.stack([radial, hoop]) - tension)
        return np.stack([film.radius * np.sqrt(squared_amplitude) * w, *stresses])

    return at
