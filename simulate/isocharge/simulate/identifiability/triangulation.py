"""Triangulation: a press is at the point where the contours of its charges meet (Mirbagheri et al. 2007).

The charge of an electrode restricts a press to an isocharge contour (figures 9 and 10 of the paper). The contours of
three or more electrodes rarely meet exactly in one point. `Triangulation` therefore estimates the contact for which the
mean square distance of the position from the contours is smallest. To first order, the distance from a contour is the
difference of the charges divided by the length of the gradient of the charge. The class therefore searches for the
contact with the nearest charges, and uses the lengths of the gradients as standard deviations of the charges.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import ChargeError
from isocharge.simulate.forward.charge_map import ChargeMap, check_electrode_count
from isocharge.simulate.identifiability.nearest_contact import explain, starting_contacts

ROUNDS = 3
"""Number of successive searches. Each search uses the charge gradients at the result of the previous search."""

STARTS = 4
"""Number of searches for each press, which start at different contacts."""

TOLERANCE = 1.0
"""Largest spread of contours that count as meeting, and largest distance of contacts that count as one contact, mm."""

MIN_RELATIVE_SLOPE = 0.02
"""Lower bound of the gradient of a charge, relative to the largest charge gradient of the same press."""

AMBIGUOUS_RATIO = 2.0
"""Ratio of spreads up to which a second contact is as good as the best contact, dimensionless.

The ratio is the spread at the second contact, divided by the spread at the best contact.
"""

AMBIGUOUS_SPREAD = 0.01
"""Spread up to which a second contact is always as good as the best contact, mm."""


@dataclass(frozen=True)
class Fix:
    """Result of a triangulation.

    Attributes:
        contact: Contact (x, y, F) of each press, shape (n, 3), mm and N; NaN if the contours do not meet within the
            tolerance, or if they meet at two positions.
        spread: Smallest root mean square distance of a position from the contours of each press, shape (n,), mm. If
            the spread is at most the tolerance, and the contact is NaN, the contours meet at two positions.
    """

    contact: Array
    spread: Array

    @property
    def found(self) -> Booleans:
        """Whether each press has a contact, shape (n,)."""
        return np.isfinite(self.contact[:, 0])


@dataclass(frozen=True)
class Triangulation:
    """Estimator that finds the contact at which the contours of the given charges meet.

    Attributes:
        charge_map: Map that computes the charges of contacts. A `ChargeSpline` is much faster than a forward map. If
            the force of the presses is known, the map has this single force.

    Raises:
        SceneError: If there are fewer than three electrodes.
    """

    charge_map: ChargeMap

    def __post_init__(self) -> None:
        check_electrode_count(len(self.charge_map.electrodes))

    def locate(self, charge: Array) -> Fix:
        """Estimate the contact (x, y, F) of each press from its charges.

        The contour of an electrode consists of the positions at which a press causes the given charge. The spread of a
        position is its root mean square distance from the contours of all electrodes. The estimate is the position with
        the smallest spread.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            Contact and spread of each press. A contact is NaN if no position or more than one position agrees with the
            charges.

        Raises:
            ChargeError: If the shape of the charges is wrong, or if a charge is not finite.
        """
        charge = np.asarray(charge, dtype=float)
        names = self.charge_map.electrodes
        if charge.ndim != 2 or charge.shape[1] != len(names) or not np.isfinite(charge).all():
            raise ChargeError(
                f"expected finite charges of shape (n, {len(names)}) for {names}, got shape {charge.shape} with "
                f"{np.count_nonzero(~np.isfinite(charge))} charges that are not finite"
            )

        # For each press, search from several starting points that do not lie close together.
        largest_charge = np.abs(charge).max(axis=1, keepdims=True, initial=1.0)  # at least 1 pC
        equal_sigma = np.broadcast_to(largest_charge, charge.shape)  # all charges of a press have the same weight
        starts = starting_contacts(self.charge_map, charge, equal_sigma, starts=STARTS)  # shape (n, STARTS, 3)
        flat_contacts, flat_spreads = self._nearest_to_contours(
            np.repeat(charge, STARTS, axis=0), starts.reshape(-1, 3)
        )
        contacts = flat_contacts.reshape(starts.shape)
        spreads = flat_spreads.reshape(starts.shape[:2])  # shape (n, STARTS), mm

        # Choose the contact with the smallest spread, unless another contact is as good and lies elsewhere. `TOLERANCE`
        # limits both the distance between equal contacts and the spread of a valid contact, mm.
        press = np.arange(len(charge))
        best_search = spreads.argmin(axis=1)
        best_contact = contacts[press, best_search]
        best_spread = spreads[press, best_search]
        distance = np.linalg.norm((contacts - best_contact[:, None])[..., :2], axis=2)
        other_spread = spreads.min(axis=1, where=distance > TOLERANCE, initial=np.inf)
        is_ambiguous = other_spread <= np.maximum(AMBIGUOUS_RATIO * best_spread, AMBIGUOUS_SPREAD)
        best_contact[(best_spread > TOLERANCE) | is_ambiguous] = np.nan
        return Fix(best_contact, best_spread)

    def _nearest_to_contours(self, charge: Array, contact: Array) -> tuple[Array, Array]:
        """Find the contacts with the smallest mean square distance from the contours, starting from given contacts.

        The contour of an electrode consists of the positions at which a press causes the given charge. To first order,
        the distance from the contour is the difference of the charges divided by the length of the gradient. The
        gradients change with the contact, so each round uses the gradients at the contacts of the previous round.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.
            contact: Starting points (x, y, F), shape (n, 3), mm and N.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N, and root mean square distances of their positions from the
            contours, shape (n,), mm.
        """
        for _ in range(ROUNDS):
            _, derivatives = self.charge_map.linearised(contact)
            gradient = np.linalg.norm(derivatives[..., :2], axis=2)  # by x and y, shape (n, n_electrode), pC/mm
            # The lower bound keeps the distance finite where a charge has an extremum.
            smallest_gradient = MIN_RELATIVE_SLOPE * gradient.max(axis=1, keepdims=True)
            limited_gradient = np.maximum(gradient, smallest_gradient)
            # `explain` minimises the sum of the squares of difference / limited_gradient, which are the distances.
            contact, distance = explain(self.charge_map, charge, limited_gradient, contact)
        return contact, np.sqrt(np.mean(distance**2, axis=1))
