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
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

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
    """

    coefficients: Array
    radius_mm: float
    force_N: tuple[float, float]
    by_pretension: Array

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

    def log_changes(self, contact: Array) -> Array:
        """Compute the changes of ln Q that one unit of each direction causes.

        A contact outside the valid range (radius and forces) is replaced by the nearest contact inside this range.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Changes, shape (n, n_direction, n_electrode), dimensionless.
        """
        *_, n_direction, n_electrode = self.coefficients.shape
        if n_direction == 0:
            return np.zeros((len(contact), 0, n_electrode))

        # The series is a function of coordinates between -1 and 1.
        min_log_force, max_log_force = np.log(self.force_N)
        log_force = np.log(np.clip(contact[:, 2], *self.force_N))
        unit_force = (2.0 * log_force - min_log_force - max_log_force) / (max_log_force - min_log_force)

        # Positions in multiples of the radius; positions beyond the radius are moved onto the circle.
        distance_mm = np.hypot(contact[:, 0], contact[:, 1])
        unit_position = contact[:, :2] / np.maximum(distance_mm, self.radius_mm)[:, None]
        unit_contact = np.column_stack([unit_position, unit_force])

        log_changes = self._series.values(unit_contact)[:, 0]  # without the derivatives, which follow in this axis
        return np.asarray(log_changes.reshape(len(contact), n_direction, n_electrode))

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        file = io.BytesIO()
        np.savez_compressed(
            file,
            series=self.coefficients.astype(np.float32),
            radius_mm=np.array(self.radius_mm),
            force_N=np.array(self.force_N),
            by_pretension=self.by_pretension,
        )
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

    Args:
        arrays: Arrays of the file by name.
        n_electrode: Number of electrodes of the model.

    Raises:
        ValueError: If an array is missing or not valid, or the arrays do not fit together.
    """
    coefficients = finite_array(arrays, "series", (None, None, None, None, n_electrode))
    n_x, n_y, n_force, n_direction, _ = coefficients.shape
    if n_x != n_y or max(n_x, n_force) > MAX_DEGREE + 1 or n_direction > MAX_DIRECTIONS:
        raise ValueError(
            f"series: expected equal degrees in x and y, degrees up to {MAX_DEGREE} and up to {MAX_DIRECTIONS} "
            f"directions, got the shape {coefficients.shape}"
        )
    # A Chebyshev polynomial is at most 1, so a series is at most the sum of the magnitudes of its coefficients.
    max_log_changes = np.abs(coefficients).sum(axis=(0, 1, 2))  # shape (n_direction, n_electrode)
    largest_log_change = float(max_log_changes.max(initial=0.0))
    if largest_log_change > MAX_LOG_CHANGE:
        raise ValueError(f"series: expected changes of ln Q up to {MAX_LOG_CHANGE:g}, got up to {largest_log_change:g}")
    by_pretension = finite_array(arrays, "by_pretension", (n_direction,))
    largest_change = float(np.abs(by_pretension).max(initial=0.0))
    if largest_change > MAX_CHANGE_WITH_PRETENSION:
        raise ValueError(
            f"by_pretension: expected changes up to {MAX_CHANGE_WITH_PRETENSION:g} per MPa, got {largest_change:g}"
        )
    radius_mm, force_N = read_contact_range(arrays)
    return FilmDirections(coefficients, radius_mm, force_N, by_pretension)
