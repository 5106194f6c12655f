"""Contacts that a model computes from charges, and the domain in which the model is valid.

A contact has ten numbers. Other programs rely on the order of these numbers. `Validity` compares contacts with the
domain for which a model was trained, and returns the flags `outside`, `beyond`, `misfit` and `stress`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Reals, Singles
from isocharge.serve.flags import BEYOND, MISFIT, OUTSIDE, STRESS
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import N_WITHOUT_CORRELATION

MAX_DECIMALS = 6
"""Largest number of decimals in the text of a contact. The last decimal is 1 nm or 1 uN."""


class Contact(NamedTuple):
    """Position and force of one press with their uncertainties. `Predictor.flags` checks whether a contact is valid.

    Attributes:
        x_mm: Position in the frame of the sensor, mm.
        y_mm: Position in the frame of the sensor, mm.
        force_N: Force, N, positive if the probe pushes.
        x_std_mm: Standard deviation of x, mm.
        y_std_mm: Standard deviation of y, mm.
        force_std_N: Standard deviation of the force, N.
        misfit: Distance of the charges from the charges of the nearest single contact, in standard deviations of the
            noise.
        xy_correlation: Correlation of the errors of x and y, -1 to 1; NaN if the model computes no correlations.
        xF_correlation: Correlation of the errors of x and the force, -1 to 1; NaN without correlations.
        yF_correlation: Correlation of the errors of y and the force, -1 to 1; NaN without correlations.
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

    def widened(self, shift: tuple[float, float, float]) -> "Contact":
        """Return the contact with larger standard deviations, which include an additional, independent error.

        A single error changes x, y and the force together, so their changes are fully correlated. The correlations of
        the contact therefore change as well. The variance of x grows by x_shift^2, and the covariance of x and y by
        x_shift * y_shift.

        Args:
            shift: Changes of x and y, mm, and of the force, N, that one standard deviation of the error causes.
        """
        x_shift, y_shift, force_shift = shift
        x_std_mm = math.hypot(self.x_std_mm, x_shift)
        y_std_mm = math.hypot(self.y_std_mm, y_shift)
        force_std_N = math.hypot(self.force_std_N, force_shift)
        xy_covariance = self.xy_correlation * self.x_std_mm * self.y_std_mm + x_shift * y_shift
        xF_covariance = self.xF_correlation * self.x_std_mm * self.force_std_N + x_shift * force_shift
        yF_covariance = self.yF_correlation * self.y_std_mm * self.force_std_N + y_shift * force_shift
        return self._replace(
            x_std_mm=x_std_mm,
            y_std_mm=y_std_mm,
            force_std_N=force_std_N,
            xy_correlation=xy_covariance / (x_std_mm * y_std_mm),
            xF_correlation=xF_covariance / (x_std_mm * force_std_N),
            yF_correlation=yF_covariance / (y_std_mm * force_std_N),
        )

    def fields(self) -> dict[str, Any]:
        """Return the contact as fields of a record. Correlations that the model does not compute are None."""
        fields = self._asdict()
        if math.isnan(self.xy_correlation):
            fields |= NO_CORRELATION
        return fields

    def __repr__(self) -> str:
        """Return each number with its standard deviation. The standard deviation is rounded to two digits."""
        numbers = ", ".join(f"{name}={value} +- {std}" for name, value, std in self._rounded())
        return f"Contact({numbers}, misfit={self.misfit:.2g})"

    def _rounded(self) -> Iterator[tuple[str, str, str]]:
        """Yield the name, the rounded value and the rounded standard deviation of x, y and the force.

        The value and the standard deviation have so many decimals that the standard deviation has two significant
        digits.
        """
        stds = {"x_mm": self.x_std_mm, "y_mm": self.y_std_mm, "force_N": self.force_std_N}
        for name, std in stds.items():
            decimals = MAX_DECIMALS
            if math.isfinite(std) and std > 0.0:
                decimals_of_two_digits = 1 - math.floor(math.log10(std))  # for example, 3 if the std is 0.012
                decimals = min(max(decimals_of_two_digits, 0), MAX_DECIMALS)
            value = getattr(self, name)
            yield name, f"{value:.{decimals}f}", f"{std:.{decimals}f}"


NO_CORRELATION = dict.fromkeys(Contact._fields[N_WITHOUT_CORRELATION:])
"""Fields of a record for a model that computes no correlations."""

REUSE_DISTANCE_mm = 0.3
"""Largest change of x or y for which a sensitivity is reused, mm."""

REUSE_FORCE_RATIO = 0.05
"""Largest change of the force for which a sensitivity is reused, relative to the force, dimensionless."""


class Sensitivity:
    """Sensitivity of a contact to a parameter whose value is uncertain.

    The sensitivity is computed from a second prediction with another value of the parameter. It is reused while the
    contact hardly moves, so that most frames of a held press need one prediction instead of two.
    """

    def __init__(self, unit: float) -> None:
        """Begin without a contact.

        Args:
            unit: Difference of the parameter between the two predictions.
        """
        self._unit = unit
        self._reference: Contact | None = None
        self._unit_shift = (0.0, 0.0, 0.0)

    def shift(
        self, contact: Contact, size: float, predict_after_unit: Callable[[], Contact]
    ) -> tuple[float, float, float]:
        """Compute by how much a change of the parameter changes the position and the force of a contact.

        The contact is assumed to change in proportion to the parameter. The change of the contact for a fixed step of
        the parameter, which the constructor was given, is stored. The stored change is used again for contacts that are
        close to the contact for which it was computed, so that no second prediction is needed.

        Args:
            contact: The contact at the present value of the parameter.
            size: Change of the parameter, in the same unit as the step.
            predict_after_unit: Function that predicts the contact with the parameter increased by the step.

        Returns:
            Changes of x and y, mm, and of the force, N.
        """
        if not is_close(contact, self._reference):
            contact_after_unit = predict_after_unit()
            self._reference = contact
            self._unit_shift = (
                contact_after_unit.x_mm - contact.x_mm,
                contact_after_unit.y_mm - contact.y_mm,
                contact_after_unit.force_N - contact.force_N,
            )
        x_shift, y_shift, force_shift = self._unit_shift
        factor = size / self._unit
        return factor * x_shift, factor * y_shift, factor * force_shift


def is_close(contact: Contact, reference: Contact | None) -> bool:
    """Return whether a contact is so close to a reference that both have the same sensitivity to a parameter.

    Args:
        contact: The contact.
        reference: The contact to compare it with. The result is False for None.
    """
    if reference is None:
        return False
    is_x_close = abs(contact.x_mm - reference.x_mm) <= REUSE_DISTANCE_mm
    is_y_close = abs(contact.y_mm - reference.y_mm) <= REUSE_DISTANCE_mm
    is_force_close = abs(contact.force_N - reference.force_N) <= REUSE_FORCE_RATIO * reference.force_N
    return is_x_close and is_y_close and is_force_close


class Contacts(NamedTuple):
    """Contacts of n presses. Each field of `Contact` is a float32 array of shape (n,).

    `np.asarray` converts the fields to one array of shape (n, 10) with one press in each row.
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
        """Return an array of shape (n, 10) with one press in each row."""
        return np.stack(tuple(self), axis=1).astype(dtype or np.float32, copy=False)


MISFIT_LIMIT = 5.0
"""Smallest limit of the misfit, in standard deviations of the noise.

The metadata of a model may contain a larger limit, which 0.1 % of good presses exceed.
"""

TOUCH_LIMIT = 5.0
"""Charge, in standard deviations of the white noise, above which an electrode indicates a touch."""

IMPLAUSIBLE_FACTOR = 3.0
"""Factor for the limits beyond which an output of the model cannot be a measurement, dimensionless.

The limits are this multiple of the largest force, and of the radius of the circle around the working area.
"""

MAX_CENTRE_OFFSET = 0.05
"""Largest distance of the centre of a centred working area from the origin, relative to the radius of the area."""


@dataclass(frozen=True)
class Validity:
    """The domain in which a model is valid: working area, range of forces, and limit of the misfit.

    Attributes:
        corners_mm: Corners of the working area, a polygon, shape (n, 2), mm.
        force_range_N: Smallest and largest force, N.
        misfit_limit: Largest misfit of a single contact, in standard deviations.
        yield_force_N: Force above which the film yields, N.
        white_pC: Standard deviation of the white noise, pC: one number for all electrodes, or one for each electrode.
    """

    corners_mm: Array
    force_range_N: tuple[float, float]
    misfit_limit: float = MISFIT_LIMIT
    yield_force_N: float = math.inf
    white_pC: float | tuple[float, ...] = 0.0

    @classmethod
    def of(cls, metadata: ModelMetadata) -> "Validity":
        """Return the domain that the metadata of a model describe."""
        measured_limit = metadata.errors.get("misfit_p999", MISFIT_LIMIT)
        return cls(
            corners_mm=np.array(metadata.working_area_mm),
            force_range_N=metadata.force_range_N,
            misfit_limit=max(MISFIT_LIMIT, measured_limit),
            yield_force_N=math.inf if metadata.yield_force_N is None else metadata.yield_force_N,
            white_pC=metadata.noise.white_pC,
        )

    @cached_property
    def radius_mm(self) -> float:
        """Largest distance of a corner of the working area from the origin, mm."""
        return float(np.linalg.norm(self.corners_mm, axis=1).max())

    @cached_property
    def centre_mm(self) -> tuple[float, float]:
        """Centre (x, y) of the bounding box of the working area, mm."""
        lowest = self.corners_mm.min(axis=0)
        highest = self.corners_mm.max(axis=0)
        x_mm, y_mm = (0.5 * (lowest + highest)).tolist()
        return x_mm, y_mm

    @cached_property
    def implausible_limits(self) -> tuple[float, float]:
        """Squared distance from the centre, mm^2, and force, N, beyond which an output cannot be a measurement."""
        radius_mm = np.linalg.norm(self.corners_mm - self.centre_mm, axis=1).max()
        _, max_force_N = self.force_range_N
        return float(IMPLAUSIBLE_FACTOR * radius_mm) ** 2, IMPLAUSIBLE_FACTOR * max_force_N

    def is_touch(self, charge_pC: Array) -> Booleans:
        """Return whether charges exceed the noise on at least one electrode.

        Args:
            charge_pC: Charges, shape (n, electrodes), pC.

        Returns:
            Whether each row of charges is a touch, shape (n,).
        """
        limit_pC = TOUCH_LIMIT * np.asarray(self.white_pC)
        return np.asarray((np.abs(charge_pC) > limit_pC).any(axis=1))

    @property
    def is_centred(self) -> bool:
        """Whether the centre of the working area is close to the origin."""
        return math.hypot(*self.centre_mm) < MAX_CENTRE_OFFSET * self.radius_mm

    @cached_property
    def area_text(self) -> str:
        """Description of the working area for messages: its radius, or its bounding box if it is not centred."""
        if self.is_centred:
            return f"up to {self.radius_mm:.3g} mm"
        # Corners of the bounding box
        left, bottom = self.corners_mm.min(axis=0)
        right, top = self.corners_mm.max(axis=0)
        return f"from ({left:.3g}, {bottom:.3g}) to ({right:.3g}, {top:.3g}) mm"

    def is_beyond(self, contact: Contact) -> bool:
        """Return whether a contact is so far outside the domain that it cannot be a measurement."""
        centre_x_mm, centre_y_mm = self.centre_mm
        limit_mm2, limit_N = self.implausible_limits  # squared distance from the centre, and force
        x_mm = contact.x_mm - centre_x_mm
        y_mm = contact.y_mm - centre_y_mm
        return x_mm * x_mm + y_mm * y_mm > limit_mm2 or contact.force_N > limit_N

    @cached_property
    def inscribed_radius_squared_mm2(self) -> float:
        """Squared radius of the largest circle around the origin inside the working area, mm^2.

        It is the squared distance of the origin from the nearest edge of the area, or 0 if the origin is outside.
        """
        origin_x_mm = np.zeros(1)  # `inside_polygon` takes arrays of points, here of one point
        origin_y_mm = np.zeros(1)
        is_origin_inside = inside_polygon(origin_x_mm, origin_y_mm, self.corners_mm)[0]
        if not is_origin_inside:
            return 0.0

        # The nearest point of each edge is the projection of the origin onto the edge, limited to the ends of the edge.
        start = self.corners_mm  # shape (edges, 2)
        edge = np.roll(start, -1, axis=0) - start
        edge_length_squared = np.maximum((edge * edge).sum(axis=1), 1e-30)  # the last corner may repeat the first one
        projection = -(start * edge).sum(axis=1) / edge_length_squared  # as a fraction of the edge, shape (edges,)
        fraction = np.clip(projection, 0.0, 1.0)
        nearest_point = start + fraction[:, np.newaxis] * edge
        distance_squared_mm2 = (nearest_point**2).sum(axis=1)
        return float(distance_squared_mm2.min())

    def flags(self, contact: Contact) -> tuple[str, ...]:
        """Return the flags of one contact.

        Most contacts take about a microsecond. If a contact is near the edge of the working area, it is compared with
        the polygon of the area, which takes about 30 us.
        """
        return _flag_words(
            is_outside=self._is_outside(contact),
            is_beyond=self.is_beyond(contact),
            has_misfit=contact.misfit > self.misfit_limit,
            is_above_yield=contact.force_N > self.yield_force_N,
        )

    def _is_outside(self, contact: Contact) -> bool:
        """Return whether a contact is outside the working area or the range of forces.

        Only a contact between the inscribed and the circumscribed circle of the area, both around the origin, is
        compared with the polygon. This saves time, because most contacts lie inside the inscribed circle.
        """
        min_force_N, max_force_N = self.force_range_N
        if contact.force_N < min_force_N or contact.force_N > max_force_N:
            return True
        distance_squared_mm2 = contact.x_mm * contact.x_mm + contact.y_mm * contact.y_mm
        if distance_squared_mm2 < self.inscribed_radius_squared_mm2:
            return False
        if distance_squared_mm2 <= self.radius_mm * self.radius_mm:
            return not inside_polygon(np.array([contact.x_mm]), np.array([contact.y_mm]), self.corners_mm)[0]
        return True

    def batch_flags(self, contacts: Contacts) -> list[tuple[str, ...]]:
        """Return the flags of each contact.

        Args:
            contacts: Contacts of n presses.

        Returns:
            For each press, the flags that `flags` returns for a single contact.
        """
        min_force_N, max_force_N = self.force_range_N
        is_outside_area = ~inside_polygon(contacts.x_mm, contacts.y_mm, self.corners_mm)
        is_outside_forces = (contacts.force_N < min_force_N) | (contacts.force_N > max_force_N)
        is_outside = is_outside_area | is_outside_forces
        has_misfit = contacts.misfit > self.misfit_limit
        is_above_yield = contacts.force_N > self.yield_force_N
        # Every contact that is beyond the limits is also outside, so that `is_beyond` need not be tested here.
        if not (is_outside | has_misfit | is_above_yield).any():  # no contact has a flag
            return [()] * len(is_outside)

        centre_x_mm, centre_y_mm = self.centre_mm
        limit_mm2, limit_N = self.implausible_limits  # squared distance from the centre, and force
        with np.errstate(over="ignore"):  # a distance that overflows is infinite and exceeds the limit
            distance_squared_mm2 = (contacts.x_mm - centre_x_mm) ** 2 + (contacts.y_mm - centre_y_mm) ** 2
        is_beyond = (distance_squared_mm2 > limit_mm2) | (contacts.force_N > limit_N)
        # The four conditions of each contact are converted to the words of the flags.
        columns = (is_outside.tolist(), is_beyond.tolist(), has_misfit.tolist(), is_above_yield.tolist())
        return [_flag_words(*conditions) for conditions in zip(*columns, strict=True)]


def _flag_words(is_outside: bool, is_beyond: bool, has_misfit: bool, is_above_yield: bool) -> tuple[str, ...]:
    """Return the flags of all conditions that are true.

    Args:
        is_outside: Whether the contact is outside the working area or the range of forces.
        is_beyond: Whether the contact is so far outside that it cannot be a measurement.
        has_misfit: Whether the misfit is above the limit of the model.
        is_above_yield: Whether the force is above the force at which the film yields.
    """
    flags = []
    if is_outside:
        flags.append(OUTSIDE)
    if is_beyond:
        flags.append(BEYOND)
    if has_misfit:
        flags.append(MISFIT)
    if is_above_yield:
        flags.append(STRESS)
    return tuple(flags)


def inside_polygon(x: Reals, y: Reals, corners: Array) -> Booleans:
    """Return whether points lie inside a polygon.

    A point is inside if a horizontal ray from the point to the right crosses an odd number of edges. An edge is crossed
    if one of its ends is above the point and the other is not, and if the edge is to the right of the point.

    Args:
        x: First coordinates of the points, shape (n,), in the unit of the corners.
        y: Second coordinates of the points, shape (n,).
        corners: Corners in order, shape (m, 2). The last corner may repeat the first one.

    Returns:
        Whether each point is inside, shape (n,). The result for points on an edge is undefined.
    """
    edge_ends = np.roll(corners, -1, axis=0)
    # Coordinates of shape (m, 1), so that the arrays below have the shape (m edges, n points).
    x_start, y_start = corners.T[..., np.newaxis]
    x_end, y_end = edge_ends.T[..., np.newaxis]
    crosses_height = (y_start > y) != (y_end > y)  # the edge crosses the horizontal line through the point
    with np.errstate(divide="ignore", invalid="ignore"):  # horizontal edges have no crossing
        crossing_x = x_start + (y - y_start) * (x_end - x_start) / (y_end - y_start)
    is_to_the_right = x < crossing_x
    crossing_count = np.count_nonzero(crosses_height & is_to_the_right, axis=0)
    return np.asarray(crossing_count % 2 == 1)
