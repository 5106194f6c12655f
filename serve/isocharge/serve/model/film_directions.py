"""Unknowns of a calibrated film except its pretension, and the file `film_directions.npz` that describes them.

After a calibration, several unknowns of the film remain uncertain: its parameters, its imperfections, its discrepancy
and its gains. From the misfits of touches, only a few linear combinations of these unknowns can be estimated. These
linear combinations are called directions. A change along a direction changes the charges of a contact by a relative
amount that depends on the contact:

    ln Q_e = ln Q_e(calibrated film) + sum over k of z_k s_ke(x, y, F),

where Q_e is the charge of electrode e, and z_k is the change along direction k. At a given pretension, the changes z_k
are independent and have the standard deviation 1. Each function s_ke is a Chebyshev series, as in the module
`charge_series`. The file contains the following arrays:

    series             coefficients of s, shape (degree + 1, degree + 1, force_degree + 1, n_direction, n_electrode)
    radius_mm          largest distance of a contact from the centre, mm
    force_N            smallest and largest force, N
    by_pretension      derivative of the mean of each z_k with respect to the pretension, shape (n_direction,), 1/MPa
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
from isocharge.serve.model.companion_files import read_companion_file
from isocharge.serve.model.contact_range import clipped_unit_contact, read_contact_range

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
"""Largest derivative of the mean of a direction with respect to the pretension, 1/MPa."""


@dataclass(frozen=True)
class FilmDirections:
    """Uncertain linear combinations of the unknowns of a film, called directions, and their effects on the charges.

    Attributes:
        coefficients: Coefficients of the Chebyshev series of the changes of ln Q, the logarithm of each charge, by one
            unit of each direction, shape (degree + 1, degree + 1, force_degree + 1, n_direction, n_electrode).
        radius_mm: Largest distance of a contact from the centre, mm.
        force_N: Smallest and largest force, N.
        by_pretension: Derivative of the mean of each direction with respect to the pretension, shape (n_direction,),
            1/MPa.
    """

    coefficients: Array
    radius_mm: float
    force_N: tuple[float, float]
    by_pretension: Array

    @classmethod
    def none(cls, n_electrode: int) -> "FilmDirections":
        """Return an empty set of directions.

        A model that was calibrated by an earlier version of isocharge has no directions.
        """
        no_coefficients = np.zeros((1, 1, 1, 0, n_electrode))
        # There are no series, so the radius and the forces have no effect.
        return cls(no_coefficients, radius_mm=1.0, force_N=(1.0, 2.0), by_pretension=np.zeros(0))

    @property
    def count(self) -> int:
        """Number of directions."""
        return int(self.by_pretension.size)

    @cached_property
    def _series(self) -> Series:
        """Chebyshev series of every direction and electrode. Directions and electrodes share one axis."""
        return Series(self.coefficients.reshape(*self.coefficients.shape[:3], -1))

    def log_changes(self, contacts: Array) -> Array:
        """Compute the change of ln Q, the logarithm of each charge, that one unit of each direction causes.

        A direction is a linear combination of the unknowns of the film. One unit of a direction is one standard
        deviation. A contact beyond the largest radius or outside the range of forces is replaced by the nearest contact
        within these limits.

        Args:
            contacts: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Changes, shape (n, n_direction, n_electrode), dimensionless.
        """
        *_coefficient_counts, n_direction, n_electrode = self.coefficients.shape
        if n_direction == 0:
            return np.zeros((len(contacts), 0, n_electrode))

        # The first entry of axis 1 is the value of the series. Its derivatives follow in this axis and are not used.
        unit_contact = clipped_unit_contact(contacts, self.radius_mm, self.force_N)
        log_changes = self._series.values_and_derivatives(unit_contact)[:, 0]  # shape (n, n_direction * n_electrode)
        return np.asarray(log_changes.reshape(len(contacts), n_direction, n_electrode))

    def to_bytes(self) -> bytes:
        """Return the content of the file `film_directions.npz`."""
        arrays: dict[str, Any] = {
            "series": self.coefficients.astype(np.float32),
            "radius_mm": np.array(self.radius_mm),
            "force_N": np.array(self.force_N),
            "by_pretension": self.by_pretension,
        }
        file = io.BytesIO()
        np.savez_compressed(file, **arrays)
        return file.getvalue()


def read_film_directions(version_folder: Path, n_electrode: int) -> FilmDirections:
    """Read the directions of a film from the file `film_directions.npz` of its model.

    If the file does not exist, return an empty set of directions. Models that were calibrated by an earlier version of
    isocharge have no such file.

    Args:
        version_folder: Folder of the model, which contains `model.onnx`.
        n_electrode: Number of electrodes of the model.

    Raises:
        ModelError: If the file is damaged or belongs to another model.
    """
    path = version_folder / FILE
    if not path.exists():
        return FilmDirections.none(n_electrode)
    data = read_companion_file(version_folder, FILE, ADVICE)
    try:
        return _directions_from_arrays(npz_arrays(data), n_electrode)
    except DAMAGED_FILE_ERRORS as error:
        raise ModelError(f"{path}: {cut(str(error))}; {ADVICE}") from error


def _directions_from_arrays(arrays: Mapping[str, np.ndarray], n_electrode: int) -> FilmDirections:
    """Check the arrays of a file, and return the directions that they describe.

    A direction is a linear combination of the unknowns of the film, such as its gains. For each direction, a Chebyshev
    series in x, y and the force gives the change of ln Q, the logarithm of each charge, by one unit of the direction.

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

    # The magnitude of a Chebyshev polynomial is at most 1. The magnitude of a series is therefore at most the sum of
    # the magnitudes of its coefficients.
    log_change_limits = np.abs(coefficients).sum(axis=(0, 1, 2))  # shape (n_direction, n_electrode)
    largest_log_change = float(log_change_limits.max(initial=0.0))
    if largest_log_change > MAX_LOG_CHANGE:
        raise ValueError(f"series: expected changes of ln Q up to {MAX_LOG_CHANGE:g}, got up to {largest_log_change:g}")

    # Derivative of the mean of each direction with respect to the pretension of the film, shape (n_direction,), 1/MPa
    by_pretension = finite_array(arrays, "by_pretension", (n_direction,))
    steepest_change = float(np.abs(by_pretension).max(initial=0.0))
    if steepest_change > MAX_CHANGE_WITH_PRETENSION:
        raise ValueError(
            f"by_pretension: expected changes up to {MAX_CHANGE_WITH_PRETENSION:g} per MPa, got {steepest_change:g}"
        )
    radius_mm, force_N = read_contact_range(arrays)
    return FilmDirections(coefficients, radius_mm, force_N, by_pretension)


def _check_degrees(name: str, coefficients: Array) -> None:
    """Check that the degrees of a Chebyshev series in x, y and the force are valid.

    Args:
        name: Name of the array in the file.
        coefficients: Coefficients. The indices of the first three axes are the degrees in x, y and the force.

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
