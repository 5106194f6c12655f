"""Isocharge contours: where presses of one force give an electrode the same charge.

Contours are traced by marching squares; then each point is moved along the slope until the map gives the charge there,
within ON_CONTOUR. `graphical_method` draws the same contours as the paper does.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from contourpy import LineType, contour_generator

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.forward.checks import check_forces
from isocharge.simulate.numerics.disk import onto_disk

GRID = 0.2
"""Largest side of the squares of the trace, mm: contours bend little within one."""

WITHIN = 1.0 - 5e-4
"""Traced radius over the map's: room for the traced points to move onto their contour."""

ON_CONTOUR, STEPS = 2e-5, 12
"""Distance from the contour at which a point counts as on it, mm, and the largest number of Newton steps to it."""


@dataclass(frozen=True)
class Contour:
    """One connected piece of a contour.

    Attributes:
        electrode: Name of the electrode.
        charge: Its charge on the contour, pC.
        points: (x, y) in order along the contour, shape (n, 2), mm; the first again at the end if it is closed.
    """

    electrode: str
    charge: float
    points: Array

    @property
    def closed(self) -> bool:
        """Whether the contour ends where it begins."""
        return bool(np.array_equal(self.points[0], self.points[-1]))


@dataclass(frozen=True)
class ContourField:
    """Contours of presses of one force over the disk of a map.

    Attributes:
        charge_map: The charges; with splines in place of a forward map it is faster.
        force: Force of the presses, N.

    Raises:
        SceneError: If the map does not cover the force.
    """

    charge_map: ChargeMap
    force: float

    def __post_init__(self) -> None:
        check_forces(self.force, self.charge_map.domain.force_range, "charge map")

    def contours(self, electrode: str, charge: float) -> tuple[Contour, ...]:
        """The pieces of an electrode's contour of a charge (pC); an empty tuple if no press gives it.

        Raises:
            SensorError: If there is no such electrode.
            SceneError: If the charge is not finite.
        """
        index = self._index(electrode)
        if not np.isfinite(charge):
            raise SceneError(f"charge of {electrode!r}: expected a finite number, got {charge:g} pC")
        x, y, values = self._squares
        unit = np.abs(values[..., index]).max()
        traced = contour_generator(x, y, values[..., index] / unit, line_type=LineType.Separate).lines(charge / unit)
        pieces = [self._onto_contour(np.asarray(line, dtype=float), index, charge) for line in traced]
        return tuple(Contour(electrode, charge, points) for points in pieces if len(points) > 1)

    def reach(self, electrode: str) -> tuple[float, float]:
        """Smallest and largest charge of an electrode on the corners of the squares, pC."""
        values = self._squares[2][..., self._index(electrode)]
        return float(values.min()), float(values.max())

    def even_charges(self, electrode: str, count: int) -> list[float]:
        """`count` charges between the smallest and the largest, pC: in even ratios, or steps if the sign changes."""
        low, high = self.reach(electrode)
        even = np.geomspace if low * high > 0.0 else np.linspace
        return [float(charge) for charge in even(low, high, count + 2)[1:-1]]

    def _index(self, electrode: str) -> int:
        names = self.charge_map.electrodes
        if electrode not in names:
            raise SensorError(f"no electrode {electrode!r}: the map has {', '.join(names)}")
        return names.index(electrode)

    @cached_property
    def _squares(self) -> tuple[Array, Array, Array]:
        """Corners x and y of a grid of squares, bent into the disk, shape (n, n), mm, and charges, (n, n, n_electrode).

        The bent grid ends on the disk's edge, so a contour that leaves the disk ends there, too.
        """
        radius = WITHIN * self.charge_map.domain.radius
        line = np.linspace(-1.0, 1.0, 2 * int(np.ceil(radius / GRID)) + 1)
        u, v = np.meshgrid(line, line)
        x, y = radius * u * np.sqrt(1.0 - 0.5 * v**2), radius * v * np.sqrt(1.0 - 0.5 * u**2)
        return (
            x,
            y,
            self.charge_map.charges(self._contacts(np.stack([x, y], axis=-1).reshape(-1, 2))).reshape(*x.shape, -1),
        )

    def _onto_contour(self, points: Array, index: int, charge: float) -> Array:
        """The points moved along the slope to where the map gives the charge; others are dropped."""
        at, away = points.copy(), np.full(len(points), np.inf)
        slope = self.charge_map.derivatives(self._contacts(points))[:, index, :2]  # good enough: they move a little
        step_per_charge = slope / np.maximum(np.sum(slope**2, axis=1, keepdims=True), 1e-300)
        for _ in range(STEPS):
            active = np.flatnonzero(np.abs(away) > ON_CONTOUR)
            if active.size == 0:
                break
            known = self.charge_map.charges(self._contacts(at[active]))[:, index]
            step = (charge - known)[:, None] * step_per_charge[active]
            away[active] = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, GRID / np.maximum(away[active], 1e-300))[:, None]
            moving = (away[active] > ON_CONTOUR)[:, None]
            at[active] = np.where(moving, onto_disk(at[active] + step, self.charge_map.domain.radius), at[active])
        if np.array_equal(points[0], points[-1]):
            at[-1] = at[0]
        on_contour: Array = at[away <= ON_CONTOUR]
        return on_contour

    def _contacts(self, at: Array) -> Array:
        return np.column_stack([at, np.full(len(at), self.force)])
