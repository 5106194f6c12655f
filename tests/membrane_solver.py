"""Independent solver of a clamped round membrane under several touches at once, for tests and benchmarks.

The film is a membrane with Green-Lagrange strain, St. Venant-Kirchhoff elasticity in plane stress, and an isotropic
pretension. All displacements are continuous and quadratic on straight triangles, which are small near the touches.
Bending is omitted. Nothing of isocharge is used. Units are mm, N and MPa.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay, cKDTree

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

POINTS_PER_RING = 20
"""Number of mesh points on each ring about a touch."""

MIN_SPACING = 0.6
"""Smallest distance between points of two touches, relative to the spacing of the rings."""

RIM_POINTS = 90
"""Number of mesh points on the rim."""

PATCH_POINTS = 6
"""Number of integration points along each side of an electrode."""

MAX_ITERATIONS = 80
"""Largest number of Newton steps."""

TOLERANCE = 1e-8
"""Out-of-balance force over load at which the solve has converged."""


class Touch(NamedTuple):
    """A touch with uniform pressure on a disk: centre, mm; force, N; radius, mm."""

    x: float
    y: float
    force: float
    radius: float = 1.0


@dataclass(frozen=True)
class Membrane:
    """The clamped film.

    Attributes:
        radius: Radius, mm.
        thickness: Thickness, mm.
        young: Young's modulus, MPa.
        poisson: Poisson's ratio.
        pretension: Isotropic stress before the touches, MPa.
    """

    radius: float = 45.0
    thickness: float = 0.025
    young: float = 3000.0
    poisson: float = 0.34
    pretension: float = 0.0

    @property
    def moduli(self) -> Array:
        """Matrix from (e11, e22, 2 e12) to (s11, s22, s12), shape (3, 3), MPa."""
        nu = self.poisson
        return self.young / (1.0 - nu**2) * np.array([[1.0, nu, 0.0], [nu, 1.0, 0.0], [0.0, 0.0, 0.5 * (1.0 - nu)]])


def mesh_points(membrane: Membrane, touches: Sequence[Touch]) -> Array:
    """Return mesh points on rings about every touch and on the rim, shape (n, 2), mm."""
    rim_angle = 2.0 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
    area_factor = np.sqrt(2.0 * np.pi / RIM_POINTS / np.sin(2.0 * np.pi / RIM_POINTS))
    rim = area_factor * membrane.radius * np.column_stack([np.cos(rim_angle), np.sin(rim_angle)])
    centres = np.array([touch[:2] for touch in touches])
    points = rim
    growth = 1.0 + 2.0 * np.pi / POINTS_PER_RING
    largest_spacing = 2.0 * np.pi * membrane.radius / RIM_POINTS
    for number, touch in enumerate(touches):
        radii = [touch.radius * share for share in (1 / 3, 2 / 3, 1.0)]
        while radii[-1] < 2.0 * membrane.radius:
            radii.append(radii[-1] + min((growth - 1.0) * radii[-1], largest_spacing))
        rings = [centres[number : number + 1]]
        spacings = [np.array([touch.radius / 3.0])]
        for ring, radius in enumerate(radii):
            count = max(POINTS_PER_RING if ring > 1 else 7 * (ring + 1), round(2.0 * np.pi * radius / largest_spacing))
            angle = 2.0 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
            rings.append(centres[number] + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
            spacings.append(np.full(count, min((growth - 1.0) * radius, largest_spacing)))
        candidates = np.concatenate(rings)
        spacing = np.concatenate(spacings)
        distances = np.linalg.norm(candidates[:, None] - centres, axis=2)
        is_nearest = distances.argmin(axis=1) == number
        is_inside = np.hypot(*candidates.T) < membrane.radius - 0.5 * np.minimum(spacing, largest_spacing)
        is_free = cKDTree(points).query(candidates)[0] > MIN_SPACING * spacing
        points = np.concatenate([points, candidates[is_nearest & is_inside & is_free]])
    return points


class QuadraticBasis(NamedTuple):
    """Quadratic basis at points of the reference triangle.

    Attributes:
        values: Shape (n_point, 6).
        derivatives: With respect to the first two area coordinates, shape (n_point, 2, 6).
    """

    values: Array
    derivatives: Array

    @classmethod
    def at(cls, first: Array, second: Array) -> "QuadraticBasis":
        """Evaluate the basis. Nodes are the three corners, then the middles of the sides 01, 12 and 20."""
        third = 1.0 - first - second
        area = [third, first, second]
        slope = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
        values = [a * (2.0 * a - 1.0) for a in area]
        derivatives = [(4.0 * a - 1.0)[:, None] * slope[i] for i, a in enumerate(area)]
        for i, j in ((0, 1), (1, 2), (2, 0)):
            values.append(4.0 * area[i] * area[j])
            derivatives.append(4.0 * (area[i][:, None] * slope[j] + area[j][:, None] * slope[i]))
        return cls(np.stack(values, axis=1), np.stack(derivatives, axis=2))


def six_point_rule() -> tuple[QuadraticBasis, Array]:
    """Return the basis at the points of an integration rule of degree 4, and its weights (Dunavant 1985)."""
    inner, outer = 0.445948490915965, 0.091576213509771
    corners = [(inner, inner), (1 - 2 * inner, inner), (inner, 1 - 2 * inner)]
    corners += [(outer, outer), (1 - 2 * outer, outer), (outer, 1 - 2 * outer)]
    first, second = np.array(corners).T
    weights = 0.5 * np.array([0.223381589678011] * 3 + [0.109951743655322] * 3)
    return QuadraticBasis.at(first, second), weights


class Discretisation:
    """Quadratic triangles on the film, and the energy of nodal displacements.

    Args:
        membrane: The film.
        touches: The touches.
    """

    def __init__(self, membrane: Membrane, touches: Sequence[Touch]) -> None:
        self.membrane = membrane
        self.touches = tuple(touches)
        self.triangulation = Delaunay(mesh_points(membrane, touches))
        corners = self.triangulation.points
        simplices = self.triangulation.simplices.astype(np.int64)
        sides = np.sort(simplices[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        unique, numbers = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
        counts = np.bincount(numbers.ravel())
        self.nodes: Integers = np.concatenate([simplices, len(corners) + numbers.reshape(-1, 3)], axis=1)
        self.points = np.concatenate([corners, corners[unique].mean(axis=1)])
        self.n_node = len(self.points)

        is_rim_side = counts == 1
        fixed = np.union1d(unique[is_rim_side].ravel(), len(corners) + np.flatnonzero(is_rim_side))
        free_nodes = np.setdiff1d(np.arange(self.n_node), fixed)
        self.free = (3 * free_nodes[:, None] + np.arange(3)).ravel()
        self.unknowns = (3 * self.nodes[:, :, None] + np.arange(3)).reshape(len(self.nodes), -1)

        basis, weights = six_point_rule()
        self.jacobian = np.stack(
            [corners[simplices[:, 1]] - corners[simplices[:, 0]], corners[simplices[:, 2]] - corners[simplices[:, 0]]],
            axis=2,
        )
        self.inverse_jacobian = np.linalg.inv(self.jacobian)
        determinant = np.linalg.det(self.jacobian)
        self.gradient = np.einsum("pkn,ekd->epdn", basis.derivatives, self.inverse_jacobian)
        self.weights = membrane.thickness * np.abs(determinant)[:, None] * weights
        self.load = self._load(basis, np.abs(determinant)[:, None] * weights)

    def _load(self, basis: QuadraticBasis, area: Array) -> Array:
        """Return the force of all touches on every unknown, shape (3 n_node,), N."""
        load = np.zeros(3 * self.n_node)
        corners = self.points[self.nodes[:, :3]]
        for touch in self.touches:
            distance = np.linalg.norm(corners - touch[:2], axis=2).max(axis=1)
            pressed = np.flatnonzero(distance < touch.radius * (1.0 + 1e-9))
            share = area[pressed] @ basis.values
            deflection_unknowns = 3 * self.nodes[pressed] + 2
            np.add.at(load, deflection_unknowns.ravel(), (touch.force / share.sum() * share).ravel())
        return load

    def slopes(self, displacement: Array) -> Array:
        """Return d(u, v, w) / d(x, y) at the integration points, shape (n_element, n_point, 2, 3)."""
        local = displacement.reshape(-1, 3)[self.nodes]
        return np.einsum("epdn,enc->epdc", self.gradient, local)

    def total_stress(self, slopes: Array) -> Array:
        """Return the stress with the pretension, shape (n_element, n_point, 3), MPa."""
        stress = strain(slopes) @ self.membrane.moduli
        stress[..., :2] += self.membrane.pretension
        return stress

    def energy(self, displacement: Array) -> float:
        """Return the potential energy, N mm."""
        deformation = strain(self.slopes(displacement))
        stress = 0.5 * deformation @ self.membrane.moduli
        stress[..., :2] += self.membrane.pretension
        return float(np.sum(self.weights * np.sum(deformation * stress, axis=-1)) - self.load @ displacement)

    def out_of_balance(self, displacement: Array) -> Array:
        """Return the gradient of the energy, shape (3 n_node,), N."""
        slopes = self.slopes(displacement)
        flux = as_matrices(self.total_stress(slopes)) @ (slopes + np.eye(2, 3)) * self.weights[..., None, None]
        local = np.einsum("epdn,epdc->enc", self.gradient, flux)
        return np.bincount(self.unknowns.ravel(), local.ravel(), 3 * self.n_node) - self.load

    def solve_linear(self, displacement: Array, extra_tension: float, right: Array) -> Array:
        """Solve with the second derivative of the energy, whose stress is increased by an extra tension, MPa."""
        slopes = self.slopes(displacement)
        stretch = slopes + np.eye(2, 3)
        total = as_matrices(self.total_stress(slopes)) + extra_tension * np.eye(2)
        n_element, n_point = self.weights.shape
        strain_matrix = np.zeros((n_element, n_point, 3, 6, 3))
        strain_matrix[:, :, 0] = np.einsum("epn,epc->epnc", self.gradient[:, :, 0], stretch[:, :, 0])
        strain_matrix[:, :, 1] = np.einsum("epn,epc->epnc", self.gradient[:, :, 1], stretch[:, :, 1])
        strain_matrix[:, :, 2] = np.einsum("epn,epc->epnc", self.gradient[:, :, 0], stretch[:, :, 1])
        strain_matrix[:, :, 2] += np.einsum("epn,epc->epnc", self.gradient[:, :, 1], stretch[:, :, 0])
        flat = strain_matrix.reshape(n_element, n_point * 3, 18)
        weighted = (self.membrane.moduli @ strain_matrix.reshape(n_element, n_point, 3, 18)) * self.weights[
            ..., None, None
        ]
        matrix = flat.swapaxes(1, 2) @ weighted.reshape(n_element, n_point * 3, 18)
        geometric = np.einsum("epdn,epdm->enm", self.gradient, (total * self.weights[..., None, None]) @ self.gradient)
        blocks = matrix.reshape(n_element, 6, 3, 6, 3)
        for component in range(3):
            blocks[:, :, component, :, component] += geometric
        rows = np.repeat(self.unknowns, 18, axis=1).ravel()
        columns = np.tile(self.unknowns, (1, 18)).ravel()
        size = 3 * self.n_node
        tangent = coo_array((matrix.ravel(), (rows, columns)), shape=(size, size)).tocsc()
        factors = splu(
            tangent[self.free][:, self.free],
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        solution = np.zeros(size)
        solution[self.free] = factors.solve(right[self.free])
        return solution

    def equilibrium(self) -> Array:
        """Minimise the energy by Newton's method with a line search.

        Where the tangent is indefinite or the step does not lower the energy, an extra tension is added to the tangent.

        Raises:
            RuntimeError: If no equilibrium is found.
        """
        force = self.load.sum()
        membrane = self.membrane
        scale = (membrane.young * (force / (membrane.thickness * membrane.radius)) ** 2) ** (1.0 / 3.0)
        displacement = np.zeros(3 * self.n_node)
        displacement = self.solve_linear(displacement, scale, self.load)
        energy = self.energy(displacement)
        extra_tension = 0.25 * scale
        for _ in range(MAX_ITERATIONS):
            residual = self.out_of_balance(displacement)
            size = float(np.linalg.norm(residual[self.free]))
            if size < TOLERANCE * force:
                return displacement
            step = -self.solve_linear(displacement, extra_tension, residual)
            descent = float(residual @ step)
            new_size = float(np.linalg.norm(self.out_of_balance(displacement + step)[self.free]))
            if extra_tension == 0.0 and new_size < 0.3 * size:
                displacement = displacement + step
                energy = self.energy(displacement)
                continue
            length = 1.0
            while length > 0.05 and self.energy(displacement + length * step) > energy + 1e-4 * length * descent:
                length *= 0.5
            if descent < 0.0 and length > 0.05:
                displacement = displacement + length * step
                energy = self.energy(displacement)
                extra_tension = 0.25 * extra_tension if extra_tension > 0.005 * scale else 0.0
            else:
                extra_tension = max(4.0 * extra_tension, 0.02 * scale)
        raise RuntimeError(f"no equilibrium under {self.touches}: {size / force:.2g} of the load is out of balance")


@dataclass(frozen=True)
class MembraneSolution:
    """Displacements under all touches at once.

    Attributes:
        discretisation: The triangles.
        displacement: Displacements (u, v, w) of the nodes, shape (3 n_node,), mm.
    """

    discretisation: Discretisation
    displacement: Array

    def touch_stress(self, points: Array) -> Array:
        """Return the stress that the touches add at points, shape (n, 2), mm.

        Returns:
            Stress (s11, s22, s12), shape (n, 3), MPa.
        """
        mesh = self.discretisation
        element = mesh.triangulation.find_simplex(points)
        first_corner = mesh.points[mesh.nodes[element, 0]]
        local = np.einsum("nij,nj->ni", mesh.inverse_jacobian[element], points - first_corner)
        basis = QuadraticBasis.at(local[:, 0], local[:, 1])
        gradient = np.einsum("nkm,nkd->ndm", basis.derivatives, mesh.inverse_jacobian[element])
        slopes = gradient @ self.displacement.reshape(-1, 3)[mesh.nodes[element]]
        return strain(slopes) @ mesh.membrane.moduli

    def charge(self, corners: Array, d31: float, d32: float) -> float:
        """Return the touch charge of a convex electrode with four corners, pC.

        Args:
            corners: Corners (x, y), shape (4, 2), mm.
            d31: Piezoelectric coefficient along x, pC/N.
            d32: Piezoelectric coefficient along y, pC/N.
        """
        node, weight = np.polynomial.legendre.leggauss(PATCH_POINTS)
        a, b = (grid.ravel() for grid in np.meshgrid(0.5 + 0.5 * node, 0.5 + 0.5 * node))
        shares = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=1)
        mean_stress = 0.25 * np.outer(weight, weight).ravel() @ self.touch_stress(shares @ corners)
        x, y = corners.T
        area = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
        return float(area * (d31 * mean_stress[0] + d32 * mean_stress[1]))


def strain(slopes: Array) -> Array:
    """Return the Green-Lagrange strain (e11, e22, 2 e12) from slopes, shape (..., 2, 3)."""
    products = slopes @ slopes.swapaxes(-1, -2)
    return np.stack(
        [
            slopes[..., 0, 0] + 0.5 * products[..., 0, 0],
            slopes[..., 1, 1] + 0.5 * products[..., 1, 1],
            slopes[..., 0, 1] + slopes[..., 1, 0] + products[..., 0, 1],
        ],
        axis=-1,
    )


def as_matrices(stress: Array) -> Array:
    """Return (s11, s22, s12) as symmetric matrices, shape (..., 2, 2)."""
    return stress[..., [0, 2, 2, 1]].reshape(*stress.shape[:-1], 2, 2)


def solve_touches(membrane: Membrane, touches: Sequence[Touch]) -> MembraneSolution:
    """Solve the film under several touches at once.

    Args:
        membrane: The clamped film.
        touches: The touches, which must not overlap.

    Raises:
        RuntimeError: If no equilibrium is found.
    """
    discretisation = Discretisation(membrane, touches)
    return MembraneSolution(discretisation, discretisation.equilibrium())
