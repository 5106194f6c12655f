"""Charges of presses, the contacts that a model computes from them, and the domain in which these contacts are valid.

A contact consists of ten numbers. Other programs rely on the order of the ten numbers.

Charges must be finite numbers in the order of the electrodes. `write_finite` is a fast check for plain numbers.

The class `Validity` compares contacts with the domain for which a model was trained. The result of the comparison is a
subset of the flags `outside`, `beyond`, `misfit` and `stress`.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isocharge.common.arrays import Array, Booleans, Reals, Singles
from isocharge.common.errors import ChargeError
from isocharge.serve.flags import BEYOND, MISFIT, OUTSIDE, STRESS
from isocharge.serve.model.metadata import ModelMetadata

STD_COLUMNS = slice(3, 6)
"""Columns of the standard deviations among the ten numbers of a contact."""

CORRELATION_COLUMNS = slice(7, 10)
"""Columns of the correlations, which are the last three of the ten numbers of a contact."""


class Contact(NamedTuple):
    """Position and force of one press, with the uncertainties of the position and the force.

    `Predictor.flags` returns the reasons why a contact may be wrong.

    Attributes:
        x_mm: Coordinate x of the position in the frame of the sensor, mm.
        y_mm: Coordinate y of the position in the frame of the sensor, mm.
        force_N: Force, N, positive if the probe pushes.
        x_std_mm: Standard deviation of x, mm.
        y_std_mm: Standard deviation of y, mm.
        force_std_N: Standard deviation of the force, N.
        misfit: Distance between the measured charges and the nearest charges that a single contact can produce, in
            standard deviations of the noise.
        xy_correlation: Correlation of the errors of x and y, -1 to 1.
        xF_correlation: Correlation of the errors of x and the force, -1 to 1.
        yF_correlation: Correlation of the errors of y and the force, -1 to 1.
    """

    x_mm: float
    y_mm: float
    force_N: float
    x_std_mm: float
    y_std_mm: float
    force_std_N: float
    misfit: float
    xy_correlation: float = math.nan
    xF_correlation: float = math.nan
    yF_correlation: float = math.nan

    def with_error(self, covariance: Array) -> "Contact":
        """Return the contact with an uncertainty that includes an additional independent error.

        Args:
            covariance: Covariance of the additional error of x, y and the force, shape (3, 3), mm and N.
        """
        (values,) = add_covariance(np.array([self], np.float32), covariance[np.newaxis])
        return Contact(*values.tolist())

    def __repr__(self) -> str:
        """Return a text with x, y, the force and their standard deviations, rounded to a few significant digits."""
        return (
            f"Contact(x_mm={self.x_mm:.4g} +- {self.x_std_mm:.2g}, y_mm={self.y_mm:.4g} +- {self.y_std_mm:.2g}, "
            f"force_N={self.force_N:.4g} +- {self.force_std_N:.2g}, misfit={self.misfit:.2g})"
        )


CLOSE_DISTANCE_mm = 0.3
"""Largest distance between two close contacts, mm."""

CLOSE_FORCE_RATIO = 0.05
"""Largest difference between the forces of two close contacts, relative to the force of the reference contact."""


def is_close(contact: Contact, reference: Contact | None) -> bool:
    """Return whether a contact has nearly the same position and force as a reference contact.

    A sensitivity describes how a contact changes with a parameter of the film. The sensitivity that was computed for
    the reference may also be used for a contact that is close to the reference.

    Args:
        contact: The contact that is compared with the reference.
        reference: The reference contact. If there is no reference contact (None), the result is False.
    """
    if reference is None:
        return False
    is_position_close = math.dist(contact[:2], reference[:2]) <= CLOSE_DISTANCE_mm
    is_force_close = abs(contact.force_N - reference.force_N) <= CLOSE_FORCE_RATIO * reference.force_N
    return is_position_close and is_force_close


class Contacts(NamedTuple):
    """Contacts of n presses, with one float32 array of shape (n,) for each field of `Contact`.

    `np.asarray` converts the fields to one array of shape (n, 10) in which each row contains one press.
    """

    x_mm: Singles
    y_mm: Singles
    force_N: Singles
    x_std_mm: Singles
    y_std_mm: Singles
    force_std_N: Singles
    misfit: Singles
    xy_correlation: Singles
    xF_correlation: Singles
    yF_correlation: Singles

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray[Any, Any]:
        """Return an array of shape (n, 10) in which each row contains one press. NumPy calls this method.

        Args:
            dtype: Requested number type; None for float32.
            copy: Ignored, because the result is always a new array.
        """
        return np.stack(tuple(self), axis=1, dtype=dtype or np.float32, casting="unsafe")


def add_covariance(contacts: Singles, covariance: Array) -> Singles:
    """Return contacts whose uncertainty includes an additional independent error. NaN correlations remain NaN.

    Args:
        contacts: The ten numbers of n contacts, shape (n, 10).
        covariance: Covariance of the additional error of x, y and the force, shape (n, 3, 3), mm and N.
    """
    result = contacts.astype(float)
    std = result[:, STD_COLUMNS]  # of x, y and the force, shape (n, 3)
    extra_variance = np.diagonal(covariance, axis1=1, axis2=2)
    total_std = np.sqrt(std**2 + extra_variance)

    # Indices of the pairs (x, y), (x, F) and (y, F). A covariance is a correlation times two standard deviations.
    first = [0, 0, 1]
    second = [1, 2, 2]
    pair_covariance = result[:, CORRELATION_COLUMNS] * std[:, first] * std[:, second]
    total_pair_covariance = pair_covariance + covariance[:, first, second]
    result[:, CORRELATION_COLUMNS] = total_pair_covariance / (total_std[:, first] * total_std[:, second])
    result[:, STD_COLUMNS] = total_std
    return result.astype(np.float32)


CORRELATION_RIDGE = 1e-5
"""Number that is added to the diagonal of the correlations, which models compute in single precision.

The smallest eigenvalue of the correlations of released models is between -5e-6 and 1.
"""


CORRELATION_PAIRS = np.array([[-1, 0, 1], [0, -1, 2], [1, 2, -1]])
"""Index of the correlation between two errors in the list of the correlations xy, xF and yF; -1 on the diagonal."""


def correlation_matrices(contacts: ArrayLike) -> Array:
    """Return the matrices of the correlations between the errors of x, y and the force, shape (..., 3, 3).

    The correlations are made slightly smaller, so that all eigenvalues are positive in spite of rounding errors.

    Args:
        contacts: The ten numbers of each contact, shape (..., 10).
    """
    correlations = np.asarray(contacts, dtype=float)[..., CORRELATION_COLUMNS]  # shape (..., 3)
    # `CORRELATION_PAIRS` contains the index of the correlation of each pair, and -1 on the diagonal, shape (3, 3).
    matrices = correlations.take(CORRELATION_PAIRS, axis=-1) / (1.0 + CORRELATION_RIDGE)
    is_diagonal = CORRELATION_PAIRS < 0
    return np.where(is_diagonal, 1.0, matrices)


def write_finite(write: Callable[..., object], values: Any) -> bool:
    """Write the charges of one press as float32 numbers, and check that they are finite.

    Args:
        write: Function that takes the numbers as separate arguments and raises the exceptions of `struct.pack_into`.
        values: Iterable of the numbers, as many as `write` takes. Values of other types give False.

    Returns:
        True if all numbers were written and are finite. If False, the memory does not contain valid charges.
    """
    try:
        numbers = tuple(values)
        write(*numbers)
        # If a number is NaN or infinite, the sum is not finite. A sum of finite numbers is finite here: `write` has
        # refused numbers beyond the range of float32, and the sum is computed in float64, whose range is much larger.
        return math.isfinite(sum(numbers))
    except (struct.error, TypeError, ValueError, OverflowError):
        return False


def as_charges(charge_pC: ArrayLike, electrodes: tuple[str, ...], *, is_batch: bool) -> Singles:
    """Convert the charges of one press or of n presses to a contiguous array of shape (n, electrodes), float32, pC.

    Args:
        charge_pC: Charges, pC, in the order of the electrodes: shape (electrodes,) for one press, or shape
            (n, electrodes) for a batch.
        electrodes: Names of the electrodes.
        is_batch: Whether `charge_pC` contains a batch of presses.

    Raises:
        ChargeError: If the charges are not numbers, their array has another shape, or a charge is not finite. The
            message names the electrode and, for a batch, the row.
    """
    n_electrode = len(electrodes)
    expected = f"{n_electrode} charges {electrodes}"
    if is_batch:
        expected = f"rows of {expected}, shape (n, {n_electrode})"
    try:
        charges = np.asarray(charge_pC)
    except ValueError as error:  # rows of different lengths
        raise ChargeError(f"expected {expected} in each row, got {charge_pC!r:.200} ({error})") from error
    # Numbers are floats, signed or unsigned integers. The array has lost the mask of a masked array.
    if charges.dtype.kind not in "fiu" or np.ma.is_masked(charge_pC):
        raise ChargeError(f"expected {expected} as numbers (pC), got {charge_pC!r:.200}")
    # The charges of one press have one axis, those of a batch have two (`is_batch` counts as 0 or 1).
    if charges.ndim != 1 + is_batch or charges.shape[-1] != n_electrode:
        raise ChargeError(f"expected {expected}, got an array of shape {charges.shape}")
    return as_float32(charges.reshape(-1, n_electrode), electrodes)


def as_float32(charges: NDArray[Any], electrodes: tuple[str, ...]) -> Singles:
    """Convert charges of any number type to a contiguous float32 array.

    Args:
        charges: Charges, shape (n, electrodes), pC.
        electrodes: Names of the electrodes, for the error message.

    Raises:
        ChargeError: If a charge is not finite or beyond the range of float32. The message names the electrodes of all
            such charges in the first row with such a charge.
    """
    with np.errstate(over="ignore"):  # charges beyond the range of float32 become infinite and are refused below
        converted = np.ascontiguousarray(charges, dtype=np.float32)
    is_finite = np.isfinite(converted)
    if is_finite.all():
        return converted
    row = np.argmin(is_finite.all(axis=1))  # index of the first row that is not finite
    bad_columns = np.flatnonzero(~is_finite[row])
    bad_charges = [f"{electrodes[column]!r} ({charges[row, column]})" for column in bad_columns]
    where = f" in row {row} (rows count from 0)" if len(charges) > 1 else ""
    raise ChargeError(f"expected finite float32 charges (pC), got{where} for electrode {', '.join(bad_charges)}")


MISFIT_LIMIT = 5.0
"""Smallest limit of the misfit, in standard deviations of the noise.

The metadata of a model may contain a larger limit, which 0.1 % of good presses exceed.
"""

TOUCH_LIMIT = 5.0
"""Charge, in standard deviations of the white noise, above which an electrode indicates a touch."""

IMPLAUSIBLE_FACTOR = 3.0
"""Factor that gives the limits beyond which an output of the model cannot be a measurement, dimensionless.

The limit of the force is the largest force times this factor. The limit of the distance from the centre of the working
area is the radius of the circle around the working area times this factor.
"""

MIN_ROUNDNESS = 0.95
"""Smallest ratio of the inner radius to the outer radius of a round working area, dimensionless.

The inner radius is the radius of the largest circle inside the area, and the outer radius is the radius of the smallest
circle around the area. The centre of both circles is the origin.
"""


N_CORNERS = 64
"""Number of corners of the polygon that represents a round working area."""


def disk_corners(radius_mm: float) -> Array:
    """Return the corners (x, y) of a regular polygon around a disk, shape (N_CORNERS, 2), mm.

    The centre of the disk is the origin. The sides of the polygon touch the disk.
    """
    angle = 2.0 * np.pi * np.arange(N_CORNERS) / N_CORNERS
    corner_distance_mm = radius_mm / np.cos(np.pi / N_CORNERS)
    return np.asarray(corner_distance_mm * np.column_stack([np.cos(angle), np.sin(angle)]))


@dataclass(frozen=True)
class Validity:
    """The domain in which a model is valid: the working area, the range of forces and the limit of the misfit.

    Attributes:
        corners_mm: Corners of the polygon that is the working area, shape (n, 2), mm.
        force_range_N: Smallest and largest force, N.
        misfit_limit: Misfit above which the charges are not attributed to a single contact, in standard deviations.
        yield_force_N: Force above which the film yields at the centre, N.
        white_pC: Standard deviation of the white noise, pC: one number for all electrodes, or one number for each
            electrode.
    """

    corners_mm: Array
    force_range_N: tuple[float, float]
    misfit_limit: float = MISFIT_LIMIT
    yield_force_N: float = math.inf
    white_pC: float | tuple[float, ...] = 0.0

    @classmethod
    def of(cls, metadata: ModelMetadata) -> "Validity":
        """Return the domain that the metadata of a model describe.

        Args:
            metadata: Metadata of the model.
        """
        measured_limit = metadata.errors.get("misfit_p999", MISFIT_LIMIT)  # 0.1 % of good presses exceed it
        return cls(
            corners_mm=np.array(metadata.working_area_mm),
            force_range_N=metadata.force_range_N,
            misfit_limit=max(MISFIT_LIMIT, measured_limit),
            yield_force_N=math.inf if metadata.yield_force_N is None else metadata.yield_force_N,
            white_pC=metadata.noise.white_pC,
        )

    @cached_property
    def centre_mm(self) -> tuple[float, float]:
        """Centre (x, y) of the bounding box of the working area, mm."""
        x_mm, y_mm = box_middle(self.corners_mm).tolist()
        return x_mm, y_mm

    @cached_property
    def implausible_limits(self) -> tuple[float, float]:
        """Limits beyond which an output of the model cannot be a measurement.

        The first limit is a squared distance from `centre_mm`, mm^2. The second limit is a force, N.
        """
        circumscribed_radius_mm = np.linalg.norm(self.corners_mm - self.centre_mm, axis=1).max()
        _min_force_N, max_force_N = self.force_range_N
        return float(IMPLAUSIBLE_FACTOR * circumscribed_radius_mm) ** 2, IMPLAUSIBLE_FACTOR * max_force_N

    def is_touch(self, charge_pC: Array) -> Booleans:
        """Compute for each press whether the charge of at least one electrode exceeds the noise.

        A charge exceeds the noise if its magnitude is larger than `TOUCH_LIMIT` standard deviations of the white noise.

        Args:
            charge_pC: Charges of n presses, shape (n, electrodes), pC.

        Returns:
            Whether each press is a touch, shape (n,).
        """
        limit_pC = np.multiply(TOUCH_LIMIT, self.white_pC)
        return np.asarray((np.abs(charge_pC) > limit_pC).any(axis=1))

    @cached_property
    def area_text(self) -> str:
        """Description of the working area for messages.

        If the area is nearly a disk around the origin, which the text calls the centre, the text states its radius.
        Otherwise, the text states its bounding box.
        """
        # The radius of the largest circle around the origin inside the area is stored as its square.
        radius_mm = math.sqrt(self.inscribed_radius_squared_mm2)
        is_round = radius_mm > MIN_ROUNDNESS * np.linalg.norm(self.corners_mm, axis=1).max()
        if is_round:
            return f"up to {radius_mm:.3g} mm from the centre"
        # The limits are the corners of the bounding box of the working area.
        left_mm, bottom_mm = self.corners_mm.min(axis=0)
        right_mm, top_mm = self.corners_mm.max(axis=0)
        return f"from ({left_mm:.3g}, {bottom_mm:.3g}) to ({right_mm:.3g}, {top_mm:.3g}) mm"

    @cached_property
    def inscribed_radius_squared_mm2(self) -> float:
        """Squared radius of a circle around the origin that lies inside the working area, mm^2.

        The radius is the distance from the origin to the nearest line through an edge of the working area. If the
        origin is not on the same side of all edges, the radius is 0.
        """
        x_start, y_start = self.corners_mm.T
        x_end, y_end = np.roll(self.corners_mm, -1, axis=0).T  # the last edge ends at the first corner
        with np.errstate(invalid="ignore"):  # if the last corner repeats the first corner, an edge has the length 0
            signed_distance_mm = (x_start * y_end - x_end * y_start) / np.hypot(x_end - x_start, y_end - y_start)
        # The distances are positive if the corners are in anticlockwise order, and negative if they are clockwise. If
        # the origin is outside, both of the following radii are negative. The distance to an edge of the length 0 is
        # NaN, and is ignored.
        anticlockwise_radius_mm = np.nanmin(signed_distance_mm)
        clockwise_radius_mm = -np.nanmax(signed_distance_mm)
        return float(max(anticlockwise_radius_mm, clockwise_radius_mm, 0.0)) ** 2

    def flags(self, contact: Contact) -> tuple[str, ...]:
        """Return the flags of one contact, which are the reasons why the contact may be wrong.

        For a contact in the largest circle inside the working area, the method takes one or two microseconds. Every
        other contact is compared with the polygon of the area, which takes about 50 us.

        Args:
            contact: Contact that the model computed.

        Returns:
            The words `outside`, `beyond`, `misfit` and `stress` whose conditions are true; empty if the contact is
            valid.
        """
        min_force_N, max_force_N = self.force_range_N
        distance_squared_mm2 = contact.x_mm * contact.x_mm + contact.y_mm * contact.y_mm
        is_in_circle = distance_squared_mm2 < self.inscribed_radius_squared_mm2
        # Fast check with the conditions of `_conditions`, for a contact in the circle
        is_valid = (
            is_in_circle
            and min_force_N <= contact.force_N <= max_force_N
            and contact.misfit <= self.misfit_limit
            and contact.force_N <= self.yield_force_N
        )
        if is_valid:
            return ()
        x_mm, y_mm = np.array([contact[:2]]).T  # arrays of shape (1,)
        is_in_area = is_in_circle or inside_polygon(x_mm, y_mm, self.corners_mm)[0]
        return tuple(word for word, is_flagged in self._conditions(contact, is_in_area).items() if is_flagged)

    def batch_flags(self, contacts: Contacts) -> list[tuple[str, ...]]:
        """Return the flags of n contacts.

        Args:
            contacts: Contacts of n presses.

        Returns:
            A list of length n with the flags of each press, as the method `flags` returns them for a single contact.
        """
        with np.errstate(over="ignore"):  # a distance that overflows is infinite and exceeds the limit
            has_flag = self._conditions(contacts, inside_polygon(contacts.x_mm, contacts.y_mm, self.corners_mm))
        flags: list[tuple[str, ...]] = [()] * len(contacts.x_mm)
        # `has_flag` contains an array of shape (n,) for each flag. The loop visits only the contacts with any flag.
        for row in np.flatnonzero(np.any(list(has_flag.values()), axis=0)):
            flags[row] = tuple(word for word, is_flagged in has_flag.items() if is_flagged[row])
        return flags

    def _conditions(self, contact: Contact | Contacts, is_in_area: Any) -> dict[str, Any]:
        """Return the condition of each flag for one contact or for n contacts.

        Args:
            contact: One contact, or n contacts.
            is_in_area: Whether the contact lies in the working area: a bool, or an array of shape (n,) for n contacts.

        Returns:
            For each flag, whether its condition is true. The values have the form of `is_in_area`.
        """
        min_force_N, max_force_N = self.force_range_N
        centre_x_mm, centre_y_mm = self.centre_mm
        max_distance_squared_mm2, implausible_force_N = self.implausible_limits
        x_mm = contact.x_mm - centre_x_mm  # relative to the centre of the working area
        y_mm = contact.y_mm - centre_y_mm
        return {
            OUTSIDE: np.logical_not(is_in_area) | (contact.force_N < min_force_N) | (contact.force_N > max_force_N),
            BEYOND: (x_mm * x_mm + y_mm * y_mm > max_distance_squared_mm2) | (contact.force_N > implausible_force_N),
            MISFIT: contact.misfit > self.misfit_limit,
            STRESS: contact.force_N > self.yield_force_N,
        }


def box_middle(corners: Array) -> Array:
    """Return the middle of the bounding box of corners (x, y), shape (2,), in their unit."""
    return np.asarray(0.5 * (corners.min(axis=0) + corners.max(axis=0)))


def inside_polygon(x: Reals, y: Reals, corners: Array) -> Booleans:
    """Compute whether points lie inside a polygon.

    A point is inside the polygon if a horizontal ray from the point to the right crosses an odd number of edges. The
    ray crosses an edge if two conditions hold: exactly one end of the edge is above the ray, and the edge intersects
    the horizontal line to the right of the point.

    Args:
        x: First coordinates of the points, shape (n,), in the unit of the corners.
        y: Second coordinates of the points, shape (n,).
        corners: Corners in their order along the polygon, shape (m, 2). The last corner may repeat the first corner.

    Returns:
        Whether each point is inside, shape (n,). The result for points on an edge is undefined.
    """
    edge_ends = np.roll(corners, -1, axis=0)
    # Coordinates of shape (m, 1), so that the arrays below have the shape (m edges, n points).
    x_start, y_start = corners.T[..., np.newaxis]
    x_end, y_end = edge_ends.T[..., np.newaxis]
    crosses_height = (y_start > y) != (y_end > y)  # the edge crosses the horizontal line through the point
    with np.errstate(divide="ignore", invalid="ignore"):  # the division by 0 of a horizontal edge has no effect
        crossing_x = x_start + (y - y_start) * (x_end - x_start) / (y_end - y_start)
    is_to_the_right = x < crossing_x
    crossing_count = np.count_nonzero(crosses_height & is_to_the_right, axis=0)
    return np.asarray(crossing_count % 2 == 1)
