"""The forward map as splines: the same charges some two hundred times faster, and their derivatives.

Charges over the amplitude's square, which takes most of the force out of them (`mechanics.scaling`), are
tabulated at a few forces, each a cubic spline in (x, y) that is fitted by least squares to presses on the disk, so that
no place is singular. Between the forces Lagrange polynomials in ln F interpolate. A forward map interpolates its fields
between forces in the same way, so at its force nodes nothing is lost.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import NdBSpline
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import splu

from isocharge.common.arrays import Array
from isocharge.simulate.forward.checks import check_presses, check_radius
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.numerics.disk import lattice, onto_disk, sunflower
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Film

SPACING, SHARE = 0.3e-3, 1.0 / 6.0
"""Distance of the knots: at most SPACING, m, and at most SHARE of the probe's reach, on which the charges vary."""

CELLS = (8, 400)
"""Fewest and most cells of the spline across the disk."""

OVERSAMPLING, ON_EDGE = 1.6, 2.0
"""Presses to fit per cell of the disk, and per cell along its edge, where the spline has presses on one side only."""

STIFFNESS = 5e-3
"""Weight of the third differences of the coefficients in the fit, dimensionless: it determines the coefficients at the
disk's edge, which few presses reach."""

MORE_FORCES = 2
"""Additional force nodes with d33: its charges are proportional to the force, not to the squared amplitude. The error
is then at most 1e-4 of them."""

CHECKS = 400
"""Presses at which the table is compared with the function it tabulates."""

STRIDE = 1e-4
"""Step in ln F of the derivative by ln F, dimensionless."""

Forward = Callable[[Array, Array, Array], Array]
"""(x, y, force) of shape (n,), SI, to charges of shape (n, n_electrode)."""


@dataclass(frozen=True)
class ChargeSpline:
    """Touch charges as a function of (x, y, F), for one probe in one orientation.

    Attributes:
        electrode_names: In the order of the charges.
        film: For the amplitude that scales the charges.
        radius: Largest distance from the centre, m.
        force_range: Smallest and largest force, N.
        force: Forces of the table, shape (n_term,), N.
        table: Scaled charge over x and y, values of shape (n_term, n_electrode).
        error: Largest error against the tabulated function, relative to a press's largest charge.
    """

    electrode_names: tuple[str, ...]
    film: Film
    radius: float
    force_range: tuple[float, float]
    force: Array
    table: NdBSpline
    error: float

    @classmethod
    def of(cls, forward_map: ForwardMap, radius: float | None = None, spacing: float | None = None) -> "ChargeSpline":
        """Tabulate a forward map: 2 s for 8 mm under a probe of 1 mm, 4 s for 10 mm.

        Args:
            forward_map: The charges; the orientation of the probe is the one it was built with.
            radius: Up to this distance from the centre, m; as far as the map reaches if absent.
            spacing: Of the knots, m; a sixth of the probe's reach, at most SPACING, if absent.

        Raises:
            SceneError: If the radius is not positive or reaches beyond the map.
        """
        radius = forward_map.radius if radius is None else radius
        check_radius(radius, forward_map.radius, "forward map")
        spacing = spacing or min(SPACING, SHARE * forward_map.probe.reach)
        sensor, force = forward_map.sensor, _force_nodes(forward_map)
        return cls.fit(
            forward_map.forward, sensor.electrode_names, sensor.film, radius, force, forward_map.force_range, spacing
        )

    @classmethod
    def fit(
        cls,
        forward: Forward,
        electrode_names: tuple[str, ...],
        film: Film,
        radius: float,
        force: Array,
        force_range: tuple[float, float],
        spacing: float,
    ) -> "ChargeSpline":
        """Tabulate any function of (x, y, force): least squares on a lattice and along the disk's edge."""
        cells = int(np.clip(np.ceil(2.0 * radius / spacing), *CELLS))
        at = radius * _samples(cells)
        columns = [forward(at[:, 0], at[:, 1], np.full(len(at), f)) / amplitude_squared(film, float(f)) for f in force]
        table = _least_squares(at, np.stack(columns, axis=1), radius, cells)
        spline = cls(electrode_names, film, radius, force_range, force, table, np.nan)
        return replace(spline, error=_largest_error(spline, forward))

    @property
    def electrodes(self) -> int:
        """Number of electrodes."""
        return len(self.electrode_names)

    def charge(self, contact: Array) -> Array:
        """Touch charges, shape (n, n_electrode), C, of contacts (x, y, F), shape (n, 3), m and N.

        Raises:
            SceneError: If a contact lies outside the radius or the forces.
        """
        self._check_inside(contact)
        charge: Array = np.einsum("nk,nke->ne", self.by_force(np.log(contact[:, 2])), self.terms(contact[:, :2]))
        return charge

    def jacobian(self, contact: Array) -> Array:
        """d(Q)/d(x, y, ln F) of contacts (x, y, F): shape (n, 3) to (n, n_electrode, 3), C/m, C/m and C.

        Raises:
            SceneError: If a contact lies outside the radius or the forces.
        """
        self._check_inside(contact)
        _, slope, by_force = self.first_order(contact[:, :2], contact[:, 2])
        return np.concatenate([slope, by_force[..., None]], axis=2)

    def first_order(self, position: Array, force: Array | float) -> tuple[Array, Array, Array]:
        """Charges and their derivatives, wherever Newton's method steps.

        Args:
            position: (x, y), shape (n, 2), m; moved onto the disk's edge where outside.
            force: Shape (n,) or a number, N.

        Returns:
            Charges (n, n_electrode), C; d/d(x, y), shape (n, n_electrode, 2), C/m; d/d(ln F), (n, n_electrode), C.
        """
        position, logs = onto_disk(position, self.radius), np.log(np.broadcast_to(force, len(position)))
        weights, terms = self.by_force(logs), self.terms(position)
        change = (self.by_force(logs + STRIDE) - self.by_force(logs - STRIDE)) / (2.0 * STRIDE)
        slope = np.einsum("nk,nkei->nei", weights, self.slopes(position))
        return np.einsum("nk,nke->ne", weights, terms), slope, np.einsum("nk,nke->ne", change, terms)

    def scale(self, force: Array | float) -> Any:
        """Approximate dependence of the charges on the force (N), dimensionless; a polynomial in ln F corrects it."""
        return amplitude_squared(self.film, force)

    def by_force(self, logs: Array) -> Array:
        """Weights of the table's forces at logarithms of forces, shape (...) to (..., n_term): Q = weights @ terms."""
        nodes = np.log(self.force)
        weights = lagrange_values(nodes, barycentric_weights(nodes), logs.ravel())
        weights *= self.scale(np.exp(logs.ravel()))[:, None]
        return weights.reshape(*logs.shape, nodes.size)

    def terms(self, position: Array) -> Array:
        """Scaled charges at the table's forces: positions (x, y), shape (n, 2), m, to (n, n_term, n_electrode)."""
        terms: Array = self.table(position)
        return terms

    def slopes(self, position: Array) -> Array:
        """Derivatives of `terms` by x and y, shape (n, n_term, n_electrode, 2), 1/m."""
        return np.stack([self.table(position, nu=nu) for nu in ((1, 0), (0, 1))], axis=-1)

    def _check_inside(self, contact: Array) -> None:
        check_presses(*contact.T, radius=self.radius, force_range=self.force_range, source="table")


def _force_nodes(forward_map: ForwardMap) -> Array:
    """Force nodes of the forward map, between which it is a polynomial; more of them with d33."""
    low, high = np.log(forward_map.force_range)
    if forward_map.sensor.piezo.d33 == 0.0 or low == high:
        return forward_map.family.force
    nodes: Array = np.exp(chebyshev_nodes(forward_map.family.force.size + MORE_FORCES, low, high))
    return nodes


def _samples(cells: int) -> Array:
    """Presses to fit to: a lattice and the edge of the unit disk, shape (n, 2)."""
    inner = lattice(int(OVERSAMPLING * np.pi * (0.5 * cells) ** 2) + 16)
    edge = np.exp(2j * np.pi * np.arange(n := int(ON_EDGE * np.pi * cells) + 8) / n) * (1.0 - 1e-12)
    at = np.concatenate([inner, edge])
    return np.stack([at.real, at.imag], axis=1)


def _least_squares(at: Array, values: Array, radius: float, cells: int) -> NdBSpline:
    """Cubic spline through values, shape (n, ...), at positions (n, 2): least squares with small third differences."""
    knots = np.concatenate([[-radius] * 3, np.linspace(-radius, radius, cells + 1), [radius] * 3])
    count = knots.size - 4
    entries = NdBSpline.design_matrix(at, (knots, knots), 3)  # only as wide as its last entry
    design = csr_array((entries.data, entries.indices, entries.indptr), shape=(len(at), count**2))
    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))
    smooth = STIFFNESS * vstack([kron(third, eye_array(count)), kron(eye_array(count), third)])
    normal = (design.T @ design + smooth.T @ smooth).tocsc()
    right = np.ascontiguousarray(design.T @ values.reshape(len(at), -1))
    factors = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solved = factors.solve(right)  # positive definite: without pivots, some ten times faster
    return NdBSpline((knots, knots), solved.reshape(count, count, *values.shape[1:]), 3)


def _largest_error(spline: ChargeSpline, forward: Forward) -> float:
    """Largest error at presses that are spread evenly but off the lattice."""
    at, number = spline.radius * sunflower(CHECKS), np.arange(CHECKS)
    low, high = spline.force_range
    force = np.clip(low * (high / low) ** (number * 0.618 % 1.0), low, high)
    truth = forward(at.real, at.imag, force)
    error = spline.charge(np.stack([at.real, at.imag, force], axis=1)) - truth
    return float((np.abs(error).max(axis=1) / np.abs(truth).max(axis=1)).max())
