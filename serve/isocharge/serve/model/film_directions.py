"""The file `film_directions.npz` of a calibrated model: unknowns of the film other than its pretension.

After a calibration, the parameters of the film, its imperfections, its discrepancy and its gains have a joint
uncertainty. The misfits of touches identify only a few linear combinations of these unknowns, the directions. A change
along a direction changes the charges of a contact by a relative amount that depends on the contact:

    ln Q_e = ln Q_e(calibrated film) + sum over k of z_k s_ke(x, y, F),

where the z_k are independent and have the standard deviation 1 at a given pretension. The s_ke are Chebyshev series, as
in `charge_series`. The file contains these arrays:

    series             coefficients of s, shape (degree + 1, degree + 1, force_degree + 1, n_direction, n_electrode)
    radius_mm          largest distance of a contact from the centre, mm
    force_N            smallest and largest force, N
    by_pretension      change of the mean of each z_k with the pretension, shape (n_direction,), 1/MPa
    log_charge         optional: coefficients of ln Q of the calibrated film, shape (degree + 1, degree + 1,
                       force_degree + 1, n_electrode), where the degrees may differ from those of `series`
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.chebyshev_series import Series
from isocharge.common.errors import ModelError, cut
from isocharge.common.npz import DAMAGED_FILE_ERRORS, finite_array, npz_arrays
from isocharge.serve.model.charge_series import read_contact_range
from isocharge.serve.model.companion_files import read_companion_file

FILE = "film_directions.npz"
"""Name of the file in a version folder."""

ADVICE = "copy the model's folder again, or calibrate again"
"""Advice to the user if a file is damaged, for error messages."""

MAX_DIRECTIONS = 40
"""Largest number of directions in a file; `isocharge train calibrate` writes about ten."""

MAX_DEGREE = 30
"""Largest degree of the series in a file."""

MAX_LOG_CHANGE = 10.0
"""Largest change of ln Q by one unit of a direction. The changes of calibrated films are below 0.5."""

LOG_CHARGE = "log_charge"
"""Name of the array with the series of ln Q of the calibrated film."""

MAX_LOG_CHARGE = 100.0
"""Largest magnitude of ln Q. The charges of calibrated films are between 0.01 and 1e5 pC."""

MAX_CHANGE_WITH_PRETENSION = 1e3
"""Largest change of the mean of a direction with the pretension, 1/MPa."""


@dataclass(frozen=True)
class FilmDirections:
    """Linear combinations of the unknowns (directions) in which the film is uncertain at a given pretension.

    Attributes:
        coefficients: Coefficients of the series, shape (degree + 1, degree + 1, force_degree + 1, n_direction,
            n_electrode).
        radius_mm: Largest distance of a contact from the centre, mm.
        force_N: Smallest and largest force, N.
        by_pretension: Change of the mean of each direction with the pretension, shape (n_direction,), 1/MPa.
        log_charge_coefficients: Coefficients of the series of ln Q of the calibrated film, shape (degree + 1, degree +
            1, force_degree + 1, n_electrode). None if the file does not contain them.
    """

    coefficients: Array
    radius_mm: float
    force_N: tuple[float, float]
    by_pretension: Array
    log_charge_coefficients: Array | None = None

    @classmethod
    def none(cls, n_electrode: int) -> "FilmDirections":
        """Return an empty set of directions.

        The empty set is used for a model that was calibrated by an earlier version.
        """
        no_coefficients = np.zeros((1, 1, 1, 0, n_electrode))
        return cls(no_coefficients, radius_mm=1.0, force_N=(1.0, 2.0), by_pretension=np.zeros(0))

    @property
    def count(self) -> int:
        """Number of directions."""
        return int(self.by_pretension.size)

    @cached_property
    def _series(self) -> Series:
        """Chebyshev series of every direction and electrode. Directions and electrodes share one axis."""
        return Series(self.coefficients.reshape(*self.coefficients.shape[:3], -1))

    @cached_property
    def _log_charge_series(self) -> Series | None:
        """Chebyshev series of ln Q of the calibrated film, or None if its coefficients are unknown."""
        return None if self.log_charge_coefficients is None else Series(self.log_charge_coefficients)

    def log_changes(self, contact: Array) -> Array:
        """Compute the changes of ln Q, the logarithm of each charge, that one unit of each direction causes.

        A direction is a linear combination of the unknowns of the film, and one unit of it is one standard deviation. A
        contact outside the valid range (radius and forces) is replaced by the nearest contact inside this range.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Changes, shape (n, n_direction, n_electrode), dimensionless.
        """
        *_, n_direction, n_electrode = self.coefficients.shape
        if n_direction == 0:
            return np.zeros((len(contact), 0, n_electrode))

        # The first entry of axis 1 is the value of the series. Its derivatives follow in this axis.
        log_changes = self._series.values(self._unit_contact(contact))[:, 0]
        return np.asarray(log_changes.reshape(len(contact), n_direction, n_electrode))

    def misfit_slopes(self, contact: Array, charge_pC: Array, noise_std_pC: Array) -> Array | None:
        """Compute the derivatives of the misfit vectors of touches with respect to the logarithms of their charges.

        The misfit vector is the part of the charges that no contact explains. Let d be a small change of ln Q, and D
        the changes Q d / sigma of the charges in units of their noise. A change of the contact explains the projection
        of D onto the plane that the derivatives of the charges with respect to the contact span. The misfit vector
        changes by the rest of D.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            charge_pC: Charges Q of these contacts, shape (n, n_electrode), pC.
            noise_std_pC: Standard deviation sigma of the noise of each charge, shape (n, n_electrode), pC.

        Returns:
            Derivatives of the misfit vectors, shape (n, n_electrode, n_electrode), in units of the noise. None if the
            file does not contain the charges of the calibrated film.
        """
        if self._log_charge_series is None:
            return None
        # The first entry of axis 1 is ln Q. Its derivatives follow. They span the same plane in any coordinates.
        log_slopes = self._log_charge_series.values(self._unit_contact(contact))[:, 1:].swapaxes(1, 2)
        relative_charge = (charge_pC / noise_std_pC)[:, :, None]  # change of the charge by one unit of ln Q
        contact_slopes = relative_charge * log_slopes  # shape (n, n_electrode, 3)

        explained_part = contact_slopes @ np.linalg.pinv(contact_slopes)
        unexplained_part = np.eye(charge_pC.shape[1]) - explained_part
        return np.asarray(unexplained_part * relative_charge.swapaxes(1, 2))

    def _unit_contact(self, contact: Array) -> Array:
        """Return the coordinates of contacts between -1 and 1, of which the series are functions.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
        """
        # The force has a logarithmic coordinate.
        min_force_N, max_force_N = self.force_N
        min_log_force, max_log_force = np.log(self.force_N)
        log_force = np.log(np.clip(contact[:, 2], min_force_N, max_force_N))
        unit_force = (2.0 * log_force - min_log_force - max_log_force) / (max_log_force - min_log_force)

        # Positions in multiples of the radius; positions beyond the radius are moved onto the circle.
        distance_mm = np.hypot(contact[:, 0], contact[:, 1])
        unit_position = contact[:, :2] / np.maximum(distance_mm, self.radius_mm)[:, None]
        return np.column_stack([unit_position, unit_force])

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        arrays: dict[str, Any] = {
            "series": self.coefficients.astype(np.float32),
            "radius_mm": np.array(self.radius_mm),
            "force_N": np.array(self.force_N),
            "by_pretension": self.by_pretension,
        }
        if self.log_charge_coefficients is not None:
            arrays[LOG_CHARGE] = self.log_charge_coefficients.astype(np.float32)
        file = io.BytesIO()
        np.savez_compressed(file, **arrays)
        return file.getvalue()


def read_film_directions(version_folder: Path, n_electrode: int) -> FilmDirections:
    """Read the file `film_directions.npz` beside a model.

    Models that were calibrated by an earlier version have no such file, and no directions.

    Args:
        version_folder: The folder that holds `model.onnx`.
        n_electrode: Number of electrodes of the model.

    Raises:
        ModelError: If the file is damaged or belongs to another model.
    """
    path = version_folder / FILE
    if not path.exists():
        return FilmDirections.none(n_electrode)
    data = read_companion_file(version_folder, FILE, ADVICE)
    try:
        return _film_directions(npz_arrays(data), n_electrode)
    except DAMAGED_FILE_ERRORS as error:
        raise ModelError(f"{path}: {cut(str(error))}; {ADVICE}") from error


def _film_directions(arrays: Mapping[str, np.ndarray], n_electrode: int) -> FilmDirections:
    """Create the directions from the arrays of a file, and check them.

    A direction is a linear combination of the unknowns of the film, such as its gains. A Chebyshev series in x, y and
    the force gives the change of ln Q, the logarithm of each charge, for one unit of each direction.

    Args:
        arrays: Arrays of the file by name.
        n_electrode: Number of electrodes of the model.

    Raises:
        ValueError: If an array is missing or not valid, or the arrays do not fit together.
    """
    coefficients = finite_array(arrays, "series", (None, None, None, None, n_electrode))
    n_direction = coefficients.shape[3]
    _check_degrees("series", coefficients)
    if n_direction > MAX_DIRECTIONS:
        raise ValueError(f"series: expected up to {MAX_DIRECTIONS} directions, got the shape {coefficients.shape}")

    # A Chebyshev polynomial is at most 1, so a series is at most the sum of the magnitudes of its coefficients.
    max_log_changes = np.abs(coefficients).sum(axis=(0, 1, 2))  # shape (n_direction, n_electrode)
    largest_log_change = float(max_log_changes.max(initial=0.0))
    if largest_log_change > MAX_LOG_CHANGE:
        raise ValueError(f"series: expected changes of ln Q up to {MAX_LOG_CHANGE:g}, got up to {largest_log_change:g}")

    # Change of the mean of each direction with the pretension of the film, 1/MPa
    by_pretension = finite_array(arrays, "by_pretension", (n_direction,))
    largest_change = float(np.abs(by_pretension).max(initial=0.0))
    if largest_change > MAX_CHANGE_WITH_PRETENSION:
        raise ValueError(
            f"by_pretension: expected changes up to {MAX_CHANGE_WITH_PRETENSION:g} per MPa, got {largest_change:g}"
        )
    radius_mm, force_N = read_contact_range(arrays)
    return FilmDirections(
        coefficients, radius_mm, force_N, by_pretension, _log_charge_coefficients(arrays, n_electrode)
    )


def _log_charge_coefficients(arrays: Mapping[str, np.ndarray], n_electrode: int) -> Array | None:
    """Return the coefficients of ln Q of the calibrated film, or None if the file does not contain them.

    Args:
        arrays: Arrays of the file by name.
        n_electrode: Number of electrodes of the model.

    Raises:
        ValueError: If the array is not valid.
    """
    if LOG_CHARGE not in arrays:  # written by an earlier version, or the film has charges of both signs
        return None
    coefficients = finite_array(arrays, LOG_CHARGE, (None, None, None, n_electrode))
    _check_degrees(LOG_CHARGE, coefficients)
    largest = float(np.abs(coefficients).sum(axis=(0, 1, 2)).max(initial=0.0))
    if largest > MAX_LOG_CHARGE:
        raise ValueError(f"{LOG_CHARGE}: expected values of ln Q up to {MAX_LOG_CHARGE:g}, got up to {largest:g}")
    return coefficients


def _check_degrees(name: str, coefficients: Array) -> None:
    """Check the degrees of a Chebyshev series in x, y and the force.

    Args:
        name: Name of the array in the file.
        coefficients: Coefficients; the first three axes are the degrees in x, y and the force.

    Raises:
        ValueError: If the degrees in x and y differ, or a degree is too large.
    """
    n_x, n_y, n_force = coefficients.shape[:3]
    largest_degree = max(n_x, n_force) - 1  # a series has one coefficient more than its degree
    if n_x != n_y or largest_degree > MAX_DEGREE:
        raise ValueError(
            f"{name}: expected equal degrees in x and y and degrees up to {MAX_DEGREE}, got the shape "
            f"{coefficients.shape}"
        )
