"""Charge maps, which compute the charges of the electrodes from contacts.

The module also contains functions that restrict the domain of a charge map, compute derivatives by central differences,
and check the number of electrodes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain, with_log_force
from isocharge.common.errors import SceneError

STEPS = (0.05, 0.05, 1e-3)
"""Steps of the central differences in x and y (mm) and in ln F (dimensionless), where F is the force.

The steps in x and y are suitable for a probe with a radius of 1 mm.
"""


class ChargeMap(Protocol):
    """Interface of an object that computes the touch charges of the electrodes from contacts (x, y, F)."""

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the charges."""

    @property
    def domain(self) -> Domain:
        """Set of contacts for which the map is valid."""

    def charges(self, contact: Array) -> Array:
        """Compute the charges that contacts cause.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC.
        """

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute the charges that contacts cause, and the derivatives of the charges with respect to x, y and ln F.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC. Derivatives, shape (n, n_electrode, 3), pC/mm, pC/mm and pC.
        """


@dataclass(frozen=True)
class _RestrictedMap:
    """Charge map that computes the same charges as another map, but has a smaller domain.

    Attributes:
        unrestricted: Map that computes the charges and their derivatives.
        domain: Contacts for which the restricted map is valid.
    """

    unrestricted: ChargeMap
    domain: Domain

    @property
    def electrodes(self) -> tuple[str, ...]:
        return self.unrestricted.electrodes

    def charges(self, contact: Array) -> Array:
        return self.unrestricted.charges(contact)

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        return self.unrestricted.linearised(contact)


def within(charge_map: ChargeMap, radius: float) -> ChargeMap:
    """Restrict the domain of a charge map to a disk with the given radius (mm). The charges do not change."""
    return _RestrictedMap(charge_map, charge_map.domain.within(radius))


def differences(function: Callable[[Array], Array], contact: Array, steps: ArrayLike = STEPS) -> Array:
    """Compute the derivatives of a function of contacts by central differences.

    Args:
        function: Function that computes values, shape (n, k), from contacts (x, y, F), shape (n, 3), mm and N. The
            function is called once with all stepped contacts, because one call is faster than six.
        contact: Contacts (x, y, F) at which the derivatives are computed, shape (n, 3), mm and N.
        steps: Steps in x and y, mm, and in ln F.

    Returns:
        Derivatives with respect to (x, y, ln F), shape (n, k, 3), in the unit of the values divided by mm, mm and 1.
    """
    # Increase and decrease one variable of each contact at a time.
    centre = with_log_force(contact)
    offsets = np.diag(steps)[:, None]  # changes of (x, y, ln F) for each variable, shape (3, 1, 3)
    stepped = np.stack([centre + offsets, centre - offsets])  # shape (2, 3, n, 3)
    stepped[..., 2] = np.exp(stepped[..., 2])  # from ln F to F

    stepped_values = function(stepped.reshape(-1, 3))
    n_value = stepped_values.shape[1]
    increased, decreased = stepped_values.reshape(*stepped.shape[:3], n_value)  # each of shape (3, n, k)
    distance = 2.0 * np.asarray(steps)[:, None, None]
    derivatives = (increased - decreased) / distance
    return np.moveaxis(derivatives, 0, 2)  # from (3, n, k) to (n, k, 3)


def check_electrode_count(n_electrode: int) -> None:
    """Raise an error if a sensor has fewer than three electrodes, because a contact has three unknowns.

    Args:
        n_electrode: Number of electrodes of the sensor.

    Raises:
        SceneError: If there are fewer than three electrodes.
    """
    if n_electrode < 3:
        raise SceneError(
            f"expected at least three electrodes, got {n_electrode}: x, y and the force are three unknowns, so with "
            "fewer charges a whole line of contacts has the same charges; add an electrode"
        )
