"""First-order change of an equilibrium by imperfections of the film, such as anisotropy and an oval clamp.

The residual of the equilibrium is R(u, m) = 0, and its tangent is K = dR/du. A small imperfection m changes the
displacement by

    du/dm = -K^-1 dR/dm,

which costs one additional back substitution. Let alpha be the angle between an axis of the imperfection and the
direction of the press. For an imperfection with two axes, the change is the sum of two fields with the factors cos(2
alpha) and sin(2 alpha). With respect to a reflection in this direction, the first field is even and the second field is
odd. Both fields are solved on the meshed half of the film. The two fields have different fixed displacement components
on the line of symmetry. The derivative dR/dm and the change of the stress are central differences of the residual and
of the stress of a press.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import Anisotropy
from isocharge.simulate.mechanics.stress import stress_rotation
from isocharge.simulate.sensor.film import Surface
from isocharge.simulate.solver.assembly import assembly
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress
from isocharge.simulate.solver.tangent_factor import factor_tangent

STEP = 1e-3
"""Step of the central differences, in units of the imperfection."""

Change = Callable[[Equilibrium, float], Equilibrium]
"""Function that adds a value of an imperfection to the film of an equilibrium, and keeps the displacements."""


@dataclass(frozen=True)
class StressField:
    """A field of stress changes that one imperfection causes.

    Attributes:
        change: Function that adds the imperfection.
        odd: Whether the field is odd about the direction of the press.
    """

    change: Change
    odd: bool


def _tension(direction: tuple[float, float, float]) -> Change:
    """Return the function that adds a tension to the pretension of a film.

    The unit of the tension is the sum of E A^2 and the mean pretension, where E is Young's modulus and A the amplitude
    that scales the deflection of the press.

    Args:
        direction: Components (T11, T22, T12) of one unit.
    """

    def with_tension(solved: Equilibrium, value: float) -> Equilibrium:
        """Return the equilibrium with `value` units of the additional tension."""
        unit = 1.0 + solved.groups.tension  # over E A^2, like all tensions in `groups`
        anisotropy = Anisotropy(moduli=np.zeros((3, 3)), tension=value * unit * np.array(direction))
        return replace(solved, groups=replace(solved.groups, anisotropy=anisotropy))

    return with_tension


def _stiffness(angle: float) -> Change:
    """Return a function that makes a film orthotropic.

    The value of the imperfection is ln(E1 / E2). To first order, E1 = E (1 + value / 2) and E2 = E (1 - value / 2).

    Args:
        angle: Angle of axis 1 from the direction of the press, rad.
    """

    def with_stiffness_ratio(solved: Equilibrium, log_ratio: float) -> Equilibrium:
        """Return the equilibrium of a film with this value of ln(E1 / E2)."""
        # Change of the elasticity matrix over E, in the axes of the film and then in the frame of the press
        plane_modulus = 1.0 / (1.0 - solved.groups.poisson**2)
        change_along_axis_1 = 0.5 * log_ratio * plane_modulus
        change_in_film_axes = np.diag([change_along_axis_1, -change_along_axis_1, 0.0])
        rotation = stress_rotation(angle)
        moduli_change = rotation @ change_in_film_axes @ rotation.T
        anisotropy = Anisotropy(moduli=moduli_change, tension=np.zeros(3))
        return replace(solved, groups=replace(solved.groups, anisotropy=anisotropy))

    return with_stiffness_ratio


def _poisson(solved: Equilibrium, value: float) -> Equilibrium:
    """Return the equilibrium of a film whose Poisson's ratio is larger by a value.

    The bending stiffness, which contains 1 / (1 - poisson^2), changes accordingly.

    Args:
        solved: The solved press.
        value: Change of Poisson's ratio.
    """
    poisson = solved.groups.poisson
    changed_poisson = poisson + value
    bending = solved.groups.bending * (1.0 - poisson**2) / (1.0 - changed_poisson**2)
    return replace(solved, groups=replace(solved.groups, poisson=changed_poisson, bending=bending))


def _oval(direction: complex) -> Change:
    """Return the function that makes the clamp of a film oval.

    The value of the imperfection is the parameter e of the oval; see `PlacedMesh.oval`.

    Args:
        direction: exp(2 i alpha), where alpha is the angle of the long axis from the direction of the press.
    """

    def with_oval(solved: Equilibrium, value: float) -> Equilibrium:
        """Return the equilibrium of a film with an oval clamp."""
        return replace(solved, mesh=replace(solved.mesh, oval=value * direction))

    return with_oval


FIELDS = {
    "tension": (StressField(_tension((1.0, -1.0, 0.0)), False), StressField(_tension((0.0, 0.0, 1.0)), True)),
    "stiffness": (StressField(_stiffness(0.0), False), StressField(_stiffness(0.25 * np.pi), True)),
    "poisson": (StressField(_poisson, False),),
    "oval": (StressField(_oval(1.0), False), StressField(_oval(1j), True)),
}
"""Fields by the name of the imperfection. Imperfections with two axes have an even and an odd field, in this order."""


def _side_load(direction: tuple[float, float]) -> Change:
    """Return the function that adds a side load to a press.

    The unit of the side load is E h a A^2, with Young's modulus E, thickness h and radius a of the film, and the
    amplitude A that scales the deflection of the press.

    Args:
        direction: Unit vector (x, y) of the side load.
    """

    def with_side_load(solved: Equilibrium, value: float) -> Equilibrium:
        """Return the equilibrium with an additional side load."""
        load_x, load_y = solved.groups.side_load
        unit_x, unit_y = direction
        side_load = (load_x + value * unit_x, load_y + value * unit_y)
        return replace(solved, groups=replace(solved.groups, side_load=side_load))

    return with_side_load


SIDE_FORCE_FIELDS = (StressField(_side_load((1.0, 0.0)), False), StressField(_side_load((0.0, 1.0)), True))
"""Fields of a side force along the direction of the press from the centre (even), and across it (odd)."""

SIDE_FORCE_IS_ODD = np.array([field.odd for field in SIDE_FORCE_FIELDS])
"""Whether each of `SIDE_FORCE_FIELDS` is odd, shape (2,)."""

TENSION_FIELDS = (StressField(_tension((1.0, 1.0, 0.0)), False), *FIELDS["tension"])
"""Fields of a change of the mean pretension, and of both components of an uneven pretension."""

TENSION_IS_ODD = np.array([field.odd for field in TENSION_FIELDS])
"""Whether each of `TENSION_FIELDS` is odd, shape (3,)."""

IS_ODD = np.array([field.odd for fields in FIELDS.values() for field in fields])
"""Whether each field is odd, in the order of `stress_changes`, shape (n_field,)."""


def stress_changes(solved: Equilibrium, surface: Surface = "middle") -> Array:
    """Compute the change of the scaled stress at the nodes that each of `FIELDS` causes, for a press on the x axis.

    The change is computed at fixed points of the film. If the rim becomes oval, the nodes move, so the effect of their
    displacement is subtracted.

    Args:
        solved: Press with a circular probe on an axisymmetric film, solved with a theory that includes stretching.
        surface: Surface in the thickness; see `touch_stress`.

    Returns:
        Change of the stress of `nodal_stress`, per unit of the imperfection, shape (n_field, n_element, n_local, 3).
    """
    return _stress_changes(solved, [field for fields in FIELDS.values() for field in fields], surface)


def side_force_stress(solved: Equilibrium, surface: Surface = "middle") -> Array:
    """Compute the change of the scaled stress at the nodes by each of `SIDE_FORCE_FIELDS`, per scaled side load.

    The probe and the film are as in `stress_changes`. `scaling.side_force_unit` is the side force of one scaled side
    load.

    Args:
        solved: Press with a circular probe on an axisymmetric film, solved with a theory that includes stretching.
        surface: Surface in the thickness; see `touch_stress`.

    Returns:
        Changes, shape (n_element, n_local, 2, 3): the field, then the stress (S11, S22, S12). This is the order of the
        table of a `ForwardMap` with several fields.
    """
    return np.moveaxis(_stress_changes(solved, SIDE_FORCE_FIELDS, surface), 0, 2)


def tension_stress(solved: Equilibrium, surface: Surface = "middle") -> Array:
    """Compute the change of the scaled stress at the nodes by each of `TENSION_FIELDS`, per unit of the tension.

    The unit is E A^2 plus the mean pretension. The probe and the film are as in `stress_changes`.

    Args:
        solved: Press with a circular probe on an axisymmetric film, solved with a theory that includes stretching.
        surface: Surface in the thickness; see `touch_stress`.

    Returns:
        Changes, shape (n_element, n_local, 3, 3): the field, then the stress (S11, S22, S12), as in
        `side_force_stress`.
    """
    return np.moveaxis(_stress_changes(solved, TENSION_FIELDS, surface), 0, 2)


def _stress_changes(solved: Equilibrium, fields: Sequence[StressField], surface: Surface) -> Array:
    """Compute the change of the scaled stress at the nodes that each field causes.

    Even and odd fields have different fixed displacements on the line of symmetry, so each kind has its own
    factorisation of the tangent.

    Args:
        solved: The solved press.
        fields: The fields.
        surface: Surface in the thickness.

    Returns:
        Change per unit of the imperfection, shape (n_field, n_element, n_local, 3).
    """
    with single_threaded_blas():
        components = 3 if solved.groups.bending == 0.0 else 4  # bending has an auxiliary unknown
        elastic = ElasticFilm(solved.mesh.geometry, solved.groups)
        even_assembly = assembly(solved.mesh.template, components, odd=False)
        odd_assembly = assembly(solved.mesh.template, components, odd=True)
        even_factor = factor_tangent(elastic, even_assembly, solved.field)
        odd_factor = factor_tangent(elastic, odd_assembly, solved.field)
        changes = []
        for field in fields:
            factor = odd_factor if field.odd else even_factor
            changes.append(_stress_change(solved, field, factor.solve, surface))
        return np.stack(changes)


def _stress_change(solved: Equilibrium, field: StressField, solve: Callable[[Array], Array], surface: Surface) -> Array:
    """Compute the change of the scaled stress at the nodes that one field causes.

    Args:
        solved: The solved press.
        field: The imperfection, whose attribute `change` applies it to a press.
        solve: Function that solves K x = b for a vector b at the nodes, shape (n_node, 3).
        surface: Surface in the thickness.

    Returns:
        Change per unit of the imperfection, shape (n_element, n_local, 3).
    """
    # Add a positive and a negative step of the imperfection. The displacements are not in equilibrium yet.
    above = field.change(solved, STEP)
    below = field.change(solved, -STEP)

    # Compute the change of the displacements that restores the equilibrium after one positive step. The change of the
    # residual by one step is half of the difference.
    residual_above = ElasticFilm(above.mesh.geometry, above.groups).residual(above.field)
    residual_below = ElasticFilm(below.mesh.geometry, below.groups).residual(below.field)
    displacement_change = -0.5 * solve(residual_above - residual_below)

    # Compute the derivative of the stress by a central difference.
    equilibrium_above = replace(above, field=above.field + displacement_change)
    equilibrium_below = replace(below, field=below.field - displacement_change)
    stress_above = nodal_stress(equilibrium_above, surface)
    stress_below = nodal_stress(equilibrium_below, surface)
    change = (stress_above - stress_below) / (2.0 * STEP)
    if above.mesh.oval != 0.0:
        # The nodes move with the rim. Subtract the change of the stress by this displacement of the nodes (x + iy).
        node_shift = (above.mesh.points - below.mesh.points) / (2.0 * STEP)
        stress_gradient = solved.mesh.node_derivatives(nodal_stress(solved, surface))
        x_contribution = node_shift.real[..., None] * stress_gradient[..., 0, :]
        y_contribution = node_shift.imag[..., None] * stress_gradient[..., 1, :]
        change -= x_contribution + y_contribution
    return np.asarray(change)
