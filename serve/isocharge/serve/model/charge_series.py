"""The charges of every contact as a short series, and the file `charges.npz` that holds it beside a model.

A model answers where charges say which contact it is. Where the map from contacts to charges folds they do not, and the
contact is followed through the charges themselves:

    ln Q_e = sum c_ijm T_i(x / r) T_j(y / r) T_m(l),   i + j <= degree, m <= force_degree,

with r the radius up to which contacts are known, and l the logarithm of the force, scaled to [-1, 1].

    series      c, shape (degree + 1, degree + 1, force_degree + 1, n_electrode)
    radius_mm   r
    force_N     the smallest and the largest force
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers
from isocharge.common.errors import ModelError, cut
from isocharge.common.npz import DAMAGED, finite_array, finite_number, npz_arrays
from isocharge.serve.model.companion_files import read_companion_file

FILE = "charges.npz"
"""Name of the file in a version folder."""

ADVICE = "copy the model's folder again, or train again"

MAX_DEGREE = 100
"""Largest degree of the series; the series of this project have at most 30."""

MAX_RADIUS_mm = 1e4
"""Largest radius, mm."""

MIN_FORCE_RATIO = 1.01
"""Smallest ratio of the largest to the smallest force: with equal forces the scaled logarithm is not defined."""

CHUNK = 4096
"""Contacts whose terms are held at once."""


@dataclass(frozen=True)
class Series:
    """Products of Chebyshev polynomials in three coordinates from -1 to 1.

    Attributes:
        coefficients: Shape (degree + 1, degree + 1, force_degree + 1, n_electrode).
    """

    coefficients: Array

    def values(self, unit: Array) -> Array:
        """The sums and their derivatives by the coordinates: places (n, 3) to (n, 4, n_electrode)."""
        degree, _, orders, n_electrode = (size - 1 for size in self.coefficients.shape)
        parts = []
        for some in np.array_split(unit, len(unit) // CHUNK + 1):
            plane, in_force = terms(some, degree, orders)
            by_force = (plane @ self._rows).reshape(len(some), in_force.shape[1], -1)
            parts.append((in_force[:, None, :] @ by_force)[:, 0])
        return np.concatenate(parts).reshape(len(unit), 4, n_electrode + 1)

    @cached_property
    def _rows(self) -> Array:
        """The series and its derivatives by term of the plane, shape (n_term, (force_degree + 1) 4 n_electrode)."""
        all_four = np.stack([self.coefficients, *(_derivative(self.coefficients, axis) for axis in range(3))])
        of_terms = all_four[:, *plane_terms(self.coefficients.shape[0] - 1)]
        return np.asarray(of_terms.transpose(1, 2, 0, 3).reshape(of_terms.shape[1], -1))


def plane_terms(degree: int) -> tuple[Integers, Integers]:
    """Degrees in x and y of the terms."""
    of_x, of_y = np.nonzero(np.add.outer(np.arange(degree + 1), np.arange(degree + 1)) <= degree)
    return of_x, of_y


def terms(unit: Array, degree: int, force_degree: int) -> tuple[Array, Array]:
    """Products of the polynomials in x and y, (n, n_term), and the polynomials in the force, (n, force_degree + 1)."""
    inside = np.clip(unit, -1.0, 1.0)
    in_x, in_y = (chebyshev.chebvander(inside[:, axis], degree).astype(float) for axis in range(2))
    of_x, of_y = plane_terms(degree)
    return in_x[:, of_x] * in_y[:, of_y], chebyshev.chebvander(inside[:, 2], force_degree).astype(float)


def _derivative(series: Array, axis: int) -> Array:
    """Series of the derivative by one unit coordinate, padded to the same shape."""
    return np.pad(chebyshev.chebder(series, axis=axis), [(0, int(k == axis)) for k in range(4)])


@dataclass(frozen=True)
class ChargeSeries:
    """The charges of contacts (x, y, ln F) up to a radius.

    Attributes:
        series: Of ln Q, Q in pC.
        radius_mm: Largest distance from the centre, mm.
        force_N: Smallest and largest force, N.
    """

    series: Series
    radius_mm: float
    force_N: tuple[float, float]

    @property
    def corners_mm(self) -> Array:
        """Corners of a polygon about the area, shape (64, 2), mm."""
        angle = 2.0 * np.pi * np.arange(64) / 64
        reach_mm = self.radius_mm / np.cos(np.pi / 64)
        return np.asarray(reach_mm * np.column_stack([np.cos(angle), np.sin(angle)]))

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Charges, pC, and their derivatives by x and y, mm, and ln F: (n, 3) to (n, e) and (n, e, 3).

        Beyond the forces, ln Q goes on as a straight line.
        """
        low, high = np.log(self.force_N)
        scale = np.array([self.radius_mm, self.radius_mm, 0.5 * (high - low)])
        unit = (contact - [0.0, 0.0, 0.5 * (low + high)]) / scale
        values = self.series.values(unit)
        beyond = unit[:, 2:] - np.clip(unit[:, 2:], -1.0, 1.0)
        charge = np.exp(values[:, 0] + beyond * values[:, 3])
        return charge, charge[:, :, None] * values[:, 1:].swapaxes(1, 2) / scale

    def to_bytes(self) -> bytes:
        """The file."""
        file = io.BytesIO()
        np.savez_compressed(
            file, series=self.series.coefficients, radius_mm=np.array(self.radius_mm), force_N=np.array(self.force_N)
        )
        return file.getvalue()


def read_charges(version_folder: Path, n_electrode: int) -> ChargeSeries | None:
    """Read the file `charges.npz` beside a model; return None if there is none.

    Args:
        version_folder: The folder that holds `model.onnx`.
        n_electrode: Number of electrodes of the model.

    Raises:
        ModelError: If the file is damaged, belongs to another model, or does not describe the charges of contacts.
    """
    path = version_folder / FILE
    if not path.exists():
        return None
    data = read_companion_file(version_folder, FILE, ADVICE)
    try:
        return _charge_series(npz_arrays(data), n_electrode)
    except DAMAGED as error:
        raise ModelError(f"{path}: {cut(str(error))}; {ADVICE}") from error


def _charge_series(arrays: Mapping[str, np.ndarray], n_electrode: int) -> ChargeSeries:
    """Return the series that the arrays of a file describe; raise ValueError if they describe none."""
    coefficients = finite_array(arrays, "series", (None, None, None, n_electrode))
    degree, y_degree, force_degree, _ = (length - 1 for length in coefficients.shape)
    if degree != y_degree or not (1 <= degree <= MAX_DEGREE and 1 <= force_degree <= MAX_DEGREE):
        raise ValueError(
            f"series: expected equal degrees in x and y and degrees from 1 to {MAX_DEGREE}, got {degree}, {y_degree} "
            f"and {force_degree} in the force"
        )
    radius_mm = finite_number(arrays, "radius_mm")
    if not 0.0 < radius_mm <= MAX_RADIUS_mm:
        raise ValueError(f"radius_mm: expected a radius up to {MAX_RADIUS_mm:g} mm, got {radius_mm:g}")
    low_N, high_N = finite_array(arrays, "force_N", (2,)).tolist()
    if not (low_N > 0.0 and high_N >= MIN_FORCE_RATIO * low_N):
        raise ValueError(
            f"force_N: expected a smallest force above 0 and a largest force of at least {MIN_FORCE_RATIO:g} times the "
            f"smallest, got {low_N:g} and {high_N:g} N"
        )
    charges = ChargeSeries(Series(coefficients), radius_mm, (low_N, high_N))
    _check_charges(charges)
    return charges


def _check_charges(charges: ChargeSeries) -> None:
    """Refuse a series whose charges overflow, or do not change with the position or with the force."""
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    log_forces = np.log(np.geomspace(*charges.force_N, 5))
    circle = 0.5 * charges.radius_mm * np.column_stack([np.cos(angle), np.sin(angle)])
    contacts = np.array([[x_mm, y_mm, log_force] for x_mm, y_mm in circle for log_force in log_forces])
    with np.errstate(over="ignore", invalid="ignore"):
        charge_pC, derivative = charges.linearised(contacts)
    if not (np.isfinite(charge_pC).all() and np.isfinite(derivative).all() and (charge_pC > 0.0).all()):
        raise ValueError("series: expected charges that are finite and positive for every contact")
    changes = np.abs(derivative).max(axis=(0, 1))
    if not (changes > 0.0).all():
        raise ValueError("series: expected charges that change with x, y and the force")
