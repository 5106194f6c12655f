"""Cramer-Rao limits of contacts with an unknown side force.

A contact with a side force has five parameters: x, y, the force F, and the side force (Fx, Fy). The limits of the five
parameters are computed for a side force of zero. The sensor must have at least six electrodes. With only five
electrodes, five parameters would fit any five charges, even if the model of the film were wrong.
"""

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import ChargeMap, linearised
from isocharge.simulate.forward.derivative_maps import SideForceMap
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.identifiability.cramer_rao import cramer_rao
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.disk import Rings

MIN_ELECTRODES = 6
"""Smallest number of electrodes for which the limits are computed."""

MAX_SIDE_FORCE_ERROR = 0.1
"""Largest median error of the side force at which the side force counts as estimable, divided by the force."""

RING_COUNT = 10
"""Number of rings on which the limits are computed."""

ANGLE_COUNT = 36
"""Number of positions on each ring."""


@dataclass(frozen=True)
class SideForceLimits:
    """Cramer-Rao limits of contacts with an unknown side force.

    All contacts have the same force, and lie on rings in the working area.

    Attributes:
        force: Force of the contacts, N.
        side_force: Smallest root mean square error of the side force divided by the force, shape (n,), dimensionless.
        position: Smallest root mean square error of the position, shape (n,), mm.
        relative_force: Smallest standard deviation of the force divided by the force, shape (n,), dimensionless.
    """

    force: float
    side_force: Array
    position: Array
    relative_force: Array

    @classmethod
    def of(
        cls, side_force_map: SideForceMap, charge_map: ChargeMap, noise: NoiseModel, force: float, radius: float
    ) -> "SideForceLimits":
        """Compute the limits of contacts on concentric rings.

        Args:
            side_force_map: Map that computes the derivatives of the charges with respect to the side force.
            charge_map: Map that computes the charges of contacts without a side force.
            noise: Noise of the readings.
            force: Force of the contacts, N.
            radius: Radius of the outermost ring, mm.
        """
        # The parameters of a contact are x, y, ln F, Fx / F and Fy / F. The derivative of a charge Q with respect to
        # Fx / F is F times its derivative with respect to Fx.
        contact = Rings.spread(radius, RING_COUNT, ANGLE_COUNT).contacts(force)
        charge, contact_jacobian = linearised(charge_map, contact)
        relative_side_force_jacobian = force * side_force_map.jacobian(contact)
        jacobian = np.concatenate([contact_jacobian, relative_side_force_jacobian], axis=2)  # (n, n_electrode, 5)

        # The last two parameters are the components of the side force.
        limits = cramer_rao(charge, jacobian, noise)
        variance = np.diagonal(limits.covariance, axis1=1, axis2=2)  # shape (n, 5)
        *_, side_x_variance, side_y_variance = variance.T
        return cls(
            force=force,
            side_force=np.sqrt(side_x_variance + side_y_variance),
            position=limits.position,
            relative_force=limits.force,
        )

    @property
    def is_estimable(self) -> bool:
        """Whether the median error of the side force is at most `MAX_SIDE_FORCE_ERROR`."""
        return self._median(self.side_force) <= MAX_SIDE_FORCE_ERROR

    def statistics(self) -> dict[str, Any]:
        """Return the weighted median and the maximum of the errors as a dictionary for JSON.

        Errors of the force and of the side force are in percent of the force.
        """
        return {
            "force_N": self.force,
            "side_force_median_percent": 100.0 * self._median(self.side_force),
            "side_force_worst_percent": 100.0 * float(self.side_force.max()),
            "position_median_mm": self._median(self.position),
            "position_worst_mm": float(self.position.max()),
            "force_median_percent": 100.0 * self._median(self.relative_force),
            "force_worst_percent": 100.0 * float(self.relative_force.max()),
            "side_force_is_estimable": self.is_estimable,
        }

    def _median(self, values: Array) -> float:
        """Compute the weighted median of the values at the contacts.

        The weight of a contact is the area that its position represents.

        Args:
            values: Values in the order of the contacts, ring by ring, shape (n,).
        """
        relative_area = np.repeat(np.arange(1, RING_COUNT + 1), ANGLE_COUNT)  # proportional to the radius of the ring
        order = np.argsort(values)
        cumulative_area = np.cumsum(relative_area[order])
        middle = np.searchsorted(cumulative_area, 0.5 * cumulative_area[-1])
        return float(values[order][middle])


def side_force_limits(
    forward_map: ForwardMap,
    charge_map: ChargeMap,
    noise: NoiseModel,
    forces: list[float],
    radius: float,
    executor: Executor | None = None,
) -> tuple[SideForceLimits, ...]:
    """For each of several forces, compute the limits of contacts with an unknown side force.

    Args:
        forward_map: Forward map of the sensor.
        charge_map: Map that computes the same charges as the forward map, with fast derivatives.
        noise: Noise of the readings.
        forces: Forces of the contacts, N.
        radius: Radius of the working area, mm.
        executor: Executor that runs the solves; None for this process.

    Returns:
        The limits for each force. The result is empty if the sensor has fewer than `MIN_ELECTRODES` electrodes or no
        working area. It is also empty if the probe is not circular, because no `SideForceMap` exists for such a probe.
    """
    if len(forward_map.electrodes) < MIN_ELECTRODES or radius <= 0.0 or not forward_map.probe.is_axisymmetric:
        return ()
    side_force_map = SideForceMap.build(forward_map, executor=executor)
    return tuple(SideForceLimits.of(side_force_map, charge_map, noise, force, radius) for force in forces)
