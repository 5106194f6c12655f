"""Change of the charges by a side force of the probe, and by the friction of a probe on a vertical stage.

A side force (Fx, Fy) of the probe on the film changes the charges to first order by

    dQ = jacobian @ (Fx, Fy).

The stress fields of a side force along and across the direction of the press are solved with the tangent of the
equilibrium (`solver.sensitivity`) at a few distances and forces, and interpolated as in a forward map. The terms of
second order are small: for side forces up to 0.2 of the force, they are below 1 % of dQ.

Example:

    forward_map = ForwardMap.build(sensor, Circle(1.0))
    side_force_map = SideForceMap.build(forward_map)
    side_force_map.jacobian(contact)  # pC/N, shape (n, n_electrode, 2)
    side_force_map.friction_charges(contact, 0.2)  # pC, shape (n, n_electrode)
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.common.progress import track
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.family import Family
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.readout import FINE, ReadoutPoints
from isocharge.simulate.mechanics.scaling import amplitude_squared, side_force_unit
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.solver.friction import check_friction, holding_force, limited
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.press import press
from isocharge.simulate.solver.sensitivity import SIDE_FORCE_IS_ODD, side_force_stress

NODE_COUNTS = (6, 6)
"""Number of distances and number of forces at which the fields are solved."""


@dataclass(frozen=True)
class SideForceMap:
    """Derivatives of the charges with respect to a side force, as a function of position and force.

    Attributes:
        film: Forward map of the film without side forces.
        fields: Map whose table contains the two stress fields of a side force.
        holding: Side force along the direction of the press that prevents the slip of the film under a probe on a
            vertical stage, over the force of the press, at the nodes of the family, shape (n_distance * n_force,).
            Negative values point to the centre of the film.
    """

    film: ForwardMap
    fields: ForwardMap
    holding: Array

    @classmethod
    def build(cls, film: ForwardMap, *, executor: Executor | None = None) -> "SideForceMap":
        """Solve the fields at `NODE_COUNTS` presses in the domain of a forward map, which takes about ten seconds.

        Args:
            film: Forward map of the film, whose probe is a circle. Its mesh and its readout are used.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If the probe is not axisymmetric.
            SolveError: If a press has no equilibrium.
        """
        if not film.probe.is_axisymmetric:
            raise SceneError(
                f"side forces: expected a circular probe, got {film.probe.notation}; use `press(..., side_force=...)` "
                "or `isocharge simulate point --side-force` for other probes"
            )
        family = Family.spread(film.domain, film.sensor.film.radius, NODE_COUNTS, period=0.0)
        theory = replace(film.theory, stretching=True)
        settings = SolveSettings(theory=theory, resolution=film.resolution, layer=film.layer)
        chains = [
            _Chain(film.sensor.film, film.probe, distance, family.force, film.sensor.surface, settings)
            for distance in family.distance.tolist()
        ]
        solved = list(track(in_order(executor, _solve_chain, chains), "solving side forces", len(chains)))
        table = np.concatenate([chain.table for chain in solved])
        holding = np.concatenate([chain.holding for chain in solved])
        return cls(film, replace(film, family=family, theory=theory, table=table), holding)

    def jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the side force (Fx, Fy) of the probe on the film.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Shape (n, n_electrode, 2), pC/N.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = self.film.domain.check(contact, "side forces")
        scaled_charges = self.fields.field_charges(contact, SIDE_FORCE_IS_ODD, self._readout)
        film = self.film.sensor.film
        force_unit = side_force_unit(film, amplitude_squared(film, contact[:, 2]))
        charge_per_newton = scaled_charges / force_unit[:, None, None]

        # Rotate the derivatives from the direction of the press and its perpendicular to x and y.
        along_press, across_press = np.moveaxis(charge_per_newton, 2, 0)
        angle = np.arctan2(contact[:, 1], contact[:, 0])[:, None]
        x_derivative = np.cos(angle) * along_press - np.sin(angle) * across_press
        y_derivative = np.sin(angle) * along_press + np.cos(angle) * across_press
        calibration = self.film.sensor.calibration
        return np.stack([calibration.read(x_derivative), calibration.read(y_derivative)], axis=2)

    def friction_forces(self, contact: Array, coefficient: float) -> Array:
        """Compute the side forces of a probe with friction on a vertical stage; see `solver.friction`.

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
        # The side force that prevents slip points along the radius, and friction limits its size.
        holding_share = self.fields.family.weights(distance, force, np.zeros(1)) @ self.holding
        direction = contact[:, :2] / np.maximum(distance, 1e-12)[:, None]
        force_without_slip = (holding_share * force)[:, None] * direction
        return limited(force_without_slip, coefficient * force)

    def friction_charges(self, contact: Array, coefficient: float) -> Array:
        """Compute the change of the charges by the friction of a probe on a vertical stage, to first order.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.
            coefficient: Coefficient of friction, dimensionless.

        Returns:
            Shape (n, n_electrode), pC.

        Raises:
            SceneError: If a press lies outside the domain, or the coefficient is not valid.
        """
        side_force = self.friction_forces(contact, coefficient)
        return np.asarray(np.einsum("nek,nk->ne", self.jacobian(contact), side_force))

    @cached_property
    def _readout(self) -> ReadoutPoints:
        """Integration rule for the electrodes, which is fine because the fields are steep near the probe."""
        return ReadoutPoints.of(self.film.sensor, FINE)


@dataclass(frozen=True)
class _Chain:
    """Presses at one distance with different forces. Each solve starts from the equilibrium before.

    Attributes:
        film: The film.
        probe: The probe.
        distance: Distance from the centre of the film, mm.
        forces: Forces in the order in which they are solved, shape (n_force,), N.
        surface: Surface in the thickness at which the stress is read.
        settings: Theory, mesh and width of the thin rings.
    """

    film: Film
    probe: Probe
    distance: float
    forces: Array
    surface: Surface
    settings: SolveSettings


class _SolvedChain(NamedTuple):
    """Results of a chain.

    Attributes:
        table: Scaled stress of the two fields at the nodes of every element, shape (n_force, n_value).
        holding: Holding force along the direction of the press over the force, shape (n_force,).
    """

    table: Array
    holding: Array


def _solve_chain(chain: _Chain) -> _SolvedChain:
    """Solve one chain, with all presses on the positive x axis."""
    start = None
    rows = []
    holding = []
    for force in chain.forces.tolist():
        start = press(chain.film, chain.probe, (chain.distance, 0.0), force, chain.settings, start=start)
        rows.append(side_force_stress(start, chain.surface).ravel())
        outward_force, _ = holding_force(start)
        holding.append(outward_force / force)
    return _SolvedChain(np.stack(rows), np.array(holding))
