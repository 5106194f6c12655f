"""Effect of a side force and of the friction of the probe on the charges.

A side force (Fx, Fy) of the probe on the film changes the charges to first order by

    dQ = jacobian @ (Fx, Fy).

A side force has two stress fields. The first field is the change of the stress by a side force along the direction of
the press. The second field is the change of the stress by a side force across this direction. The stress fields are
computed from the tangent of the equilibrium (see `solver.sensitivity`) at a few distances and forces. Between the
solved presses, the stress fields are interpolated as in a forward map. If the side force is at most 0.2 times the force
of the press, the terms of second order are smaller than 1 % of dQ.

Example:

    forward_map = ForwardMap.build(sensor, Circle(1.0))
    side_force_map = SideForceMap.build(forward_map)
    side_force_map.jacobian(contact)  # pC/N, shape (n, n_electrode, 2)
    side_force_map.friction_charges(contact, 0.2)  # pC, shape (n, n_electrode)
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.derivative_fields import solve_derivatives
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.readout import FINE, ReadoutPoints
from isocharge.simulate.mechanics.scaling import amplitude_squared, side_force_unit
from isocharge.simulate.sensor.film import Surface
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.friction import check_friction, holding_force, limit_to_friction
from isocharge.simulate.solver.sensitivity import SIDE_FORCE_IS_ODD, side_force_stress


@dataclass(frozen=True)
class SideForceMap:
    """Map that computes how the charges change with a side force of the probe, at any position and force.

    Attributes:
        film: Forward map of the film without side forces.
        fields: Forward map whose table contains the two stress fields of a side force.
        holding: Ratio of the holding force to the force of the press for each solved press, shape (n_distance *
            n_force,), dimensionless. The holding force is the side force that prevents the film from slipping under a
            probe on a vertical stage. It acts along the direction from the centre of the film to the press, and is
            negative if it points to the centre.
    """

    film: ForwardMap
    fields: ForwardMap
    holding: Array

    @classmethod
    def build(cls, forward_map: ForwardMap, *, executor: Executor | None = None) -> "SideForceMap":
        """Solve a few presses in the domain of a forward map, and compute the stress fields of a side force.

        The solves take about ten seconds. The map also contains the holding force of each press, which is the side
        force that prevents the film from slipping under the probe.

        Args:
            forward_map: Forward map of the film under a circular probe. It provides the domain, the mesh and the
                readout.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If the probe is not axisymmetric.
            SolveError: If a press has no equilibrium.
        """
        if not forward_map.probe.is_axisymmetric:
            raise SceneError(
                f"side forces: expected a circular probe, got {forward_map.probe.notation}; use "
                "`press(..., side_force=...)` or `isocharge simulate point --side-force` for other probes"
            )
        # The table contains the stress fields and, in the last column, the holding force divided by the force of the
        # press.
        derivative_map = solve_derivatives(forward_map, _side_force_changes, executor)
        stress_table, holding_column = np.split(derivative_map.table, [-1], axis=1)
        return cls(forward_map, replace(derivative_map, table=stress_table), holding_column.ravel())

    def jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the side force (Fx, Fy) that the probe exerts.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, 2), pC/N.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.film.domain.check(contact, "side forces")
        scaled_charges = self.fields.field_charges(contact, SIDE_FORCE_IS_ODD, self._readout)

        # The stress fields are derivatives with respect to the side force in units of `force_unit`.
        film = self.film.sensor.film
        force_unit = side_force_unit(film, amplitude_squared(film, contact[:, 2]))
        charge_per_newton = scaled_charges / force_unit[:, None, None]

        # The fields belong to side forces along and across the direction of the press. Rotate the derivatives to x and
        # y. Each derivative has the shape (n, n_electrode), and the angle has the shape (n, 1).
        along_press, across_press = np.moveaxis(charge_per_newton, 2, 0)
        angle = np.arctan2(contact[:, 1], contact[:, 0])[:, None]
        x_derivative = np.cos(angle) * along_press - np.sin(angle) * across_press
        y_derivative = np.sin(angle) * along_press + np.cos(angle) * across_press
        calibration = self.film.sensor.calibration
        return np.stack([calibration.read(x_derivative), calibration.read(y_derivative)], axis=2)

    def friction_forces(self, contact: Array, coefficient: float) -> Array:
        """Compute the side forces that a probe on a vertical stage exerts on the film by friction.

        The friction prevents the film from slipping until the side force reaches its limit. The limit of the side force
        is the coefficient of friction times the force of the press; see `solver.friction`.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.
            coefficient: Coefficient of friction, dimensionless.

        Returns:
            Forces (Fx, Fy) of the probe on the film, shape (n, 2), N.

        Raises:
            SceneError: If a press lies outside the domain, or the coefficient is not valid.
        """
        check_friction(coefficient)
        contact = self.film.domain.check(contact, "side forces")
        distance = np.hypot(contact[:, 0], contact[:, 1])
        force = contact[:, 2]
        orientation = np.zeros(1)  # a circular probe has no orientation
        weights = self.fields.family.weights(distance, force, orientation)
        relative_holding_force = weights @ self.holding  # holding force over the force of the press
        # Unit vectors from the centre to the presses. The lower bound avoids a division by zero at the centre.
        direction = contact[:, :2] / np.maximum(distance, 1e-12)[:, None]
        holding_force = (relative_holding_force * force)[:, None] * direction
        return limit_to_friction(holding_force, coefficient * force)

    def friction_charges(self, contact: Array, coefficient: float) -> Array:
        """Compute, to first order, how the friction of a probe on a vertical stage changes the charges.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.
            coefficient: Coefficient of friction, dimensionless.

        Returns:
            Changes of the charges, shape (n, n_electrode), pC.

        Raises:
            SceneError: If a press lies outside the domain, or the coefficient is not valid.
        """
        side_force = self.friction_forces(contact, coefficient)
        # For each press (index n) and electrode (e), sum over the components x and y of the side force (k).
        return np.asarray(np.einsum("nek,nk->ne", self.jacobian(contact), side_force))

    @cached_property
    def _readout(self) -> ReadoutPoints:
        """Integration points of the electrodes.

        The fine integration rule is used, because the stress fields of a side force change rapidly near the probe.
        """
        return ReadoutPoints.of(self.film.sensor, FINE)


def _side_force_changes(solved: Equilibrium, surface: Surface) -> Array:
    """For one press, compute how a side force changes the stress, and which side force prevents slipping.

    Args:
        solved: Equilibrium of the film under a press on the positive x axis.
        surface: Surface at which the stress is computed: the middle, the top or the bottom of the film.

    Returns:
        One array, as the interpolation between presses requires. It contains all changes of the scaled stress, which
        `side_force_stress` computes, and then the holding force divided by the force of the press. Shape
        (n_change + 1,), dimensionless. The holding force is the side force that prevents the film from slipping under
        the probe. It is positive if it points away from the centre.
    """
    # The second component is zero, because the press is symmetric about the x axis.
    outward_force, _ = holding_force(solved)
    return np.append(side_force_stress(solved, surface), outward_force / solved.force)
