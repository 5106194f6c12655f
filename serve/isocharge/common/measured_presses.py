"""Measured presses: charges of a film under presses. For each press, the position, the force or both are known.

A file of presses is CSV or Parquet with the columns `x_mm`, `y_mm`, `force_N` and one column for each electrode (pC),
in any order. An empty cell stands for an unknown value. A file may have four further columns:

    position_std_mm      standard deviation of x and of y, mm
    force_std            standard deviation of the force relative to the force: 0.01 is 1 %
    temperature_C        temperature of the ring of the film, degrees Celsius
    film_temperature_C   temperature of the film itself, or of the air at its surface, degrees Celsius

All other columns are ignored if the names of the electrodes are given. `isocharge serve predict` reads these files,
too.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import PressError, error_prefix, shown
from isocharge.common.tables.csv_table import csv_text
from isocharge.common.tables.header_advice import ColumnMeaning
from isocharge.common.tables.number_table import (
    CHARGE_RULE,
    MAX_COLUMNS,
    ColumnRule,
    NumberColumns,
    NumberTable,
)
from isocharge.common.tables.table_file import open_table, write_columns

POSITION_STD_MM = 0.1
"""Default standard deviation of a position, mm. It is typical of a stage that is set by hand."""

FORCE_STD = 0.01
"""Default standard deviation of a force relative to the force, dimensionless. It is typical of a simple load cell."""

MAX_ROWS = 1_000_000
"""Largest number of presses in a file."""

CONTACT = ("x_mm", "y_mm", "force_N")
UNCERTAINTY = ("position_std_mm", "force_std")

TEMPERATURE = "temperature_C"
FILM_TEMPERATURE = "film_temperature_C"
MIN_TEMPERATURE_C = -100.0
MAX_TEMPERATURE_C = 200.0
"""Range of temperatures that a film of PVDF may have."""

_POSITION = "a position in mm, or an empty cell if it is unknown"
_FORCE_WORDS = frozenset({"force", "kraft", "fuerza", "forza", "f", "load", "last"})

_TEMPERATURE_RULE = ColumnRule(
    f"a temperature of {MIN_TEMPERATURE_C:g} to {MAX_TEMPERATURE_C:g} degrees Celsius, or an empty cell if it is "
    "unknown",
    MIN_TEMPERATURE_C,
    MAX_TEMPERATURE_C,
)

PRESS_RULES = {
    "x_mm": ColumnRule(_POSITION, meaning=ColumnMeaning(unit="mm", words=frozenset({"x"}))),
    "y_mm": ColumnRule(_POSITION, meaning=ColumnMeaning(unit="mm", words=frozenset({"y"}))),
    "force_N": ColumnRule(
        "a positive force in N, or an empty cell if it is unknown",
        is_positive=True,
        meaning=ColumnMeaning(unit="N", words=_FORCE_WORDS, is_known_by_unit=True),
    ),
    "position_std_mm": ColumnRule("a positive standard deviation in mm", is_positive=True),
    "force_std": ColumnRule("a positive share of the force up to 1 (0.01 is 1 %)", maximum=1.0, is_positive=True),
    TEMPERATURE: _TEMPERATURE_RULE,
    FILM_TEMPERATURE: _TEMPERATURE_RULE,
}
"""The columns of a file of presses that are not electrodes."""

MAX_ELECTRODES = MAX_COLUMNS - len(PRESS_RULES)
"""Largest number of electrodes in a file of presses."""

MAX_NAME_CHARACTERS = 1_000
"""Largest number of characters of the name of an electrode in a file of presses."""


@dataclass(frozen=True, eq=False)
class MeasuredPresses:
    """Charges and contacts of n measured presses.

    Two objects are equal if they have the same values and electrodes, even if they come from different lines of a file.

    Attributes:
        contact: x_mm, y_mm and force_N, shape (n, 3); NaN if unknown. Either both x and y are known, or neither.
        charge_pC: Touch charges, shape (n, electrodes), pC; NaN if unknown. At least one charge of each press is known.
        position_std_mm: Standard deviation of x and of y, shape (n,), mm.
        force_std: Standard deviation of the force relative to the force, shape (n,), dimensionless.
        electrodes: Names of the electrodes, in the order of the charges.
        lines: Number of each press in its file, for messages: the line of a CSV file, or the row of a Parquet file. If
            there is no file, the presses are numbered from 1.
        ignored: Columns of the file that were not read.
        temperature_C: Temperature of the ring of the film, shape (n,), degrees Celsius; NaN if unknown, None if it is
            unknown for all presses.
        film_temperature_C: Temperature of the film or of the air at its surface, shape (n,), degrees Celsius. An
            unknown temperature is NaN. If all temperatures are unknown, the attribute is None. It is only allowed
            together with `temperature_C`.
        row_noun: What `lines` counts, for messages: "line", "row" or "press".

    Raises:
        PressError: If the shapes do not fit each other, or a value is not allowed. The message names the line and the
            column.
    """

    contact: Array
    charge_pC: Array
    position_std_mm: Array
    force_std: Array
    electrodes: tuple[str, ...]
    lines: tuple[int, ...]
    ignored: tuple[str, ...] = ()
    temperature_C: Array | None = None
    row_noun: str = "line"
    film_temperature_C: Array | None = None

    def __post_init__(self) -> None:
        _check_electrodes(self.electrodes)
        self._check_shapes()
        self._check_values()

    def __len__(self) -> int:
        return len(self.lines)

    def __getitem__(self, rows: int | slice | Sequence[int] | Integers | Booleans) -> "MeasuredPresses":
        """Return the presses that an index, several indices, a slice or a mask selects."""
        indices = np.atleast_1d(np.arange(len(self))[rows])
        return replace(
            self,
            contact=self.contact[indices],
            charge_pC=self.charge_pC[indices],
            position_std_mm=self.position_std_mm[indices],
            force_std=self.force_std[indices],
            temperature_C=None if self.temperature_C is None else self.temperature_C[indices],
            film_temperature_C=None if self.film_temperature_C is None else self.film_temperature_C[indices],
            lines=tuple(self.lines[index] for index in indices),
        )

    @property
    def placed(self) -> Booleans:
        """Whether both the position and the force of each press are known, shape (n,)."""
        return np.asarray(np.isfinite(self.contact).all(axis=1))

    @property
    def knows_temperature(self) -> bool:
        """Whether the temperature of at least one press is known."""
        return self.temperature_C is not None and not bool(np.isnan(self.temperature_C).all())

    @property
    def knows_film_temperature(self) -> bool:
        """Whether the temperature of the film itself is known for at least one press."""
        return self.film_temperature_C is not None and not bool(np.isnan(self.film_temperature_C).all())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, MeasuredPresses):
            return NotImplemented
        own_columns = self.columns
        other_columns = other.columns
        return list(own_columns) == list(other_columns) and all(
            np.array_equal(column, other_columns[name], equal_nan=True) for name, column in own_columns.items()
        )

    def of_electrodes(self, electrodes: Sequence[str], owner: str) -> "MeasuredPresses":
        """Return the same presses with the charges of some electrodes, in the given order.

        Args:
            electrodes: Names of the electrodes.
            owner: Object that has these electrodes, for the error message, such as "the model".

        Raises:
            PressError: If one of the electrodes is missing.
        """
        names = tuple(electrodes)
        missing = [name for name in names if name not in self.electrodes]
        if missing:
            raise PressError(
                f"expected charges of the electrodes {names} of {owner}, got {self.electrodes}; "
                f"missing: {', '.join(map(shown, missing))}"
            )
        order = [self.electrodes.index(name) for name in names]
        return replace(self, charge_pC=self.charge_pC[:, order], electrodes=names)

    @property
    def columns(self) -> dict[str, Array]:
        """Columns of a file of these presses by their names, each of shape (n,).

        A column of temperatures is omitted if it would be empty for every press.
        """
        columns = dict(zip(CONTACT, self.contact.T, strict=True))  # x_mm, y_mm and force_N
        columns |= dict(zip(self.electrodes, self.charge_pC.T, strict=True))
        columns |= {"position_std_mm": self.position_std_mm, "force_std": self.force_std}

        # The comparisons with None are only needed by type checkers.
        if self.temperature_C is not None and self.knows_temperature:
            columns[TEMPERATURE] = self.temperature_C
        if self.film_temperature_C is not None and self.knows_film_temperature:
            columns[FILM_TEMPERATURE] = self.film_temperature_C
        return columns

    def _check_shapes(self) -> None:
        """Raise PressError if an array does not have one row for each press, or one charge for each electrode."""
        press_count = len(self.lines)
        expected_shapes: dict[str, tuple[int, ...]] = {
            "contact": (press_count, len(CONTACT)),
            "charge_pC": (press_count, len(self.electrodes)),
            "position_std_mm": (press_count,),
            "force_std": (press_count,),
        }
        if self.temperature_C is not None:
            expected_shapes["temperature_C"] = (press_count,)
        if self.film_temperature_C is not None:
            expected_shapes["film_temperature_C"] = (press_count,)
        for name, shape in expected_shapes.items():
            given_shape = getattr(self, name).shape
            if given_shape != shape:
                raise PressError(f"{name}: expected an array of shape {shape}, got {given_shape}")

    def _check_values(self) -> None:
        """Raise PressError if a number is not allowed, if only one of x and y is given, or if no charge is given."""
        # The columns have the same rules as in a file, except that all standard deviations must be known.
        rules = PRESS_RULES | dict.fromkeys(self.electrodes, CHARGE_RULE)
        for name in UNCERTAINTY:
            rules[name] = replace(rules[name], may_be_empty=False)
        columns = NumberColumns(self.columns, np.array(self.lines, dtype=np.intp), self.row_noun)
        columns.check(rules, where="", error=PressError)  # the caller knows the file, if there is one

        if self.knows_film_temperature and not self.knows_temperature:
            raise PressError(
                f"{FILM_TEMPERATURE}: expected also the temperature of the ring in the column {TEMPERATURE}, got none; "
                "measure both, because their difference changes the pretension"
            )
        x_is_unknown = np.isnan(self.contact[:, CONTACT.index("x_mm")])
        y_is_unknown = np.isnan(self.contact[:, CONTACT.index("y_mm")])
        self._refuse_first(
            x_is_unknown != y_is_unknown,
            "expected both x_mm and y_mm, or two empty cells, got one of them; give the other",
        )
        self._refuse_first(
            np.asarray(np.isnan(self.charge_pC).all(axis=1)),
            f"expected a charge of one electrode or more, got none; fill it in or remove the {self.row_noun}",
        )

    def _refuse_first(self, refused: Booleans, reason: str) -> None:
        """Raise PressError for the first press that a mask selects, if it selects any."""
        rows = np.flatnonzero(refused)
        if rows.size:
            raise PressError(f"{self.row_noun} {self.lines[rows[0]]}: {reason}")


def read_presses(
    path: Path,
    electrodes: Sequence[str] | None = None,
    *,
    position_std_mm: float = POSITION_STD_MM,
    force_std: float = FORCE_STD,
) -> MeasuredPresses:
    """Read a file of measured presses.

    Args:
        path: CSV in UTF-8, with or without byte order mark; or Parquet, if its name ends in `.parquet`. It may have up
            to `MAX_ROWS` presses.
        electrodes: Names of the electrodes, in the requested order of the charges. If absent, all columns without
            another meaning are electrodes.
        position_std_mm: Standard deviation of x and of y where the file has none, mm.
        force_std: Standard deviation of a force where the file has none, relative to the force.

    Raises:
        PressError: If the file cannot be used. The message names file, line and column, what was expected, what was
            given and what to do.
        MissingExtra: If the file is Parquet and pyarrow is not installed.
    """
    path = Path(path)
    default_stds = {"position_std_mm": position_std_mm, "force_std": force_std}
    for name, std in default_stds.items():
        if not 0.0 < std <= PRESS_RULES[name].maximum:
            raise PressError(f"{name}: expected {PRESS_RULES[name].description}, got {std:g}")

    # Read the columns of the file that are electrodes or have another meaning for a press (`PRESS_RULES`).
    expected_electrodes = "the electrodes' names" if electrodes is None else f"the electrodes {tuple(electrodes)}"
    expected_header = f"a header with {', '.join(CONTACT)} and {expected_electrodes} (charges in pC)"
    names_with_meaning = (*(electrodes or ()), *PRESS_RULES)
    with open_table(path, names_with_meaning, PressError, expected_header) as table:
        electrode_names = _electrode_columns(table) if electrodes is None else tuple(electrodes)
        with error_prefix(f"{path}: ", PressError):
            _check_electrodes(electrode_names)
        chosen_rules = table.choose_columns(dict.fromkeys(electrode_names, CHARGE_RULE), optional=PRESS_RULES)
        columns = table.read(chosen_rules, MAX_ROWS)
        ignored_names = tuple(name for name in table.header if name not in chosen_rules)
    press_count = len(columns.row_numbers)
    if press_count == 0:
        raise PressError(f"{path}: expected one press or more below the header, got none")

    # Columns that the file does not have become NaN. Missing standard deviations get their default values.
    absent_column = np.full(press_count, np.nan)
    values = {name: columns.values.get(name, absent_column) for name in (*electrode_names, *PRESS_RULES)}
    for name, std in default_stds.items():
        values[name] = np.where(np.isnan(values[name]), std, values[name])
    with error_prefix(f"{path}, ", PressError):
        return MeasuredPresses(
            contact=np.column_stack([values[name] for name in CONTACT]),
            charge_pC=np.column_stack([values[name] for name in electrode_names]),
            position_std_mm=values["position_std_mm"],
            force_std=values["force_std"],
            electrodes=electrode_names,
            lines=tuple(columns.row_numbers.tolist()),
            ignored=ignored_names,
            temperature_C=_none_if_unknown(values[TEMPERATURE]),
            row_noun=columns.row_noun,
            film_temperature_C=_none_if_unknown(values[FILM_TEMPERATURE]),
        )


def _none_if_unknown(temperature_C: Array) -> Array | None:
    """Return a column of temperatures, shape (n,), degrees Celsius, or None if all temperatures are NaN."""
    return None if np.isnan(temperature_C).all() else temperature_C


def _electrode_columns(table: NumberTable) -> tuple[str, ...]:
    """Return the names of the columns without another meaning, which are assumed to be electrodes.

    Raises:
        PressError: If the name of a column has several characters and is similar to a name in `PRESS_RULES`. The
            column is then probably misspelt.
    """
    electrodes = tuple(name for name in table.header if name and name not in PRESS_RULES)
    long_names = [name for name in electrodes if len(name) > 1]
    table.refuse_similar_names(long_names, PRESS_RULES)
    return electrodes


def read_press_list(path: Path) -> Array:
    """Read the presses that a machine makes, in their order.

    Args:
        path: CSV or Parquet file with the columns x_mm, y_mm and force_N; see `read_presses`. Other columns are
            ignored.

    Returns:
        Position and force (x, y, F) of each press, shape (n, 3), mm and N. Empty cells of the file are NaN.

    Raises:
        PressError: If the file cannot be read, or a row is not a press. The message names the line and the column.
        MissingExtra: If the file is Parquet and pyarrow is not installed.
    """
    path = Path(path)
    with open_table(path, CONTACT, PressError, f"a header with {', '.join(CONTACT)}") as table:
        rules = table.choose_columns({name: PRESS_RULES[name] for name in CONTACT})
        columns = table.read(rules, MAX_ROWS)
    press_count = len(columns.row_numbers)
    if press_count == 0:
        raise PressError(f"{path}: expected one press or more below the header, got none")
    contact = np.column_stack([columns.values[name] for name in CONTACT])
    with error_prefix(f"{path}, ", PressError):
        # The object is created only because it checks the contacts. Its other values are arbitrary valid values.
        MeasuredPresses(
            contact=contact,
            charge_pC=np.zeros((press_count, 1)),
            position_std_mm=np.ones(press_count),
            force_std=np.ones(press_count),
            electrodes=("charge",),
            lines=tuple(columns.row_numbers.tolist()),
            row_noun=columns.row_noun,
        )
    return contact


def write_presses(path: Path, presses: MeasuredPresses) -> None:
    """Write presses to a file from which `read_presses` reads the same numbers. An existing file is replaced.

    Args:
        path: The file. Its format is Parquet if its name ends in `.parquet`, and otherwise CSV.
        presses: The presses.

    Raises:
        PressError: If there are no presses, or more than `MAX_ROWS` presses.
        OutputError: If the file cannot be written.
        MissingExtra: If the format is Parquet and pyarrow is not installed.
    """
    if not 0 < len(presses) <= MAX_ROWS:
        raise PressError(f"{path}: expected 1 to {MAX_ROWS:,} presses to write, got {len(presses):,}")
    write_columns(Path(path), presses.columns)


def presses_text(presses: MeasuredPresses) -> str:
    """Return the CSV text that `write_presses` writes."""
    return csv_text(presses.columns)


def row_words(rows: Sequence[int], row_noun: str, max_listed: int = 10) -> str:
    """Return the lines or rows of presses in a file as text for a message, as in "line 3" or "rows 3, 4 and 12 more".

    Args:
        rows: Numbers of the presses in their file.
        row_noun: What the numbers count, such as "line", "row" or "press".
        max_listed: Largest number of presses that are listed. The message only counts the others.
    """
    plural = f"{row_noun}es" if row_noun.endswith("s") else f"{row_noun}s"
    noun = row_noun if len(rows) == 1 else plural
    listed = ", ".join(map(str, rows[:max_listed]))
    if len(rows) <= max_listed:
        return f"{noun} {listed}"
    return f"{noun} {listed} and {len(rows) - max_listed} more"


def _check_electrodes(electrodes: Collection[str]) -> None:
    """Raise PressError if names of electrodes cannot be the names of columns in a file of presses."""
    are_different = len(set(electrodes)) == len(electrodes)
    has_empty_name = any(name == "" for name in electrodes)
    if not electrodes or not are_different or has_empty_name:
        raise PressError(f"electrodes: expected one name or more, all different, none empty, got {shown(electrodes)}")
    if len(electrodes) > MAX_ELECTRODES:
        raise PressError(f"electrodes: expected at most {MAX_ELECTRODES} names, got {len(electrodes):,}")
    for name in electrodes:
        if name in PRESS_RULES:
            raise PressError(
                f"electrode {shown(name)}: expected a name that is none of {', '.join(PRESS_RULES)}, which are columns "
                "of a file of presses; rename the electrode"
            )
        if not name.isprintable() or name != name.strip() or len(name) > MAX_NAME_CHARACTERS:
            raise PressError(
                f"electrode {shown(name)}: expected a name of at most {MAX_NAME_CHARACTERS:,} printable characters "
                "without blanks at its ends, because the name is the header of a column of charges; rename the "
                "electrode"
            )
