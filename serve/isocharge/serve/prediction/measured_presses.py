"""Measured presses: charges of a film under presses whose place or force, or both, are known. Their CSV file.

The header has `x_mm, y_mm, force_N` and the electrodes' names (pC), in any order. An empty cell is unknown. Optional
columns `position_std_mm` and `force_std` (a share: 0.01 is 1 %) say how well the rig knows place and force. Further
columns are ignored. The file `isocharge serve predict` reads it too.
"""

import csv
import io
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import PressError
from isocharge.common.files import bounded_lines, write_whole
from isocharge.common.tables import is_number, shown
from isocharge.serve.prediction.csv_numbers import CsvNumbers
from isocharge.serve.prediction.table import CHARGE

POSITION_STD_MM = 0.1
"""Uncertainty of a position where nothing else is said, mm: that of a hand-set stage."""

FORCE_STD = 0.01
"""Uncertainty of a force where nothing else is said, a share: that of a simple load cell."""

MOST_ROWS = 1_000_000
"""Presses of a file."""

CONTACT = ("x_mm", "y_mm", "force_N")
UNCERTAINTY = ("position_std_mm", "force_std")

KINDS = {
    "x_mm": "a position in mm, or an empty cell if it is unknown",
    "y_mm": "a position in mm, or an empty cell if it is unknown",
    "force_N": "a positive force in N, or an empty cell if it is unknown",
    "position_std_mm": "a positive standard deviation in mm",
    "force_std": "a positive share of the force up to 1 (0.01 is 1 %)",
}


@dataclass(frozen=True, eq=False)
class MeasuredPresses:
    """n presses; equal are those of the same numbers and electrodes, whatever lines they come from.

    Attributes:
        contact: x_mm, y_mm, force_N, shape (n, 3); NaN where unknown. x and y are known both or not at all.
        charge_pC: Touch charges, shape (n, electrodes), pC; NaN where unknown, but one of each press is known.
        position_std_mm: Standard deviation of x and of y, shape (n,), mm.
        force_std: Standard deviation of the force as a share of it, shape (n,).
        electrodes: Names, in the order of the charges.
        lines: Line of each press in its file, for messages; its number from 1 where there is no file.
        ignored: Columns of the file that were not read.

    Raises:
        PressError: If shapes disagree or a value is impossible; the line and the column are named.
    """

    contact: Array
    charge_pC: Array
    position_std_mm: Array
    force_std: Array
    electrodes: tuple[str, ...]
    lines: tuple[int, ...]
    ignored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_electrodes(self.electrodes)
        n = len(self.lines)
        _check_shape("contact", self.contact, (n, 3))
        _check_shape("charge_pC", self.charge_pC, (n, len(self.electrodes)))
        _check_shape("position_std_mm", self.position_std_mm, (n,))
        _check_shape("force_std", self.force_std, (n,))
        self._check_values()

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, rows: int | slice | Sequence[int] | Integers | Booleans) -> "MeasuredPresses":
        """Some of the presses, by their places or by a mask; one alone for a whole number."""
        chosen = np.atleast_1d(np.arange(len(self))[rows])
        return MeasuredPresses(
            self.contact[chosen],
            self.charge_pC[chosen],
            self.position_std_mm[chosen],
            self.force_std[chosen],
            self.electrodes,
            tuple(self.lines[row] for row in chosen),
            self.ignored,
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, MeasuredPresses):
            return NotImplemented
        numbers, others = self._columns(), other._columns()
        return self.electrodes == other.electrodes and np.array_equal(numbers, others, equal_nan=True)

    def _columns(self) -> Array:
        """All numbers, in the columns of the file, shape (n, 5 + electrodes)."""
        return np.column_stack([self.contact, self.charge_pC, self.position_std_mm, self.force_std])

    def _check_values(self) -> None:
        names, values = (*CONTACT, *self.electrodes, *UNCERTAINTY), self._columns()
        force, place = self.contact[:, 2], np.isnan(self.contact[:, :2])
        wrong = np.isinf(values)
        wrong[:, 2] |= force <= 0.0
        wrong[:, -2] |= ~(self.position_std_mm > 0.0)
        wrong[:, -1] |= ~((self.force_std > 0.0) & (self.force_std <= 1.0))
        for row, column in np.argwhere(wrong)[:1]:
            kind = KINDS.get(names[column], CHARGE)
            self._refuse(row, f", column {shown(names[column])}: expected {kind}, got {values[row, column]:.6g}")
        for row in np.flatnonzero(place[:, 0] != place[:, 1])[:1]:
            self._refuse(row, ": expected both x_mm and y_mm, or two empty cells, got one of them; give the other")
        for row in np.flatnonzero(np.isnan(self.charge_pC).all(axis=1))[:1]:
            self._refuse(row, ": expected a charge of one electrode or more, got none; fill it in or remove the line")

    def _refuse(self, row: int, reason: str) -> None:
        raise PressError(f"line {self.lines[row]}{reason}")


def read_presses(
    path: Path,
    electrodes: Sequence[str],
    *,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> MeasuredPresses:
    """Read a file of measured presses.

    Args:
        path: CSV in UTF-8, with or without byte order mark.
        electrodes: Names of the electrodes, in the order in which the charges are wanted.
        position_std_mm: Standard deviation of x and of y where the file has none, mm.
        force_std: Standard deviation of a force where the file has none, as a share of it.

    Raises:
        PressError: Names file, line and column, what was expected, what was got and what to do.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            return parse_presses(
                bounded_lines(file), electrodes, str(path), position_std_mm=position_std_mm, force_std=force_std
            )
    except OSError as error:
        raise PressError(f"{path}: cannot be read ({error.strerror}); expected a CSV file of presses") from error


def parse_presses(
    lines: Iterable[str],
    electrodes: Sequence[str],
    where: str,
    *,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> MeasuredPresses:
    """As `read_presses`, of lines; `where` names them in messages."""
    electrodes = tuple(electrodes)
    check_electrodes(electrodes)
    _check_default("position_std_mm", position_std_mm)
    _check_default("force_std", force_std, most=1.0)
    table = _open_table(lines, electrodes, where)
    columns = table.columns(electrodes, (*CONTACT, *UNCERTAINTY))
    if ("x_mm" in columns) != ("y_mm" in columns):
        missing = "y_mm" if "x_mm" in columns else "x_mm"
        raise PressError(f"{where}: expected the columns x_mm and y_mm, or neither, got one of them; add {missing!r}")
    numbered = array("q")
    values = _values(table, columns, electrodes, numbered)
    try:
        return MeasuredPresses(
            np.column_stack([_column(values, columns, name, np.nan) for name in CONTACT]),
            np.column_stack([_column(values, columns, name, np.nan) for name in electrodes]),
            _column(values, columns, "position_std_mm", position_std_mm),
            _column(values, columns, "force_std", force_std),
            electrodes,
            tuple(numbered),
            tuple(name for name in table.header if name not in columns),
        )
    except PressError as error:
        raise PressError(f"{where}, {error}") from error


def write_presses(out: Path | TextIO, presses: MeasuredPresses) -> None:
    """Write presses as `read_presses` reads them, to the last bit; a file appears whole and replaces an older one."""
    if isinstance(out, Path):
        text = io.StringIO()
        write_presses(text, presses)
        write_whole(out, text.getvalue().encode())
        return
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow((*CONTACT, *presses.electrodes, *UNCERTAINTY))
    for row in presses._columns().tolist():
        writer.writerow("" if value != value else repr(value) for value in row)


def check_electrodes(electrodes: tuple[str, ...]) -> None:
    """Raise PressError if names of electrodes cannot be those of columns."""
    if not electrodes or len(set(electrodes)) < len(electrodes) or not all(electrodes):
        raise PressError(f"electrodes: expected one name or more, all different, none empty, got {shown(electrodes)}")
    for name in electrodes:
        if name in KINDS or "\n" in name or "\r" in name:
            raise PressError(
                f"electrode {shown(name)}: expected a name of one line that is none of {', '.join(KINDS)}, which are "
                "columns of a file of presses; rename the electrode"
            )


def _check_shape(name: str, values: Array, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise PressError(f"{name}: expected an array of shape {shape}, got {values.shape}")


def _check_default(name: str, value: float, most: float = np.inf) -> None:
    if not (is_number(value) and 0.0 < value <= most):
        raise PressError(f"{name}: expected {KINDS[name]}, got {shown(value)}")


def _open_table(lines: Iterable[str], electrodes: tuple[str, ...], where: str) -> CsvNumbers:
    expected = f"a header with {', '.join(CONTACT)} and the electrodes {electrodes} (charges in pC)"
    return CsvNumbers(lines, (*electrodes, *KINDS), where, PressError, expected)


def _values(table: CsvNumbers, columns: dict[str, int], electrodes: tuple[str, ...], numbered: Any) -> Array:
    """Numbers of the columns, shape (n, columns); the lines are appended to `numbered`."""
    values = array("d")
    for line, row in table.rows(columns, KINDS | dict.fromkeys(electrodes, CHARGE)):
        numbered.append(line)
        values.extend(row)
        if len(numbered) > MOST_ROWS:
            raise PressError(f"{table.where}: expected at most {MOST_ROWS:,} presses, got more; split the file")
    if not numbered:
        raise PressError(f"{table.where}: expected one press or more below the header, got none")
    return np.array(values, dtype=np.float64).reshape(-1, len(columns))


def _column(values: Array, columns: dict[str, int], name: str, default: float) -> Array:
    """A column of the table, the default where it is absent or its cell empty, shape (n,)."""
    if name not in columns:
        return np.full(len(values), default)
    column = values[:, list(columns).index(name)]
    return np.where(np.isnan(column), default, column)
