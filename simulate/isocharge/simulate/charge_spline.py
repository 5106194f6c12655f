"""The forward map as splines: the same charges some two hundred times faster, and their derivatives.

Charges over the amplitude's square, which takes most of the force out of them (`isocharge.simulate.scaling`), are
tabulated on a polar grid, cubic splines along both directions, and at a few forces, Lagrange's polynomials in the
logarithm. A forward map interpolates its fields between forces in the same way, so there its own nodes lose nothing.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import NdBSpline, make_interp_spline

from isocharge.errors import SceneError
from isocharge.simulate.arrays import Array, Complexes
from isocharge.simulate.forward import ForwardMap
from isocharge.simulate.sampling import sunflower
from isocharge.simulate.scaling import amplitude_squared
from isocharge.simulate.sensor import Film
from isocharge.simulate.spectral import barycentric_weights, lagrange_values

STEPS = (16, 400)
"""Fewest and most radial steps of the table."""

CHECKS = 400
"""Presses at which the table is compared with its forward map."""

STRIDE = 1e-4
"""Relative step in force of its derivative."""


@dataclass(frozen=True)
class ChargeSpline:
    """Touch charges as a function of (x, y, F).

    Attributes:
        film: For the amplitude that scales the charges.
        radius: Largest distance from the centre, m.
        force_range: Smallest and largest force, N.
        force: Forces of the table, shape (n_force,), N.
        pressed: Whether a further term goes with the force itself: the contact pressure on electrodes (d33).
        table: Scaled charge over distance and angle, values of shape (n_term, n_electrode).
        error: Largest error against the forward map, relative to a press's largest charge.
    """

    film: Film
    radius: float
    force_range: tuple[float, float]
    force: Array
    pressed: bool
    table: NdBSpline
    error: float

    @classmethod
    def of(cls, forward_map: ForwardMap, spacing: float | None = None) -> "ChargeSpline":
        """Tabulate a forward map: 2 s for 8 mm under a probe of 1 mm, 4 s for 10 mm.

        Args:
            forward_map: The charges; the orientation of the probe is the one it was built with.
            spacing: Of the grid, m; a sixth of the probe's reach if absent.
        """
        radius, film, force = forward_map.radius, forward_map.sensor.film, forward_map.family.force
        pressed = forward_map.sensor.piezo.d33 != 0.0
        steps = int(np.clip(round(radius / (spacing or forward_map.probe.reach / 6.0)), *STEPS))
        distance, angle = np.linspace(0.0, radius, steps + 1), np.linspace(0.0, 2.0 * np.pi, 6 * steps + 1)
        at = np.outer(distance, np.exp(1j * angle[:-1]))
        terms = _terms(forward_map, at.ravel(), force, pressed).reshape(*at.shape, force.size + pressed, -1)
        table = _polar_spline(distance, angle, terms)
        made = cls(film, radius, forward_map.force_range, force, pressed, table, np.nan)
        return replace(made, error=_difference(made, forward_map))

    @property
    def electrodes(self) -> int:
        """How many charges a press gives."""
        return int(self.table.c.shape[-1])

    def charge(self, contact: Array) -> Array:
        """Touch charges, shape (n, n_electrode), C, of contacts (x, y, F), shape (n, 3), m and N.

        Raises:
            SceneError: If a contact lies outside the radius or the forces.
        """
        self._check_inside(contact)
        charge: Array = np.einsum("nk,nke->ne", self.by_force(np.log(contact[:, 2])), self.terms(contact[:, :2]))
        return charge

    def jacobian(self, contact: Array) -> Array:
        """d(Q)/d(x, y, ln F) of contacts (x, y, F): shape (n, 3) to (n, n_electrode, 3), C/m, C/m and C."""
        self._check_inside(contact)
        logs = np.log(contact[:, 2])
        slope = np.einsum("nk,nkei->nei", self.by_force(logs), self.slopes(contact[:, :2]))
        apart = (self.by_force(logs + STRIDE) - self.by_force(logs - STRIDE)) / (2.0 * STRIDE)
        by_force = np.einsum("nk,nke->ne", apart, self.terms(contact[:, :2]))
        return np.concatenate([slope, by_force[..., None]], axis=2)

    def by_force(self, logs: Array) -> Array:
        """Weights of the table's forces at logarithms of forces, shape (...) to (..., n_term): Q = weights @ terms."""
        nodes = np.log(self.force)
        weights = lagrange_values(nodes, barycentric_weights(nodes), logs.ravel())
        weights *= amplitude_squared(self.film, np.exp(logs.ravel()))[:, None]
        if self.pressed:
            weights = np.concatenate([weights, _own_scale(self.film) * np.exp(logs.ravel())[:, None]], axis=1)
        return weights.reshape(*logs.shape, -1) if logs.size else np.empty((*logs.shape, weights.shape[1]))

    def terms(self, position: Array) -> Array:
        """Scaled charges at the table's forces: positions (x, y), shape (n, 2), m, to (n, n_term, n_electrode)."""
        terms: Array = self.table(_polar(position))
        return terms

    def slopes(self, position: Array) -> Array:
        """Their derivatives by x and y, shape (n, n_term, n_electrode, 2), 1/m."""
        polar = _polar(position)
        polar[:, 0] = np.maximum(polar[:, 0], 1e-6 * self.radius)  # at the very centre the angle says nothing
        distance, angle = polar[:, 0, None, None], polar[:, 1, None, None]
        radial, around = self.table(polar, nu=(1, 0)), self.table(polar, nu=(0, 1)) / distance
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack([cos * radial - sin * around, sin * radial + cos * around], axis=-1)

    def _check_inside(self, contact: Array) -> None:
        low, high = self.force_range
        distance, force, slack = np.hypot(contact[:, 0], contact[:, 1]), contact[:, 2], 1.0 + 1e-9
        wrong = ~((distance <= self.radius * slack) & (force >= low / slack) & (force <= high * slack))
        if wrong.any():
            i = int(np.argmax(wrong))
            raise SceneError(
                f"contact {i}, {1e3 * distance[i]:.4g} mm from the centre with {force[i]:.4g} N, is outside the table: "
                f"expected at most {self.radius * 1e3:g} mm and {low:g} to {high:g} N"
            )


def _terms(forward_map: ForwardMap, at: Complexes, force: Array, pressed: bool) -> Array:
    """Scaled charges at positions x + iy, shape (n,), for every force, and the contact pressure's: (n, n_term, ...)."""
    sensor = forward_map.sensor
    stretched = replace(forward_map, sensor=replace(sensor, piezo=replace(sensor.piezo, d33=0.0)))
    rows = [stretched.forward(at.real, at.imag, np.full(at.size, f)) for f in force]
    terms = [row / amplitude_squared(sensor.film, f) for row, f in zip(rows, force, strict=True)]
    if pressed:
        most = force[-1]
        contact = forward_map.forward(at.real, at.imag, np.full(at.size, most)) - rows[-1]
        terms.append(contact / (_own_scale(sensor.film) * most))
    return np.stack(terms, axis=1)


def _own_scale(film: Film) -> float:
    """What makes a term that goes with the force as large as those that go with the amplitude's square, at 1 N."""
    return float(amplitude_squared(film, 1.0))


def _polar(position: Array) -> Array:
    """Distance and angle from 0 to a full turn, shape (n, 2)."""
    x, y = np.asarray(position, dtype=float).T
    return np.stack([np.hypot(x, y), np.mod(np.arctan2(y, x), 2.0 * np.pi)], axis=1)


def _polar_spline(distance: Array, angle: Array, values: Array) -> NdBSpline:
    """Cubic, periodic in the angle; values of shape (n_distance, n_angle - 1, ...), the full turn not repeated."""
    closed = np.concatenate([values, values[:, :1]], axis=1)
    radial = make_interp_spline(distance, closed, k=3)
    around = make_interp_spline(angle, np.moveaxis(radial.c, 1, 0), k=3, bc_type="periodic")
    return NdBSpline((radial.t, around.t), np.ascontiguousarray(np.moveaxis(around.c, 0, 1)), 3)


def _difference(made: ChargeSpline, forward_map: ForwardMap) -> float:
    """Largest error at presses that are spread evenly but off the grid."""
    number = np.arange(CHECKS)
    at = made.radius * sunflower(CHECKS)
    low, high = made.force_range
    force = np.clip(low * (high / low) ** (number * 0.618 % 1.0), low, high)
    truth = forward_map.forward(at.real, at.imag, force)
    apart = made.charge(np.stack([at.real, at.imag, force], axis=1)) - truth
    return float((np.abs(apart).max(axis=1) / np.abs(truth).max(axis=1)).max())
