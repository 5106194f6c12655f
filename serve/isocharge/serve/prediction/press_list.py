"""Presses that a machine makes, in their order: a CSV file with `x_mm, y_mm, force_N`; an empty cell is unknown."""

from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.files import bounded_lines
from isocharge.serve.prediction.csv_numbers import CsvNumbers
from isocharge.serve.prediction.measured_presses import CONTACT, KINDS


def read_press_list(path: Path) -> Array:
    """The presses (x_mm, y_mm, force_N) of a file, NaN where unknown, shape (n, 3).

    Args:
        path: CSV in UTF-8; further columns are ignored.

    Raises:
        PressError: If the file cannot be read, or a row is no press; names line and column.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            table = CsvNumbers(
                bounded_lines(file), CONTACT, str(path), PressError, f"a header with {', '.join(CONTACT)}"
            )
            rows = list(table.rows(table.columns(CONTACT), KINDS))
    except OSError as error:
        raise PressError(f"{path}: cannot be read ({error.strerror}); expected a CSV file of presses") from error
    for line, (x_mm, y_mm, force_N) in rows:
        if force_N <= 0.0:
            raise PressError(f"{path}, line {line}, column 'force_N': expected {KINDS['force_N']}, got {force_N:g}")
        if np.isnan(x_mm) != np.isnan(y_mm):
            raise PressError(f"{path}, line {line}: expected both x_mm and y_mm, or two empty cells, got one of them")
    if not rows:
        raise PressError(f"{path}: expected one press or more below the header, got none")
    return np.array([row for _, row in rows])
