"""Change of an equilibrium due to small changes of the film or the probe, or due to friction under the probe.

The displacements u of an equilibrium satisfy R(u, m) = 0, where R is the residual and m is the value of an
imperfection, or of another property of the film or the probe. The tangent is K = dR/du. The derivative of the
displacements with respect to m is

    du/dm = -K^-1 dR/dm.

If the tangent is already factorised, the derivative costs only one back substitution.

An imperfection may have two axes, like an ellipse. Let alpha be the angle between one axis of the imperfection and the
direction of the press. To first order, the equilibrium changes by the sum of two fields. The first field is multiplied
by cos(2 alpha), and the second field by sin(2 alpha). Under a reflection in the line through the centre of the film and
the press, the first field is even and the second field is odd. Both fields are solved on the meshed half of the film,
but different displacement components are fixed on the line of symmetry.

The derivative dR/dm and the change of the stress are computed by central differences.

Friction acts between the film and a probe on a stage that moves vertically. If a probe presses beside the centre, the
film is steeper between the probe and the near rim than elsewhere. The material point under the probe moves outwards,
because the steeper part of the film would otherwise stretch more than the rest. A probe on a stage that moves exactly
vertically does not follow the movement of the material point. The film therefore slips outwards under the probe, and
friction pulls the film inwards. A probe that hangs freely follows the movement of the material point, and exerts no
side force.

The model is Coulomb friction during one press with increasing force (Johnson 1985, section 7.1). The holding force is
the side force that would keep the material point under the probe in place. The largest possible friction is the
coefficient of friction times the force of the press. If the holding force is smaller than the largest friction, the
film sticks to the probe, and the side force is the holding force. If the holding force is larger, the film slips, and
the side force is the largest friction. The friction acts in the direction opposite to the slip. The side force is
distributed over the footprint like the pressure.

While the probe is lifted, the directions of the slip and of the side force are reversed. The model does not describe
the lifting.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.theory import bending_stiffness, elasticity, side_force_unit
from isocharge.simulate.mesh.placed_mesh import PlacedMesh
from isocharge.simulate.mesh.placement import Placement
from isocharge.simulate.sensor.film import Surface, add_anisotropy, check_range
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.probe import RoundProbe
from isocharge.simulate.solver.assembly import SolveTangent, factor_tangent, single_threaded_blas
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.load_case import MAX_SIDE_SHARE

STEP = 1e-3
"""Step of the central differences, in units of the changed property."""

AddChange = Callable[[Equilibrium, float], Equilibrium]
"""Function that changes one property of an equilibrium, namely of its film or its probe, by a given value.

The displacements remain unchanged, so the returned state is not in equilibrium.
"""


@dataclass(frozen=True)
class StressField:
    """Stress field that describes the effect of a change of one property of the film or of the probe.

    Attributes:
        name: Name of the changed property.
        add: Function that adds a value to this property.
        odd: Whether the field is odd under a reflection in the line through the centre of the film and the press.
    """

    name: str
    add: AddChange
    odd: bool


def _add_tension(solved: Equilibrium, value: float, direction: tuple[float, float, float]) -> Equilibrium:
    """Add a tension to the pretension of the film.

    The unit of the added tension is E A^2 plus the mean pretension, where E is Young's modulus and A is the amplitude
    of the press.

    Args:
        solved: The press.
        value: Size of the added tension, in units of E A^2 plus the mean pretension.
        direction: Components (T11, T22, T12) of an added tension whose size is 1.
    """
    groups = solved.groups
    tension_unit = 1.0 + groups.tension  # divided by E A^2, like all tensions in `groups`

    # The solver adds `uneven_tension` to the mean pretension, so it may also contain a change of the mean pretension.
    changed_tension = groups.uneven_tension + value * tension_unit * np.array(direction)
    return replace(solved, groups=replace(groups, uneven_tension=changed_tension))


def _add_stiffness(solved: Equilibrium, log_ratio: float, angle: float) -> Equilibrium:
    """Add a second anisotropy, whose axes may differ from the axes of the film, to the moduli of the film.

    Args:
        solved: The press.
        log_ratio: ln(E1 / E2) of the second anisotropy.
        angle: Angle from the direction of the press to axis 1 of the second anisotropy, rad.
    """
    film = solved.film
    changed_film = add_anisotropy(film, cmath.rect(log_ratio, 2.0 * (solved.direction + angle)))
    groups = replace(
        solved.groups,
        elasticity=elasticity(changed_film, solved.direction),
        bending=solved.groups.bending * bending_stiffness(changed_film) / bending_stiffness(film),
    )
    return replace(solved, groups=groups)


def _add_oval(solved: Equilibrium, value: float, direction: complex) -> Equilibrium:
    """Make the clamp of the film oval. The displacements at the nodes are unchanged.

    Args:
        solved: The press.
        value: Parameter e of the oval clamp, whose semi-axes are 1 + e and 1 - e film radii.
        direction: exp(2 i alpha), where alpha is the angle from the direction of the press to the longer axis.
    """
    placement = solved.mesh.placement
    return _place_mesh_again(solved, placement.probe, placement.oval + value * direction)


def _add_radius(solved: Equilibrium, value: float) -> Equilibrium:
    """Increase the radius of a round probe. The displacements at the nodes are unchanged.

    Args:
        solved: The press.
        value: Increase of the radius, mm.
    """
    placement = solved.mesh.placement
    assert isinstance(placement.probe, RoundProbe)
    larger_probe = replace(placement.probe, radius=placement.probe.radius + value)
    return _place_mesh_again(solved, larger_probe, placement.oval)


def _place_mesh_again(solved: Equilibrium, probe: Probe, oval: complex | Complexes) -> Equilibrium:
    """Place the mesh of a press again for another probe or another clamp, with unchanged displacements at its nodes.

    Args:
        solved: The press.
        probe: Probe for which the mesh is placed. It has the same topology as the probe of the press.
        oval: Shape of the clamp in the frame of the press, as the complex number e exp(2 i alpha). The clamp has the
            semi-axes 1 + e and 1 - e film radii. The angle alpha leads from the direction of the press to the longer
            axis.
    """
    mesh = solved.mesh
    distance = np.array(np.hypot(*solved.at))
    placement = Placement.of(mesh.template, probe, distance, solved.film.radius, mesh.layer, oval=oval)
    return replace(solved, mesh=replace(mesh, placement=placement))


FILM_FIELDS = (
    StressField("probe_radius", _add_radius, odd=False),
    StressField("pretension", partial(_add_tension, direction=(1.0, 1.0, 0.0)), odd=False),
    StressField("tension_difference", partial(_add_tension, direction=(1.0, -1.0, 0.0)), odd=False),
    StressField("tension_shear", partial(_add_tension, direction=(0.0, 0.0, 1.0)), odd=True),
    StressField("stiffness_x", partial(_add_stiffness, angle=0.0), odd=False),
    StressField("stiffness_xy", partial(_add_stiffness, angle=0.25 * np.pi), odd=True),
    StressField("oval_x", partial(_add_oval, direction=1.0), odd=False),
    StressField("oval_xy", partial(_add_oval, direction=1j), odd=True),
)
"""Stress fields of a changed probe or film: radius of the probe, mean and uneven tension, uneven stiffness, oval clamp.

The radius of the probe and the mean tension have one field each. Each imperfection has an even field and an odd field,
in this order. Let alpha be the angle from the x axis to axis 1 of the imperfection. The two fields belong to two
properties of the film: the size of the imperfection times cos(2 alpha), and the size times sin(2 alpha).
"""

SCALAR_FIELDS = 2
"""Number of fields without a direction. They are the first entries of `FILM_FIELDS`."""

TENSION_FIELDS = slice(1, 4)
"""Indices of the entries of `FILM_FIELDS` that describe a change of the tension."""

FILM_IS_ODD = np.array([field.odd for field in FILM_FIELDS])
"""Values of `StressField.odd` for the fields in `FILM_FIELDS`, shape (n_field,)."""


def stress_changes(solved: Equilibrium, surface: Surface) -> Array:
    """Compute how the scaled stress at the nodes changes if a property of the film or the radius of the probe changes.

    Each entry of `FILM_FIELDS` describes one property. The film is rotated such that the press lies on the positive x
    axis. The stress is compared at fixed points of the rotated film. An even change of the film is symmetric about the
    x axis, and an odd change is antisymmetric.

    Args:
        solved: Press with a circular probe.
        surface: Surface of the film at which the stress is computed. The probe touches the surface "top".

    Returns:
        Change of the stress per unit of each property, shape (n_element, n_local, n_field, 3). The last axis is the
        stress component (S11, S22, S12). The unit of a tension is E A^2 + T, where E is Young's modulus, A is the
        amplitude of the press, and T is the mean pretension. The tension under the press has this order of magnitude.
    """
    # The touch stress is the stress under the press minus the stress before the contact. Its changes are the same
    # difference of the changes of both stresses. `rest` is the equilibrium before the contact under a static pressure.
    if solved.rest is not None:
        before_contact = stress_changes(solved.rest, surface)
        under_press = stress_changes(replace(solved, rest=None), surface)
        return under_press - before_contact

    # Even and odd fields have different fixed displacements on the line of symmetry. Therefore the tangent is
    # factorised once for all even fields, and once for all odd fields.
    with single_threaded_blas():
        elastic = solved.elastic
        solve_even = factor_tangent(elastic, solved.field)
        solve_odd = factor_tangent(elastic, solved.field, odd=True)

        # In an odd change, the two halves of the film displace opposite amounts of air, so the pressure of trapped air
        # remains constant. The trapped air is therefore replaced by a static pressure of the same size.
        solved_for_odd = solved
        if elastic.back_pressure is not None:
            groups = elastic.back_pressure.at_constant_pressure(solved.field[:, 2])
            solved_for_odd = replace(solved, groups=groups)

        # `add` is the function that adds a value to the property.
        changes = []
        for film_property in FILM_FIELDS:
            if film_property.odd:
                changes.append(_change_of_stress(solved_for_odd, film_property.add, solve_odd, surface))
            else:
                changes.append(_change_of_stress(solved, film_property.add, solve_even, surface))
        return np.stack(changes, axis=2)


def _change_of_stress(solved: Equilibrium, add_change: AddChange, solve: SolveTangent, surface: Surface) -> Array:
    """Compute how a change of one property changes the scaled stress at the nodes.

    Args:
        solved: The solved press.
        add_change: Function that adds a given value to the property of the film or the probe.
        solve: Function that solves linear systems with the tangent of the press.
        surface: Surface of the film at which the stress is computed.

    Returns:
        Change per unit of the property, shape (n_element, n_local, 3).
    """
    # Add a positive and a negative step to the property. The displacements are not in equilibrium yet.
    positive_press = add_change(solved, STEP)
    negative_press = add_change(solved, -STEP)

    # Compute the change of the displacements that restores the equilibrium after one positive step.
    positive_residual = positive_press.elastic.residual(positive_press.field)
    negative_residual = negative_press.elastic.residual(negative_press.field)
    residual_change = 0.5 * (positive_residual - negative_residual)  # by one step
    displacement_change = -solve(residual_change)

    # Compute the derivative of the stress by a central difference.
    positive_equilibrium = replace(positive_press, field=positive_press.field + displacement_change)
    negative_equilibrium = replace(negative_press, field=negative_press.field - displacement_change)
    positive_stress = nodal_stress(positive_equilibrium, surface)
    negative_stress = nodal_stress(negative_equilibrium, surface)
    change = (positive_stress - negative_stress) / (2.0 * STEP)

    # The nodes move with an oval rim or with the edge of the probe. Subtract the change of the stress that the movement
    # of the nodes causes, so that the result holds for fixed points of the film. The two presses only have different
    # meshes if the changed property moves the nodes.
    if positive_press.mesh is not negative_press.mesh:
        node_shift = (positive_press.mesh.points - negative_press.mesh.points) / (2.0 * STEP)
        change -= change_by_node_shift(solved.mesh, nodal_stress(solved, surface), node_shift)
    return change


def change_by_node_shift(mesh: PlacedMesh, stress: Array, node_shift: Complexes) -> Array:
    """Compute, to first order, how the stress at the nodes changes if the nodes move through an unchanged stress field.

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
    return x_contribution + y_contribution


def holding_force(solved: Equilibrium) -> tuple[float, float]:
    """Compute, to first order, the side force that cancels the mean in-plane displacement of the footprint.

    The side force acts in the plane of the film. The compliance of the film is the mean displacement of the footprint
    under a unit side load. The holding force causes a mean displacement that is equal and opposite to the mean
    displacement caused by the press.

    Args:
        solved: Press without a side force.

    Returns:
        Force (Fx, Fy) of the probe on the film, N. The force points inwards if the film would slip outwards.
    """
    mesh = solved.mesh
    n_direction = 1 if mesh.template.half else 2  # a half template has no displacement across its line of symmetry

    # Mean in-plane displacement of the footprint since the contact, shape (n_direction,). `mesh.load` contains the
    # weights of the nodes in the mean over the footprint.
    field_before_contact = np.zeros_like(solved.field) if solved.rest is None else solved.rest.field
    slip = mesh.load @ (solved.field - field_before_contact)[:, :n_direction]

    # Mean displacement of the footprint under a unit side load in each direction, with one column for each load
    compliance = np.empty((n_direction, n_direction))
    with single_threaded_blas():
        solve = factor_tangent(solved.elastic, solved.field)
        for direction in range(n_direction):
            unit_load = np.zeros_like(solved.field)
            unit_load[:, direction] = mesh.load  # distributes a load of 1 over the nodes with the same weights
            compliance[:, direction] = mesh.load @ solve(unit_load)[:, :n_direction]

    # Compute the scaled side load that cancels the slip.
    scaled_force = np.zeros(2)
    scaled_force[:n_direction] = -np.linalg.solve(compliance, slip)

    # Convert the side load to N, and rotate it from the frame of the press to the axes x and y.
    force_unit = side_force_unit(solved.film, solved.groups.squared_amplitude)
    force = complex(*scaled_force) * force_unit * cmath.rect(1.0, solved.direction)  # Fx + i Fy
    return force.real, force.imag


def friction_force(solved: Equilibrium, coefficient: float) -> tuple[float, float]:
    """Compute the side force that friction exerts on the film under a probe on a stage that moves vertically.

    The holding force is the side force that would keep the film under the probe in place. The largest possible friction
    is the coefficient of friction times the force of the press. If the holding force does not exceed the largest
    friction, the film sticks to the probe, and the side force is the holding force. Otherwise the film slips, and the
    magnitude of the side force is the largest friction.

    Args:
        solved: Press without a side force.
        coefficient: Coefficient of friction, dimensionless. The coefficient of steel on PVDF is about 0.2.

    Returns:
        Force (Fx, Fy) of the probe on the film, N. The function `press` accepts this force as its argument
        `side_force`.

    Raises:
        SceneError: If the coefficient is not between 0 and `MAX_SIDE_SHARE`.
    """
    check_range("coefficient of friction", coefficient, (0.0, MAX_SIDE_SHARE), "", SceneError)
    holding_x, holding_y = holding_force(solved)
    magnitude = max(math.hypot(holding_x, holding_y), 1e-300)  # the limit avoids a division by zero
    factor = min(1.0, coefficient * solved.force / magnitude)  # 1 if the film sticks to the probe
    return factor * holding_x, factor * holding_y
