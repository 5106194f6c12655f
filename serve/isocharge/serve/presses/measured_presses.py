"""Presses on a film, together with the charges that were measured during each press.

For each press, the position, the force or both may also be known. A file of presses is a CSV file with the columns
`x_mm`, `y_mm`, `force_N` and one column for the charges of each electrode in pC. The columns may be in any order. An
empty cell stands for an unknown value. The file may have three further columns:

    position_std_mm   standard deviation of x and of y, mm
    force_std         standard deviation of the force relative to the force: 0.01 is 1 %
    temperature_C     temperature of the ring of the film, for the reader of the file; it is not used

If the names of the electrodes are given, all other columns are ignored. If no names are given, all columns without
another meaning are assumed to be electrodes. `isocharge serve predict` also reads files of presses.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import PressError, cut, error_context, shown
from isocharge.common.files import as_output_errors, write_whole
from isocharge.serve.presses.number_columns import CHARGE_RULE, ColumnRule, NumberColumns
from isocharge.serve.presses.table_file import MAX_COLUMNS, CsvTable, csv_text, open_table

POSITION_STD_MM = 0.1
"""Default standard deviation of a position, mm. This value is typical of a stage that is set by hand."""

FORCE_STD = 0.01
"""Default standard deviation of a force relative to the force, dimensionless. This value is typical of a simple load
cell."""

PLACE_STEP_mm = 0.02
"""Largest distance between neighbouring positions that count as one place, mm. The noise of encoders is smaller."""

MAX_ROWS = 1_000_000
"""Largest number of presses in a file."""

CONTACT = ("x_mm", "y_mm", "force_N")
"""Names of the columns of the position and the force."""

TEMPERATURE = "temperature_C"
"""Name of a column that is not used and that does not count as an electrode."""

_POSITION = "a position in mm, or an empty cell if it is unknown"

PRESS_RULES = {
    "x_mm": ColumnRule(_POSITION),
    "y_mm": ColumnRule(_POSITION),
    "force_N": ColumnRule("a positive force in N, or an empty cell if it is unknown", is_positive=True),
    "position_std_mm": ColumnRule("a positive standard deviation in mm", is_positive=True),
    "force_std": ColumnRule("a positive share of the force up to 1 (0.01 is 1 %)", maximum=1.0, is_positive=True),
}
"""Rules of the columns that are not electrodes, by the names of the columns in a file of presses."""

MAX_ELECTRODES = MAX_COLUMNS - len(PRESS_RULES)
"""Largest number of electrodes in a file of presses."""


@dataclass(frozen=True, eq=False)
class MeasuredPresses:
    """Charges, positions and forces of n measured presses.

    Attributes:
        contact: Position and force (x_mm, y_mm, force_N) of each press, shape (n, 3); NaN if unknown. Either both x and
            y are known, or neither is known.
        charge_pC: Touch charges, shape (n, electrodes), pC; NaN if unknown. At least one charge of each press is known.
        position_std_mm: Standard deviation of x and of y, shape (n,), mm.
        force_std: Standard deviation of the force relative to the force, shape (n,), dimensionless.
        electrodes: Names of the electrodes, in the order of the charges.
        lines: Number of the line of each press in a file, for messages. Presses that do not come from a file are
            numbered from 1.
        ignored: Names of the columns of the file that were not read.

    Raises:
        PressError: If the arrays have inconsistent shapes, or a value is not allowed. For a wrong value, the message
            names the line and the column.
    """

    contact: Array
    charge_pC: Array
    position_std_mm: Array
    force_std: Array
    electrodes: tuple[str, ...]
    lines: tuple[int, ...]
    ignored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the names of the electrodes, the shapes of the arrays and all values."""
        _check_electrodes(self.electrodes)
        count = len(self.lines)  # each press has a line number
        # Shapes of contact, charge_pC, position_std_mm and force_std. A contact has the three values `CONTACT`.
        expected = ((count, len(CONTACT)), (count, len(self.electrodes)), (count,), (count,))
        shapes = tuple(array.shape for array in (self.contact, self.charge_pC, self.position_std_mm, self.force_std))
        if shapes != expected:
            raise PressError(
                "contact, charge_pC, position_std_mm and force_std: expected arrays of the shapes "
                f"{expected}, got {shapes}"
            )
        self._check_values()

    def __len__(self) -> int:
        """Return the number n of presses."""
        return len(self.lines)

    def __getitem__(self, rows: int | slice | Sequence[int] | Integers | Booleans) -> "MeasuredPresses":
        """Return the selected presses.

        Args:
            rows: Index of one press, indices of several presses, a slice, or a mask of shape (n,).
        """
        indices = np.atleast_1d(np.arange(len(self))[rows])  # converts every kind of argument to an array of indices
        return replace(
            self,
            contact=self.contact[indices],
            charge_pC=self.charge_pC[indices],
            position_std_mm=self.position_std_mm[indices],
            force_std=self.force_std[indices],
            lines=tuple(self.lines[index] for index in indices),
        )

    @property
    def placed(self) -> Booleans:
        """Mask of the presses whose position and force are both known, shape (n,)."""
        return np.asarray(np.isfinite(self.contact).all(axis=1))

    @cached_property
    def same_place_count(self) -> Integers:
        """Number of presses at the place of each press, with the press itself, shape (n,); 0 at an unknown place.

        Presses at one place share the error of their position, so this error is hardly smaller for the mean of the
        presses. A calculation with independent errors therefore multiplies the variance of each position by this
        number.
        """
        x_mm, y_mm, _ = self.contact.T
        place = x_mm + 1j * y_mm
        return np.array([(np.abs(place - one) <= PLACE_STEP_mm).sum() for one in place])

    def of_electrodes(self, electrodes: Sequence[str], owner: str) -> "MeasuredPresses":
        """Return the same presses with only the charges of the given electrodes, in the given order.

        Args:
            electrodes: Names of the electrodes.
            owner: Object to which the electrodes belong, for the error message, such as "the model".

        Raises:
            PressError: If the presses contain no charges of one of the electrodes.
        """
        names = tuple(electrodes)
        missing_names = [name for name in names if name not in self.electrodes]
        if missing_names:
            raise PressError(
                f"expected charges of the electrodes {names} of {owner}, got {self.electrodes}; "
                f"missing: {', '.join(map(shown, missing_names))}"
            )
        column_indices = [self.electrodes.index(name) for name in names]
        return replace(self, charge_pC=self.charge_pC[:, column_indices], electrodes=names)

    @property
    def line_words(self) -> str:
        """Line numbers of the presses for a message, such as "line 3" or "lines 3, 4, 7".

        Only the first line numbers are listed.
        """
        return f"{'line' if len(self) == 1 else 'lines'} {cut(', '.join(map(str, self.lines)))}"

    @property
    def columns(self) -> dict[str, Array]:
        """Columns of a file of these presses, as a dictionary from names of columns to arrays of shape (n,)."""
        columns = dict(zip(CONTACT, self.contact.T, strict=True))  # x_mm, y_mm and force_N
        columns |= dict(zip(self.electrodes, self.charge_pC.T, strict=True))
        return columns | {"position_std_mm": self.position_std_mm, "force_std": self.force_std}

    def _check_values(self) -> None:
        """Check the values of all presses.

        Raises:
            PressError: If a number is not allowed, if only one of x and y is known, or if no charge of a press is
                known.
        """
        # The columns have the same rules as the columns of a file, except that all standard deviations must be known.
        rules = PRESS_RULES | dict.fromkeys(self.electrodes, CHARGE_RULE)
        for name in ("position_std_mm", "force_std"):
            rules[name] = replace(rules[name], may_be_empty=False)
        columns = NumberColumns(self.columns, self.lines)  # `self.columns` are arrays by the names of the columns
        # The message does not begin with the name of a file, because only the caller knows the file, if there is one.
        columns.check(rules, where="", error_class=PressError)

        _refuse_single_coordinates(columns)
        has_no_charge = np.isnan(self.charge_pC).all(axis=1)
        if has_no_charge.any():
            raise PressError(
                f"line {self.lines[has_no_charge.argmax()]}: expected a charge of one electrode or more, got none; "
                "fill it in or remove the line"
            )


def _refuse_single_coordinates(columns: NumberColumns) -> None:
    """Raise an error for the first press for which only one of the two coordinates x and y is known.

    Args:
        columns: Columns of the presses, with `x_mm` and `y_mm`.

    Raises:
        PressError: If there is such a press.
    """
    # Whether exactly one coordinate of each press is known
    is_half = np.isnan(columns.values["x_mm"]) != np.isnan(columns.values["y_mm"])
    if is_half.any():
        raise PressError(
            f"line {columns.lines[is_half.argmax()]}: expected both x_mm and y_mm, or two empty cells, got one of "
            "them; give the other"
        )


def read_presses(
    path: Path,
    electrodes: Sequence[str] | None = None,
    *,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> MeasuredPresses:
    """Read a file of measured presses.

    Args:
        path: The file, with up to `MAX_ROWS` presses.
        electrodes: Names of the electrodes, in the requested order of the charges. If None, all columns without another
            meaning are electrodes.
        position_std_mm: Standard deviation of x and of y, mm, for presses without a standard deviation in the file.
        force_std: Standard deviation of the force, relative to the force, for presses without a standard deviation of
            the force in the file.

    Raises:
        PressError: If the file cannot be used. The message names the file, the line and the column, and states what was
            expected, what was given and what the user can do.
    """
    default_stds = {"position_std_mm": position_std_mm, "force_std": force_std}
    for name, std in default_stds.items():
        is_allowed = 0.0 < std <= PRESS_RULES[name].maximum  # false for NaN
        if not is_allowed:
            raise PressError(f"{name}: expected {PRESS_RULES[name].description}, got {std:g}")

    # Read the columns of the file that are electrodes (required) or have another meaning for a press (optional). The
    # keys of `PRESS_RULES` are the names of the columns with another meaning. `open_table` recognises the header by the
    # known names.
    expected_electrodes = "the electrodes' names" if electrodes is None else f"the electrodes {tuple(electrodes)}"
    expected_header = f"a header with {', '.join(CONTACT)} and {expected_electrodes} (charges in pC)"
    with open_table(path, (*(electrodes or ()), *PRESS_RULES), PressError, expected_header) as table:
        electrode_names = _electrode_columns(table) if electrodes is None else tuple(electrodes)
        with error_context(PressError, f"{path}: "):
            _check_electrodes(electrode_names)
        columns = _read_rows(table, dict.fromkeys(electrode_names, CHARGE_RULE), PRESS_RULES)

    # `columns.values` is a dictionary of arrays by the names of the columns. Columns that the file does not have are
    # filled with NaN. Missing standard deviations get their default values.
    unknown_values = np.full(len(columns.lines), np.nan)
    values = {name: columns.values.get(name, unknown_values) for name in (*electrode_names, *PRESS_RULES)}
    for name, std in default_stds.items():
        values[name] = np.where(np.isnan(values[name]), std, values[name])
    with error_context(PressError, f"{path}, "):
        return MeasuredPresses(
            contact=np.column_stack([values[name] for name in CONTACT]),
            charge_pC=np.column_stack([values[name] for name in electrode_names]),
            position_std_mm=values["position_std_mm"],
            force_std=values["force_std"],
            electrodes=electrode_names,
            lines=tuple(columns.lines),
            ignored=tuple(name for name in table.header if name not in columns.values),
        )


def _read_rows(
    table: CsvTable, required: Mapping[str, ColumnRule], optional: Mapping[str, ColumnRule]
) -> NumberColumns:
    """Read columns of a file of presses; see `CsvTable.read`.

    Raises:
        PressError: If the file has no press, or the header or a cell is wrong.
    """
    columns = table.read(required, optional, MAX_ROWS)
    if len(columns.lines) == 0:
        raise table.error(": expected one press or more below the header, got none")
    return columns


def _electrode_columns(table: CsvTable) -> tuple[str, ...]:
    """Return the names of all columns without another meaning, which are assumed to be electrodes.

    Args:
        table: The table with the header of the file.

    Raises:
        PressError: If the name of a column is similar to a name in `PRESS_RULES`. The name is then probably misspelt.
    """
    other_names = (TEMPERATURE, *PRESS_RULES)
    electrodes = tuple(name for name in table.header if name and name not in other_names)
    table.refuse_similar_names(electrodes, other_names)
    return electrodes


def read_press_list(path: Path) -> Array:
    """Read the positions and forces of the presses that a machine will make, in the order of the rows of a file.

    Args:
        path: CSV file with the columns x_mm, y_mm and force_N; see `read_presses`. All other columns are ignored.

    Returns:
        Position and force (x, y, F) of each press, shape (n, 3), mm and N. Empty cells of the file are NaN.

    Raises:
        PressError: If the file cannot be read, or a row is not a press. The message names the line and the column.
    """
    # `CONTACT` are the names of the columns. All three are required, and no others are read.
    with open_table(path, CONTACT, PressError, f"a header with {', '.join(CONTACT)}") as table:
        columns = _read_rows(table, {name: PRESS_RULES[name] for name in CONTACT}, {})
    with error_context(PressError, f"{path}, "):
        _refuse_single_coordinates(columns)
    return np.column_stack([columns.values[name] for name in CONTACT])  # `columns.values` are arrays by name


def write_presses(path: Path, presses: MeasuredPresses) -> None:
    """Write presses to a file. An existing file is replaced.

    All numbers are written with all digits, so `read_presses` reads the same numbers from the file.

    Args:
        path: The file.
        presses: The presses.

    Raises:
        PressError: If there are no presses, or more than `MAX_ROWS` presses.
        OutputError: If the file cannot be written.
    """
    if not 0 < len(presses) <= MAX_ROWS:
        raise PressError(f"{path}: expected 1 to {MAX_ROWS:,} presses to write, got {len(presses):,}")
    path = Path(path)
    with as_output_errors(path):
        write_whole(path, csv_text(presses.columns).encode())


def _check_electrodes(electrodes: Collection[str]) -> None:
    """Check that the names of electrodes can be the names of columns in a file of presses.

    Args:
        electrodes: Names of the electrodes.

    Raises:
        PressError: If there are no names, if there are too many names, or if one of the names is not allowed.
    """
    are_different = len(set(electrodes)) == len(electrodes)
    are_names = all(
        name not in PRESS_RULES and name.isprintable() and name == name.strip() and name for name in electrodes
    )
    if not (0 < len(electrodes) <= MAX_ELECTRODES and are_different and are_names):
        raise PressError(
            f"electrodes: expected 1 to {MAX_ELECTRODES} different names of printable characters, without blanks "
            f"at their ends, none of {', '.join(PRESS_RULES)}, got {shown(electrodes)}; "
            "rename the electrodes"
        )
