"""Derivatives of the charges with respect to properties of the film and to a side force of the probe.

A change of a property of the film, such as its pretension or an oval clamp, changes the stress. So does a side force
(Fx, Fy) of the probe, which changes the charges to first order by

    dQ = jacobian @ (Fx, Fy).

The class `FilmSlopes` computes the derivatives with respect to the film, and the class `SideForceMap` those with
respect to the side force. Both classes compute changes of the stress from the factorised tangent of the equilibrium
(see `solver.sensitivity`), at a few distances and forces. Between the solved presses, these changes are interpolated as
in a forward map. The changes need fewer solved presses than the stress itself, because they are used for small
corrections. If the side force is at most 0.2 times the force of the press, the terms of second order are smaller than
1 % of dQ.

Each property with two axes, like an ellipse, has two components. Let alpha be the angle from the x axis to axis 1 of
the property. The components are the size of the property times cos(2 alpha) and sin(2 alpha). A side force has two
stress fields: the changes of the stress by a side force along and across the direction of the press.

Example:

    forward_map = ForwardMap.build(sensor, Circle(1.0))
    slopes = FilmSlopes.build(forward_map)
    slopes.jacobian(contact)["oval_x"]  # pC, shape (n, n_electrode)
    slopes.temperature_jacobian(contact)  # pC/K, shape (n, n_electrode)
    side_force_map = SideForceMap.build(forward_map)
    side_force_map.jacobian(contact)  # pC/N, shape (n, n_electrode, 2)
    side_force_map.friction_charges(contact, 0.2)  # pC, shape (n, n_electrode)
"""

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.family import NodeCount, Reading
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.mechanics.theory import amplitude_squared, side_force_unit
from isocharge.simulate.mechanics.warming import tension_change
from isocharge.simulate.mesh.conformal_map import distance_coordinate
from isocharge.simulate.numerics.polygon import to_complex, to_corners
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.solver.equilibrium import Equilibrium
from isocharge.simulate.solver.sensitivity import (
    FILM_FIELDS,
    FILM_IS_ODD,
    SIDE_FORCE_FIELDS,
    SIDE_FORCE_IS_ODD,
    check_friction,
    holding_force,
    limit_to_friction,
    stress_changes,
)

TENSION_NAMES = ("pretension", "tension_difference", "tension_shear")
"""Names of the mean pretension, of half of T11 - T22, and of T12, whose unit is MPa."""

STIFFNESS_NAMES = ("stiffness_x", "stiffness_xy")
"""Names of the components of ln(E1 / E2), which are dimensionless."""

OVAL_NAMES = ("oval_x", "oval_xy")
"""Names of the components of the parameter e of an oval clamp, which are dimensionless."""


def few_nodes(film: Film, domain: Domain) -> NodeCount:
    """Return the numbers of distances and forces that suffice for derivatives and for approximate charges.

    The errors are a few thousandths of the largest value. They depend mainly on the number of forces. Only for presses
    near the clamp, where the distance coordinate is large, more distances are needed.

    Args:
        film: The film.
        domain: Presses for which the derivatives or the charges are needed.
    """
    largest_coordinate = float(distance_coordinate(domain.radius / film.radius))
    return NodeCount(distances=3 + math.ceil(2.0 * largest_coordinate), forces=8)


@dataclass(frozen=True)
class FilmSlopes:
    """Derivatives of the charges with respect to properties of one film, at any position and force.

    Attributes:
        film: Forward map of the film.
        fields: Forward map whose table contains the stress fields `sensitivity.FILM_FIELDS`.
    """

    film: ForwardMap
    fields: ForwardMap

    @classmethod
    def build(cls, forward_map: ForwardMap, *, executor: Executor | None = None) -> "FilmSlopes":
        """Solve a few presses in the domain of a forward map, and compute the stress fields of its properties.

        Args:
            forward_map: Forward map of the film under a circular probe. It provides the domain, the mesh and the
                readout.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If the probe is not axisymmetric.
            SolveError: If a press has no equilibrium.
        """
        if not forward_map.probe.is_axisymmetric:
            raise SceneError(f"properties of a film: expected a circular probe, got {forward_map.probe.notation}")
        return cls(forward_map, _solve_fields(forward_map, partial(stress_changes, fields=FILM_FIELDS), executor))

    def jacobian(self, contact: Array) -> dict[str, Array]:
        """Compute the derivatives of the charges with respect to the properties of the film.

        The names of the properties are `TENSION_NAMES`, `STIFFNESS_NAMES` and `OVAL_NAMES`.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives by the name of the property, each of shape (n, n_electrode), pC per unit of the property.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.film.domain.check(contact, "properties of a film")
        film = self.film.sensor.film
        field_charge = self.film.sensor.calibration.read(
            self.fields.field_charges(contact, FILM_IS_ODD).swapaxes(1, 2)  # shape (n, n_field, n_electrode)
        )
        mean_tension, even_tension, odd_tension, *other_fields = np.moveaxis(field_charge, 1, 0)
        tension_unit = (film.young * amplitude_squared(film, contact[:, 2]) + film.pretension)[:, None]

        derivatives = {TENSION_NAMES[0]: mean_tension / tension_unit}
        even_and_odd = {
            TENSION_NAMES[1:]: (even_tension / tension_unit, odd_tension / tension_unit),
            STIFFNESS_NAMES: tuple(other_fields[:2]),
            OVAL_NAMES: tuple(other_fields[2:]),
        }
        # The axes of an even field are along and across the direction of the press, at the angle t from the x axis.
        # The axes of an odd field are rotated by 45 degrees from them. Rotate both to the axes x and y.
        twice_angle = 2.0 * np.arctan2(contact[:, 1], contact[:, 0])[:, None]
        for names, (even, odd) in even_and_odd.items():
            derivatives.update(zip(names, _to_axes(even, odd, twice_angle), strict=True))
        return derivatives

    def tension_jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the pretension (T11, T22, T12) in the axes x and y.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, 3), pC/MPa.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        mean, difference, shear = (self.jacobian(contact)[name] for name in TENSION_NAMES)
        # T11 and T22 contribute to the mean pretension and to half of their difference.
        return np.stack([0.5 * (mean + difference), 0.5 * (mean - difference), shear], axis=2)

    def temperature_jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the touch charges with respect to the temperature of the film.

        The temperature of the ring remains constant. The pyroelectric charge is not included.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode), pC/K. They are zero if the film has no expansion coefficients.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        tension_per_kelvin = tension_change(self.film.sensor.film, 1.0, 0.0)  # (T11, T22, T12), MPa/K
        return np.asarray(self.tension_jacobian(contact) @ tension_per_kelvin)


@dataclass(frozen=True)
class SideForceMap:
    """Map that computes how the charges change with a side force of the probe, at any position and force.

    Attributes:
        film: Forward map of the film without side forces.
        fields: Forward map whose table contains the two stress fields of a side force.
        holding: Ratio of the holding force to the force of the press for each solved press, shape (n_press, 2),
            dimensionless. The holding force is the side force that prevents the film from slipping under a probe on a
            vertical stage. Its components act along and across the direction from the centre of the film to the press.
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
        # The table contains the stress fields and, in the last two columns, the holding force divided by the force of
        # the press.
        derivative_map = _solve_fields(forward_map, _side_force_changes, executor)
        stress_table, holding = np.split(derivative_map.table, [-2], axis=1)
        return cls(forward_map, replace(derivative_map, table=stress_table), holding)

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
        scaled_charges = self.fields.field_charges(contact, SIDE_FORCE_IS_ODD)

        # The stress fields are derivatives with respect to the side force in units of `force_unit`.
        film = self.film.sensor.film
        force_unit = side_force_unit(film, amplitude_squared(film, contact[:, 2]))
        charge_per_newton = scaled_charges / force_unit[:, None, None]

        # The fields belong to side forces along and across the direction of the press. Rotate the derivatives to x and
        # y. Each derivative has the shape (n, n_electrode), and the angle has the shape (n, 1).
        along_press, across_press = np.moveaxis(charge_per_newton, 2, 0)
        angle = np.arctan2(contact[:, 1], contact[:, 0])[:, None]
        calibration = self.film.sensor.calibration
        derivatives = [calibration.read(one) for one in _to_axes(along_press, across_press, angle)]
        return np.stack(derivatives, axis=2)

    def friction_forces(self, contact: Array, coefficient: float) -> Array:
        """Compute the side forces that a probe on a vertical stage exerts on the film by friction.

        The friction prevents the film from slipping until the side force reaches its limit. The limit of the side force
        is the coefficient of friction times the force of the press; see `solver.sensitivity`.

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
        force = contact[:, 2]
        position = to_complex(contact[:, :2])
        rotation = np.zeros(1)  # a circular probe has no orientation
        weights = self.fields.family.weights(position, force, rotation)

        # Rotate the holding force, Fx + i Fy, from the frame of the press to the axes x and y.
        relative_force = to_complex(weights @ self.holding)  # divided by the force of the press
        holding_force = force * relative_force * np.exp(1j * np.angle(position))
        return limit_to_friction(to_corners(holding_force), coefficient * force)

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


def _to_axes(even: Array, odd: Array, angle: Array) -> tuple[Array, Array]:
    """Rotate derivatives from the frame of each press to the axes x and y.

    Args:
        even: Derivatives that belong to the even field, shape (n, n_electrode).
        odd: Derivatives that belong to the odd field, shape (n, n_electrode).
        angle: Angle of the rotation, shape (n, 1), rad.

    Returns:
        Both components, each of shape (n, n_electrode).
    """
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return cosine * even - sine * odd, sine * even + cosine * odd


def _side_force_changes(solved: Equilibrium, surface: Surface) -> Array:
    """For one press, compute how a side force changes the stress, and which side force prevents slipping.

    Args:
        solved: Equilibrium of the film under a press on the positive x axis.
        surface: Surface at which the stress is computed: the middle, the top or the bottom of the film.

    Returns:
        One array, as the interpolation between presses requires. It contains all changes of the scaled stress, and then
        the two components of the holding force divided by the force of the press. Shape (n_change + 2,), dimensionless.
        The holding force is the side force that prevents the film from slipping under the probe.
    """
    relative_holding_force = np.array(holding_force(solved)) / solved.force
    return np.append(stress_changes(solved, surface, SIDE_FORCE_FIELDS), relative_holding_force)


def _solve_fields(forward_map: ForwardMap, read: Reading, executor: Executor | None) -> ForwardMap:
    """Solve a few presses in the domain of a forward map with its mesh, and return a map with other stress fields.

    Args:
        forward_map: Forward map of the film under a circular probe.
        read: Function that computes the values of the table at the nodes of the mesh from a solved press.
        executor: Executor that runs the solves; None for this process.
    """
    return ForwardMap.build_unchecked(
        forward_map.sensor,
        forward_map.probe,
        forward_map.domain,
        few_nodes(forward_map.sensor.film, forward_map.domain),
        replace(forward_map.settings, layer=forward_map.layer),
        read=read,
        executor=executor,
    )
