"""Independent second solver of a pressed film with imperfections, with scikit-fem: a test oracle.

Green-Lagrange membrane strain, St. Venant-Kirchhoff plane stress of an orthotropic film with a tensor pretension,
linear plate bending, a clamp that may be oval, electrodes that may be stiffer, dead load spread uniformly over a round
tip.
All three displacements are continuous cubic triangles; bending is a C0 interior penalty method, which also clamps the
slope. Electrodes are not meshed: their charge, that of the film alone, is integrated on a fine mesh of their own.
Newton, millimetre and MPa throughout.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu
from skfem import Basis, BoundaryFacetBasis, ElementTriP1, ElementTriP3, InteriorFacetBasis, MeshTri

Array = NDArray[np.float64]

PENALTY = 10.0
"""On jumps of slope, times plate stiffness * side / area of the triangle; too little makes the plate unstable."""


@dataclass(frozen=True)
class SkfemFilm:
    """What is solved.

    Attributes:
        young: Along the film's axes 1 and 2, MPa.
        poisson: nu12.
        shear: G12, MPa; None for that of the isotropic film of the geometric mean of `young`.
        angle: Of axis 1 against x, rad.
        tension: T11, T22, T12 along x and y, MPa.
        oval: e of the clamp, with semi-axes radius * (1 +- e).
        oval_angle: Of its long axis, rad.
        stiffer: Convex polygons (n, 2), mm, anticlockwise, within which the membrane is stiffer, with their factors.
        soft: Width of their edges, mm, over which the factor rises.
    """

    young: tuple[float, float] = (3000.0, 3000.0)
    poisson: float = 0.34
    shear: float | None = None
    angle: float = 0.0
    tension: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thickness: float = 0.025
    radius: float = 45.0
    oval: float = 0.0
    oval_angle: float = 0.0
    stiffer: Sequence[tuple[Array, float]] = ()
    soft: float = 1e-9

    @property
    def moduli(self) -> Array:
        """Plane-stress C along x and y, (s11, s22, s12) from (e11, e22, 2 e12), (3, 3), MPa (Jones 1999, ch. 2)."""
        (one, two), nu = self.young, self.poisson
        mean = np.sqrt(one * two)
        shear = self.shear if self.shear is not None else mean / (2 * (1 + nu * np.sqrt(two / one)))
        local = np.linalg.inv(np.array([[1 / one, -nu / one, 0], [-nu / one, 1 / two, 0], [0, 0, 1 / shear]]))
        turn = stress_turn(self.angle)
        return turn @ local @ turn.T


def stress_turn(angle: float) -> Array:
    """(s11, s22, s12) along axes turned by `angle` to those along x and y, shape (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c * c, s * s, -2 * c * s], [s * s, c * c, 2 * c * s], [c * s, -c * s, c * c - s * s]])


# --- mesh -------------------------------------------------------------------------------------------------------------


def film_mesh(
    film: SkfemFilm, at: complex, reach: float, layer: float, around: int
) -> tuple[MeshTri, NDArray[np.bool_]]:
    """Triangles in mm whose rings follow tip and rim, and which of them the tip presses on.

    A Moebius map carries rings about the centre onto the disk, circles staying circles; z + e z^3 makes the rim oval.
    """
    bend = film.oval * np.exp(-2j * film.oval_angle)
    target = at / film.radius
    place = target
    for _ in range(20):  # the place in the disk whose image is the tip's
        place = target - bend * place**3
    radius = reach / film.radius / abs(1 + 3 * bend * place**2)
    distance, turn = abs(place), np.exp(1j * np.angle(place))
    far, near = np.arctanh(distance + radius), np.arctanh(distance - radius)
    centre, tip = np.tanh((far + near) / 2) * turn, np.tanh((far - near) / 2)
    step = 2 * np.pi / around
    thin = 1 - layer * (2.0 ** np.arange(1, 5) - 1)
    rings = np.geomspace(tip, thin[-1], 1 + round(np.log(0.8 * film.radius / reach) / (1.2 * step)))
    rings = np.r_[tip / 3, tip * 2 / 3, rings, thin[-2::-1], 1]
    phase = step * (np.arange(around) + 0.5 * (np.arange(len(rings)) % 2)[:, None])
    ring = rings[:, None] * np.exp(1j * phase)
    ring = (ring + centre) / (1 + np.conj(centre) * ring)
    apart = np.angle(np.roll(ring[-1], -1) / ring[-1])
    apart = (apart + np.roll(apart, 1)) / 2
    ring[-1] *= np.sqrt(apart / np.sin(apart))  # the polygon has the area of the film
    edge = ring[2]
    middle = edge.mean()
    edge_area = 0.5 * np.sum((np.conj(edge) * np.roll(edge, -1)).imag)
    ring[:3] = place + (ring[:3] - place) * radius * np.sqrt(np.pi / edge_area)
    points = np.r_[middle, ring.ravel()]
    points = film.radius * (points + bend * points**3)
    here, there = np.arange(around), np.roll(np.arange(around), -1)
    triangles = [np.c_[np.zeros(around, int), 1 + here, 1 + there]]
    for k in range(len(rings) - 1):
        low, high = 1 + k * around, 1 + (k + 1) * around
        if k % 2 == 0:  # the outer ring is half a step ahead
            triangles += [np.c_[low + here, high + here, low + there], np.c_[low + there, high + here, high + there]]
        else:
            triangles += [np.c_[low + here, high + here, high + there], np.c_[low + here, high + there, low + there]]
    pressed = np.zeros(around * (1 + 2 * (len(rings) - 1)), bool)
    pressed[: 5 * around] = True
    return MeshTri(np.c_[points.real, points.imag].T.copy(), np.vstack(triangles).T.copy()), pressed


# --- equilibrium ------------------------------------------------------------------------------------------------------


def gradients(basis: Basis) -> Array:
    """Gradients of the shape functions: triangle, point, direction, function."""
    return np.stack([shape[0].grad for shape in basis.basis], axis=-1).transpose(1, 2, 0, 3)


def curvatures(basis: Basis) -> Array:
    """(w11, w22, 2 w12) of the shape functions: triangle, point, 3, function."""
    local = basis.mapping.invF(np.asarray(basis.global_coordinates()), basis.tind)
    inverse = basis.mapping.invDF(local, basis.tind)
    steps = 0.5 * np.eye(2)[:, :, None, None]
    result = []
    for k in range(basis.Nbfun):  # the central difference of a quadratic is exact
        second = [basis.elem.lbasis(local + step, k)[1] - basis.elem.lbasis(local - step, k)[1] for step in steps]
        hessian = np.einsum("acep,abep,bdep->epcd", inverse, np.array(second), inverse, optimize=True)
        result.append(np.stack([hessian[..., 0, 0], hessian[..., 1, 1], 2 * hessian[..., 0, 1]], axis=-1))
    return np.stack(result, axis=-1)


def assemble(blocks: Array, dofs: NDArray[np.int64], number: int) -> csc_array:
    """Sum of element matrices (e, m, n) with degrees of freedom (e, m)."""
    rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
    return coo_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(number, number)).tocsc()


def bending(basis: Basis, stiffness: Array) -> csc_array:
    """C0 interior penalty matrix of the plate equation in w, with the rim's slope clamped; stiffness (3, 3), N mm."""
    bent = curvatures(basis)
    blocks = bent.swapaxes(2, 3) @ (basis.dx[..., None, None] * stiffness @ bent)
    matrix = assemble(blocks.sum(axis=1), basis.element_dofs.T, basis.N)
    inner = [InteriorFacetBasis(basis.mesh, basis.elem, side=side, intorder=4) for side in (0, 1)]
    for sides in (inner, [BoundaryFacetBasis(basis.mesh, basis.elem, intorder=4)]):
        normal = np.asarray(sides[0].normals)
        across = np.stack([normal[0] ** 2, normal[1] ** 2, 2 * normal[0] * normal[1]], axis=-1) @ stiffness
        jumps, means = [], []  # of the normal slope and of the bending moment
        for sign, side in zip((1, -1), sides, strict=False):
            means.append((across[:, :, None] @ curvatures(side))[:, :, 0] / len(sides))
            jumps.append(sign * np.einsum("cep,epcm->epm", normal, gradients(side)))
        jump, mean = np.concatenate(jumps, axis=2), np.concatenate(means, axis=2)
        steep = np.max([side.dx.sum(axis=1) / basis.dx.sum(axis=1)[side.tind] for side in sides], axis=0)
        mixed = PENALTY / 2 * stiffness.max() * steep[:, None, None] * jump - mean
        half = (sides[0].dx[..., None] * jump).swapaxes(1, 2) @ mixed
        dofs = np.concatenate([side.element_dofs for side in sides]).T
        matrix += assemble(half + half.swapaxes(1, 2), dofs, basis.N)
    return matrix


def strain(slopes: Array) -> Array:
    """Green-Lagrange (e11, e22, 2 e12) from slopes (..., 3, 2)."""
    twice = slopes[..., :2, :] + slopes[..., :2, :].swapaxes(-1, -2) + slopes.swapaxes(-1, -2) @ slopes
    return np.stack([twice[..., 0, 0] / 2, twice[..., 1, 1] / 2, twice[..., 0, 1]], axis=-1)


class Discrete:
    """Discrete energy of the film; an unknown vector holds u, v, w of one node after the other, in mm."""

    def __init__(self, film: SkfemFilm, basis: Basis, load: Array) -> None:
        self.film, self.basis, self.load = film, basis, load
        self.gradient = gradients(basis)
        at = np.asarray(basis.global_coordinates()).transpose(1, 2, 0)
        factor = np.ones(at.shape[:2])
        for polygon, stiffer in film.stiffer:
            factor += (stiffer - 1) * np.clip(0.5 - beyond(at, polygon) / film.soft, 0, 1)
        self.weights = film.thickness * basis.dx
        self.moduli = factor[..., None, None] * film.moduli
        self.tension = np.array(film.tension)
        self.dofs = (3 * basis.element_dofs.T[:, :, None] + np.arange(3)).reshape(basis.nelems, -1)
        bent = bending(basis, film.moduli * film.thickness**3 / 12).tocoo()
        self.plate = coo_array((bent.data, (3 * bent.row + 2, 3 * bent.col + 2)), shape=(3 * basis.N,) * 2).tocsc()
        inner = np.setdiff1d(np.arange(basis.N), basis.get_dofs().all())
        self.free = (3 * inner[:, None] + np.arange(3)).ravel()

    def slopes(self, unknown: Array) -> Array:
        """d(u, v, w) / d(x, y), shape (e, p, 3, 2)."""
        local = unknown.reshape(-1, 3)[self.basis.element_dofs.T].swapaxes(1, 2)[:, None]
        return local @ self.gradient.swapaxes(2, 3)

    def stress(self, strained: Array) -> Array:
        """Without the pretension, shape (e, p, 3), as the membrane bears it."""
        return (self.moduli @ strained[..., None])[..., 0]

    def energy(self, unknown: Array) -> float:
        """Potential energy in N mm."""
        strained = strain(self.slopes(unknown))
        density = np.sum(strained * (self.stress(strained) / 2 + self.tension), axis=-1)
        return float(np.sum(self.weights * density) + unknown @ (self.plate @ unknown / 2 - self.load))

    def force(self, unknown: Array) -> Array:
        """Gradient of the energy."""
        slopes = self.slopes(unknown)
        total = matrix_of(self.stress(strain(slopes)) + self.tension)
        flux = (slopes + np.eye(3, 2)) @ total * self.weights[..., None, None]
        cells, _, _, shapes = self.gradient.shape
        flat = self.gradient.reshape(cells, -1, shapes).swapaxes(1, 2)
        local = flat @ flux.swapaxes(2, 3).reshape(cells, -1, 3)
        return np.bincount(self.dofs.ravel(), local.ravel(), len(unknown)) + self.plate @ unknown - self.load

    def size(self, unknown: Array) -> float:
        """Norm of the force that is out of balance, N."""
        return float(np.linalg.norm(self.force(unknown)[self.free]))

    def tangent(self, unknown: Array, extra: float) -> csc_array:
        """Second derivative of the energy, with an extra tension in its stress."""
        slopes = self.slopes(unknown)
        total = matrix_of(self.stress(strain(slopes)) + self.tension) + extra * np.eye(2)
        stretch = slopes + np.eye(3, 2)
        cells, points, _, shapes = self.gradient.shape
        flat = self.gradient.reshape(cells, -1, shapes).swapaxes(1, 2)
        local = np.empty((cells, shapes, 3, shapes, 3))
        voigt = np.zeros((3, cells, points, 3, 2))  # d(e11, e22, 2 e12) / d(w_i,1, w_i,2)
        voigt[..., 0, 0] = voigt[..., 2, 1] = stretch[..., 0].transpose(2, 0, 1)
        voigt[..., 1, 1] = voigt[..., 2, 0] = stretch[..., 1].transpose(2, 0, 1)
        for i in range(3):
            left = voigt[i].swapaxes(2, 3) @ self.moduli
            for j in range(i, 3):
                modulus = self.weights[..., None, None] * (left @ voigt[j] + (i == j) * total)
                block = flat @ (modulus @ self.gradient).reshape(cells, -1, shapes)
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

    def equilibrium(self, start: Array | None = None) -> Array:
        """Newton's method with an energy line search, and an extra tension in the tangent where that fails."""
        film = self.film
        scale = (max(film.young) * self.load.sum() ** 2 / (film.thickness * film.radius) ** 2) ** (1 / 3)
        if start is None:
            unknown = self.inverse(np.zeros_like(self.load), scale - min(0.0, *film.tension[:2]))(self.load)
            extra = scale / 4
        else:
            unknown, extra = start, 0.0
        energy = self.energy(unknown)
        for _ in range(30):
            force = self.force(unknown)
            solve_linear = self.inverse(unknown, extra)
            step = -solve_linear(force)
            slope = float(force @ step)
            if extra == 0 and abs(slope) < 1e-9 * abs(energy):
                return unknown + step
            if extra == 0 and self.size(unknown + step) < 0.3 * self.size(unknown):  # also where a wrinkle is lower
                unknown = unknown + step
                energy = self.energy(unknown)
                continue
            length, lower = 1.0, self.energy(unknown + step)
            while lower > energy + 1e-4 * length * slope and length > 0.05:
                length /= 2
                lower = self.energy(unknown + length * step)
            if slope < 0 and length > 0.05:
                unknown, energy = unknown + length * step, lower
                for _ in range(
                    12 if extra == 0 and length == 1 else 0
                ):  # more steps with the same tangent while it pays
                    before, step = slope, -solve_linear(force := self.force(unknown))
                    slope = float(force @ step)
                    if abs(slope) > 0.1 * abs(before):
                        break
                    unknown = unknown + step
                    if abs(slope) < 1e-10 * abs(energy):
                        return unknown
                energy = self.energy(unknown)
                extra = extra / 4 if extra > 0.02 * scale else 0.0
            else:
                extra = max(4 * extra, 0.05 * scale)
        raise RuntimeError("no equilibrium found")


def matrix_of(stress: Array) -> Array:
    """(s11, s22, s12) as matrices (..., 2, 2)."""
    return stress[..., [0, 2, 2, 1]].reshape(*stress.shape[:-1], 2, 2)


def beyond(points: Array, polygon: Array) -> Array:
    """How far points (..., 2) lie beyond an anticlockwise convex polygon's sides, mm; negative inside."""
    x, y = (np.roll(polygon, -1, axis=0) - polygon).T
    outward = np.c_[y, -x] / np.hypot(x, y)[:, None]
    return np.max(points @ outward.T - np.sum(polygon * outward, axis=1), axis=-1)


# --- answers ----------------------------------------------------------------------------------------------------------


@dataclass
class Solution:
    """A pressed film: ask it for charges and deflections."""

    film: SkfemFilm
    basis: Basis
    unknown: Array

    def touch_stress(self, points: Array) -> Array:
        """Stress of the film, s11, s22, s12 along x and y, that the press adds: (m, 3), MPa, at points (m, 2) in mm."""
        cells = self.basis.mesh.element_finder()(*points.T)
        local = self.basis.mapping.invF(points.T[:, :, None], cells)
        shapes = [self.basis.elem.gbasis(self.basis.mapping, local, k, cells)[0].grad for k in range(self.basis.Nbfun)]
        gradient = np.stack(shapes, axis=-1).transpose(1, 2, 0, 3)[:, 0]
        slopes = self.unknown.reshape(-1, 3)[self.basis.element_dofs[:, cells].T].swapaxes(1, 2) @ gradient.swapaxes(
            1, 2
        )
        return strain(slopes) @ self.film.moduli

    def deflection(self, point: ArrayLike) -> float:
        """Deflection in mm at a point in mm."""
        return float((self.basis.probes(np.asarray(point, float)[:, None]) @ self.unknown[2::3])[0])

    def charge(self, electrode: Sequence[Array], d31: float, d32: float) -> float:
        """Touch charge in pC of disjoint convex polygons (n, 2) in mm; d31 and d32 in pC/N along the film's axes."""
        along = np.array([d31, d32, 0.0]) @ np.linalg.inv(stress_turn(self.film.angle))
        total = 0.0
        for corners in electrode:
            around = np.arange(len(corners))
            fan = np.stack([around, np.roll(around, -1), np.full_like(around, len(corners))])
            patch = MeshTri(np.vstack([corners, corners.mean(axis=0)]).T.copy(), fan).refined(3)
            fine = Basis(patch, ElementTriP1(), intorder=4)
            tension = self.touch_stress(np.asarray(fine.global_coordinates()).reshape(2, -1).T)
            total += float(fine.dx.ravel() @ (tension @ along))
        return total


def solve(
    film: SkfemFilm,
    at: tuple[float, float],
    reach: float,
    force: float,
    around: int = 24,
    edges: float = 0.7,
    start: Callable[[Basis], Array] | None = None,
) -> Solution:
    """Equilibrium under a round tip at a place; `around` triangles round the circle, `edges` mm at stiffer electrodes.

    `start` gives Newton's first field.
    """
    pull = max(0.05, 0.5 * (film.tension[0] + film.tension[1])) + 0.2 * (
        film.young[0] * (force / film.thickness / film.radius) ** 2
    ) ** (1 / 3)
    layer = min(np.sqrt(film.moduli[0, 0] * film.thickness**2 / 12 / pull) / film.radius, 0.01)
    mesh, pressed = film_mesh(film, complex(*at), reach, float(layer), around)
    tip = np.flatnonzero(pressed)
    mesh = mesh.with_subdomains({"tip": tip})
    if film.stiffer and edges:
        mesh = finer_at(mesh, [np.asarray(polygon) for polygon, _ in film.stiffer], edges)
    basis = Basis(mesh, ElementTriP3(), intorder=10 if film.stiffer else 5)
    weight = np.zeros(mesh.nelements)
    weight[mesh.subdomains["tip"]] = 1.0
    local = np.stack([np.sum(weight[:, None] * basis.dx * np.asarray(shape[0]), axis=1) for shape in basis.basis])
    load = np.zeros(3 * basis.N)
    load[2::3] = np.bincount(basis.element_dofs.ravel(), local.ravel(), basis.N)
    load *= force / load.sum()
    return Solution(film, basis, Discrete(film, basis, load).equilibrium(start(basis) if start else None))


def finer_at(mesh: MeshTri, polygons: Sequence[Array], size: float) -> MeshTri:
    """The mesh with triangles that touch a polygon's edge refined down to a size in mm."""
    dense = np.vstack(
        [
            a + np.linspace(0, 1, 2 + int(np.hypot(*(b - a)) / (0.3 * size)))[:, None] * (b - a)
            for polygon in polygons
            for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True)
        ]
    )
    for _ in range(4):
        touched = np.unique(mesh.element_finder()(*dense.T))
        corners = mesh.p[:, mesh.t[:, touched]]
        longest = np.max([np.hypot(*(corners[:, i] - corners[:, i - 1])) for i in range(3)], axis=0)
        if not (longest > 1.5 * size).any():
            break
        mesh = mesh.refined(touched[longest > 1.5 * size])
    return mesh
