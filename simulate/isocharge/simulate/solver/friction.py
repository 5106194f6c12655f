"""Friction between the film and a probe on a stage that moves vertically.

If a probe presses beside the centre, the film is steeper between the probe and the near rim than elsewhere. The
material point under the probe moves outwards, because the steeper part of the film would otherwise stretch more than
the rest. A probe on a stage that moves exactly vertically does not follow the movement of the material point. The film
therefore slips outwards under the probe, and friction pulls the film inwards. A probe that hangs freely follows the
movement of the material point, and exerts no side force.

The model is Coulomb friction during one press with increasing force (Johnson 1985, section 7.1). The holding force is
the side force that would keep the material point under the probe in place. The largest possible friction is the
coefficient of friction times the force of the press. If the holding force is smaller than the largest friction, the
film sticks to the probe, and the side force is the holding force. If the holding force is larger, the film slips, and
the side force is the largest friction. The friction acts in the direction opposite to the slip. The side force is
distributed over the footprint like the pressure.

While the probe is lifted, the directions of the slip and of the side force are reversed. The model does not describe
the lifting.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.execution.workers import single_threaded_blas
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import side_force_unit
from isocharge.simulate.solver.assembly import assembly
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.tangent_factor import factor_tangent

MAX_FRICTION = 1.0
"""Largest allowed coefficient of friction, dimensionless. The coefficient of steel on PVDF is about 0.2."""


def holding_force(solved: Equilibrium) -> tuple[float, float]:
    """Compute, to first order, the side force that cancels the mean in-plane displacement of the footprint.

    The compliance of the film is the mean displacement of the footprint under a unit side load. The holding force
    causes a mean displacement that is equal and opposite to the mean displacement caused by the press.

    Args:
        solved: Press without a side force.

    Returns:
        Force (Fx, Fy) of the probe on the film, N. The force points inwards if the film would slip outwards.
    """
    mesh = solved.mesh
    geometry = mesh.geometry
    groups = solved.groups
    n_direction = 1 if mesh.template.half else 2  # a half template has no displacement across its line of symmetry

    # Mean in-plane displacement of the footprint since the contact, shape (n_direction,). `geometry.load` contains the
    # weights of the nodes in the mean over the footprint.
    field_before_contact = np.zeros_like(solved.field) if solved.rest is None else solved.rest.field
    slip = geometry.load @ (solved.field - field_before_contact)[:, :n_direction]

    # Mean displacement of the footprint under a unit side load in each direction, with one column for each load
    compliance = np.empty((n_direction, n_direction))
    with single_threaded_blas():
        elastic = ElasticFilm(geometry, groups)
        factor = factor_tangent(elastic, assembly(mesh.template, elastic.unknowns_per_node), solved.field)
        for direction in range(n_direction):
            unit_load = np.zeros_like(solved.field)
            unit_load[:, direction] = geometry.load
            compliance[:, direction] = geometry.load @ factor.solve(unit_load)[:, :n_direction]

    # Compute the scaled side load that cancels the slip.
    scaled_force = np.zeros(2)
    scaled_force[:n_direction] = -np.linalg.solve(compliance, slip)

    # Convert the side load to N, and rotate it from the frame of the press to the axes x and y.
    x, y = solved.at
    rotation = np.exp(1j * np.arctan2(y, x))
    force_unit = side_force_unit(solved.film, groups.squared_amplitude)
    force = complex(*scaled_force) * force_unit * rotation  # Fx + i Fy
    return float(force.real), float(force.imag)


def friction_force(solved: Equilibrium, coefficient: float) -> tuple[float, float]:
    """Compute the side force of a probe on a stage that moves vertically.

    The side force is the holding force, but not larger than the coefficient of friction times the force of the press.
    The docstring of the module describes the model.

    Args:
        solved: Press without a side force.
        coefficient: Coefficient of friction, dimensionless.

    Returns:
        Force (Fx, Fy) of the probe on the film, N, for the argument `side_force` of `press`.

    Raises:
        SceneError: If the coefficient is not between 0 and `MAX_FRICTION`.
    """
    check_friction(coefficient)
    holding = np.array([holding_force(solved)])  # shape (1, 2)
    largest_friction = np.array([coefficient * solved.force])  # shape (1,)
    ((side_x, side_y),) = limit_to_friction(holding, largest_friction).tolist()
    return side_x, side_y


def check_friction(coefficient: float) -> None:
    """Raise an error if a coefficient of friction is not between 0 and `MAX_FRICTION`.

    Args:
        coefficient: Coefficient of friction, dimensionless.

    Raises:
        SceneError: If the coefficient is outside this range.
    """
    if not 0.0 <= coefficient <= MAX_FRICTION:
        raise SceneError(f"friction: expected a coefficient from 0 to {MAX_FRICTION:g}, got {coefficient}")


def limit_to_friction(holding: Array, largest_friction: Array) -> Array:
    """Limit the magnitudes of holding forces to the largest friction. The directions of the forces do not change.

    Args:
        holding: Side forces (Fx, Fy) that would prevent the slip, shape (n, 2), N.
        largest_friction: Largest friction, shape (n,), N.

    Returns:
        Side forces, shape (n, 2), N.
    """
    magnitude = np.maximum(np.hypot(holding[:, 0], holding[:, 1]), 1e-300)  # the limit avoids a division by zero
    reduction = np.minimum(1.0, largest_friction / magnitude)
    return np.asarray(holding * reduction[:, None])
