"""The film at rest under a press, and what can be read from it at any point.

The film is round and its elasticity isotropic, so every press is solved on the positive x axis and turned when it is
read: one equilibrium serves all angles, electrode layouts and piezoelectric coefficients.
"""

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from isocharge.common.arrays import Array, Complexes, Integers
from isocharge.common.errors import SceneError
from isocharge.common.json_values import finite_or_none
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mechanics.stress import principal_stresses, strain, stress, turn_stress
from isocharge.simulate.mechanics.theory import Theory, bending_length, modelling_error
from isocharge.simulate.mesh.elements import film_gradient
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.mesh.template import Template, template_for
from isocharge.simulate.numerics.interpolation import tensor_basis, tensor_values
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.error_estimate import LEAST_ERROR, mesh_error

LINEAR_STRESS = 40e6
"""Largest stress, Pa, at which PVDF counts as linear."""

WRINKLE_SHARE = 1e-3
"""Compression over the largest stress, dimensionless, above which a warning is given."""


@dataclass(frozen=True, kw_only=True)
class Equilibrium:
    """The film at rest under a press.

    Attributes:
        film: The film.
        probe: The footprint.
        at: Centroid of the footprint (x, y), m.
        force: N.
        theory: Which terms were modelled.
        placed_mesh: Mesh, where it lies under the press turned onto the x axis.
        field: Nodal (U1, U2, W), dimensionless, of the press turned onto the x axis; shape (n_node, 3).
        groups: Dimensionless groups of the scene.
        status: "converged" or "failed".
        message: One sentence.
        iterations: Newton steps, each with its tangent; of a linear theory, solves with its only tangent.
        residual: Out-of-balance force over load; of a linear theory, the size of the last correction in the
            energy norm.
        seconds: Process CPU time of mesh and solve.
        proven_error: Difference of the charges from those on a mesh of one order less, if that was solved too.
    """

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    theory: Theory
    placed_mesh: PlacedMesh
    field: Array
    groups: DimensionlessGroups
    status: Literal["converged", "failed"]
    message: str
    iterations: int
    residual: float
    seconds: float
    proven_error: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON: deflection under the probe, theory, estimated error, and how the solve went."""
        return {
            "deflection_mm": 1e3 * float(self.deflection(np.array([self.at]))[0]),
            "theory": self.theory.name,
            "status": self.status,
            "iterations": self.iterations,
            "residual": self.residual,
            "seconds": self.seconds,
            "estimated_error": finite_or_none(self.estimated_error),
            "groups": {**asdict(self.groups), "bending_length": self.bending_length},
            "warnings": list(self.warnings),
        }

    @property
    def estimated_error(self) -> float:
        """Expected relative error of a charge, from the terms that the theory leaves out and from the mesh.

        Infinite where the theory has no meaning for this film.
        """
        return self.mesh_error + modelling_error(self.film, self.probe, self.force, self.theory)

    @property
    def bending_length(self) -> float:
        """Length over which a clamped edge bends the film, over the film's radius."""
        return bending_length(self.film, self.force)

    @cached_property
    def mesh_error(self) -> float:
        """Expected relative error of a charge from the mesh."""
        if self.proven_error is not None:
            return max(LEAST_ERROR, self.proven_error)
        return mesh_error(self.placed_mesh, self._node_slope[..., 2])

    @cached_property
    def principal_stress(self) -> tuple[float, float]:
        """Smallest and largest principal stress anywhere in the film, pretension included, Pa, tension positive.

        At the mid-surface, and where the theory has bending at both surfaces for the largest.
        """
        middle = principal_stresses(self.nodal_stress())
        largest = middle[1]
        if self.theory.bending:
            largest = max(
                largest, *(principal_stresses(self.nodal_stress(surface))[1] for surface in ("top", "bottom"))
            )
        scale = self.film.young * self.groups.amplitude2
        return scale * middle[0] + self.film.pretension, scale * largest + self.film.pretension

    @property
    def warnings(self) -> tuple[str, ...]:
        """Effects in a real film that the theory does not model, one sentence each."""
        smallest, largest = self.principal_stress
        sentences = []
        if largest > LINEAR_STRESS:
            sentences.append(
                f"the film is stressed to {largest * 1e-6:.3g} MPa; PVDF is linear up to {LINEAR_STRESS * 1e-6:g} MPa"
            )
        if smallest < -WRINKLE_SHARE * largest:
            sentences.append(
                f"the film is compressed to {smallest * 1e-6:.3g} MPa somewhere; a thin film may wrinkle there"
            )
        return tuple(sentences)

    @property
    def mesh(self) -> Template:
        """The template."""
        return self.placed_mesh.template

    @property
    def resolution(self) -> Resolution:
        """How fine the mesh is."""
        return self.placed_mesh.resolution

    @property
    def layer(self) -> float:
        """Width of the mesh's thin rings at the rim over the film's radius."""
        return self.placed_mesh.layer

    @property
    def placement(self) -> Placement:
        """Where the template lies, the press turned onto the x axis."""
        return self.placed_mesh.placement

    def field_of_order(self, order: int) -> Array:
        """The field on the nodes of the same mesh with elements of another order, shape (n_node, 3)."""
        other = template_for(self.probe, replace(self.resolution, order=order))
        values = tensor_values(self.resolution.order, other.xi, other.eta)
        field = np.empty((other.n_node, 3))
        field[other.nodes] = values @ self.field[self.mesh.nodes]
        return field

    def deflection(self, points: Array) -> Array:
        """Deflection w at film points.

        Args:
            points: (x, y), shape (n, 2), m, on the film.

        Returns:
            Shape (n,), m, positive the way the probe pushes.
        """
        element, xi, eta, _ = self._locate(points)
        values = tensor_values(self.resolution.order, xi, eta)
        scaled = np.einsum("pn,pn->p", values, self.field[self.mesh.nodes[element], 2])
        deflection: Array = self.film.radius * np.sqrt(self.groups.amplitude2) * scaled
        return deflection

    def touch_stress(self, points: Array, surface: Surface = "middle") -> Array:
        """Second Piola-Kirchhoff stress that the press adds to the pretension.

        Args:
            points: (x, y), shape (n, 2), m, on the film.
            surface: Where in the thickness: "top" is the side that the probe touches. The stress of bending is linear
                through the thickness and exists whether or not the theory lets the film resist it.

        Returns:
            (s11, s22, s12) in the film's axes, shape (n, 3), Pa, tension positive.
        """
        element, xi, eta, mirrored = self._locate(points)
        gradient = self._gradient(element, xi, eta)
        strained = strain(gradient @ self.field[self.mesh.nodes[element]], self.groups.amplitude2)
        if surface != "middle":
            side = 1.0 if surface == "top" else -1.0
            strained += side * self._bent_strain(gradient @ self._node_slope[element, :, :, 2])
        local = self.film.young * self.groups.amplitude2 * stress(strained, self.groups.poisson)
        local[mirrored, 2] *= -1.0
        return turn_stress(local, np.arctan2(self.at[1], self.at[0]))

    def nodal_stress(self, surface: Surface = "middle") -> Array:
        """Scaled touch stress C : E' at the nodes of every element, the press turned onto the x axis.

        Shape (n_element, n_local, 3): (S11, S22, S12) over E_young A^2; see `touch_stress` for the surface.
        """
        strained = strain(self._node_slope, self.groups.amplitude2)
        if surface != "middle":
            side = 1.0 if surface == "top" else -1.0
            strained += side * self._bent_strain(self._node_hessian)
        return stress(strained, self.groups.poisson)

    def _bent_strain(self, hessian: Array) -> Array:
        """Scaled strain (E11, E22, 2 E12) of bending at the side that the probe touches, `hessian` that of W."""
        half = 0.5 * self.film.thickness / (self.film.radius * np.sqrt(self.groups.amplitude2))
        bent: Array = half * np.stack(
            [hessian[..., 0, 0], hessian[..., 1, 1], hessian[..., 0, 1] + hessian[..., 1, 0]], axis=-1
        )
        return bent

    def _gradient(self, element: Integers, xi: Array, eta: Array) -> Array:
        """d(basis)/d(X1, X2) at points of elements, shape (n, 2, n_local)."""
        _, by_local = tensor_basis(self.resolution.order, xi, eta)
        return film_gradient(by_local[:, :, None, :], self.placed_mesh.points[element])[0][:, 0]

    @cached_property
    def _node_gradient(self) -> Array:
        """d(basis)/d(X1, X2) at the nodes of every element, shape (n_element, n_local, 2, n_local)."""
        _, by_local = tensor_basis(self.resolution.order, self.mesh.xi, self.mesh.eta)
        return film_gradient(by_local[:, None], self.placed_mesh.points)[0]

    @property
    def _node_hessian(self) -> Array:
        """Second derivatives of W at the nodes of every element, shape (n_element, n_local, 2, 2)."""
        gradient, slope = self._node_gradient, self._node_slope[..., 2]
        flat = gradient.reshape(len(gradient), -1, gradient.shape[-1])
        return (flat @ slope).reshape(*gradient.shape[:3], 2)

    @cached_property
    def _node_slope(self) -> Array:
        """d(U1, U2, W)/d(X1, X2) at the nodes of every element, shape (n_element, n_local, 2, 3)."""
        gradient = self._node_gradient
        flat = gradient.reshape(len(gradient), -1, gradient.shape[-1])
        return (flat @ self.field[self.mesh.nodes]).reshape(*gradient.shape[:3], 3)

    def _locate(self, points: Array) -> tuple[Integers, Array, Array, np.ndarray]:
        """Element, xi, eta of each point and whether it was mirrored into a half template; SceneError off the film."""
        points = np.asarray(points, dtype=float)
        off = ~(np.hypot(points[:, 0], points[:, 1]) <= self.film.radius * (1.0 + 1e-9))
        if off.any():
            x, y = 1e3 * points[np.argmax(off)]
            raise SceneError(f"point ({x:.4g}, {y:.4g}) mm is off the film of radius {self.film.radius * 1e3:.4g} mm")
        position, mirrored = self.mesh.into_meshed_half(_on_axis(points, self.at) / self.film.radius)
        element, xi, eta = self.placement.batch().locate(self.mesh, position[None])
        return element[0], xi[0], eta[0], mirrored


def _on_axis(points: Array, at: tuple[float, float]) -> Complexes:
    """Film points as complex numbers, turned so that `at` comes to lie on the positive x axis; m."""
    turned: Complexes = (points[..., 0] + 1j * points[..., 1]) * np.exp(-1j * np.arctan2(at[1], at[0]))
    return turned
