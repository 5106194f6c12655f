"""Contacts that a model computes from charges.

A contact consists of ten numbers. Other programs rely on the order of the ten numbers.
"""

import math
import struct
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import ChargeError


class Contact(NamedTuple):
    """Position and force of one press, with the uncertainties of the position and the force.

    `Predictor.flags` returns the reasons why a contact may be wrong.

    Attributes:
        x_mm: Coordinate x of the position in the frame of the sensor, mm.
        y_mm: Coordinate y of the position in the frame of the sensor, mm.
        force_N: Force, N, positive if the probe pushes.
        x_std_mm: Standard deviation of x, mm.
        y_std_mm: Standard deviation of y, mm.
        force_std_N: Standard deviation of the force, N.
        misfit: Distance between the measured charges and the nearest charges that a single contact can produce, in
            standard deviations of the noise.
        xy_correlation: Correlation of the errors of x and y, -1 to 1.
        xF_correlation: Correlation of the errors of x and the force, -1 to 1.
        yF_correlation: Correlation of the errors of y and the force, -1 to 1.
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

    def with_covariance(self, covariance: Array) -> "Contact":
        """Return the contact with the covariance of an additional independent error.

        Args:
            covariance: Covariance of the additional error of x, y and the force, shape (3, 3), mm and N.
        """
        contacts = Contacts(*np.array([self], np.float32).T).with_covariance(covariance[np.newaxis])
        return Contact(*np.asarray(contacts)[0].tolist())

    def __repr__(self) -> str:
        """Return a text with x, y, the force and their standard deviations, rounded to a few significant digits."""
        return (
            f"Contact(x_mm={self.x_mm:.4g} +- {self.x_std_mm:.2g}, y_mm={self.y_mm:.4g} +- {self.y_std_mm:.2g}, "
            f"force_N={self.force_N:.4g} +- {self.force_std_N:.2g}, misfit={self.misfit:.2g})"
        )


CLOSE_DISTANCE_mm = 0.3
"""Largest difference of x or of y between two close contacts, mm."""

CLOSE_FORCE_RATIO = 0.05
"""Largest difference of the force between two close contacts, relative to the force of the reference contact."""


def is_close(contact: Contact, reference: Contact | None) -> bool:
    """Return whether a contact has nearly the same position and force as a reference contact.

    A sensitivity describes how a contact changes with a parameter of the film. The sensitivity that was computed for
    the reference may also be used for a contact that is close to the reference.

    Args:
        contact: The contact that is compared with the reference.
        reference: The reference contact. If it is None, the result is False.
    """
    if reference is None:
        return False
    is_x_close = abs(contact.x_mm - reference.x_mm) <= CLOSE_DISTANCE_mm
    is_y_close = abs(contact.y_mm - reference.y_mm) <= CLOSE_DISTANCE_mm
    is_force_close = abs(contact.force_N - reference.force_N) <= CLOSE_FORCE_RATIO * reference.force_N
    return is_x_close and is_y_close and is_force_close


class Contacts(NamedTuple):
    """Contacts of n presses, with one float32 array of shape (n,) for each field of `Contact`.

    `np.asarray` converts the fields to one array of shape (n, 10) in which each row contains one press.
    """

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
        """Return an array of shape (n, 10) in which each row contains one press. NumPy calls this method.

        Args:
            dtype: Requested number type; None for float32.
            copy: Ignored, because the result is always a new array.
        """
        return np.stack(tuple(self), axis=1).astype(dtype or np.float32, copy=False)

    def with_covariance(self, covariance: Array) -> "Contacts":
        """Return the contacts with the covariance of an additional independent error.

        Correlations that are NaN remain NaN.

        Args:
            covariance: Covariance of the additional error of x, y and the force, shape (n, 3, 3), mm and N.
        """
        std = np.stack([self.x_std_mm, self.y_std_mm, self.force_std_N], axis=1).astype(float)
        correlation = np.stack([self.xy_correlation, self.xF_correlation, self.yF_correlation], axis=1)
        total_std = np.sqrt(std**2 + np.diagonal(covariance, axis1=1, axis2=2))
        i, j = [0, 0, 1], [1, 2, 2]  # the pairs (x, y), (x, F) and (y, F)
        total = correlation * std[:, i] * std[:, j] + covariance[:, i, j]
        x_std_mm, y_std_mm, force_std_N = total_std.T.astype(np.float32)
        xy, xF, yF = (total / (total_std[:, i] * total_std[:, j])).T.astype(np.float32)
        return self._replace(
            x_std_mm=x_std_mm,
            y_std_mm=y_std_mm,
            force_std_N=force_std_N,
            xy_correlation=xy,
            xF_correlation=xF,
            yF_correlation=yF,
        )


def write_finite(write: Callable[..., object], values: Iterable[float]) -> bool:
    """Write the charges of one press as float32 numbers, and check that they are finite.

    Args:
        write: Function that takes the numbers as separate arguments and raises the exceptions of `struct.pack_into`.
        values: The numbers, as many as `write` takes.

    Returns:
        True if all numbers were written and are finite. If False, the memory does not contain valid charges.
    """
    try:
        numbers = tuple(values)
        write(*numbers)
        # The sum is not finite if a number is NaN or infinite. Otherwise, the sum is finite, because `write` has
        # refused numbers beyond the range of float32, and their sum is computed in float64.
        return math.isfinite(sum(numbers))
    except (struct.error, TypeError, ValueError, OverflowError):
        return False


def as_press(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """Convert the charges of one press to an array of shape (electrodes,), float32, pC.

    Args:
        charge_pC: Charges, pC, in the order of the electrodes.
        electrodes: Names of the electrodes.

    Raises:
        ChargeError: If the number of charges is wrong, or a charge is not finite. The message names the electrode.
    """
    expected = f"{len(electrodes)} charges {electrodes}"
    charges = _as_numbers(charge_pC, expected, (len(electrodes),))
    return np.asarray(as_float32(charges[np.newaxis], electrodes)[0])


def as_batch(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """Convert the charges of n presses to a contiguous array of shape (n, electrodes), float32, pC.

    Args:
        charge_pC: Charges, shape (n, electrodes), pC, with the columns in the order of the electrodes.
        electrodes: Names of the electrodes.

    Raises:
        ChargeError: If the shape is wrong, or a charge is not finite. The message names the electrode and the row.
    """
    n_electrode = len(electrodes)
    expected = f"rows of {n_electrode} charges {electrodes}, shape (n, {n_electrode})"
    return as_float32(_as_numbers(charge_pC, expected, ("n", n_electrode)), electrodes)


def _as_numbers(charge_pC: ArrayLike, expected: str, shape: tuple[str | int, ...]) -> NDArray[np.number]:
    """Convert charges to an array of numbers.

    Args:
        charge_pC: Charges of one press or of several presses, pC.
        expected: Description of the required charges, for error messages.
        shape: Required shape, in which a name stands for any length.

    Raises:
        ChargeError: If the charges are not numbers, or their array has another shape.
    """
    try:
        charges = np.asarray(charge_pC)
    except ValueError as error:  # rows of different lengths
        raise ChargeError(f"expected {expected} in each row, got {charge_pC!r:.200} ({error})") from error
    # Numbers are floats, signed or unsigned integers. The array has lost the mask of a masked array.
    if charges.dtype.kind not in "fiu" or np.ma.is_masked(charge_pC):
        raise ChargeError(f"expected {expected} as numbers (pC), got {charge_pC!r:.200}")
    if charges.ndim != len(shape) or charges.shape[-1] != shape[-1]:
        raise ChargeError(f"expected {expected}, got an array of shape {charges.shape}")
    return charges


def as_float32(charges: NDArray[Any], electrodes: tuple[str, ...]) -> Singles:
    """Convert charges of any number type to a contiguous float32 array.

    Args:
        charges: Charges, shape (n, electrodes), pC.
        electrodes: Names of the electrodes, for the error message.

    Raises:
        ChargeError: If a charge is not finite or beyond the range of float32. The message names the electrodes of all
            such charges in the first row that contains one.
    """
    with np.errstate(over="ignore"):  # charges beyond the range of float32 become infinite and are refused below
        converted = np.ascontiguousarray(charges, dtype=np.float32)
    is_finite = np.isfinite(converted)
    if is_finite.all():
        return converted
    row = int(np.argmin(is_finite.all(axis=1)))  # index of the first row that is not finite
    bad_columns = np.flatnonzero(~is_finite[row])
    bad_charges = [f"{electrodes[column]!r} ({charges[row, column]})" for column in bad_columns]
    where = f" in row {row} (rows count from 0)" if len(charges) > 1 else ""
    raise ChargeError(f"expected finite float32 charges (pC), got{where} for electrode {', '.join(bad_charges)}")
