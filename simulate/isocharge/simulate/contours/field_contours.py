"""Computation of isocharge contours from a charge map.

An isocharge contour is a curve on the film along which presses of constant force cause a constant charge on one
electrode. The contours are traced on a grid by the method of marching squares. In contrast to this module, the module
`graphical_method` draws contours by the method of Mirbagheri and others (2007).
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

Over this distance, a contour deviates from a straight line by a few micrometres.
"""

TRACED_RADIUS = 1.0 - 5e-4
"""Radius of the disk in which contours are traced, divided by the radius of the charge map, dimensionless."""


@dataclass(frozen=True)
class ContourField:
    """Charges on a grid of presses that have the same force. Contours are traced from these charges.

    Attributes:
        charge_map: Map that computes the charges of contacts. Splines are faster than a forward map.
        force: Force of the presses, N.

    Raises:
        SceneError: If the force is outside the range of the map.
    """

    charge_map: ChargeMap
    force: float

    def __post_init__(self) -> None:
        check_forces(self.force, self.charge_map.domain.force_range, "charge map")

    def contours(self, electrode: str, charge: float) -> tuple[Array, ...]:
        """Trace the contour on which one electrode has a given charge.

        Args:
            electrode: Name of the electrode.
            charge: Charge of the electrode on the contour, pC.

        Returns:
            Separate curves of the contour. Each curve is an array of successive points (x, y), shape (n, 2), mm. The
            last point of a closed curve is equal to its first point. The tuple is empty if no press causes the charge.

        Raises:
            SensorError: If the map has no such electrode.
            SceneError: If the charge is not finite.
        """
        if not np.isfinite(charge):
            raise SceneError(f"charge of {electrode!r}: expected a finite number, got {charge:g} pC")

        # The charges are divided by the largest charge, so that the result does not depend on their order of magnitude.
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
        """Return evenly spaced charges between the smallest and the largest charge of an electrode on the grid.

        If all charges of the electrode have the same sign, the ratios of successive returned charges are equal. If the
        charges have different signs, the differences of successive returned charges are equal.

        Args:
            electrode: Name of the electrode.
            count: Number of returned charges.

        Returns:
            Charges in ascending order, pC. The smallest and the largest charge of the electrode are not included.
        """
        smallest, largest = self.charge_range(electrode)
        has_one_sign = smallest * largest > 0.0
        spacing = np.geomspace if has_one_sign else np.linspace
        charges = spacing(smallest, largest, count + 2)  # includes the smallest and the largest charge
        return [float(charge) for charge in charges[1:-1]]

    @cached_property
    def _grid(self) -> tuple[Array, Array]:
        """Coordinates x and y of the points of a square grid that is mapped onto the disk, each of shape (n, n), mm.

        The boundary of the mapped grid is the edge of the disk. Contours that leave the disk therefore end on its edge.
        """
        radius = TRACED_RADIUS * self.charge_map.domain.radius
        n_spacings = 2 * int(np.ceil(radius / GRID_SPACING))  # number of grid spacings along a diameter
        coordinates = np.linspace(-1.0, 1.0, n_spacings + 1)
        square_x, square_y = np.meshgrid(coordinates, coordinates)

        # Map the square [-1, 1] x [-1, 1] onto the unit disk (elliptical grid mapping, Nowell 2005).
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
        """Return the charges of one electrode at the points of the grid, shape (n, n), pC.

        Args:
            electrode: Name of the electrode.

        Raises:
            SensorError: If the map has no such electrode.
        """
        names = self.charge_map.electrodes
        if electrode not in names:
            raise SensorError(f"no electrode {electrode!r}: the map has {', '.join(names)}")
        return np.asarray(self._grid_charges[..., names.index(electrode)])
