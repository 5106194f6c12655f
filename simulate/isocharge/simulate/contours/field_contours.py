"""Isocharge contours: curves on which all presses with the same force cause the same charge on an electrode.

Contours are traced by marching squares on a grid. The module `graphical_method` draws the same contours by the method
of Mirbagheri and others (2007).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from contourpy import LineType, contour_generator

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate.forward.charge_map import ChargeMap, check_forces

GRID_SPACING = 0.2
"""Largest distance between neighbouring points of the grid, mm.

The deviation of a contour from a straight line within this distance is a few micrometres.
"""

TRACED_RADIUS = 1.0 - 5e-4
"""Radius within which contours are traced, in units of the radius of the charge map, dimensionless."""


@dataclass(frozen=True)
class ContourField:
    """Contours over the domain of a charge map for presses with one force.

    Attributes:
        charge_map: Charges as a function of the contact. Splines are faster than a forward map.
        force: Force of the presses, N.

    Raises:
        SceneError: If the force is outside the range of the map.
    """

    charge_map: ChargeMap
    force: float

    def __post_init__(self) -> None:
        check_forces(self.force, self.charge_map.domain.force_range, "charge map")

    def contours(self, electrode: str, charge: float) -> tuple[Array, ...]:
        """Trace the contour of one electrode.

        Args:
            electrode: Name of the electrode.
            charge: Charge on the contour, pC.

        Returns:
            Separate curves of the contour, each with points (x, y) in order, shape (n, 2), mm. The first point of a
            closed curve is repeated at its end. The tuple is empty if no press gives the charge.

        Raises:
            SensorError: If there is no such electrode.
            SceneError: If the charge is not finite.
        """
        if not np.isfinite(charge):
            raise SceneError(f"charge of {electrode!r}: expected a finite number, got {charge:g} pC")
        # The contour is traced with charges of order one, so that it does not depend on the size of the charges.
        x, y = self._grid
        charges = self._charges(electrode)
        largest_charge = np.abs(charges).max()
        generator = contour_generator(x, y, charges / largest_charge, line_type=LineType.Separate)
        return tuple(np.asarray(line, dtype=float) for line in generator.lines(charge / largest_charge))

    def charge_range(self, electrode: str) -> tuple[float, float]:
        """Return the smallest and the largest charge of an electrode on the grid, pC."""
        values = self._charges(electrode)
        return float(values.min()), float(values.max())

    def even_charges(self, electrode: str, count: int) -> list[float]:
        """Return charges between the smallest and the largest charge of an electrode.

        The charges have equal ratios, or equal differences if the charge changes its sign.

        Args:
            electrode: Name of the electrode.
            count: Number of charges.

        Returns:
            Charges in pC, without the smallest and the largest one.
        """
        low, high = self.charge_range(electrode)
        has_one_sign = low * high > 0.0
        spacing = np.geomspace if has_one_sign else np.linspace
        charges = spacing(low, high, count + 2)  # with both ends
        return [float(charge) for charge in charges[1:-1]]

    @cached_property
    def _grid(self) -> tuple[Array, Array]:
        """Coordinates x and y of a square grid that is mapped onto the disk, each of shape (n, n), mm.

        The boundary of the mapped grid is the edge of the disk, so that contours that leave the disk end on its edge.
        """
        radius = TRACED_RADIUS * self.charge_map.domain.radius
        n_spacings = 2 * int(np.ceil(radius / GRID_SPACING))  # along a diameter
        line = np.linspace(-1.0, 1.0, n_spacings + 1)
        square_x, square_y = np.meshgrid(line, line)
        # Elliptical grid mapping of the square [-1, 1] x [-1, 1] onto the unit disk (Nowell 2005)
        disk_x = square_x * np.sqrt(1.0 - 0.5 * square_y**2)
        disk_y = square_y * np.sqrt(1.0 - 0.5 * square_x**2)
        return radius * disk_x, radius * disk_y

    @cached_property
    def _grid_charges(self) -> Array:
        """Charges of all electrodes on the grid, shape (n, n, n_electrode), pC."""
        x, y = self._grid
        contact = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, self.force)])
        return self.charge_map.charges(contact).reshape(*x.shape, -1)

    def _charges(self, electrode: str) -> Array:
        """Return the charges of one electrode on the grid, shape (n, n), pC."""
        names = self.charge_map.electrodes
        if electrode not in names:
            raise SensorError(f"no electrode {electrode!r}: the map has {', '.join(names)}")
        return np.asarray(self._grid_charges[..., names.index(electrode)])
