"""Area of measured presses, and checks of the presses before a network is trained on them.

Without such checks, the loss could become infinite or NaN during the training. The reported errors and misfits of the
model could also be meaningless.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import PressError, shown
from isocharge.serve.model.contact import box_middle, inside_polygon
from isocharge.serve.presses.measured_presses import CONTACT, MeasuredPresses
from isocharge.simulate import Domain
from isocharge.train.data.channel_noise import EXTREME_SHARE

HULL_RATIO = 0.3
"""Relative length above which an edge of the outline is bent inwards to further places, dimensionless. The length 0
stands for the shortest distance between neighbouring places, and the length 1 for the longest distance.
"""

MIN_FORCE_RATIO = 1.1
"""Smallest ratio of the largest to the smallest force of a domain, which applies even if all forces are equal."""

MIN_INDEPENDENCE = 1e-4
"""Columns count as linearly independent if their smallest singular value is above this share of the largest.

The columns are the standardised charges of the channels, or the coordinates of the places.
"""


@dataclass(frozen=True)
class PressedArea(Domain):
    """Domain of measured contacts: an area of any shape and position, and a range of forces.

    `radius` is the distance of the farthest corner from the middle of the area, not from the origin.

    Attributes:
        corners: Corners (x, y) of the area in the order along its outline, mm.
    """

    corners: tuple[tuple[float, float], ...]

    @classmethod
    def of_contacts(cls, contact: Array) -> "PressedArea":
        """Return the domain of given contacts: the outline of their places, and the range of their forces.

        If all forces are nearly equal, the range of forces is enlarged.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            PressError: If the places lie on a line.
        """
        places = np.unique(contact[:, :2], axis=0)
        corners = np.round(outline(places), 4)  # to 0.1 um
        force = contact[:, 2]
        min_force = float(force.min())
        max_force = float(force.max())
        if max_force < MIN_FORCE_RATIO * min_force:
            # Both ends are moved by the same factor, so that their geometric mean remains.
            min_force /= MIN_FORCE_RATIO**0.5
            max_force *= MIN_FORCE_RATIO**0.5
        distance_from_middle = np.linalg.norm(corners - box_middle(corners), axis=1)
        corner_places = tuple((x, y) for x, y in corners.tolist())
        # The first argument is the attribute `radius`, the distance of the farthest corner from the middle.
        return cls(float(distance_from_middle.max()), (min_force, max_force), corner_places)

    @cached_property
    def centre(self) -> Array:
        """Middles of the ranges of x, y and ln F, shape (3,), with x and y in mm and F in N."""
        return np.append(box_middle(np.array(self.corners)), super().centre[2])

    @cached_property
    def scale(self) -> Array:
        """Half widths of the ranges of x, y and ln F, shape (3,), with x and y in mm and F in N."""
        return np.append(0.5 * np.ptp(np.array(self.corners), axis=0), super().scale[2])

    def is_outside(self, contact: Array) -> Booleans:
        """Return whether each contact lies outside the area or has a force outside the range of forces.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N. A position or a force that is NaN counts as inside.

        Returns:
            Whether each contact lies outside, shape (n,).
        """
        x, y, _ = contact.T
        is_position_known = np.isfinite(x) & np.isfinite(y)
        is_off_area = is_position_known & ~inside_polygon(x, y, np.array(self.corners))
        unlimited_area = Domain(np.inf, self.force_range)  # only a force can be outside
        return np.asarray(is_off_area | unlimited_area.is_outside(contact))


def outline(places: Array) -> Array:
    """Compute the outline of the area that places cover.

    The outline is the concave hull of the places. The hull is moved outwards by half the median distance between
    neighbouring places.

    Args:
        places: Positions (x, y), all different, shape (m, 2), mm.

    Returns:
        Corners of the outline, anticlockwise, shape (n, 2), mm.

    Raises:
        PressError: If the places lie exactly or nearly on one line.
    """
    # The singular values are proportional to the extents of the places along their principal axes.
    length, width = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if width <= MIN_INDEPENDENCE * length:
        raise PressError(f"expected presses over an area, got {len(places)} places on one line; press beside it, too")

    # The nearest place is the place itself, and the second nearest is its nearest neighbour.
    distances, _ = cKDTree(places).query(places, 2)
    spacing = np.median(distances[:, 1])
    # `HULL_RATIO` determines how far the hull is bent inwards between places. `simplify(0.0)` removes corners on
    # straight edges.
    exterior = shapely.concave_hull(shapely.MultiPoint(places), HULL_RATIO).simplify(0.0)
    enlarged = exterior.buffer(0.5 * spacing, join_style="mitre", mitre_limit=2.0)
    # The corners are clockwise, and the last corner repeats the first. Reverse them, and leave out the repeated corner.
    closed_outline = shapely.get_coordinates(enlarged.normalize().exterior)
    return np.asarray(closed_outline[:0:-1])


USUAL_DISTANCE_QUANTILE = 0.9
"""Share of the values of a column whose distance from the median is at most the usual distance, dimensionless."""

MAX_DISTANCE_RATIO = 1_000.0
"""Largest accepted distance of a value from the median of its column, as a multiple of the usual distance."""


def check_measured_presses(presses: MeasuredPresses) -> None:
    """Check that a network can be trained on measured presses.

    Args:
        presses: The presses. All their positions, forces and charges must be known.

    Raises:
        PressError: If the charges of a channel hardly vary or are in ascending order, if a value is far from all
            others, or if channels depend linearly on each other. The message names the channels, or the line and the
            column.
    """
    for name in (*CONTACT, *presses.electrodes):
        values = presses.columns[name]
        _check_far_value(presses, name, values, compared_values=values)
    for name in presses.electrodes:  # the charges must vary, and must not be in ascending order
        _check_variation(name, presses.columns[name])

    # A force that is far too small is not far from the other forces, but its inverse is far from the other inverses.
    force = presses.columns["force_N"]
    _check_far_value(presses, "force_N", force, compared_values=1.0 / force)
    _check_independence(presses)


def _check_variation(name: str, charge: Array) -> None:
    """Raise an error if nearly all charges of a channel are equal, or if they are in ascending order.

    A column in ascending order contains times or numbers of the presses instead of charges. Neighbouring places are
    often pressed one after the other. A network could then read the place from the time, and the estimated errors of
    the model would be far too small.

    Args:
        name: Name of the channel.
        charge: Charges of the channel, shape (n,), pC.

    Raises:
        PressError: If all charges are in ascending order, or if all charges are equal after the smallest and the
            largest charges are left out, each a share `EXTREME_SHARE` of all.
    """
    low, high = np.quantile(charge, (EXTREME_SHARE, 1.0 - EXTREME_SHARE))
    if np.isclose(low, high, atol=0.0):
        equal_count = np.isclose(charge, low, atol=0.0).sum()
        raise PressError(
            f"channel {shown(name)}: expected charges that vary, got {low:g} in {equal_count} of {len(charge)} "
            "presses; leave the channel out"
        )
    if (np.diff(charge) >= 0.0).all():
        raise PressError(
            f"channel {shown(name)}: expected charges, got values in ascending order; leave out columns with times or "
            "numbers of the presses"
        )


def _check_far_value(presses: MeasuredPresses, name: str, values: Array, compared_values: Array) -> None:
    """Raise an error if a value of a column is far from all other values.

    The largest distance of a value from the median is compared with the usual distance, which is a quantile of all
    distances that are not zero.

    Args:
        presses: The presses, whose line numbers the message needs.
        name: Name of the column, for the message.
        values: Values of the column, shape (n,).
        compared_values: Numbers whose distances from their median are compared, shape (n,). They are the values or a
            function of the values, such as their inverses, which shows values that are far too small.

    Raises:
        PressError: If the largest distance exceeds `MAX_DISTANCE_RATIO` times the usual distance.
    """
    distance = np.abs(compared_values - np.median(compared_values))
    if not distance.any():  # all values are equal
        return
    # Distances of zero are left out, because the usual distance would otherwise be zero if most values are equal.
    usual_distance = np.quantile(distance[distance > 0.0], USUAL_DISTANCE_QUANTILE)
    row = distance.argmax()  # row of the farthest value
    if distance[row] > MAX_DISTANCE_RATIO * usual_distance:
        raise PressError(
            f"line {presses.lines[row]}, column {shown(name)}: expected a value of the size of the others, whose "
            f"median is {np.median(values):.3g}, got {values[row]:.6g}; correct it, or remove the line"
        )


def _check_independence(presses: MeasuredPresses) -> None:
    """Raise an error if the charges of any channel are a linear combination of those of other channels.

    Args:
        presses: The presses.

    Raises:
        PressError: If the smallest singular value of the standardised charges is nearly zero. The message names the
            channels that contribute to the singular vector of this value.
    """
    charge = presses.charge_pC
    standardised_charge = (charge - charge.mean(axis=0)) / charge.std(axis=0)
    # Each row of `directions` contains the coefficients of one combination of the channels. The last row belongs to the
    # smallest singular value.
    _, singular_values, directions = np.linalg.svd(standardised_charge, full_matrices=False)
    largest, *_, smallest = singular_values
    if smallest > MIN_INDEPENDENCE * largest:
        return
    # The last combination is nearly zero. Its coefficients form a unit vector.
    dependent_names = [
        shown(name)
        for name, coefficient in zip(presses.electrodes, directions[-1], strict=True)
        if abs(coefficient) > MIN_INDEPENDENCE
    ]
    raise PressError(
        f"channels {', '.join(dependent_names)}: expected charges that are linearly independent, got channels of which "
        "each follows from the others; leave out a channel that is a copy or a sum of others"
    )
