"""What counts as charges for a model: the right number of finite numbers, in the order of its electrodes.

The hot paths ask `write_finite` for plain numbers and `as_singles` for arrays; what these do not take is examined
number by number, so that the error names the electrode.
"""

import math
import struct
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from isocharge.common.arrays import Singles
from isocharge.common.errors import ChargeError

LARGEST_SQUARE_SUM = 1e38
"""Sum of squared charges, pC^2, up to which each charge is certainly finite and fits into float32."""


def write_finite(write: Callable[..., object], values: Iterable[float]) -> bool:
    """Write numbers as float32 if they are finite and fit; the fast way for the few numbers of one press.

    Args:
        write: Takes the numbers one by one, as `struct.Struct("=3f").pack_into` does, and raises what that raises.
        values: The numbers, as many as `write` takes.

    Returns:
        Whether they were written and are finite; if not, what was written is not to be used.
    """
    try:
        numbers = tuple(values)
        write(*numbers)
        return math.isfinite(sum(numbers))  # float32 numbers cannot overflow a sum of float64
    except (struct.error, TypeError, ValueError, OverflowError):
        return False


def as_press(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """The charges of one press as an array of shape (electrodes,), float32, pC.

    Raises:
        ChargeError: If the number of charges is another, or one is not finite; the electrode is named.
    """
    charges = _as_numbers(charge_pC, electrodes)
    if charges.shape != (len(electrodes),):
        raise ChargeError(f"expected {_charges(electrodes)}, got an array of shape {charges.shape}")
    press: Singles = as_singles(charges[np.newaxis], electrodes, one_press=True)[0]
    return press


def as_batch(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """The charges of n presses as a contiguous array of shape (n, electrodes), float32, pC.

    Raises:
        ChargeError: If the shape is another, or a charge is not finite; the electrode and the row are named.
    """
    charges = _as_numbers(charge_pC, electrodes)
    if charges.ndim != 2 or charges.shape[1] != len(electrodes):
        raise ChargeError(
            f"expected rows of {_charges(electrodes)}, shape (n, {len(electrodes)}), "
            f"got an array of shape {charges.shape}"
        )
    return as_singles(charges, electrodes)


def _charges(electrodes: tuple[str, ...]) -> str:
    return f"{len(electrodes)} charges {electrodes}"


def _as_numbers(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> NDArray[np.number]:
    try:
        charges = np.asarray(charge_pC)
    except ValueError as error:  # rows of different lengths
        raise ChargeError(f"expected {_charges(electrodes)} in each row, got {charge_pC!r:.200} ({error})") from error
    if charges.dtype.kind not in "fiu":
        raise ChargeError(f"expected {_charges(electrodes)} as numbers (pC), got {charge_pC!r:.200}")
    return charges


def as_singles(charges: NDArray[Any], electrodes: tuple[str, ...], *, one_press: bool = False) -> Singles:
    """Charges of shape (n, electrodes), pC, of any number type as a contiguous float32 array.

    Raises:
        ChargeError: If a charge is not finite; its electrode is named, and its row unless there is only `one_press`.
    """
    flat = charges.ravel()
    if (
        charges.dtype.kind == "f" and np.vdot(flat, flat) <= LARGEST_SQUARE_SUM
    ):  # one call instead of three and an errstate
        return np.ascontiguousarray(charges, dtype=np.float32)
    return _examined(charges, electrodes, one_press)


def _examined(charges: NDArray[np.number], electrodes: tuple[str, ...], one_press: bool) -> Singles:
    """Charges one by one; the first row with a bad one is named."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite and is refused below
        singles = np.ascontiguousarray(charges, dtype=np.float32)
    rows, columns = np.nonzero(~np.isfinite(singles))
    if rows.size:
        row = rows[0]
        bad = [f"{electrodes[column]!r} ({charges[row, column]})" for column in columns[rows == row]]
        where = "" if one_press else f" in row {row} (rows count from 0)"
        raise ChargeError(f"expected finite charges (pC), got{where} for electrode {', '.join(bad)}")
    return singles
