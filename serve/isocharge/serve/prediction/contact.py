"""What a model says about presses, one or many, and whether to trust it.

A contact is ten numbers in an order that other programs rely on. `Validity` checks contacts against the domain that a
model was trained for: the flags `outside`, `misfit` and `beyond`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Reals, Singles
from isocharge.serve.flags import BEYOND, MISFIT, OUTSIDE, STRESS
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import N_WITHOUT_CORRELATION

MOST_DECIMALS = 6
"""Decimals that are shown at most: 1 nm and 1 uN."""


class Contact(NamedTuple):
    """Where and how hard one press is, and how sure that is; whether to trust it, `Predictor.flags` says.

    Attributes:
        x_mm, y_mm: Position in the sensor's frame, mm.
        force_N: Force, N, positive when pushing.
        x_std_mm, y_std_mm, force_std_N: Standard deviations.
        misfit: Distance of the charges from the nearest single contact the model knows, in standard deviations.
        xy_correlation, xF_correlation, yF_correlation: Correlations of position and force, -1 to 1; NaN from a model
            that gives none.
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
        """With an error more, a standard deviation of which moves x and y, mm, and force, N, by so much together."""
        by_x, by_y, by_F = shift
        x, y, force, of_x, of_y, of_F, misfit, xy, xF, yF = self
        x_std, y_std, F_std = math.hypot(of_x, by_x), math.hypot(of_y, by_y), math.hypot(of_F, by_F)
        xy = (xy * of_x * of_y + by_x * by_y) / (x_std * y_std)
        xF = (xF * of_x * of_F + by_x * by_F) / (x_std * F_std)
        yF = (yF * of_y * of_F + by_y * by_F) / (y_std * F_std)
        return Contact(x, y, force, x_std, y_std, F_std, misfit, xy, xF, yF)

    def fields(self) -> dict[str, Any]:
        """As fields of a record: correlations that the model does not give are None."""
        fields = self._asdict()
        return fields if self.xy_correlation == self.xy_correlation else fields | NO_CORRELATION

    def __repr__(self) -> str:
        """Each number with its standard deviation, to two digits of that."""
        numbers = ", ".join(f"{name}={value} +- {std}" for name, value, std in self._rounded())
        return f"Contact({numbers}, misfit={self.misfit:.2g})"

    def _rounded(self) -> Iterator[tuple[str, str, str]]:
        """Name, value and standard deviation of position and force."""
        for name, value, std in zip(self._fields[:3], self[:3], self[3:6], strict=True):
            certain = math.isfinite(std) and std > 0.0
            decimals = min(max(1 - math.floor(math.log10(std)), 0), MOST_DECIMALS) if certain else MOST_DECIMALS
            yield name, f"{value:.{decimals}f}", f"{std:.{decimals}f}"


NEAR_MM, NEAR_FORCE = 0.3, 0.05
"""Way along x or y, mm, and share of the force, within which a contact depends on what is not known as before."""


class Sensitivity:
    """How a contact changes with something that is not known, by a second answer of a model.

    It is asked for once while a contact stays near: a frame of a held press takes one prediction, not two.
    """

    def __init__(self, unit: float) -> None:
        """Begin without an answer; `unit` is how much of it lies between the two answers."""
        self._unit = unit
        self._asked: Contact | None = None
        self._change = (0.0, 0.0, 0.0)

    def shift(self, contact: Contact, size: float, other: Callable[[], Contact]) -> tuple[float, float, float]:
        """How far so much of it moves x and y, mm, and force, N.

        Args:
            contact: The first answer.
            size: How much, in the unit of `unit`.
            other: Asks for the second answer, that of one unit more.
        """
        x_mm, y_mm, force_N = contact[:3]
        asked = self._asked
        if (
            asked is None
            or abs(x_mm - asked.x_mm) > NEAR_MM
            or abs(y_mm - asked.y_mm) > NEAR_MM
            or abs(force_N - asked.force_N) > NEAR_FORCE * asked.force_N
        ):
            self._asked, beside = contact, other()
            self._change = beside.x_mm - x_mm, beside.y_mm - y_mm, beside.force_N - force_N
        by_x, by_y, by_F = self._change
        units = size / self._unit
        return units * by_x, units * by_y, units * by_F


NO_CORRELATION = dict.fromkeys(Contact._fields[N_WITHOUT_CORRELATION:])
"""The fields that a model may not give."""


class Contacts(NamedTuple):
    """Contacts of n presses: the fields of `Contact`, each an array of shape (n,), float32; a row each as one array."""

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
        """What `np.asarray` gives: shape (n, 10), a press in each row."""
        return np.stack(tuple(self), axis=1).astype(dtype or np.float32, copy=False)


MISFIT_LIMIT = 5.0
"""Smallest limit of the misfit, in standard deviations; a model may state a larger one, that of 0.1 % of presses."""

TOUCH_LIMIT = 5.0
"""Charge on at least one electrode, in standard deviations of the white noise, from which something touches."""

FAR = 3.0
"""Multiple of the largest force, and of the radius of the circle around the working area, beyond which an answer is no
measurement."""


OFF_CENTRE = 0.05
"""Distance of the working area's middle from the origin, over its reach, up to which its place is given by its reach
alone."""


@dataclass(frozen=True)
class Validity:
    """Where a model may be trusted: the area, the forces and the misfit that it was trained for.

    Attributes:
        corners_mm: Corners of the working area, a polygon, shape (n, 2), mm.
        force_range_N: Smallest and largest force, N.
        misfit_limit: Largest misfit of a single contact, in standard deviations.
        yield_force_N: Force beyond which the film yields, N.
        white_pC: Standard deviation of the white noise of each charge, or one for each electrode, pC.
    """

    corners_mm: Array
    force_range_N: tuple[float, float]
    misfit_limit: float = MISFIT_LIMIT
    yield_force_N: float = math.inf
    white_pC: float | tuple[float, ...] = 0.0

    @classmethod
    def of(cls, metadata: ModelMetadata) -> "Validity":
        """Return the limits that a model's metadata state."""
        measured_limit = metadata.errors.get("misfit_p999", MISFIT_LIMIT)
        return cls(
            corners_mm=np.array(metadata.working_area_mm),
            force_range_N=metadata.force_range_N,
            misfit_limit=max(MISFIT_LIMIT, measured_limit),
            yield_force_N=math.inf if metadata.yield_force_N is None else metadata.yield_force_N,
            white_pC=metadata.noise.white_pC,
        )

    @cached_property
    def reach_mm(self) -> float:
        """Distance of the working area's farthest corner from the origin, mm."""
        return float(np.linalg.norm(self.corners_mm, axis=1).max())

    @cached_property
    def middle_mm(self) -> tuple[float, float]:
        """Middle (x, y) of the box around the working area, mm."""
        x_mm, y_mm = (0.5 * (self.corners_mm.min(axis=0) + self.corners_mm.max(axis=0))).tolist()
        return x_mm, y_mm

    @cached_property
    def far(self) -> tuple[float, float]:
        """Squared distance from the middle, mm^2, and force, N, beyond which an answer is no measurement."""
        radius_mm = np.linalg.norm(self.corners_mm - self.middle_mm, axis=1).max()
        return float(FAR * radius_mm) ** 2, FAR * self.force_range_N[1]

    def is_touch(self, charge_pC: Array) -> Booleans:
        """Return whether something touches, for charges of shape (n, electrodes), pC; shape (n,).

        Charges that do not rise out of the noise on any electrode determine no position.
        """
        return np.asarray((np.abs(charge_pC) > TOUCH_LIMIT * np.asarray(self.white_pC)).any(axis=1))

    @property
    def is_centred(self) -> bool:
        """Whether the middle of the working area is the origin, or close to it."""
        return math.hypot(*self.middle_mm) < OFF_CENTRE * self.reach_mm

    @cached_property
    def places(self) -> str:
        """Words that say where the working area lies."""
        if self.is_centred:
            return f"up to {self.reach_mm:.3g} mm"
        left, bottom = self.corners_mm.min(axis=0)
        right, top = self.corners_mm.max(axis=0)
        return f"from ({left:.3g}, {bottom:.3g}) to ({right:.3g}, {top:.3g}) mm"

    def is_beyond(self, contact: Contact) -> bool:
        """Return whether a contact is so far from the working area and the forces that it is no measurement."""
        middle_x_mm, middle_y_mm = self.middle_mm
        far_mm2, far_N = self.far
        x_mm = contact.x_mm - middle_x_mm
        y_mm = contact.y_mm - middle_y_mm
        return x_mm * x_mm + y_mm * y_mm > far_mm2 or contact.force_N > far_N

    @cached_property
    def safe_mm2(self) -> float:
        """Squared radius of the largest disk about the origin inside the area, mm^2; 0 if the origin is outside."""
        zero = np.zeros(1)
        start, end = self.corners_mm, np.roll(self.corners_mm, -1, axis=0)
        along = end - start
        share = np.clip(-(start * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-30), 0.0, 1.0)
        nearest = ((start + share[:, np.newaxis] * along) ** 2).sum(axis=1).min()
        return float(nearest) if inside_polygon(zero, zero, self.corners_mm)[0] else 0.0

    def flags(self, contact: Contact) -> tuple[str, ...]:
        """The flags of one contact; a microsecond, 30 where only the polygon says whether it is inside."""
        x_mm, y_mm, force_N = contact[:3]
        low, high = self.force_range_N
        distance_mm2 = x_mm * x_mm + y_mm * y_mm
        inside = distance_mm2 < self.safe_mm2 or (
            distance_mm2 <= self.reach_mm**2 and inside_polygon(np.array([x_mm]), np.array([y_mm]), self.corners_mm)[0]
        )
        outside = not inside or force_N < low or force_N > high
        misfit = contact.misfit > self.misfit_limit
        return _words(outside, self.is_beyond(contact), misfit, force_N > self.yield_force_N)

    def batch_flags(self, contacts: Contacts) -> list[tuple[str, ...]]:
        """The flags of each of n contacts."""
        low, high = self.force_range_N
        outside = ~inside_polygon(contacts.x_mm, contacts.y_mm, self.corners_mm)
        outside |= (contacts.force_N < low) | (contacts.force_N > high)
        misfit, yields = contacts.misfit > self.misfit_limit, contacts.force_N > self.yield_force_N
        far_mm2, far_N = self.far
        middle_x_mm, middle_y_mm = self.middle_mm
        with np.errstate(over="ignore"):  # infinity is far, too
            distance_mm2 = (contacts.x_mm - middle_x_mm) ** 2 + (contacts.y_mm - middle_y_mm) ** 2
        beyond = (distance_mm2 > far_mm2) | (contacts.force_N > far_N)
        if not (outside | misfit | yields).any():
            return [()] * len(outside)
        return [_words(*row) for row in np.stack([outside, beyond, misfit, yields], 1).tolist()]


def _words(outside: bool, beyond: bool, misfit: bool, yields: bool) -> tuple[str, ...]:
    return tuple(compress((OUTSIDE, BEYOND, MISFIT, STRESS), (outside, beyond, misfit, yields)))


def inside_polygon(x: Reals, y: Reals, corners: Array) -> Booleans:
    """Whether points lie inside a polygon, by counting the edges to their right.

    Args:
        x, y: Points, shape (n,), in the unit of the corners.
        corners: Shape (m, 2), in order; the last one may repeat the first.

    Returns:
        Shape (n,). Points on the edge itself may be counted either way.
    """
    (x0, y0), (x1, y1) = corners.T[..., np.newaxis], np.roll(corners, -1, axis=0).T[..., np.newaxis]
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):  # horizontal edges never cross
        edge_x = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray(np.count_nonzero(crosses & (x < edge_x), axis=0) % 2 == 1)
