"""Independent second solver of the pressed clamped film, with scikit-fem: a test oracle, not part of the product.

Green-Lagrange membrane strain, St. Venant-Kirchhoff plane stress, linear plate bending, clamped round film, dead load
spread uniformly over a convex footprint. All three displacements are continuous cubic triangles on an unstructured,
graded mesh that follows the footprint's outline; bending is a C0 interior penalty method, which also clamps the slope.
Electrodes are not meshed: their charge is integrated on a fine mesh of their own.
Newton, millimetre and MPa throughout.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay
from skfem import Basis, BoundaryFacetBasis, ElementTriP1, ElementTriP3, InteriorFacetBasis, MeshTri

Array = NDArray[np.float64]
Index = NDArray[np.int64]

RADIUS, YOUNG, POISSON = 45.0, 3000.0, 0.34
PLANE = YOUNG / (1 - POISSON**2)  # plane-stress modulus
# On jumps of slope, times plate stiffness * side length / area of the triangle; too little makes the plate unstable.
PENALTY = 10.0


# --- mesh -------------------------------------------------------------------------------------------------------------


def outline(footprint: ArrayLike, sides: int) -> Array:
    """Corners (n, 2) in mm, anticlockwise; a circle (x, y, r) becomes a regular polygon of the same area."""
    corners = np.asarray(footprint, float)
    if corners.shape == (3,):
        turn = 2 * np.pi * np.arange(sides) / sides
        radius = corners[2] * np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
        return corners[:2] + radius * np.c_[np.cos(turn), np.sin(turn)]
    return corners if area(corners) > 0 else corners[::-1]


def area(polygon: Array) -> float:
    """Area of a polygon (n, 2), positive if anticlockwise."""
    x, y = polygon.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def outward(polygon: Array) -> Array:
    """Return the unit normals (n, 2) of an anticlockwise polygon's sides; side k starts at corner k."""
    x, y = (np.roll(polygon, -1, axis=0) - polygon).T
    return np.c_[y, -x] / np.hypot(x, y)[:, None]


def beyond(points: Array, polygon: Array) -> Array:
    """How far points (m, 2) lie beyond a convex polygon's sides; negative inside."""
    return np.max(points @ outward(polygon).T - np.sum(polygon * outward(polygon), axis=1), axis=1)


def spaced(curve: Array, size: Callable[[Array], Array], phase: float = 0.0) -> Array:
    """Points along a closed polyline (n, 2), as far apart as the local size, moved on by phase (0 to 1) of it."""
    sides = np.roll(curve, -1, axis=0) - curve
    fine = (curve[:, None] + np.linspace(0, 1, 16, endpoint=False)[:, None] * sides[:, None]).reshape(-1, 2)
    fine = np.vstack([fine, fine[:1]])
    count = np.r_[0, np.cumsum(np.hypot(*np.diff(fine, axis=0).T) / size((fine[1:] + fine[:-1]) / 2))]
    number = max(6, round(count[-1]))
    at = (np.arange(number) + phase) * count[-1] / number
    return np.c_[np.interp(at, count, fine[:, 0]), np.interp(at, count, fine[:, 1])]


def film_mesh(corners: Array, near: float, growth: float, far: float, layer: float) -> MeshTri:
    """Triangles of the film, in mm, that follow the convex footprint's outline.

    Edges are `near` long in the footprint and grow by `growth` per mm up to `far`. Points on rings round the footprint
    are smoothed and joined by Delaunay; stretched layers follow the rim, the first `layer` wide, each twice the last.
    """

    def size(points: Array) -> Array:
        return np.minimum(near + growth * np.maximum(beyond(points, corners), 0), far)

    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    rim = spaced(np.c_[np.cos(turn), np.sin(turn)] * RADIUS, size)
    rim = rim[:, 0] + 1j * rim[:, 1]
    apart = np.angle(np.roll(rim, -1) / rim)
    apart = (apart + np.roll(apart, 1)) / 2
    rim *= RADIUS / abs(rim) * np.sqrt(apart / np.sin(apart))  # so that the polygon has the area of the film
    rim = np.c_[rim.real, rim.imag]
    middle = corners.mean(axis=0)
    depth = np.r_[0, np.cumsum(layer * 2.0 ** np.arange(12))]
    thin = np.r_[True, (np.diff(depth) < 0.6 * far) & (depth[1:] < 0.3 * (RADIUS - np.hypot(*middle)))]
    layers = [rim * (1 - d / RADIUS) for d in depth[thin][::-1]]  # from the inside out

    shells = max(1, round(-beyond(middle[None], corners)[0] / near))
    inward = [middle + (corners - middle) * k / shells for k in range(1, shells)]
    rings = [middle[None]]
    rings += [spaced(curve, lambda p: np.full(len(p), near), k % 2 / 2) for k, curve in enumerate(inward, start=1)]
    border = spaced_sides(corners, near)
    last = np.arctan2(*outward(corners).T[::-1])
    first = np.roll(last, 1)
    arcs = first[:, None] + np.linspace(0, 1, 9) * np.mod(last - first, 2 * np.pi)[:, None]  # round each corner
    offset = 0.0
    while offset < 2 * RADIUS:
        offset += 0.87 * min(near + growth * offset, far)
        curve = corners[:, None] + offset * np.stack([np.cos(arcs), np.sin(arcs)], axis=2)
        rings.append(spaced(curve.reshape(-1, 2), size, len(rings) % 2 / 2))

    fixed, free = np.vstack([layers[0], border]), np.vstack(rings)
    edges = np.vstack([np.roll(layers[0], -1, axis=0), np.roll(border, -1, axis=0)]) - fixed
    for _ in range(5):
        free = free[np.hypot(*free.T) < np.hypot(*layers[0].T).mean()]
        away = np.linalg.norm(free[:, None] - (fixed + edges / 2), axis=2) / np.linalg.norm(edges, axis=1)
        free = free[np.min(away, axis=1) > 0.65]  # none in the circle over a fixed edge: Delaunay keeps that edge
        points = np.vstack([fixed, free])
        triangles = Delaunay(points).simplices
        pairs = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2).tocsr()
        links = ((links + links.T) > 0).astype(float)
        free = ((links @ points) / links.sum(axis=1)[:, None])[len(fixed) :]
    here = np.arange(len(rim))
    there = np.roll(here, -1)
    for k, ring in enumerate(layers[1:]):
        low, high = (len(points) - len(rim) if k else 0), len(points)
        strip = [np.c_[low + here, low + there, high + here], np.c_[low + there, high + there, high + here]]
        triangles, points = np.vstack([triangles, *strip]), np.vstack([points, ring])
    return MeshTri(points.T.copy(), triangles.T.copy())


def spaced_sides(polygon: Array, near: float) -> Array:
    """Points along a polygon, its corners among them."""
    ends = zip(polygon, np.roll(polygon, -1, axis=0), strict=True)
    return np.vstack([np.linspace(a, b, 1 + max(1, round(np.hypot(*(b - a)) / near)))[:-1] for a, b in ends])


# --- equilibrium ------------------------------------------------------------------------------------------------------


def gradients(basis: Basis) -> Array:
    """Gradients of the shape functions: triangle, point, direction, function."""
    return np.stack([shape[0].grad for shape in basis.basis], axis=-1).transpose(1, 2, 0, 3)


def hessians(basis: Basis) -> Array:
    """Second derivatives of the shape functions: triangle, point, direction, direction, function."""
    local = basis.mapping.invF(np.asarray(basis.global_coordinates()), basis.tind)
    inverse = basis.mapping.invDF(local, basis.tind)
    steps = 0.5 * np.eye(2)[:, :, None, None]
    result = []
    for k in range(basis.Nbfun):  # the central difference of a quadratic is exact
        second = [basis.elem.lbasis(local + step, k)[1] - basis.elem.lbasis(local - step, k)[1] for step in steps]
        result.append(np.einsum("acep,abep,bdep->epcd", inverse, np.array(second), inverse, optimize=True))
    return np.stack(result, axis=-1)


def assemble(blocks: Array, dofs: Index, number: int) -> csc_array:
    """Sum of element matrices (e, m, n) with degrees of freedom (e, m)."""
    rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
    return coo_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(number, number)).tocsc()


def bending(basis: Basis, stiffness: float) -> csc_array:
    """C0 interior penalty matrix of the plate equation in w, with the rim's slope clamped."""
    hess = hessians(basis)
    trace = np.trace(hess, axis1=2, axis2=3)
    blocks = (1 - POISSON) * np.einsum("ep,epcdm,epcdn->emn", basis.dx, hess, hess, optimize=True)
    blocks += POISSON * np.einsum("ep,epm,epn->emn", basis.dx, trace, trace, optimize=True)
    matrix = assemble(stiffness * blocks, basis.element_dofs.T, basis.N)
    inner = [InteriorFacetBasis(basis.mesh, basis.elem, side=side, intorder=4) for side in (0, 1)]
    for sides in (inner, [BoundaryFacetBasis(basis.mesh, basis.elem, intorder=4)]):
        normal = np.asarray(sides[0].normals)
        jumps, means = [], []  # of the normal slope and of the bending moment, per unit stiffness
        for sign, side in zip((1, -1), sides, strict=False):
            hess = hessians(side)
            curvature = np.einsum("cep,epcdm,dep->epm", normal, hess, normal, optimize=True)
            moment = (1 - POISSON) * curvature + POISSON * np.trace(hess, axis1=2, axis2=3)
            jumps.append(sign * np.einsum("cep,epcm->epm", normal, gradients(side)))
            means.append(moment / len(sides))
        jump, mean = np.concatenate(jumps, axis=2), np.concatenate(means, axis=2)
        steep = np.max([side.dx.sum(axis=1) / basis.dx.sum(axis=1)[side.tind] for side in sides], axis=0)
        mixed = PENALTY / 2 * steep[:, None, None] * jump - mean
        half = stiffness * np.einsum("ep,epm,epn->emn", sides[0].dx, jump, mixed, optimize=True)
        dofs = np.concatenate([side.element_dofs for side in sides]).T
        matrix += assemble(half + half.swapaxes(1, 2), dofs, basis.N)
    return matrix


def deformation(gradient: Array, unknown: Array, dofs: Index) -> tuple[Array, Array]:
    """Deformation gradient (..., 3, 2) and Green-Lagrange strain (..., 2, 2) at points of triangles."""
    slopes = unknown.reshape(-1, 3)[dofs.T].swapaxes(1, 2)[:, None] @ gradient.swapaxes(2, 3)
    twice = slopes[..., :2, :] + slopes[..., :2, :].swapaxes(2, 3) + slopes.swapaxes(2, 3) @ slopes
    return slopes + np.eye(3, 2), twice / 2


def stress(strain: Array) -> Array:
    """Second Piola-Kirchhoff stress of plane stress, without the pretension."""
    trace = np.trace(strain, axis1=-2, axis2=-1)[..., None, None]
    return PLANE * ((1 - POISSON) * strain + POISSON * trace * np.eye(2))


@dataclass
class Film:
    """Discrete energy of the film; an unknown vector holds u, v, w of one node after the other, in mm."""

    basis: Basis
    thickness: float
    pretension: float
    load: Array

    def __post_init__(self) -> None:
        """Compute what does not depend on the displacements."""
        self.gradient = gradients(self.basis)
        self.weights = (self.thickness * self.basis.dx)[:, :, None, None]
        self.dofs = (3 * self.basis.element_dofs.T[:, :, None] + np.arange(3)).reshape(self.basis.nelems, -1)
        bent = bending(self.basis, PLANE * self.thickness**3 / 12).tocoo()
        self.plate = coo_array((bent.data, (3 * bent.row + 2, 3 * bent.col + 2)), shape=(3 * self.basis.N,) * 2).tocsc()
        inner = np.setdiff1d(np.arange(self.basis.N), self.basis.get_dofs().all())
        self.free = (3 * inner[:, None] + np.arange(3)).ravel()

    def energy(self, unknown: Array) -> float:
        """Potential energy in N mm."""
        strain = deformation(self.gradient, unknown, self.basis.element_dofs)[1]
        density = strain * (stress(strain) / 2 + self.pretension * np.eye(2))
        return float(np.sum(self.weights * density) + unknown @ (self.plate @ unknown / 2 - self.load))

    def force(self, unknown: Array) -> Array:
        """Gradient of the energy."""
        deformed, strain = deformation(self.gradient, unknown, self.basis.element_dofs)
        flux = deformed @ (stress(strain) + self.pretension * np.eye(2)) * self.weights
        local = np.einsum("epia,epam->emi", flux, self.gradient, optimize=True)
        return np.bincount(self.dofs.ravel(), local.ravel(), len(unknown)) + self.plate @ unknown - self.load

    def tangent(self, unknown: Array, extra: float) -> csc_array:
        """Second derivative of the energy, with an extra tension in its stress."""
        deformed, strain = deformation(self.gradient, unknown, self.basis.element_dofs)
        tension = stress(strain) + (self.pretension + extra) * np.eye(2)
        cells, _, _, shapes = self.gradient.shape
        flat = self.gradient.reshape(cells, -1, shapes)
        local = np.empty((cells, shapes, 3, shapes, 3))
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            one, two = deformed[:, :, i, :, None], deformed[:, :, j, :, None]
            shear = two @ one.swapaxes(2, 3) + (one.swapaxes(2, 3) @ two) * np.eye(2)
            modulus = PLANE * (POISSON * one @ two.swapaxes(2, 3) + (1 - POISSON) / 2 * shear) + (i == j) * tension
            block = flat.swapaxes(1, 2) @ (self.weights * modulus @ self.gradient).reshape(cells, -1, shapes)
            local[:, :, i, :, j], local[:, :, j, :, i] = block, block.swapaxes(1, 2)
        return assemble(local.reshape(cells, 3 * shapes, -1), self.dofs, len(unknown)) + self.plate

    def inverse(self, unknown: Array, extra: float) -> Callable[[Array], Array]:
        """Solve with the tangent, the rim held."""
        matrix = self.tangent(unknown, extra)[self.free][:, self.free]
        factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

        def apply(right: Array) -> Array:
            result = np.zeros_like(right)
            result[self.free] = factors.solve(right[self.free])
            return result

        return apply

    def start(self, tension: float) -> Array:
        """Shape of a linear film under a tension, with the stretch it entails, scaled to the least energy."""
        solve_linear = self.inverse(np.zeros_like(self.load), tension)
        shape = solve_linear(self.load)
        inplane = self.force(shape)
        inplane[2::3] = 0
        stretch = -solve_linear(inplane)
        best = minimize_scalar(lambda t: self.energy(np.exp(2 * t) * stretch + np.exp(t) * shape), (-1, 1)).x
        return np.exp(2 * best) * stretch + np.exp(best) * shape

    def equilibrium(self) -> Array:
        """Newton's method with an energy line search, and an extra tension in the tangent where that fails."""
        scale = (YOUNG * self.load.sum() ** 2 / (self.thickness * RADIUS) ** 2) ** (1 / 3)
        unknown, extra = self.start(scale), 0.0
        energy = self.energy(unknown)
        for _ in range(60):
            force = self.force(unknown)
            step = -self.inverse(unknown, extra)(force)
            slope = float(force @ step)
            if extra == 0 and abs(slope) < 1e-9 * abs(energy):
                return unknown + step
            length, lower = 1.0, self.energy(unknown + step)
            while lower > energy + 1e-4 * length * slope and length > 0.05:
                length /= 2
                lower = self.energy(unknown + length * step)
            if slope < 0 and length > 0.05:
                unknown, energy = unknown + length * step, lower
                extra = extra / 4 if extra > 0.02 * scale else 0.0
            else:
                extra = max(4 * extra, 0.05 * scale)
        raise RuntimeError("no equilibrium found")


# --- answers ----------------------------------------------------------------------------------------------------------


@dataclass
class Solution:
    """A pressed film: ask it for charges and deflections."""

    basis: Basis
    unknown: Array

    def touch_stress(self, points: Array) -> Array:
        """Second Piola-Kirchhoff stress without the pretension (m, 2, 2) in MPa, at points (m, 2) in mm."""
        cells = self.basis.mesh.element_finder()(*points.T)
        local = self.basis.mapping.invF(points.T[:, :, None], cells)
        shapes = [self.basis.elem.gbasis(self.basis.mapping, local, k, cells)[0].grad for k in range(self.basis.Nbfun)]
        gradient = np.stack(shapes, axis=-1).transpose(1, 2, 0, 3)
        return stress(deformation(gradient, self.unknown, self.basis.element_dofs[:, cells])[1])[:, 0]

    def deflection(self, point: ArrayLike) -> float:
        """Deflection in mm at a point in mm."""
        return float((self.basis.probes(np.asarray(point, float)[:, None]) @ self.unknown[2::3])[0])

    def charge(self, electrode: ArrayLike, d31: float, d32: float) -> float:
        """Touch charge in pC of a convex electrode, corners (n, 2) in mm; d31 and d32 in pC/N."""
        corners = outline(electrode, 64)
        around = np.arange(len(corners))
        fan = np.stack([around, np.roll(around, -1), np.full_like(around, len(corners))])
        patch = MeshTri(np.vstack([corners, corners.mean(axis=0)]).T.copy(), fan).refined(4)
        fine = Basis(patch, ElementTriP1(), intorder=4)
        tension = self.touch_stress(np.asarray(fine.global_coordinates()).reshape(2, -1).T)
        return float(fine.dx.ravel() @ (d31 * tension[:, 0, 0] + d32 * tension[:, 1, 1]))

    def edge_charge(self, centre: ArrayLike, side: float, d31: float, d32: float) -> float:
        """Touch charge in pC of a square by its edges: s11 on the left and right, s22 on the lower and upper ones."""
        along = (np.arange(400) + 0.5) / 400 - 0.5
        right = np.stack([np.full_like(along, 0.5), along], axis=1)
        edges = np.vstack([right, -right, right[:, ::-1], -right[:, ::-1]])
        tension = self.touch_stress(np.asarray(centre, float) + side * edges)
        return float(side**2 * (d31 * tension[:800, 0, 0].mean() + d32 * tension[800:, 1, 1].mean()))


def solve(thickness: float, pretension: float, footprint: ArrayLike, force: float, refine: float = 1) -> Solution:
    """Equilibrium under a convex footprint, corners (n, 2) or circle (x, y, r); edges are 1/refine as long."""
    corners = outline(footprint, 2 * round(8 * refine))
    across = np.sqrt(area(corners) / np.pi)  # radius of a circle as large
    margin = RADIUS - np.hypot(*corners.mean(axis=0))
    tension = thickness * (pretension + 0.2 * (YOUNG * (force / thickness / margin) ** 2) ** (1 / 3))
    layer = np.sqrt(PLANE * thickness**3 / 12 / tension)  # length over which bending matters at the rim
    mesh = film_mesh(corners, 0.45 * across / refine, 0.3 / refine, 4.5 / refine, 0.7 * layer / refine)
    basis = Basis(mesh, ElementTriP3(), intorder=6)
    pressed = basis.dx * (beyond(mesh.p[:, mesh.t].mean(axis=1).T, corners) < 0)[:, None]
    if abs(pressed.sum() / area(corners) - 1) > 1e-9:
        raise RuntimeError("the mesh misses the footprint's outline")
    local = np.stack([np.sum(pressed * np.asarray(shape[0]), axis=1) for shape in basis.basis])
    local *= force / area(corners)
    load = np.zeros(3 * basis.N)
    load[2::3] = np.bincount(basis.element_dofs.ravel(), local.ravel(), basis.N)
    return Solution(basis, Film(basis, thickness, pretension, load).equilibrium())
