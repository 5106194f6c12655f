"""Named columns of numbers from a file: the checks of names, values and rows that all formats share.

Each format is a subclass of `NumberTable`. The subclass reads the header, and converts the requested columns to float64
arrays in which NaN stands for an empty cell. All further checks are in this module, so that the same fault gets the
same message in every format.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import ClassVar, NoReturn

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import InputError, shown
from isocharge.common.tables.header_advice import ColumnMeaning, header_advice

MAX_COLUMNS = 1_000
"""Largest number of columns of a file."""

LARGEST = float(np.finfo(np.float32).max)
"""Largest magnitude of a number in a file.

It is the largest float32 number, because the tensors of the models are float32.
"""

MAX_LISTED_NAMES = 10
"""Largest number of column names that an error message lists."""


@dataclass(frozen=True)
class ColumnRule:
    """The numbers that a column may hold.

    Attributes:
        description: Description of the expected cell for messages, such as "a force in N".
        minimum: Smallest number that is accepted.
        maximum: Largest number that is accepted.
        is_positive: Whether only numbers above zero are accepted.
        may_be_empty: Whether empty cells are accepted.
        meaning: Names that other programs use for the column, for advice about a header.
    """

    description: str
    minimum: float = -LARGEST
    maximum: float = LARGEST
    is_positive: bool = False
    may_be_empty: bool = True
    meaning: ColumnMeaning = field(default_factory=ColumnMeaning)

    def violations(self, values: Array) -> Booleans:
        """Return a mask of the values that violate the rule, shape (n,). NaN stands for an empty cell."""
        is_empty = np.isnan(values)
        # Comparisons with NaN are false, so that an empty cell is not outside of the limits.
        is_outside = (values < self.minimum) | (values > self.maximum)
        if self.is_positive:
            is_outside |= values <= 0.0
        if not self.may_be_empty:
            is_outside |= is_empty
        return np.asarray(is_outside)


CHARGE_RULE = ColumnRule("a charge in pC", meaning=ColumnMeaning("electrode", "pC"))
"""Rule of the columns of charges."""


@dataclass(frozen=True)
class NumberColumns:
    """Columns of numbers, and the numbers of the rows from which they were read.

    Attributes:
        values: The columns by name, each of shape (n,); NaN for an empty cell.
        row_numbers: Number of each row in the file, shape (n,).
        row_noun: What the row numbers count: "line" of a text, "row" of a table.
    """

    values: Mapping[str, Array]
    row_numbers: Integers
    row_noun: str

    def check(self, rules: Mapping[str, ColumnRule], where: str, error: type[InputError]) -> None:
        """Check the values of all columns.

        Args:
            rules: The rule of each column.
            where: Beginning of the message, for example the file with a comma and a blank; may be empty.
            error: Class of the error.

        Raises:
            error: If a value breaks a rule. The message names the first such row, the column, the rule and the value.
        """
        masks = [rules[name].violations(column) for name, column in self.values.items()]
        is_violation = np.column_stack(masks)  # shape (n, n_column)
        violations = np.argwhere(is_violation)  # row and column of each violation, ordered by rows
        if not violations.size:
            return
        row, column_index = violations[0]
        name = list(self.values)[column_index]
        value = _value_text(float(self.values[name][row]))
        raise error(
            f"{where}{self.row_noun} {self.row_numbers[row]}, column {shown(name)}: expected "
            f"{rules[name].description}, got {value}"
        )


def _value_text(value: float) -> str:
    """Return a number as text for an error message, with enough digits to recognise the number."""
    if np.isnan(value):
        return "an empty cell"
    short = f"{value:.6g}"
    if float(short) == value:
        return short
    return repr(value)


class NumberTable(ABC):
    """A file with a header and columns of numbers, which is read once.

    Attributes:
        header: Names of the columns.
        where: The file, for messages.
        error: Class of the error that is raised for anything that is wrong with the file.
        row_noun: What the row numbers of the format count, for messages.
    """

    row_noun: ClassVar[str]

    def __init__(
        self, header: Sequence[str], names: Collection[str], where: str, error: type[InputError], expected: str
    ) -> None:
        """Check the number of columns and store their names.

        Args:
            header: Names of the columns in the file.
            names: Names that have a meaning. Blanks at the ends of all other names are removed.
            where: The file, for messages.
            error: Class of the error that is raised for anything that is wrong with the file.
            expected: The expected header, for messages.

        Raises:
            error: If the file has too many columns.
        """
        if len(header) > MAX_COLUMNS:
            raise error(f"{where}: expected at most {MAX_COLUMNS:,} columns, got {len(header):,}")
        self.header = tuple(name if name in names else name.strip() for name in header)
        self.where = where
        self.error = error
        self.expected = expected

    def choose_columns(
        self, required: Mapping[str, ColumnRule], optional: Mapping[str, ColumnRule] | None = None
    ) -> dict[str, ColumnRule]:
        """Return the rules of the columns to read: all required columns, and the optional columns that the file has.

        Args:
            required: Rules of the required columns, by name.
            optional: Rules of the optional columns, by name.

        Raises:
            error: If a required column is missing, if the name of a column is similar to that of an absent optional
                column, or if the file has one of the columns twice. The message states which column to rename.
        """
        known_rules = {**required, **(optional or {})}
        chosen_rules = {name: rule for name, rule in known_rules.items() if name in self.header or name in required}
        other_columns = [name for name in self.header if name not in chosen_rules]

        missing_names = [name for name in required if name not in self.header]
        if missing_names:
            # A missing column may be in the file under another name.
            absent = {name: rule.meaning for name, rule in known_rules.items() if name not in self.header}
            advice = islice(header_advice(other_columns, absent), MAX_LISTED_NAMES)
            self._refuse_header("; ".join([f"missing: {_listed(missing_names)}", *advice]))

        repeated_names = [name for name in chosen_rules if self.header.count(name) > 1]
        if repeated_names:
            self._refuse_header(f"repeated: {_listed(repeated_names)}")
        self.refuse_similar_names(other_columns, optional or {})
        return chosen_rules

    def refuse_similar_names(self, columns: Iterable[str], optional: Mapping[str, ColumnRule]) -> None:
        """Raise `error` if the names of columns are similar to those of optional columns that the file does not have.

        Args:
            columns: Names of the columns.
            optional: Rules of the optional columns, by name.
        """
        absent = {name: rule.meaning for name, rule in optional.items() if name not in self.header}
        advice = list(islice(header_advice(columns, absent), MAX_LISTED_NAMES))
        if advice:
            self._refuse_header(f"{'; '.join(advice)}; or remove the column")

    def read(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Read columns and check their values.

        Args:
            rules: Rules of the columns to read, in the requested order, as `choose_columns` returns them.
            max_rows: Largest number of rows that is accepted.

        Raises:
            error: If the file is damaged or has more than `max_rows` rows, or if a cell breaks the rule of its column.
        """
        columns = self._read_columns(rules, max_rows)
        columns.check(rules, f"{self.where}, ", self.error)
        return columns

    @abstractmethod
    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Convert the requested columns to arrays without checking the values; see `read` for the arguments."""

    def _refuse_header(self, reason: str) -> NoReturn:
        raise self.error(f"{self.where}: expected {self.expected}, got the header {shown(list(self.header))}; {reason}")

    def _refuse_row_count(self, max_rows: int) -> NoReturn:
        raise self.error(f"{self.where}: expected at most {max_rows:,} presses, got more; split the file")


def _listed(names: Sequence[str]) -> str:
    """List names for a message. If there are more than `MAX_LISTED_NAMES` names, the message only counts the others."""
    listed = ", ".join(map(shown, names[:MAX_LISTED_NAMES]))
    if len(names) <= MAX_LISTED_NAMES:
        return listed
    return f"{listed} and {len(names) - MAX_LISTED_NAMES} more"


def ignored_columns_message(where: str, names: Sequence[str]) -> str:
    """Return a message that lists the ignored columns of a file.

    Args:
        where: Name of the file.
        names: Names of the ignored columns.
    """
    return f"{where}: ignored columns: {shown(list(names))}"
