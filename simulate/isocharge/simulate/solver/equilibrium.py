"""The film at rest under a press, and its deflection and stress at any point.

Every press is solved on the positive x axis, the film turned with it, and rotated when it is read. If the film is round
and its elasticity isotropic, one equilibrium serves all angles, electrode layouts and piezoelectric coefficients.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.scaling import DimensionlessGroups, scaled_stress
from isocharge.simulate.mechanics.stress import principal_stresses, rotate_stress, strain
from isocharge.simulate.mechanics.theory import Theory
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.numerics.interpolation import tensor_values
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Probe

SIDE = {"middle": 0.0, "top": 1.0, "bottom": -1.0}
"""Place of each surface in the thickness: 1 on the side that the probe touches."""


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """The film at rest under a press: what `deflection`, `touch_stress` and `touch_charge` read.

    Attributes:
        film: The film.
        probe: The footprint.
        at: Centroid of the footprint (x, y), mm.
        force: N.
        theory: Which terms were modelled.
        mesh: The mesh, where it lies under the press rotated onto the x axis.
        field: Nodal (U1, U2, W), dimensionless, of the press rotated onto the x axis; shape (n_node, 3).
        groups: Dimensionless groups of the press.
        status: "converged" or "failed".
        message: One sentence.
        iterations: Newton steps, each with its tangent; of a linear theory, solves with its only tangent.
        residual: Out-of-balance force over load; of a linear theory, the size of the last correction in the
            energy norm.
        seconds: Process CPU time of mesh and solve, s.
        proven_error: Difference of the charges from those on a mesh of one order less, if that was solved too.
    """

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    theory: Theory
    mesh: PlacedMesh
    field: Array
    groups: DimensionlessGroups
    status: Literal["converged", "failed"]
    message: str
    iterations: int
    residual: float
    seconds: float
    proven_error: float | None = None

    def __repr__(self) -> str:
        """The press, its deflection and its largest stress, beside that at which PVDF yields."""
        (depth,), most = deflection(self, np.array([self.at])), principal_stress(self)[1]
        yields = f", beyond {DEFAULT_STRESS_LIMIT:g} MPa: PVDF yields" * (most > DEFAULT_STRESS_LIMIT)
        x, y = self.at
        return (
            f"Equilibrium({self.force:g} N under {self.probe.notation} at ({x:g}, {y:g}) mm: {self.status}, deflection "
            f"{depth:.4g} mm, stress up to {most:.3g} MPa{yields})"
        )


def deflection(equilibrium: Equilibrium, points: Array) -> Array:
    """Deflection w at film points.

    Args:
        equilibrium: The solved press.
        points: (x, y), shape (n, 2), mm, on the film.

    Returns:
        Shape (n,), mm, positive in the direction of the push.

    Raises:
        SceneError: If a point is off the film.
    """
    mesh = equilibrium.mesh
    element, xi, eta, _ = _locate(equilibrium, points)
    values = tensor_values(mesh.resolution.order, xi, eta)
    scaled = np.einsum("pn,pn->p", values, equilibrium.field[mesh.template.nodes[element], 2])
    return np.asarray(equilibrium.film.radius * np.sqrt(equilibrium.groups.amplitude2) * scaled)


def touch_stress(equilibrium: Equilibrium, points: Array, surface: Surface = "middle") -> Array:
    """Second Piola-Kirchhoff stress that the press adds to the pretension.

    Args:
        equilibrium: The solved press.
        points: (x, y), shape (n, 2), mm, on the film.
        surface: Where in the thickness: "top" is the side that the probe touches. The stress of bending is linear
            through the thickness and exists whether or not the theory lets the film resist it.

    Returns:
        (s11, s22, s12) in the film's axes, shape (n, 3), MPa, tension positive.

    Raises:
        SceneError: If a point is off the film.
    """
    mesh, groups = equilibrium.mesh, equilibrium.groups
    element, xi, eta, mirrored = _locate(equilibrium, points)
    gradient = mesh.gradient(element, xi, eta)
    strained = strain(gradient @ equilibrium.field[mesh.template.nodes[element]], groups.amplitude2)
    if surface != "middle":
        strained += _bent_strain(equilibrium, surface, gradient @ node_slope(equilibrium)[element, :, :, 2])
    if mesh.coat is not None:
        strained = mesh.coat.of_film(_rotated(equilibrium, points), strained)
    local = equilibrium.film.young * groups.amplitude2 * scaled_stress(strained, groups)
    local[mirrored, 2] *= -1.0
    return rotate_stress(local, np.arctan2(equilibrium.at[1], equilibrium.at[0]))


def nodal_stress(equilibrium: Equilibrium, surface: Surface = "middle") -> Array:
    """Scaled touch stress C : E' at the nodes of every element, the press rotated onto the x axis.

    Shape (n_element, n_local, 3): (S11, S22, S12) over E_young A^2; see `touch_stress` for the surface.
    """
    slope = node_slope(equilibrium)
    strained = strain(slope, equilibrium.groups.amplitude2)
    if surface != "middle":
        strained += _bent_strain(equilibrium, surface, equilibrium.mesh.node_derivatives(slope[..., 2]))
    return scaled_stress(strained, equilibrium.groups)


def principal_stress(equilibrium: Equilibrium) -> tuple[float, float]:
    """Smallest and largest principal stress anywhere in the film, pretension included, MPa, tension positive.

    At the mid-surface, and where the theory has bending at both surfaces for the largest.
    """
    groups = equilibrium.groups
    deviator = np.zeros(3) if groups.anisotropy is None else groups.anisotropy.tension
    smallest, largest = principal_stresses(nodal_stress(equilibrium) + deviator)
    if equilibrium.theory.bending:
        outer = (principal_stresses(nodal_stress(equilibrium, surface) + deviator)[1] for surface in ("top", "bottom"))
        largest = max(largest, *outer)
    scale = equilibrium.film.young * groups.amplitude2
    return scale * smallest + equilibrium.film.pretension, scale * largest + equilibrium.film.pretension


def node_slope(equilibrium: Equilibrium) -> Array:
    """d(U1, U2, W)/d(X1, X2) at the nodes of every element, shape (n_element, n_local, 2, 3)."""
    mesh = equilibrium.mesh
    return mesh.node_derivatives(equilibrium.field[mesh.template.nodes])


def _bent_strain(equilibrium: Equilibrium, surface: Surface, hessian: Array) -> Array:
    """Scaled strain (E11, E22, 2 E12) of bending at a surface, `hessian` that of W."""
    film = equilibrium.film
    half = 0.5 * film.thickness / (film.radius * np.sqrt(equilibrium.groups.amplitude2))
    return np.asarray(
        (SIDE[surface] * half)
        * np.stack([hessian[..., 0, 0], hessian[..., 1, 1], hessian[..., 0, 1] + hessian[..., 1, 0]], axis=-1)
    )


def _locate(equilibrium: Equilibrium, points: Array) -> tuple[Integers, Array, Array, Booleans]:
    """Element, xi, eta of each point and whether it was mirrored into a half template; SceneError off the film."""
    points, radius = np.asarray(points, dtype=float), equilibrium.film.radius
    alpha, oval = equilibrium.film.oval_axis, equilibrium.film.oval
    rim = radius * (1.0 + oval * np.cos(2.0 * (np.arctan2(points[:, 1], points[:, 0]) - alpha))) if oval else radius
    off = ~(np.hypot(points[:, 0], points[:, 1]) <= rim * (1.0 + 1e-9))
    if off.any():
        first = points[np.argmax(off)]
        raise SceneError(f"point ({first[0]:.4g}, {first[1]:.4g}) mm is off the film of radius {radius:.4g} mm")
    return equilibrium.mesh.locate(_rotated(equilibrium, points))


def _rotated(equilibrium: Equilibrium, points: Array) -> Complexes:
    """Points (x, y), mm, as x + iy in film radii, the press rotated onto the x axis."""
    z = (points[:, 0] + 1j * points[:, 1]) / equilibrium.film.radius
    return np.asarray(z * np.exp(-1j * np.arctan2(equilibrium.at[1], equilibrium.at[0])))
