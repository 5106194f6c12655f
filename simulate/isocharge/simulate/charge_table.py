"""Charges as splines of the position: a forward map tabled once, so that contours and their meetings are cheap.

A cubic spline in (x, y) for every electrode and force node, fitted by least squares to presses inside the disk that the
map covers; between the force nodes the polynomial in ln F that the map itself interpolates with. Charge, slope and
derivative by force come from one evaluation and are continuous, which Newton needs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import NdBSpline
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import splu

from isocharge.errors import SceneError
from isocharge.simulate.arrays import Array
from isocharge.simulate.forward import ForwardMap
from isocharge.simulate.sampling import lattice
from isocharge.simulate.scaling import amplitude_squared
from isocharge.simulate.sensor import Film
from isocharge.simulate.spectral import barycentric_weights, chebyshev_nodes, lagrange_values

SPACING = 0.3e-3
"""Distance of knots, m."""

OVERSAMPLING = 1.6
"""Presses for each cell of the spline's grid."""

STIFFNESS = 1e-5
"""Weight of the coefficients' third differences in the fit: holds those outside the disk, which no press reaches."""

FORCES = 9
"""Force nodes where d33 counts."""

CHECKS = 200
"""Presses that a table is compared with."""

Forward = Callable[[Array, Array, Array], Array]
"""(x, y, force) of shape (n,), SI, to charges of shape (n, n_electrode)."""


@dataclass(frozen=True)
class ChargeTable:
    """Charges of every electrode over a disk of positions and a range of forces, for one probe as it is turned.

    Attributes:
        electrodes: Names, in the order of the charges.
        film: Its amplitude scales the charges between forces.
        radius: Positions up to this distance from the centre are covered, m.
        force: Nodes in the force, shape (n_force,), N.
        force_range: Smallest and largest force covered, N.
        knots: Of both axes, m.
        coefficients: Of the scaled charges, shape (n_knot, n_knot, n_force, n_electrode).
        error: Largest difference from the map over CHECKS presses, over the press's largest charge.
    """

    electrodes: tuple[str, ...]
    film: Film
    radius: float
    force: Array
    force_range: tuple[float, float]
    knots: Array
    coefficients: Array
    error: float

    @classmethod
    def of(cls, forward_map: ForwardMap, radius: float | None = None, spacing: float = SPACING) -> "ChargeTable":
        """Table a forward map over its disk, or a smaller one of `radius` (m), with knots `spacing` (m) apart.

        Raises:
            SceneError: If the radius is not positive or reaches beyond the map.
        """
        radius = forward_map.radius if radius is None else radius
        if not 0.0 < radius <= forward_map.radius * (1.0 + 1e-9):
            raise SceneError(
                f"radius: expected up to the forward map's {forward_map.radius * 1e3:g} mm, got {radius * 1e3:g} mm"
            )
        sensor, force = forward_map.sensor, _force_nodes(forward_map)
        return cls.fit(
            forward_map.forward, sensor.electrode_names, sensor.film, radius, force, forward_map.force_range, spacing
        )

    @classmethod
    def fit(
        cls,
        forward: Forward,
        electrodes: tuple[str, ...],
        film: Film,
        radius: float,
        force: Array,
        force_range: tuple[float, float],
        spacing: float = SPACING,
    ) -> "ChargeTable":
        """Table any function of (x, y, force): least squares on a lattice and along the disk's edge."""
        at = _samples(radius, spacing)
        cells = max(4, int(np.ceil(2.0 * radius / spacing)))
        knots = np.concatenate([[-radius] * 3, np.linspace(-radius, radius, cells + 1), [radius] * 3])
        columns = [forward(at[:, 0], at[:, 1], np.full(len(at), f)) / _scale(film, f) for f in force]
        target = np.stack(columns, axis=1).reshape(len(at), -1)
        fitted = _least_squares(at, target, knots)
        coefficients = fitted.reshape(cells + 3, cells + 3, force.size, len(electrodes))
        made = cls(electrodes, film, radius, force, force_range, knots, coefficients, np.nan)
        error = _error_against(forward, made)
        return cls(electrodes, film, radius, force, force_range, knots, coefficients, error)

    def charge(self, at: Array, force: Array | float) -> Array:
        """Touch charges of presses at (x, y), shape (n, 2), m, with forces of shape (n,), N; (n, n_electrode), C."""
        weights = self.force_weights(np.broadcast_to(np.asarray(force, dtype=float), len(at)))
        charge: Array = np.einsum("nf,nfe->ne", weights, self.scaled(at))
        return charge

    def slopes(self, at: Array, force: Array | float) -> tuple[Array, Array, Array]:
        """Charges and their derivatives.

        Args:
            at: (x, y), shape (n, 2), m; moved onto the disk's edge where outside.
            force: Shape (n,) or a number, N.

        Returns:
            Charges (n, n_electrode), C; d/d(x, y), shape (n, n_electrode, 2), C/m; d/d(ln F), (n, n_electrode), C.
        """
        at, force = onto_disk(at, self.radius), np.broadcast_to(np.asarray(force, dtype=float), len(at))
        weights, step = self.force_weights(force), 1e-4
        change = (self.force_weights(force * np.exp(step)) - self.force_weights(force * np.exp(-step))) / (2.0 * step)
        nodal = self._spline(at)
        charge = np.einsum("nf,nfe->ne", weights, nodal)
        by_place = [np.einsum("nf,nfe->ne", weights, self._spline(at, nu=nu)) for nu in ((1, 0), (0, 1))]
        return charge, np.stack(by_place, axis=-1), np.einsum("nf,nfe->ne", change, nodal)

    @cached_property
    def _spline(self) -> NdBSpline:
        return NdBSpline((self.knots, self.knots), self.coefficients, 3)

    def scaled(self, at: Array) -> Array:
        """Charges at the force nodes over `scale`, at positions of shape (n, 2), m; (n, n_force, n_electrode)."""
        scaled: Array = self._spline(onto_disk(at, self.radius))
        return scaled

    def scale(self, force: Array) -> Array:
        """What charges go with, near enough for a polynomial in ln F to do the rest: C, the shape of `force` (N)."""
        return _scale(self.film, force)

    def force_weights(self, force: Array) -> Array:
        """What each force node adds to the charges at forces of shape (n,), N; shape (n, n_force), C."""
        logs = np.log(self.force)
        weights: Array = lagrange_values(logs, barycentric_weights(logs), np.log(force))
        return weights * _scale(self.film, force)[:, None]


def _force_nodes(forward_map: ForwardMap) -> Array:
    """The map's own, between which it is a polynomial; more where the contact pressure (d33) goes another way."""
    low, high = np.log(forward_map.force_range)
    if forward_map.sensor.piezo.d33 == 0.0 or low == high:
        return forward_map.family.force
    nodes: Array = np.exp(chebyshev_nodes(FORCES, low, high))
    return nodes


def onto_disk(at: Array, radius: float) -> Array:
    """Positions (x, y), shape (n, 2), those outside the disk moved onto its edge; m."""
    onto: Array = at / np.maximum(1.0, np.hypot(at[:, 0], at[:, 1]) / radius)[:, None]
    return onto


def _scale(film: Film, force: Array) -> Array:
    scale: Array = film.young * amplitude_squared(film, np.asarray(force, dtype=float)) * 1e-12
    return scale


def _samples(radius: float, spacing: float) -> Array:
    """Presses to fit to: a lattice and the disk's edge, shape (n, 2), m."""
    inner = lattice(int(OVERSAMPLING * np.pi * (radius / spacing) ** 2) + 16)
    edge = np.exp(2j * np.pi * np.arange(n := int(2.0 * np.pi * radius / spacing) + 8) / n) * (1.0 - 1e-12)
    at = radius * np.concatenate([inner, edge])
    return np.stack([at.real, at.imag], axis=1)


def _least_squares(at: Array, target: Array, knots: Array) -> Array:
    """Spline coefficients, shape (n_knot^2, n_target): normal equations, with third differences held small."""
    count = knots.size - 4
    found = NdBSpline.design_matrix(at, (knots, knots), 3)  # as wide as its last entry
    design = csr_array((found.data, found.indices, found.indptr), shape=(len(at), count**2))
    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))
    smooth = STIFFNESS * vstack([kron(third, eye_array(count)), kron(eye_array(count), third)])
    normal = (design.T @ design + smooth.T @ smooth).tocsc()
    solved: Array = splu(normal, permc_spec="MMD_AT_PLUS_A").solve(np.ascontiguousarray(design.T @ target))
    return solved


def _error_against(forward: Forward, made: ChargeTable) -> float:
    at = made.radius * lattice(CHECKS) * np.exp(0.3j)
    logs = np.log(made.force_range)
    force = np.clip(np.exp(logs[0] + (logs[1] - logs[0]) * ((0.618 * np.arange(at.size)) % 1.0)), *made.force_range)
    direct = forward(at.real, at.imag, force)
    made_up = made.charge(np.stack([at.real, at.imag], axis=1), force)
    return float((np.abs(made_up - direct).max(axis=1) / np.abs(direct).max(axis=1)).max())
