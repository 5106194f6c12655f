"""Charges of a film, described by a Chebyshev series in the position and the force of the contact.

A network maps charges to a contact. Near a fold of the forward map, several contacts give the same charges, and a
network cannot distinguish these contacts. The tracker then compares the measured charges with the charges of this
series:

    ln Q_e = sum c_ijm T_i(x / r) T_j(y / r) T_m(l),   i + j <= degree, m <= force_degree,

where T_i are Chebyshev polynomials, r is the largest distance of a contact from the centre, and l is the logarithm of
the force, scaled to [-1, 1]. The series is stored in the file `charges.npz`, which is in the same folder as
`model.onnx`. The file contains three arrays.

- `series`: the coefficients c of the Chebyshev series, shape (degree + 1, degree + 1, force_degree + 1, n_electrode).
- `radius_mm`: the largest distance r of a contact from the centre, mm.
- `force_N`: the smallest and the largest force of a contact, N.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.chebyshev_series import Series
from isocharge.common.errors import ModelError, cut
from isocharge.common.npz import DAMAGED_FILE_ERRORS, finite_array, finite_number, npz_arrays
from isocharge.serve.model.companion_files import read_companion_file

FILE = "charges.npz"
"""Name of the file in a version folder."""

ADVICE = "copy the model's folder again, or train again"
"""What the user can do about a damaged file, for error messages."""

MAX_DEGREE = 100
"""Largest degree of a series in a file; `isocharge train` writes degrees up to 30."""

MAX_RADIUS_mm = 1e4
"""Largest radius in a file, mm."""

MIN_FORCE_RATIO = 1.01
"""Smallest ratio of the largest force to the smallest force. With equal forces, the scaled logarithm is undefined."""

N_CORNERS = 64
"""Number of corners of the polygon that encloses the area of a series."""

N_CHECKED_DIRECTIONS = 8
"""Number of directions in which the charges of a file are checked."""

N_CHECKED_FORCES = 5
"""Number of forces at which the charges of a file are checked."""


@dataclass(frozen=True)
class ChargeSeries:
    """Charges of a film as a function of the contact, for contacts up to a given distance from the centre of the film.

    Attributes:
        series: Series of ln Q, where Q is the charge in pC.
        radius_mm: Largest distance of a contact from the centre, mm.
        force_N: Smallest and largest force, N.
    """

    series: Series
    radius_mm: float
    force_N: tuple[float, float]

    @property
    def corners_mm(self) -> Array:
        """Corners (x, y) of a regular polygon that encloses the circle of `radius_mm`, shape (64, 2), mm."""
        angle = 2.0 * np.pi * np.arange(N_CORNERS) / N_CORNERS
        corner_distance_mm = self.radius_mm / np.cos(np.pi / N_CORNERS)  # the sides of the polygon touch the circle
        return np.asarray(corner_distance_mm * np.column_stack([np.cos(angle), np.sin(angle)]))

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute the charges of contacts, and the derivatives of the charges with respect to the contacts.

        The series gives ln Q, the logarithm of the charge, as a function of coordinates between -1 and 1. The contacts
        are converted to these coordinates. Outside the range of forces, ln Q is extrapolated linearly in the logarithm
        of the force. The slope is taken from the nearest end of the range.

        Args:
            contact: Contacts (x, y, ln F), shape (n, 3), with x and y in mm and F in N.

        Returns:
            Charges, shape (n, n_electrode), pC. Derivatives of the charges with respect to x and y (pC/mm) and ln F
            (pC), shape (n, n_electrode, 3).
        """
        # Coordinates of the series
        min_log_force, max_log_force = np.log(self.force_N)
        centre = np.array([0.0, 0.0, 0.5 * (min_log_force + max_log_force)])
        scale = np.array([self.radius_mm, self.radius_mm, 0.5 * (max_log_force - min_log_force)])
        unit_contact = (contact - centre) / scale

        # ln Q, followed by its derivatives with respect to the three coordinates, shape (n, 4, n_electrode). The series
        # is evaluated at the end of the range of forces if the force is outside this range.
        values = self.series.values_and_derivatives(unit_contact)
        log_charge = values[:, 0]
        log_slopes = values[:, 1:]  # shape (n, 3, n_electrode)
        log_force_slope = log_slopes[:, -1]  # with respect to the coordinate of the force, shape (n, n_electrode)

        unit_force = unit_contact[:, 2:]  # shape (n, 1)
        distance_from_range = unit_force - np.clip(unit_force, -1.0, 1.0)  # 0 within the range of forces
        charge_pC = np.exp(log_charge + distance_from_range * log_force_slope)  # shape (n, n_electrode)

        # dQ = Q d(ln Q). The division by the scale converts the derivatives with respect to the coordinates into
        # derivatives with respect to the contact.
        electrode_slopes = log_slopes.swapaxes(1, 2)  # shape (n, n_electrode, 3)
        jacobian = charge_pC[:, :, None] * electrode_slopes / scale
        return charge_pC, jacobian

    def to_bytes(self) -> bytes:
        """Return the content of the file `charges.npz`."""
        file = io.BytesIO()
        np.savez_compressed(
            file, series=self.series.coefficients, radius_mm=np.array(self.radius_mm), force_N=np.array(self.force_N)
        )
        return file.getvalue()


def read_charges(version_folder: Path, n_electrode: int) -> ChargeSeries | None:
    """Read the series in the file `charges.npz` of a model. Return None if the model has no such file.

    Args:
        version_folder: Folder of the model, which contains `model.onnx`.
        n_electrode: Number of electrodes of the model.

    Raises:
        ModelError: If the file is damaged, belongs to another model, or does not describe the charges of contacts.
    """
    path = version_folder / FILE
    if not path.exists():
        return None
    data = read_companion_file(version_folder, FILE, ADVICE)
    try:
        return _charges_from_arrays(npz_arrays(data), n_electrode)
    except DAMAGED_FILE_ERRORS as error:
        raise ModelError(f"{path}: {cut(str(error))}; {ADVICE}") from error


def _charges_from_arrays(arrays: Mapping[str, np.ndarray], n_electrode: int) -> ChargeSeries:
    """Create the Chebyshev series of the charges from the arrays of a file, and check the series.

    The logarithm of the charge of each electrode is a Chebyshev series in x, y and the logarithm of the force. Along
    each of these three axes, a series of degree n has n + 1 coefficients.

    Args:
        arrays: Arrays of the file by name.
        n_electrode: Number of electrodes of the model.

    Raises:
        ValueError: If an array is missing or not valid.
    """
    coefficients = finite_array(arrays, "series", (None, None, None, n_electrode))
    x_count, y_count, force_count, _electrode_count = coefficients.shape
    x_degree = x_count - 1
    y_degree = y_count - 1
    force_degree = force_count - 1
    has_equal_degrees = x_degree == y_degree
    has_valid_degrees = 1 <= x_degree <= MAX_DEGREE and 1 <= force_degree <= MAX_DEGREE
    if not (has_equal_degrees and has_valid_degrees):
        raise ValueError(
            f"series: expected equal degrees in x and y and degrees from 1 to {MAX_DEGREE}, got {x_degree}, "
            f"{y_degree} and {force_degree} in the force"
        )
    radius_mm, force_N = read_contact_range(arrays)
    charges = ChargeSeries(Series(coefficients), radius_mm, force_N)
    _check_charges(charges)
    return charges


def read_contact_range(arrays: Mapping[str, np.ndarray]) -> tuple[float, tuple[float, float]]:
    """Read the range of contacts for which a series is valid from the arrays `radius_mm` and `force_N` of a file.

    Args:
        arrays: Arrays of the file by name.

    Returns:
        The largest distance of a contact from the centre, mm, and the smallest and the largest force, N.

    Raises:
        ValueError: If an array is missing or not valid.
    """
    radius_mm = finite_number(arrays, "radius_mm")
    if not 0.0 < radius_mm <= MAX_RADIUS_mm:
        raise ValueError(f"radius_mm: expected a radius up to {MAX_RADIUS_mm:g} mm, got {radius_mm:g}")
    min_force_N, max_force_N = finite_array(arrays, "force_N", (2,)).tolist()
    if not (min_force_N > 0.0 and max_force_N >= MIN_FORCE_RATIO * min_force_N):
        raise ValueError(
            f"force_N: expected a smallest force above 0 and a largest force of at least {MIN_FORCE_RATIO:g} times the "
            f"smallest, got {min_force_N:g} and {max_force_N:g} N"
        )
    return radius_mm, (min_force_N, max_force_N)


def _check_charges(charges: ChargeSeries) -> None:
    """For some contacts, check that the charges are finite and positive, and that they depend on the contact.

    The contacts lie on a circle with half of the largest radius of the series. Several forces are checked at each point
    of the circle.

    Raises:
        ValueError: If a charge or a derivative is not finite, if a charge is not positive, or if all charges are
            independent of x, of y or of the force.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, N_CHECKED_DIRECTIONS, endpoint=False)
    positions_mm = 0.5 * charges.radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])
    min_force_N, max_force_N = charges.force_N
    log_forces = np.log(np.geomspace(min_force_N, max_force_N, N_CHECKED_FORCES))
    contacts = np.array([[x_mm, y_mm, log_force] for x_mm, y_mm in positions_mm for log_force in log_forces])
    with np.errstate(over="ignore", invalid="ignore"):  # charges that overflow are reported below
        charge_pC, slopes = charges.linearised(contacts)  # shapes (n, n_electrode) and (n, n_electrode, 3)

    is_finite = np.isfinite(charge_pC).all() and np.isfinite(slopes).all()
    if not (is_finite and (charge_pC > 0.0).all()):
        raise ValueError("series: expected charges that are finite and positive for every contact")
    # Largest magnitude of the derivatives with respect to x, y and ln F over all contacts and electrodes, shape (3,)
    largest_slopes = np.abs(slopes).max(axis=(0, 1))
    if not (largest_slopes > 0.0).all():
        raise ValueError("series: expected charges that change with x, y and the force")
