"""Measured presses: charges of a film under presses whose place or force, or both, are known. Their CSV file.

The header has `x_mm, y_mm, force_N` and the electrodes' names (pC), in any order. An empty cell is unknown. Optional
columns `position_std_mm` and `force_std` (a share: 0.01 is 1 %) say how well the rig knows place and force, and
`temperature_C` how warm the film's ring was. Further columns are ignored where the electrodes are named. `isocharge
serve predict` reads the file too. Parquet with the same columns will do as well.
"""

import csv
import io
from array import array
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import PressError, shown, told_where
from isocharge.common.files import bounded_lines, write_whole
from isocharge.serve.prediction.parquet import SUFFIX, parquet_bytes, parquet_lines
from isocharge.serve.prediction.table import CHARGE, LARGEST, CsvNumbers

POSITION_STD_MM = 0.1
"""Uncertainty of a position where nothing else is said, mm: that of a hand-set stage."""

FORCE_STD = 0.01
"""Uncertainty of a force where nothing else is said, a share: that of a simple load cell."""

MOST_ROWS = 1_000_000
"""Presses of a file."""

CONTACT = ("x_mm", "y_mm", "force_N")
UNCERTAINTY = ("position_std_mm", "force_std")

TEMPERATURE = "temperature_C"
COLDEST_C, WARMEST_C = -100.0, 200.0
"""Temperatures that a film of PVDF may have."""

KINDS = {
    "x_mm": "a position in mm, or an empty cell if it is unknown",
    "y_mm": "a position in mm, or an empty cell if it is unknown",
    "force_N": "a positive force in N, or an empty cell if it is unknown",
    "position_std_mm": "a positive standard deviation in mm",
    "force_std": "a positive share of the force up to 1 (0.01 is 1 %)",
    TEMPERATURE: f"a temperature of {COLDEST_C:g} to {WARMEST_C:g} degrees Celsius, or an empty cell if it is unknown",
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
        temperature_C: Of the film's ring, shape (n,), degrees Celsius; NaN where unknown, None if it nowhere is known.

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
    temperature_C: Array | None = None

    def __post_init__(self) -> None:
        _check_electrodes(self.electrodes)
        n = len(self.lines)
        shapes = {"contact": (n, 3), "charge_pC": (n, len(self.electrodes)), "position_std_mm": (n,), "force_std": (n,)}
        if self.temperature_C is not None:
            shapes[TEMPERATURE] = (n,)
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise PressError(f"{name}: expected an array of shape {shape}, got {getattr(self, name).shape}")
        self._check_values()

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, rows: int | slice | Sequence[int] | Integers | Booleans) -> "MeasuredPresses":
        """Some of the presses, by their places or by a mask; one alone for a whole number."""
        chosen = np.atleast_1d(np.arange(len(self))[rows])
        names = ("contact", "charge_pC", "position_std_mm", "force_std")
        columns = {name: getattr(self, name)[chosen] for name in names}
        if self.temperature_C is not None:
            columns[TEMPERATURE] = self.temperature_C[chosen]
        return replace(self, **columns, lines=tuple(self.lines[row] for row in chosen))

    @property
    def placed(self) -> Booleans:
        """Presses of which place and force are known, shape (n,)."""
        return np.asarray(np.isfinite(self.contact).all(axis=1))

    @property
    def knows_temperature(self) -> bool:
        """Whether the temperature of one of them is known."""
        return self.temperature_C is not None and bool(np.isfinite(self.temperature_C).any())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, MeasuredPresses):
            return NotImplemented
        numbers, others = self.columns, other.columns
        return [*numbers] == [*others] and all(
            np.array_equal(column, others[name], equal_nan=True) for name, column in numbers.items()
        )

    def of_electrodes(self, electrodes: Sequence[str], whose: str) -> "MeasuredPresses":
        """The same presses with the charges of these electrodes, in this order.

        Raises:
            PressError: If one of them is missing; `whose` says in the message who has these electrodes.
        """
        names = tuple(electrodes)
        if missing := [name for name in names if name not in self.electrodes]:
            raise PressError(
                f"expected charges of the electrodes {names} of {whose}, got {self.electrodes}; "
                f"missing: {', '.join(map(shown, missing))}"
            )
        order = [self.electrodes.index(name) for name in names]
        return replace(self, charge_pC=self.charge_pC[:, order], electrodes=names)

    @property
    def columns(self) -> dict[str, Array]:
        """All numbers, in the columns of the file, each of shape (n,)."""
        numbers = [*self.contact.T, *self.charge_pC.T, self.position_std_mm, self.force_std]
        columns = dict(zip((*CONTACT, *self.electrodes, *UNCERTAINTY), numbers, strict=True))
        return columns if self.temperature_C is None else columns | {TEMPERATURE: self.temperature_C}

    def _check_values(self) -> None:
        columns, place = self.columns, np.isnan(self.contact[:, :2])
        wrong = {name: np.isinf(column) for name, column in columns.items()}
        wrong["force_N"] |= self.contact[:, 2] <= 0.0
        wrong["position_std_mm"] |= ~(self.position_std_mm > 0.0)
        wrong["force_std"] |= ~((self.force_std > 0.0) & (self.force_std <= 1.0))
        if self.temperature_C is not None:
            wrong[TEMPERATURE] |= (self.temperature_C < COLDEST_C) | (self.temperature_C > WARMEST_C)
        for row, number in np.argwhere(np.column_stack([*wrong.values()]))[:1]:
            name = [*columns][number]
            expected = KINDS.get(name, CHARGE)
            self._refuse(row, f", column {shown(name)}: expected {expected}, got {columns[name][row]:.6g}")
        for row in np.flatnonzero(place[:, 0] != place[:, 1])[:1]:
            self._refuse(row, ": expected both x_mm and y_mm, or two empty cells, got one of them; give the other")
        for row in np.flatnonzero(np.isnan(self.charge_pC).all(axis=1))[:1]:
            self._refuse(row, ": expected a charge of one electrode or more, got none; fill it in or remove the line")

    def _refuse(self, row: int, reason: str) -> None:
        raise PressError(f"line {self.lines[row]}{reason}")


def read_presses(
    path: Path,
    electrodes: Sequence[str] | None = None,
    *,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> MeasuredPresses:
    """Read a file of measured presses.

    Args:
        path: CSV in UTF-8, with or without byte order mark; or Parquet, if its name ends in `.parquet`.
        electrodes: Names of the electrodes, in the order in which the charges are wanted; all columns without another
            meaning if absent.
        position_std_mm: Standard deviation of x and of y where the file has none, mm.
        force_std: Standard deviation of a force where the file has none, as a share of it.

    Raises:
        PressError: Names file, line and column, what was expected, what was got and what to do.
    """
    for name, std, most in (("position_std_mm", position_std_mm, LARGEST), ("force_std", force_std, 1.0)):
        if not 0.0 < std <= most:
            raise PressError(f"{name}: expected {KINDS[name]}, got {std:g}")
    named = f"the electrodes {tuple(electrodes)}" if electrodes is not None else "the electrodes' names"
    with _open_table(path, (*(electrodes or ()), *KINDS), f"{', '.join(CONTACT)} and {named} (charges in pC)") as table:
        if electrodes is None:
            electrodes = [name for name in table.header if name and name not in KINDS]
        electrodes = tuple(electrodes)
        _check_electrodes(electrodes)
        columns = table.columns(electrodes, KINDS)
        lines, values = _values(table, columns, electrodes)
    defaults = {"position_std_mm": position_std_mm, "force_std": force_std}
    column = {name: values[:, number] for number, name in enumerate(columns)}
    for name in KINDS:
        given, default = column.get(name, np.full(len(lines), np.nan)), defaults.get(name, np.nan)
        column[name] = np.where(np.isnan(given), default, given)
    with told_where(f"{path}, ", PressError):
        return MeasuredPresses(
            np.column_stack([column[name] for name in CONTACT]),
            np.column_stack([column[name] for name in electrodes]),
            column["position_std_mm"],
            column["force_std"],
            electrodes,
            lines,
            tuple(name for name in table.header if name not in columns),
            None if np.isnan(column[TEMPERATURE]).all() else column[TEMPERATURE],
        )


def read_press_list(path: Path) -> Array:
    """Presses that a machine makes, in their order: (x_mm, y_mm, force_N), NaN where unknown, shape (n, 3).

    Args:
        path: CSV in UTF-8 with x_mm, y_mm and force_N; further columns are ignored.

    Raises:
        PressError: If the file cannot be read, or a row is no press; names line and column.
    """
    with _open_table(path, CONTACT, ", ".join(CONTACT)) as table:
        lines, contact = _values(table, table.columns(CONTACT), ())
    known = np.zeros((len(lines), 1)), np.ones(len(lines)), np.ones(len(lines))
    with told_where(f"{path}, ", PressError):
        return MeasuredPresses(contact, *known, ("charge",), lines).contact


def write_presses(path: Path, presses: MeasuredPresses) -> None:
    """Write presses as `read_presses` reads them, to the last bit; the file appears whole and replaces an older one.

    Its name decides: Parquet if it ends in `.parquet`, else CSV.
    """
    write_whole(
        path, parquet_bytes(presses.columns) if path.suffix.lower() == SUFFIX else presses_text(presses).encode()
    )


def presses_text(presses: MeasuredPresses) -> str:
    """What `write_presses` writes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(presses.columns)
    for row in np.column_stack([*presses.columns.values()]).tolist():
        writer.writerow("" if value != value else repr(value) for value in row)
    return text.getvalue()


def _check_electrodes(electrodes: tuple[str, ...]) -> None:
    """Raise PressError if names of electrodes cannot be those of columns."""
    if not electrodes or len(set(electrodes)) < len(electrodes) or not all(electrodes):
        raise PressError(f"electrodes: expected one name or more, all different, none empty, got {shown(electrodes)}")
    for name in electrodes:
        if name in KINDS or "\n" in name or "\r" in name:
            raise PressError(
                f"electrode {shown(name)}: expected a name of one line that is none of {', '.join(KINDS)}, which are "
                "columns of a file of presses; rename the electrode"
            )


@contextmanager
def _open_table(path: Path, names: Sequence[str], expected: str) -> Iterator[CsvNumbers]:
    """The table of an open file; `names` have a meaning, and `expected` are those that the header should have."""
    header = f"a header with {expected}"
    if Path(path).suffix.lower() == SUFFIX:
        yield CsvNumbers(parquet_lines(Path(path)), names, str(path), PressError, header)
        return
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            yield CsvNumbers(bounded_lines(file), names, str(path), PressError, header)
    except OSError as error:
        raise PressError(f"{path}: cannot be read ({error.strerror}); expected a CSV file of presses") from error


def _values(table: CsvNumbers, columns: dict[str, int], electrodes: Sequence[str]) -> tuple[tuple[int, ...], Array]:
    """Lines, and the numbers of the columns, shape (n, columns); NaN for an empty cell."""
    lines, values = array("q"), array("d")
    for line, row in table.rows(columns, KINDS | dict.fromkeys(electrodes, CHARGE)):
        lines.append(line)
        values.extend(row)
        if len(lines) > MOST_ROWS:
            raise PressError(f"{table.where}: expected at most {MOST_ROWS:,} presses, got more; split the file")
    if not lines:
        raise PressError(f"{table.where}: expected one press or more below the header, got none")
    return tuple(lines), np.array(values, dtype=np.float64).reshape(len(lines), -1)
