"""Isocharge contours: where presses of one force give an electrode the same charge.

Contours are traced by marching squares; `graphical_method` draws the same contours as the paper does.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from contourpy import LineType, contour_generator

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate.forward.charge_map import ChargeMap, check_forces

GRID = 0.2
"""Largest side of the squares of the trace, mm: contours bend by some um within one."""

WITHIN = 1.0 - 5e-4
"""Traced radius over the map's."""


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

    def contours(self, electrode: str, charge: float) -> tuple[Array, ...]:
        """The pieces of an electrode's contour of a charge (pC); an empty tuple if no press gives it.

        Returns:
            (x, y) in order along each piece, shape (n, 2), mm; the first again at the end if it is closed.

        Raises:
            SensorError: If there is no such electrode.
            SceneError: If the charge is not finite.
        """
        if not np.isfinite(charge):
            raise SceneError(f"charge of {electrode!r}: expected a finite number, got {charge:g} pC")
        (x, y), values = self._squares, self._charges(electrode)
        unit = np.abs(values).max()
        generator = contour_generator(x, y, values / unit, line_type=LineType.Separate)
        return tuple(np.asarray(line, dtype=float) for line in generator.lines(charge / unit))

    def reach(self, electrode: str) -> tuple[float, float]:
        """Smallest and largest charge of an electrode on the corners of the squares, pC."""
        values = self._charges(electrode)
        return float(values.min()), float(values.max())

    def even_charges(self, electrode: str, count: int) -> list[float]:
        """`count` charges between the smallest and the largest, pC: in even ratios, or steps if the sign changes."""
        low, high = self.reach(electrode)
        even = np.geomspace if low * high > 0.0 else np.linspace
        return [float(charge) for charge in even(low, high, count + 2)[1:-1]]

    @cached_property
    def _squares(self) -> tuple[Array, Array]:
        """Corners x and y of a grid of squares, bent into the disk, shape (n, n), mm.

        The bent grid ends on the disk's edge, so a contour that leaves the disk ends there, too.
        """
        radius = WITHIN * self.charge_map.domain.radius
        line = np.linspace(-1.0, 1.0, 2 * int(np.ceil(radius / GRID)) + 1)
        u, v = np.meshgrid(line, line)
        return radius * u * np.sqrt(1.0 - 0.5 * v**2), radius * v * np.sqrt(1.0 - 0.5 * u**2)

    @cached_property
    def _every_charge(self) -> Array:
        """Charges on the corners, shape (n, n, n_electrode), pC."""
        x, y = self._squares
        contact = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, self.force)])
        return self.charge_map.charges(contact).reshape(*x.shape, -1)

    def _charges(self, electrode: str) -> Array:
        names = self.charge_map.electrodes
        if electrode not in names:
            raise SensorError(f"no electrode {electrode!r}: the map has {', '.join(names)}")
        return np.asarray(self._every_charge[..., names.index(electrode)])
