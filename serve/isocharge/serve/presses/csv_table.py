"""Tables of numbers from files with the checks that all file formats share, and the format CSV.

Each file format is a subclass of `NumberTable`. The subclass reads the header, and converts the requested columns to
float64 arrays in which NaN stands for an empty cell. The base class makes all other checks. The same mistake in a file
therefore leads to the same message in every format.

The columns of CSV text are separated by commas, semicolons, tabs or bars. The header is the first row that contains a
name with a meaning; rows above it are ignored. The decimal mark is a point or a comma, and the same in the whole file.
A number such as `1,064` may be 1.064 or 1064. A file in which no number determines the decimal mark is therefore
refused. A point is always the decimal mark if commas separate the columns.

A row that begins with # is a comment. Blank rows, and a row below the header that has the units mm, N and pC in the
columns to read, are ignored. Blanks before and after a name or a number are also ignored. The texts `nan` and `inf` are
not accepted.
"""

import csv
import io
import logging
import math
import re
from abc import ABC, abstractmethod
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, islice
from typing import ClassVar, NoReturn

import numpy as np

from isocharge.common.arrays import LARGEST, Array, Booleans, Integers
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
        return np.asarray(is_violation)


CHARGE_RULE = ColumnRule("a charge in pC")
"""Rule of the columns of charges."""


@dataclass(frozen=True)
class NumberColumns:
    """Columns of numbers, and the positions of their rows in the file.

    Attributes:
        values: The columns by their names, each of shape (n,); NaN for an empty cell.
        row_numbers: Number of the line or row in the file from which each row was read, shape (n,).
        row_noun: What the row numbers count: "line" for the lines of a text, or "row" for the rows of a table.
    """

    values: Mapping[str, Array]
    row_numbers: Integers
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
        row_noun: What the row numbers of the format count, for error messages: "line" or "row".
    """

    row_noun: ClassVar[str]

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

    def choose_columns(
        self, required: Mapping[str, ColumnRule], optional: Mapping[str, ColumnRule] | None = None
    ) -> dict[str, ColumnRule]:
        """Choose the columns to read: all required columns, and the optional columns that the file contains.

        A warning lists all other columns of the file, which are ignored.

        Args:
            required: Rules of the required columns, by the names of the columns.
            optional: Rules of the optional columns, by the names of the columns.

        Returns:
            The rules of the chosen columns, by the names of the columns.

        Raises:
            InputError: If a required column is missing, if the file contains a chosen column twice, or if a column has
                a similar name as a column that the file does not contain.
        """
        known_rules = {**required, **(optional or {})}
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
        return chosen_rules

    def refuse_similar_names(self, columns: Iterable[str], names: Iterable[str]) -> None:
        """Refuse a column whose name differs from that of a missing column by case, brackets, blanks or the unit pC.

        Args:
            columns: Names of the columns of the file that are checked.
            names: Names of columns that have a meaning.

        Raises:
            InputError: If a column has such a name.
        """
        absent_names = {
            _letters_of(f"{name}{unit}"): name for name in names for unit in ("", "pC") if name not in self.header
        }
        for column in columns:
            if _letters_of(column) in absent_names:
                name = absent_names[_letters_of(column)]
                self._refuse_header(f"rename {shown(column)} to {shown(name)}, or remove the column; missing", [name])

    def read(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Read the chosen columns, and check their values.

        Args:
            rules: Rules of the columns to read, as `choose_columns` returns them. The columns are returned in the same
                order.
            max_rows: Largest number of rows that is accepted.

        Raises:
            InputError: If the file is damaged or has more than `max_rows` rows, or if a cell violates the rule of its
                column.
        """
        columns = self._read_columns(rules, max_rows)
        columns.check(rules, f"{self.source.where}, ", self.source.error_class)
        return columns

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
        """Raise the error for a file that has more than `max_rows` rows.

        Raises:
            InputError: Always.
        """
        raise self.source.error(f": expected at most {max_rows:,} presses, got more; split the file")


def _letters_of(name: str) -> str:
    """Return the letters and digits of a name in lower case."""
    return re.sub(r"[\W_]+", "", name.casefold())


_SEPARATORS = ",;\t|"
"""Characters that may separate the columns."""

_UNITS = frozenset({"mm", "N", "pC", "1", "-", ""})
"""Cells of a row of units below the header."""

_MAX_LINES_TO_HEADER = 100
"""Number of lines at the beginning of a file among which the header is searched."""

_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:([.,])[0-9]*)?|([.,])[0-9]+)(?:[eE][-+]?[0-9]+)?")
"""Number with or without a decimal mark, which is a group."""

_THOUSANDS = re.compile(r"[-+]?[1-9][0-9]{0,2}[.,][0-9]{3}")
"""Number whose mark may be a separator of thousands."""


class CsvTable(NumberTable):
    """Table of numbers that is read from a CSV text."""

    row_noun = "line"

    def __init__(self, lines: Iterable[str], source: TableSource) -> None:
        """Find and read the header.

        Args:
            lines: Lines of the text.
            source: Name of the file, its known columns, and the class of errors.

        Raises:
            InputError: If the file is empty, is not CSV text in UTF-8, or has too many columns.
        """
        checked_lines = _checked_lines(lines, source)
        first_lines = list(islice(checked_lines, _MAX_LINES_TO_HEADER))
        lines_above, self._separator = _find_header(first_lines, source.names)
        lines_below = chain(first_lines[lines_above:], checked_lines)
        self._rows = _numbered_rows(lines_below, lines_above, self._separator, source)
        header_row = next(self._rows, None)
        if header_row is None:
            raise source.error(f": empty; expected {source.expected}")
        super().__init__(header_row[1], source)
        self._mark = ""  # decimal mark; empty until it is known
        self._is_mark_certain = False

    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Convert the cells of the requested columns to numbers, row by row.

        Args:
            rules: Rules of the requested columns, by the names of the columns. This method uses only their
                descriptions, for error messages.
            max_rows: Largest number of rows that is accepted.

        Raises:
            InputError: If there are too many rows, a row has the wrong number of cells, a cell is not a finite number,
                or the decimal mark is not clear.
        """
        column_indices = {name: self.header.index(name) for name in rules}
        # The arrays of the module `array` need less memory than lists. "q" are 64-bit integers, "d" are 64-bit floats.
        line_numbers = array("q")
        numbers = array("d")  # the numbers of the first row, then the numbers of the second row, and so on
        for index, (line_number, cells) in enumerate(self._rows):
            if index == 0 and _is_row_of_units([cells[i] for i in column_indices.values() if i < len(cells)]):
                continue
            if len(line_numbers) == max_rows:  # this row is one row too many
                self._refuse_row_count(max_rows)
            self._check_cell_count(line_number, cells)
            line_numbers.append(line_number)
            for name, column_index in column_indices.items():
                number = self._number(cells[column_index].strip())
                if number is None:
                    cell = cells[column_index].strip()
                    has_other_mark = self._mark != "" and any(mark in cell for mark in ",." if mark != self._mark)
                    advice = f"; the decimal mark is {self._mark!r}" if has_other_mark else ""
                    raise self.source.error(
                        f", line {line_number}, column {shown(name)}: expected {rules[name].description}, got "
                        f"{shown(cell)}{advice}"
                    )
                numbers.append(number)
            if not self._is_mark_certain:
                is_point_between_commas = (self._separator, self._mark) == (",", ".")
                has_evidence = any(_has_decimal_mark(cell.strip(), self._mark) for cell in cells)
                self._is_mark_certain = is_point_between_commas or has_evidence
        if self._mark and not self._is_mark_certain:
            raise self.source.error(
                f": every number with the mark {self._mark!r} may have a decimal mark or a separator of thousands; "
                "write commas between the columns, decimal points and no separators of thousands"
            )
        rows = np.asarray(numbers, dtype=np.float64).reshape(len(line_numbers), len(column_indices))
        values = dict(zip(column_indices, rows.T, strict=True))
        return NumberColumns(values, np.array(line_numbers, dtype=np.intp), self.row_noun)

    def _number(self, text: str) -> float | None:
        """Return the number in a cell: NaN for an empty cell, and None for a cell without a finite number.

        The first number with a decimal mark determines the decimal mark of the file.

        Args:
            text: The cell, without blanks at its ends.
        """
        if not text:
            return math.nan
        match = _NUMBER.fullmatch(text)
        if match is None:
            return None
        mark = match[1] or match[2]
        if mark and mark != self._mark:
            if self._mark:
                return None
            self._mark = mark
        number = float(text.replace(",", "."))
        return number if math.isfinite(number) else None

    def _check_cell_count(self, line_number: int, cells: list[str]) -> None:
        """Check that a row has as many cells as the header. Additional blank cells are accepted.

        Args:
            line_number: Number of the line, for the error message.
            cells: Cells of the row.

        Raises:
            InputError: If the row has too few cells, or additional cells that are not blank.
        """
        additional_cells = cells[len(self.header) :]
        if len(cells) < len(self.header) or any(cell.strip() for cell in additional_cells):
            raise self.source.error(
                f", line {line_number}: expected {len(self.header)} cells as in the header, got "
                f"{len(cells)}: {shown(cells)}"
            )


def csv_text(columns: Mapping[str, Array]) -> str:
    """Return columns of numbers as CSV text. Numbers have all digits, and NaN becomes an empty cell.

    Args:
        columns: Columns by their names, each of shape (n,).
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)  # the keys of `columns`, which are the names
    rows = np.column_stack(list(columns.values()))  # shape (n, n_column)
    for row in rows.tolist():
        writer.writerow("" if math.isnan(value) else value for value in row)
    return buffer.getvalue()


def _is_row_of_units(cells: list[str]) -> bool:
    """Return whether cells are the units of charges and other known columns, with or without brackets."""
    units = {cell.strip().strip("[]()") for cell in cells}
    return "pC" in units and units <= _UNITS


def _has_decimal_mark(text: str, mark: str) -> bool:
    """Return whether a text is a number with the given mark, which cannot be a separator of thousands."""
    is_number_with_mark = mark != "" and mark in text and _NUMBER.fullmatch(text) is not None
    return is_number_with_mark and _THOUSANDS.fullmatch(text) is None


def _checked_lines(lines: Iterable[str], source: TableSource) -> Iterator[str]:
    """Yield the lines of a text without a byte order mark.

    Args:
        lines: Lines of the text, each with its line end.
        source: Name of the file and class of the error, for error messages.

    Raises:
        InputError: If the lines are not text in UTF-8, or a line is too long.
    """
    line_count = 0
    advice = (
        "is not text in UTF-8: export the file as CSV in UTF-8; convert other text with: iconv -f UTF-16 (or "
        "WINDOWS-1252) -t UTF-8 FILE > NEW.csv"
    )
    try:
        for line in lines:
            if "\0" in line:  # the file is binary, or text in UTF-16
                raise source.error(f", line {line_count + 1}: the byte 0x00 {advice}")
            yield line.removeprefix("\ufeff") if line_count == 0 else line
            line_count += 1
    except UnicodeDecodeError as cause:
        # The exception contains the part of the file that was decoded last.
        line_number = line_count + cause.object[: cause.start].count(b"\n") + 1
        raise source.error(f", line {line_number}: the byte 0x{cause.object[cause.start]:02x} {advice}") from cause
    except InputError:  # is a ValueError, too
        raise
    except ValueError as cause:  # the next line is too long
        raise source.error(f", line {line_count + 1}: not CSV text ({cause})") from cause


def _numbered_rows(
    lines: Iterable[str], lines_above: int, separator: str, source: TableSource
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each row that is neither blank nor a comment.

    The first line of the file has the number 1. If a row extends over several lines, the line number is the number of
    its last line.

    Args:
        lines: Lines of the text, each with its line end.
        lines_above: Number of lines above these lines.
        separator: Character between the columns.
        source: Name of the file, its known columns, and the class of errors.

    Raises:
        InputError: If the lines are not CSV text.
    """
    reader = csv.reader(lines, delimiter=separator, strict=True)
    try:
        for cells in reader:
            first_cell = cells[0].strip() if cells else ""
            is_comment = first_cell.startswith("#") and first_cell not in source.names
            if any(cell.strip() for cell in cells) and not is_comment:
                yield lines_above + reader.line_num, cells
    except csv.Error as cause:
        raise source.error(f", line {lines_above + reader.line_num}: not CSV text ({cause})") from cause


def _find_header(lines: list[str], names: Collection[str]) -> tuple[int, str]:
    """Find the header at the beginning of a text, and the separator of the columns.

    The header is the first line that contains a name and no number. If there is no such line, the result is the first
    line. The separator is the one with which the header has most names, and then most cells.

    Args:
        lines: First lines of the text.
        names: Names of columns that have a meaning.

    Returns:
        The number of lines above the header, and the separator.
    """
    best_score = (0, 0)
    best = (0, _SEPARATORS[0])
    for line_index, line in enumerate(lines):
        for separator in _SEPARATORS:
            with suppress(csv.Error):  # the error is raised again when the table is read
                texts = {cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])}
                has_number = any(map(_NUMBER.fullmatch, texts.difference(names)))
                score = (0 if has_number else len(texts.intersection(names)), len(texts) if line_index == 0 else 0)
                if score > best_score:
                    best_score = score
                    best = (line_index, separator)
        if best_score[0] > 0:
            break
    return best
