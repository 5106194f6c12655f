"""The forward map as splines: the same charges some two hundred times faster, and their derivatives.

Charges over the amplitude's square, which takes most of the force out of them (`mechanics.scaling`), are
tabulated at a few forces, each a cubic spline in (x, y) that is fitted by least squares to presses on the disk, so that
no place is singular. Between the forces Lagrange polynomials in ln F interpolate. A forward map interpolates its fields
between forces in the same way, so at its force nodes nothing is lost.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads a part when it is used
from scipy.sparse import csr_array, diags_array, eye_array, kron, vstack
from scipy.sparse.linalg import splu

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, check_radius
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.numerics.disk import lattice, onto_disk, sunflower
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values
from isocharge.simulate.sensor.film import Film

SPACING, SHARE = 0.3, 1.0 / 6.0
"""Distance of the knots: at most SPACING, mm, and at most SHARE of the probe's reach, on which the charges vary."""

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


@dataclass(frozen=True)
class ChargeSpline:
    """Touch charges as a function of (x, y, F), for one probe in one orientation.

    Attributes:
        electrodes: Names in the order of the charges.
        film: For the amplitude that scales the charges.
        domain: The presses that are tabulated.
        force: Forces of the table, shape (n_term,), N.
        table: Scaled charge over x and y, values of shape (n_term, n_electrode).
        error: Largest error against the tabulated function, relative to a press's largest charge.
    """

    electrodes: tuple[str, ...]
    film: Film
    domain: Domain
    force: Array
    table: "scipy.interpolate.NdBSpline"
    error: float

    @classmethod
    def of(cls, forward_map: ForwardMap, radius: float | None = None, spacing: float | None = None) -> "ChargeSpline":
        """Tabulate a forward map: 2 s for 8 mm under a probe of 1 mm, 4 s for 10 mm.

        Args:
            forward_map: The charges; the orientation of the probe is the one it was built with.
            radius: Up to this distance from the centre, mm; as far as the map reaches if absent.
            spacing: Of the knots, mm; a sixth of the probe's reach, at most SPACING, if absent.

        Raises:
            SceneError: If the radius is not positive or reaches beyond the map.
        """
        whole = forward_map.domain
        domain = whole if radius is None else whole.within(radius)
        check_radius(domain.radius, whole.radius, "forward map")
        spacing = spacing or min(SPACING, SHARE * forward_map.probe.reach)
        film, force = forward_map.sensor.film, _force_nodes(forward_map)
        cells = int(np.clip(np.ceil(2.0 * domain.radius / spacing), *CELLS))
        at = domain.radius * _samples(cells)
        presses = [(f, np.column_stack([at, np.full(len(at), f)])) for f in force.tolist()]
        columns = [forward_map.charges(contact) / amplitude_squared(film, f) for f, contact in presses]
        table = _least_squares(at, np.stack(columns, axis=1), domain.radius, cells)
        spline = cls(forward_map.electrodes, film, domain, force, table, np.nan)
        return replace(spline, error=_largest_error(spline, forward_map))

    def charges(self, contact: Array) -> Array:
        """Touch charges, shape (n, n_electrode), pC, of contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            SceneError: If a contact lies outside the domain.
        """
        contact = self.domain.check(contact, "table")
        return np.asarray(np.einsum("nk,nke->ne", self.by_force(np.log(contact[:, 2])), self.terms(contact[:, :2])))

    def derivatives(self, contact: Array) -> Array:
        """d(Q)/d(x, y, ln F) of contacts (x, y, F): shape (n, 3) to (n, n_electrode, 3), pC/mm, pC/mm and pC.

        Raises:
            SceneError: If a contact lies outside the domain.
        """
        return self.linearised(contact)[1]

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """See `charges` and `derivatives`."""
        contact = self.domain.check(contact, "table")
        charge, slope, by_force = self.first_order(contact[:, :2], contact[:, 2])
        return charge, np.concatenate([slope, by_force[..., None]], axis=2)

    def first_order(self, position: Array, force: Array | float) -> tuple[Array, Array, Array]:
        """Charges and their derivatives, wherever Newton's method steps.

        Args:
            position: (x, y), shape (n, 2), mm; moved onto the disk's edge where outside.
            force: Shape (n,) or a number, N.

        Returns:
            Charges (n, n_electrode), pC; d/d(x, y), shape (n, n_electrode, 2), pC/mm; d/d(ln F), (n, n_electrode), pC.
        """
        position, logs = onto_disk(position, self.domain.radius), np.log(np.broadcast_to(force, len(position)))
        weights, terms = self.by_force(logs), self.terms(position)
        change = (self.by_force(logs + STRIDE) - self.by_force(logs - STRIDE)) / (2.0 * STRIDE)
        slope = np.einsum("nk,nkei->nei", weights, self.slopes(position))
        return np.einsum("nk,nke->ne", weights, terms), slope, np.einsum("nk,nke->ne", change, terms)

    def by_force(self, logs: Array) -> Array:
        """Weights of the table's forces at logarithms of forces, shape (...) to (..., n_term): Q = weights @ terms."""
        nodes = np.log(self.force)
        weights = lagrange_values(nodes, barycentric_weights(nodes), logs.ravel())
        weights *= amplitude_squared(self.film, np.exp(logs.ravel()))[:, None]
        return weights.reshape(*logs.shape, nodes.size)

    def terms(self, position: Array) -> Array:
        """Scaled charges at the table's forces: positions (x, y), shape (n, 2), mm, to (n, n_term, n_electrode)."""
        return np.asarray(self.table(position))

    def slopes(self, position: Array) -> Array:
        """Derivatives of `terms` by x and y, shape (n, n_term, n_electrode, 2), 1/mm."""
        return np.stack([self.table(position, nu=nu) for nu in ((1, 0), (0, 1))], axis=-1)


def with_fast_derivatives(charge_map: ChargeMap) -> ChargeMap:
    """A forward map as splines, which takes seconds; any other map as it is."""
    return ChargeSpline.of(charge_map) if isinstance(charge_map, ForwardMap) else charge_map


def _force_nodes(forward_map: ForwardMap) -> Array:
    """Force nodes of the forward map, between which it is a polynomial; more of them with d33."""
    low, high = np.log(forward_map.domain.force_range)
    if forward_map.sensor.piezo.d33 == 0.0 or low == high:
        return forward_map.family.force
    return np.asarray(np.exp(chebyshev_nodes(forward_map.family.force.size + MORE_FORCES, low, high)))


def _samples(cells: int) -> Array:
    """Presses to fit to: a lattice and the edge of the unit disk, shape (n, 2)."""
    inner = lattice(int(OVERSAMPLING * np.pi * (0.5 * cells) ** 2) + 16)
    edge = np.exp(2j * np.pi * np.arange(n := int(ON_EDGE * np.pi * cells) + 8) / n) * (1.0 - 1e-12)
    at = np.concatenate([inner, edge])
    return np.stack([at.real, at.imag], axis=1)


def _least_squares(at: Array, values: Array, radius: float, cells: int) -> "scipy.interpolate.NdBSpline":
    """Cubic spline through values, shape (n, ...), at positions (n, 2): least squares with small third differences."""
    knots = np.concatenate([[-radius] * 3, np.linspace(-radius, radius, cells + 1), [radius] * 3])
    count = knots.size - 4
    entries = scipy.interpolate.NdBSpline.design_matrix(at, (knots, knots), 3)  # only as wide as its last entry
    design = csr_array((entries.data, entries.indices, entries.indptr), shape=(len(at), count**2))
    third = diags_array([-1.0, 3.0, -3.0, 1.0], offsets=[0, 1, 2, 3], shape=(count - 3, count))
    smooth = STIFFNESS * vstack([kron(third, eye_array(count)), kron(eye_array(count), third)])
    normal = (design.T @ design + smooth.T @ smooth).tocsc()
    right = np.ascontiguousarray(design.T @ values.reshape(len(at), -1))
    factors = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solved = factors.solve(right)  # positive definite: without pivots, some ten times faster
    return scipy.interpolate.NdBSpline((knots, knots), solved.reshape(count, count, *values.shape[1:]), 3)


def _largest_error(spline: ChargeSpline, forward_map: ForwardMap) -> float:
    """Largest error at presses that are spread evenly but off the lattice."""
    at, number = spline.domain.radius * sunflower(CHECKS), np.arange(CHECKS)
    low, high = spline.domain.force_range
    force = np.clip(low * (high / low) ** (number * 0.618 % 1.0), low, high)
    contact = np.stack([at.real, at.imag, force], axis=1)
    truth = forward_map.charges(contact)
    error = spline.charges(contact) - truth
    return float((np.abs(error).max(axis=1) / np.abs(truth).max(axis=1)).max())
