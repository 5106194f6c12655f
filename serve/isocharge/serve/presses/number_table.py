"""Named columns of numbers from a file, and the checks that all file formats share.

Each file format is a subclass of `NumberTable`. The subclass reads the header, and converts the requested columns to
float64 arrays in which NaN stands for an empty cell. All other checks are in this module. The same mistake in a file
therefore leads to the same message in every format.
"""

import logging
import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from isocharge.common.arrays import LARGEST, Array, Booleans
from isocharge.common.errors import InputError, shown

log = logging.getLogger(__name__)

MAX_COLUMNS = 1_000
"""Largest number of columns of a file."""


@dataclass(frozen=True)
class ColumnRule:
    """Rule that states which numbers a column may contain.

    Attributes:
        description: Description of a correct cell for messages, such as "a force in N".
        maximum: Largest number that is accepted.
        is_positive: Whether only numbers above zero are accepted.
        may_be_empty: Whether empty cells are accepted.
    """

    description: str
    maximum: float = LARGEST
    is_positive: bool = False
    may_be_empty: bool = True

    def violations(self, values: Array) -> Booleans:
        """Compute which values of a column violate the rule.

        Args:
            values: Values of the column, shape (n,); NaN for an empty cell.

        Returns:
            Whether each value violates the rule, shape (n,).
        """
        # Comparisons with NaN are false, so these comparisons accept empty cells.
        is_violation = (values < -LARGEST) | (values > self.maximum)
        if self.is_positive:
            is_violation |= values <= 0.0
        if not self.may_be_empty:
            is_violation |= np.isnan(values)
        return is_violation


CHARGE_RULE = ColumnRule("a charge in pC")
"""Rule of the columns of charges."""


@dataclass(frozen=True)
class NumberColumns:
    """Columns of numbers, and the positions of their rows in the file.

    Attributes:
        values: The columns by their names, each of shape (n,); NaN for an empty cell.
        row_numbers: Number of the line or row in the file from which each row was read.
        row_noun: What the row numbers count: "line" for the lines of a text, or "row" for the rows of a table.
    """

    values: Mapping[str, Array]
    row_numbers: Sequence[int]
    row_noun: str

    def check(self, rules: Mapping[str, ColumnRule], where: str, error_class: type[InputError]) -> None:
        """Check that all values comply with the rules of their columns.

        Args:
            rules: Rules by the names of the columns.
            where: Beginning of the error message, such as "presses.csv, "; may be empty.
            error_class: Class of the error that is raised.

        Raises:
            error_class: If a value violates its rule. The message names the first wrong row, the column, the rule and
                the value.
        """
        violations_of_columns = [rules[name].violations(column) for name, column in self.values.items()]
        is_violation = np.column_stack(violations_of_columns)  # shape (n, n_column)
        positions = np.argwhere(is_violation)  # row and column of each violation, ordered by rows
        if not positions.size:
            return
        row, column_index = positions[0]  # the first violation
        name = list(self.values)[column_index]
        value = float(self.values[name][row])
        text = "an empty cell" if np.isnan(value) else f"{value:.15g}"
        raise error_class(
            f"{where}{self.row_noun} {self.row_numbers[row]}, column {shown(name)}: expected "
            f"{rules[name].description}, got {text}"
        )


_UNITS_AT_END = {"length": "[µμnmc]?m", "force": "(?:[µμmk]?n|m?k?gf?)", "charge": "[µμfpn]?c"}
"""Patterns of units in lower case that may stand at the end of the name of a column, by their quantity."""


@dataclass(frozen=True)
class TableSource:
    """File of a table, for its reader and for error messages.

    Attributes:
        names: Names of columns that have a meaning. These names are kept unchanged.
        where: Name of the file.
        error_class: Class of the error that is raised for every mistake in the file.
        expected: Description of the expected header.
    """

    names: Collection[str]
    where: str
    error_class: type[InputError]
    expected: str

    def error(self, message: str) -> InputError:
        """Return an error whose message consists of the name of the file and the given text."""
        return self.error_class(f"{self.where}{message}")


class NumberTable(ABC):
    """Base class for a file with a header and columns of numbers. The columns can be read only once.

    Every mistake in the file raises the error class of `source`.

    Attributes:
        header: Names of the columns in the file.
        source: The file.
    """

    def __init__(self, header: Sequence[str], source: TableSource) -> None:
        """Check the number of columns, and store the names of the columns without blanks at their ends.

        Args:
            header: Names of the columns in the file.
            source: The file.

        Raises:
            InputError: If the file has too many columns.
        """
        if len(header) > MAX_COLUMNS:
            raise source.error(f": expected at most {MAX_COLUMNS:,} columns, got {len(header):,}")
        self.header = tuple(name if name in source.names else name.strip() for name in header)
        self.source = source

    def read(
        self, required: Mapping[str, ColumnRule], optional: Mapping[str, ColumnRule], max_rows: int
    ) -> NumberColumns:
        """Read all required columns and the optional columns that the file contains, and check their values.

        A warning lists all other columns of the file, which are ignored.

        Args:
            required: Rules of the required columns, by the names of the columns.
            optional: Rules of the optional columns, by the names of the columns.
            max_rows: Largest number of rows that is accepted.

        Returns:
            The required columns, and then the optional columns.

        Raises:
            InputError: If a required column is missing, if one of these columns occurs twice, if the name of a
                column is almost that of a column that the file does not contain, such as `a (pC)` for `A`, if the file
                is damaged or has more than `max_rows` rows, or if a cell violates the rule of its column.
        """
        known_rules = {**required, **optional}
        self.refuse_similar_names((name for name in self.header if name not in known_rules), known_rules)
        missing_names = [name for name in required if name not in self.header]
        if missing_names:
            self._refuse_header("missing", missing_names)
        chosen_rules = {name: rule for name, rule in known_rules.items() if name in self.header}
        repeated_names = [name for name in chosen_rules if self.header.count(name) > 1]
        if repeated_names:
            self._refuse_header("repeated", repeated_names)
        ignored_names = [name for name in self.header if name not in chosen_rules]
        if ignored_names:
            log.warning("%s: ignored columns: %s", self.source.where, shown(ignored_names))
        columns = self._read_columns(chosen_rules, max_rows)
        columns.check(chosen_rules, f"{self.source.where}, ", self.source.error_class)
        return columns

    def refuse_similar_names(self, columns: Iterable[str], names: Iterable[str]) -> None:
        """Refuse a column whose name differs from that of a missing column by case, brackets, blanks or its unit.

        Args:
            columns: Names of the columns of the file that are checked.
            names: Names of columns that have a meaning.

        Raises:
            InputError: If a column has such a name.
        """
        absent_names = {
            spelling: name
            for name in names
            if name not in self.header
            for spelling in _spellings(name) | _spellings(f"{name}_pC")
        }
        for column in columns:
            for spelling in _spellings(column) & absent_names.keys():
                name = absent_names[spelling]
                advice = f"rename {shown(column)} to {shown(name)} and check its unit, or remove the column"
                self._refuse_header(f"{advice}; missing", [name])

    @abstractmethod
    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Convert the requested columns to arrays, without checking the values. `read` describes the arguments."""

    def _refuse_header(self, reason: str, names: Sequence[str]) -> NoReturn:
        """Raise the error for a wrong header.

        Args:
            reason: What is wrong with some names, for the error message.
            names: These names.

        Raises:
            InputError: Always.
        """
        raise self.source.error(
            f": expected {self.source.expected}, got the header {shown(list(self.header))}; {reason}: {shown(names)}"
        )

    def _refuse_row_count(self, max_rows: int) -> NoReturn:
        """Raise the error for a file that has more than `max_rows` rows, which are the most that are accepted.

        Raises:
            InputError: Always.
        """
        raise self.source.error(f": expected at most {max_rows:,} presses, got more; split the file")


def _spellings(name: str) -> set[str]:
    """Return the letters and digits of a name in lower case, and the same with the quantity instead of a unit."""
    with_quantity = name.casefold()
    for quantity, unit in _UNITS_AT_END.items():
        with_quantity = re.sub(rf"[\W_]{unit}[\W_]*$", quantity, with_quantity)
    return {re.sub(r"[\W_]+", "", text) for text in (name.casefold(), with_quantity)}
