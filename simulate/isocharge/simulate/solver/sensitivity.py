"""Effect of small imperfections of the film, such as anisotropy or an oval clamp, on an equilibrium.

The displacements u of an equilibrium satisfy R(u, m) = 0, where R is the residual and m is the value of an
imperfection. The tangent is K = dR/du. The derivative of the displacements with respect to m is

    du/dm = -K^-1 dR/dm.

If the tangent is already factorised, the derivative costs only one back substitution.

An imperfection may have two axes, like an ellipse. Let alpha be the angle between one axis of the imperfection and the
direction of the press. To first order, the change of the equilibrium is a sum of two fields, which have the factors
cos(2 alpha) and sin(2 alpha). With respect to a reflection in the line through the centre of the film and the press,
the first field is even and the second field is odd. Both fields are solved on the meshed half of the film, but
different displacement components are fixed on the line of symmetry.

The derivative dR/dm and the change of the stress are computed by central differences.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.execution.workers import single_threaded_blas
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.stress import stress_rotation
from isocharge.simulate.mesh.placed_mesh import PlacedMesh, from_oval
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.sensor.film import Surface
from isocharge.simulate.solver.assembly import assembly
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.tangent_factor import TangentFactor, factor_tangent

STEP = 1e-3
"""Step of the central differences, in units of the imperfection."""

AddImperfection = Callable[[Equilibrium, float], Equilibrium]
"""Function that adds a given value of an imperfection to the film of an equilibrium.

The displacements of the returned equilibrium are unchanged, and are therefore not in equilibrium.
"""


@dataclass(frozen=True)
class StressField:
    """Field of the stress changes that an imperfection causes.

    Attributes:
        add: Function that adds the imperfection to the film of an equilibrium.
        odd: Whether the field is odd about the direction of the press.
    """

    add: AddImperfection
    odd: bool


def _tension_imperfection(direction: tuple[float, float, float]) -> AddImperfection:
    """Create a function that adds a tension to the pretension of a film.

    The unit of the tension is the sum of E A^2 and the mean pretension, where E is Young's modulus and A is the
    amplitude of the press.

    Args:
        direction: Components (T11, T22, T12) of one unit.
    """

    def add_tension(solved: Equilibrium, value: float) -> Equilibrium:
        """Return the equilibrium with `value` units of additional tension."""
        unit = 1.0 + solved.groups.tension  # divided by E A^2, like all tensions in `groups`
        anisotropy = solved.groups.anisotropy
        tension = anisotropy.tension + value * unit * np.array(direction)
        return replace(solved, groups=replace(solved.groups, anisotropy=replace(anisotropy, tension=tension)))

    return add_tension


def _stiffness_imperfection(angle: float) -> AddImperfection:
    """Create a function that makes a film orthotropic.

    The value of the imperfection is ln(E1 / E2). To first order, E1 = E (1 + value / 2) and E2 = E (1 - value / 2).

    Args:
        angle: Angle from the direction of the press to axis 1 of the film, rad.
    """

    def add_stiffness(solved: Equilibrium, log_ratio: float) -> Equilibrium:
        """Return the equilibrium of a film with the given value of ln(E1 / E2)."""
        # Change of the elasticity matrix divided by E, in the axes of the film
        plane_modulus = 1.0 / (1.0 - solved.groups.poisson**2)
        change_along_axis_1 = 0.5 * log_ratio * plane_modulus
        change_in_film_axes = np.diag([change_along_axis_1, -change_along_axis_1, 0.0])

        # Rotate the change into the frame of the press.
        rotation = stress_rotation(angle)
        moduli_change = rotation @ change_in_film_axes @ rotation.T
        anisotropy = solved.groups.anisotropy
        moduli = anisotropy.moduli + moduli_change
        return replace(solved, groups=replace(solved.groups, anisotropy=replace(anisotropy, moduli=moduli)))

    return add_stiffness


def _oval_imperfection(direction: complex) -> AddImperfection:
    """Create a function that makes the clamp of a film oval.

    The value of the imperfection is the parameter e of the oval clamp; see `PlacedMesh.oval`.

    Args:
        direction: exp(2 i alpha), where alpha is the angle from the direction of the press to the longer axis.
    """

    def add_oval(solved: Equilibrium, value: float) -> Equilibrium:
        """Return the equilibrium of a film whose oval clamp has the parameter `value`."""
        # The position of the probe does not change, so its position on the circular film does.
        mesh = solved.mesh
        radius = solved.film.radius
        oval = mesh.oval + value * direction
        relative_position = np.array(np.hypot(*solved.at) / radius, dtype=complex)
        circular_distance = radius * from_oval(relative_position, oval).real
        placement = Placement.of(mesh.template, mesh.placement.probe, circular_distance, radius, mesh.layer)
        return replace(solved, mesh=replace(mesh, oval=oval, placement=placement))

    return add_oval


FILM_FIELDS = (
    StressField(_tension_imperfection((1.0, 1.0, 0.0)), odd=False),
    StressField(_tension_imperfection((1.0, -1.0, 0.0)), odd=False),
    StressField(_tension_imperfection((0.0, 0.0, 1.0)), odd=True),
    StressField(_stiffness_imperfection(0.0), odd=False),
    StressField(_stiffness_imperfection(0.25 * np.pi), odd=True),
    StressField(_oval_imperfection(1.0), odd=False),
    StressField(_oval_imperfection(1j), odd=True),
)
"""Stress fields of a changed film: mean tension, uneven tension, uneven stiffness, and oval clamp.

The mean tension has one field. Each other imperfection has an even field and an odd field, in this order.
"""

FILM_IS_ODD = np.array([field.odd for field in FILM_FIELDS])
"""Whether each of `FILM_FIELDS` is odd about the direction of the press, shape (n_field,)."""


def _side_load_imperfection(direction: tuple[float, float]) -> AddImperfection:
    """Create a function that adds a side load to a press.

    The unit of the side load is E h a A^2, with Young's modulus E, the thickness h, the film radius a and the amplitude
    A.

    Args:
        direction: Unit vector (x, y) of the side load.
    """

    def add_side_load(solved: Equilibrium, value: float) -> Equilibrium:
        """Return the equilibrium with `value` units of additional side load."""
        load_x, load_y = solved.groups.side_load
        direction_x, direction_y = direction
        side_load = (load_x + value * direction_x, load_y + value * direction_y)
        return replace(solved, groups=replace(solved.groups, side_load=side_load))

    return add_side_load


SIDE_FORCE_FIELDS = (
    StressField(_side_load_imperfection((1.0, 0.0)), odd=False),
    StressField(_side_load_imperfection((0.0, 1.0)), odd=True),
)
"""Stress fields of a side force along the direction of the press (even), and across this direction (odd)."""

SIDE_FORCE_IS_ODD = np.array([field.odd for field in SIDE_FORCE_FIELDS])
"""Whether each of `SIDE_FORCE_FIELDS` is odd, shape (2,)."""


def stress_changes(solved: Equilibrium, fields: Sequence[StressField], surface: Surface = "middle") -> Array:
    """Compute how the scaled stress at the nodes changes, for example by `FILM_FIELDS` or `SIDE_FORCE_FIELDS`.

    The changes refer to fixed points of the film, after the press has been rotated onto the x axis. The unit of a
    tension is the sum of E A^2 and the mean pretension, where E is Young's modulus and A is the amplitude of the press.
    The function `scaling.side_force_unit` returns the unit of a side force.

    Args:
        solved: Press with a circular probe.
        fields: Stress fields to be computed.
        surface: Surface of the film at which the stress is computed; see `touch_stress`.

    Returns:
        Changes per unit, shape (n_element, n_local, n_field, 3), in the order of the table of a `ForwardMap` with
        several fields. The last two axes are the field and the stress component (S11, S22, S12).
    """
    # Even and odd fields have different fixed displacements on the line of symmetry. Therefore the tangent is
    # factorised once for all even fields, and once for all odd fields.
    with single_threaded_blas():
        elastic = ElasticFilm(solved.mesh.geometry, solved.groups)
        factors = [
            factor_tangent(elastic, assembly(solved.mesh.template, elastic.unknowns_per_node, odd), solved.field)
            for odd in (False, True)
        ]
        changes = [_change_by_imperfection(solved, field.add, factors[field.odd], surface) for field in fields]
        return np.stack(changes, axis=2)


def _change_by_imperfection(
    solved: Equilibrium, add_imperfection: AddImperfection, factor: TangentFactor, surface: Surface
) -> Array:
    """Compute how one imperfection changes the scaled stress at the nodes.

    Args:
        solved: The solved press.
        add_imperfection: Function that adds a given value of the imperfection to the film of the press.
        factor: Factorised tangent of the press.
        surface: Surface of the film at which the stress is computed.

    Returns:
        Change per unit of the imperfection, shape (n_element, n_local, 3).
    """
    # Add a positive and a negative step of the imperfection. The displacements are not in equilibrium yet.
    positive_press = add_imperfection(solved, STEP)
    negative_press = add_imperfection(solved, -STEP)

    # Compute the change of the displacements that restores the equilibrium after one positive step. The change of the
    # residual by one step is half of the difference between both residuals.
    positive_residual = ElasticFilm(positive_press.mesh.geometry, positive_press.groups).residual(positive_press.field)
    negative_residual = ElasticFilm(negative_press.mesh.geometry, negative_press.groups).residual(negative_press.field)
    displacement_change = -0.5 * factor.solve(positive_residual - negative_residual)

    # Compute the derivative of the stress by a central difference.
    positive_equilibrium = replace(positive_press, field=positive_press.field + displacement_change)
    negative_equilibrium = replace(negative_press, field=negative_press.field - displacement_change)
    positive_stress = nodal_stress(positive_equilibrium, surface)
    negative_stress = nodal_stress(negative_equilibrium, surface)
    change = (positive_stress - negative_stress) / (2.0 * STEP)

    # The nodes of an oval film move with the rim. Subtract the change of the stress that the movement of the nodes
    # causes, so that the result holds for fixed points of the film.
    if positive_press.mesh.oval != negative_press.mesh.oval:
        node_shift = (positive_press.mesh.points - negative_press.mesh.points) / (2.0 * STEP)
        change -= change_by_node_shift(solved.mesh, nodal_stress(solved, surface), node_shift)
    return np.asarray(change)


def change_by_node_shift(mesh: PlacedMesh, stress: Array, node_shift: Complexes) -> Array:
    """Compute to first order how the stress at the nodes changes if the nodes move in a constant stress field.

    Args:
        mesh: Mesh before the movement.
        stress: Stress at the nodes of every element, shape (n_element, n_local, 3).
        node_shift: Movement x + iy of the nodes of every element, shape (n_element, n_local), in film radii.

    Returns:
        Change of the stress at the nodes, same shape and unit as `stress`.
    """
    stress_gradient = mesh.node_derivatives(stress)
    x_contribution = node_shift.real[..., None] * stress_gradient[..., 0, :]
    y_contribution = node_shift.imag[..., None] * stress_gradient[..., 1, :]
    return np.asarray(x_contribution + y_contribution)
