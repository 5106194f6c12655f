"""Files with columns of numbers, as CSV text.

The columns are separated by commas, semicolons, tabs or bars. The header is the first row that contains a known name of
a column. Rows above the header are ignored. The decimal mark is a point or a comma, and must be the same in the whole
file. A number such as `1,064` may be 1.064 or 1064. A file is therefore refused if every mark in its numbers may be a
separator of thousands. If commas separate the columns, a point is always the decimal mark.

A row that begins with # is a comment. If no other row is a header, a comment can be the header. Blank rows are ignored.
The first row below the header is also ignored if the columns to read contain units in this row: mm, N and pC. Blanks
before and after a name or a number are ignored, too. The texts `nan` and `inf` are not accepted.
"""

import csv
import io
import logging
import math
import re
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain, islice
from pathlib import Path
from pty import STDIN_FILENO

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, IsochargeError, cut, shown
from isocharge.common.files import bounded_lines
from isocharge.serve.presses.number_columns import ColumnRule, NumberColumns

log = logging.getLogger(__name__)

MAX_COLUMNS = 1_000
"""Largest number of columns of a file."""

_SEPARATORS = ",;\t|"
"""Characters that may separate the columns."""

_UNITS = frozenset({"mm", "N", "pC", "1", "-", ""})
"""Cells of a row of units below the header."""

_MAX_LINES_TO_HEADER = 100
"""Number of lines at the beginning of a file that are searched for the header."""

_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:([.,])[0-9]*)?|([.,])[0-9]+)(?:[eE][-+]?[0-9]+)?")
"""Number with or without a decimal mark. The mark is a group of the regular expression."""

_PARQUET_START = "PAR1"
"""Beginning of a Parquet file."""

_WRONG_BYTE = re.compile("[\0\udc80-\udcff]")
"""Zero byte, or the surrogate by which the error handler `surrogateescape` replaces a byte that is not UTF-8."""

_THOUSANDS = re.compile(r"[-+]?[1-9][0-9]{0,2}[.,][0-9]{3}")
"""Number whose mark may be a separator of thousands."""

_UNIT_AT_END = re.compile(r"[\W_](?:[uµμnmc]?m|in|(?:da|[uµμmck])?n|m?k?gf?|lbf?|[uµμfpn]?c)[\W_]*$")
"""Lower-case unit of a length, a force or a charge at the end of the name of a column."""


class CsvTable:
    """Table of numbers that is read from a CSV text. The columns can be read only once.

    Attributes:
        header: Names of the columns. Blanks at the ends of unknown names are removed.
    """

    def __init__(
        self, lines: Iterable[str], where: str, names: Collection[str], error_class: type[InputError], expected: str
    ) -> None:
        """Find and read the header.

        Args:
            lines: Lines of the text.
            where: Name of the file, for error messages.
            names: Names of columns that have a meaning.
            error_class: Class of the error that is raised for every mistake in the file.
            expected: Description of the expected header, for error messages.

        Raises:
            error_class: If the file is empty, is not CSV text in UTF-8, or has too many columns.
        """
        self._where = where
        self._names = names
        self._error_class = error_class
        self._expected = expected
        # The numbers of a file have one mark, a point or a comma. The mark is empty until a number with a mark is read.
        # It counts as a decimal mark as soon as a number such as 0.5 shows that it does not separate thousands.
        self._number_mark = ""
        self._is_mark_decimal = False

        # Search for the header among the first lines. If the header is a comment, `header_line` does not contain the
        # comment sign #.
        line_iterator = self._checked_lines(lines)
        first_lines = list(islice(line_iterator, _MAX_LINES_TO_HEADER))
        lines_above, self._separator, header_line = _find_header(first_lines or [""], names)

        # The rows are divided into cells only when they are needed: the header now, and the rows below it later.
        first_lines_below = first_lines[lines_above + 1 :]
        self._rows = self._numbered_rows(chain([header_line], first_lines_below, line_iterator), lines_above)
        _line_number, header_cells = next(self._rows, (0, []))  # no cells if the file contains only blank lines
        if not header_cells:
            raise self.error(f": empty; expected {expected}")
        if len(header_cells) > MAX_COLUMNS:
            raise self.error(f": expected at most {MAX_COLUMNS:,} columns, got {len(header_cells):,}")
        # A known name is not changed, because it may begin or end with blanks.
        self.header = tuple(name if name in names else name.strip() for name in header_cells)

    def error(self, message: str) -> InputError:
        """Return an error whose message consists of the name of the file and the given text."""
        return self._error_class(f"{self._where}{message}")

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
            InputError: If one of these conditions is met: a required column is missing; a required or optional column
                occurs twice; the name of a column is similar to the name of a missing column, such as `a (pC)` to `A`;
                the file is damaged or has more than `max_rows` rows; a cell violates the rule of its column.
        """
        known_rules = {**required, **optional}
        other_names = [name for name in self.header if name not in known_rules]
        self.refuse_similar_names(other_names, known_rules)
        missing_names = [name for name in required if name not in self.header]
        if missing_names:
            raise self._header_error("missing", missing_names)
        repeated_names = [name for name in known_rules if self.header.count(name) > 1]
        if repeated_names:
            raise self._header_error("repeated", repeated_names)
        if other_names:
            log.warning("%s: ignored columns: %s", self._where, shown(other_names))
        chosen_rules = {name: rule for name, rule in known_rules.items() if name in self.header}
        columns = self._read_columns(chosen_rules, max_rows)
        columns.check(chosen_rules, f"{self._where}, ", self._error_class)
        return columns

    def refuse_similar_names(self, columns: Iterable[str], names: Iterable[str]) -> None:
        """Refuse columns whose names are probably misspellings of the names of missing columns.

        The two names differ only in case, punctuation, blanks or a unit at the end, as `a (pC)` and `A` do.

        Args:
            columns: Names of the columns of the file that are checked.
            names: Names of columns that have a meaning.

        Raises:
            InputError: If the name of a column is a probable misspelling. The message lists all such columns.
        """
        # Collect the spellings of each missing name. A column with one of these spellings is probably the missing
        # column.
        missing_name_of_spelling: dict[str, str] = {}
        for name in names:
            if name not in self.header:
                # The second set has the spellings with a unit, so that the column `ApC` is similar to the name `A`.
                spellings = _spellings(name) | _spellings(f"{name}_pC")
                if name == "force_N":  # F (N), F (mN) and F (g) are forces, but `F` without a unit may be an electrode
                    spellings |= {"fn", "fmn", "fg"}
                missing_name_of_spelling |= dict.fromkeys(spellings, name)

        # Find the missing name for which each column was probably meant.
        name_of_column = {
            column: missing_name_of_spelling[spelling]
            for column in columns
            for spelling in _spellings(column) & missing_name_of_spelling.keys()
        }
        if name_of_column:
            renames = ", ".join(f"{shown(column)} to {shown(name)}" for column, name in name_of_column.items())
            advice = f"rename {cut(renames)} and check the units, or remove these columns"
            raise self._header_error(f"{advice}; missing", [*name_of_column.values()])

    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Convert the cells of the requested columns to numbers, row by row.

        Whether the numbers lie in the ranges of their columns is not checked here.

        The point or the comma in the numbers of the file is called their mark. The method `_number` stores the mark of
        the file in `_number_mark`. The mark may be a decimal mark, or a separator of thousands as in `1,064`. A single
        number such as `0,5` in any row shows that the mark is decimal (`_is_mark_decimal`). If the numbers have a mark,
        but none of them shows this, the file is refused.

        Args:
            rules: Rules of the requested columns, by the names of the columns. The header contains all of them.
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
            requested_cells = [cells[i] for i in column_indices.values() if i < len(cells)]
            if index == 0 and _is_row_of_units(requested_cells):  # a row such as mm, mm, N, pC below the header
                continue
            if len(line_numbers) == max_rows:  # the arrays already contain as many rows as are allowed
                raise self.error(f": expected at most {max_rows:,} presses, got more; split the file")
            additional_cells = cells[len(self.header) :]  # may be blank
            if len(cells) < len(self.header) or "".join(additional_cells).strip():
                raise self.error(
                    f", line {line_number}: expected {len(self.header)} cells as in the header, got "
                    f"{len(cells)}: {shown(cells)}"
                )
            line_numbers.append(line_number)
            for name, column_index in column_indices.items():
                cell = cells[column_index].strip()
                number = self._number(cell)
                if number is None:  # the cell is neither empty nor a finite number with the mark of the file
                    raise self.error(
                        f", line {line_number}, column {shown(name)}: expected {rules[name].description}, got "
                        f"{shown(cell)}{self._cell_advice(cell)}"
                    )
                numbers.append(number)
            # The columns that are not read may show, too, that the mark of the numbers is a decimal mark.
            self._is_mark_decimal = self._is_mark_decimal or self._has_fraction(cells)
        if self._number_mark and not self._is_mark_decimal:
            raise self.error(
                f": every number with the mark {self._number_mark!r} may have a decimal mark or a separator of "
                "thousands; write commas between the columns, decimal points and no separators of thousands"
            )
        rows = np.asarray(numbers).reshape(len(line_numbers), len(column_indices))
        values = dict(zip(column_indices, rows.T, strict=True))
        return NumberColumns(values, line_numbers)

    def _cell_advice(self, cell: str) -> str:
        """Return advice for a cell that is not a number, for the end of an error message; empty if there is none."""
        if "pC" in cell:  # this cell is right, but another one is wrong
            return "; a row of units may only contain mm, N and pC"
        has_other_mark = ({",", "."} - {self._number_mark}) & {*cell}
        return f"; the decimal mark is {self._number_mark!r}" if self._number_mark and has_other_mark else ""

    def _has_fraction(self, cells: list[str]) -> bool:
        """Return whether a cell of any column has a fraction such as 0.5, whose mark does not separate thousands."""
        if not self._number_mark:
            return False
        texts = (cell.strip().lstrip("+-") for cell in cells)
        return any(text.startswith(f"0{self._number_mark}") and _NUMBER.fullmatch(text) for text in texts)

    def _number(self, text: str) -> float | None:
        """Return the number in a cell: NaN for an empty cell, and None for a cell without a finite number.

        The point or the comma in a number is called its mark. All numbers of a file must have the same mark. The mark
        may be a decimal mark, or a separator of thousands as in `1,064`. Some numbers show that the mark is a decimal
        mark: `0,5`, `12,34` and `1,064e3` cannot be whole numbers with a separator of thousands.

        The function stores the first mark of the file in `_number_mark`. As soon as a number shows that this mark is a
        decimal mark, `_is_mark_decimal` becomes true. The number `1,064` is always read as 1.064. If no number of the
        file has shown that its mark is a decimal mark, `_read_columns` refuses the file.

        Args:
            text: The cell, without blanks at its ends.
        """
        if not text:
            return math.nan
        match = _NUMBER.fullmatch(text)
        if match is None:
            return None
        mark = match[1] or match[2]  # the first group matches the mark in `3.5`, the second group the mark in `.5`
        if mark:
            self._number_mark = self._number_mark or mark
            if mark != self._number_mark:
                return None
            if not self._is_mark_decimal:
                # Where points separate thousands, commas are decimal marks and do not separate the columns of a file.
                # If commas separate the columns, a point is therefore a decimal mark.
                must_be_decimal = self._separator == "," and mark == "."
                # `_THOUSANDS` matches a number whose mark may separate thousands, such as `1,064`.
                self._is_mark_decimal = must_be_decimal or _THOUSANDS.fullmatch(text) is None
        number = float(text.replace(",", "."))
        return number if math.isfinite(number) else None

    def _header_error(self, reason: str, names: Sequence[str]) -> InputError:
        """Return the error for a wrong header.

        Args:
            reason: Description of the fault of some names, for the error message.
            names: The names that have this fault.
        """
        return self.error(
            f": expected {self._expected}, got the header {shown(list(self.header))}; {reason}: {shown(names)}"
        )

    def _checked_lines(self, lines: Iterable[str]) -> Iterator[str]:
        """Check each line of a text, and yield the lines without the byte order mark at the beginning of the text.

        Args:
            lines: Lines of the text, each with its line end. Each byte that is not UTF-8 was replaced by a surrogate,
                as `surrogateescape` does.

        Raises:
            InputError: If the file is a Parquet file, the lines are not text in UTF-8, or a line is too long.
        """
        line_number = 0
        try:
            for line_number, line in enumerate(lines, start=1):
                if line_number == 1 and line.startswith(_PARQUET_START):
                    raise self.error(
                        ": expected a CSV file, got a Parquet file; convert it to CSV, for example in Python with "
                        "pandas.read_parquet(FILE).to_csv(NEW, index=False)"
                    )
                wrong_character = _WRONG_BYTE.search(line)
                if wrong_character:  # the file is binary, or text in another encoding
                    # The surrogate U+DC80 stands for the byte 0x80, and so on. Its lowest eight bits are the byte.
                    wrong_byte = ord(wrong_character[0]) & 0xFF
                    raise self.error(
                        f", line {line_number}: the byte 0x{wrong_byte:02x} is not text in UTF-8: export the file as "
                        "CSV in UTF-8; convert other text with: iconv -f UTF-16 (or WINDOWS-1252) -t UTF-8 FILE > "
                        "NEW.csv"
                    )
                yield line.removeprefix("\ufeff") if line_number == 1 else line
        except InputError:  # an error that is raised above, and that is a ValueError, too
            raise
        except ValueError as cause:  # the next line is too long
            raise self.error(f", line {line_number + 1}: not CSV text in UTF-8 ({cause})") from cause

    def _numbered_rows(self, lines: Iterable[str], lines_above: int) -> Iterator[tuple[int, list[str]]]:
        """Yield the line number and the cells of each row that is neither blank nor a comment.

        A row whose first cell begins with # is a comment, unless the cell is the name of a column. The first line of
        the file has the number 1. If a row extends over several lines, the line number is the number of its last line.

        Args:
            lines: Lines of the text, each with its line end.
            lines_above: Number of lines of the file above these lines.

        Raises:
            InputError: If the lines are not CSV text.
        """
        reader = csv.reader(lines, delimiter=self._separator, strict=True)
        try:
            for cells in reader:
                first_cell = "".join(cells[:1]).strip()  # empty for a row without cells
                is_comment = first_cell.startswith("#") and first_cell not in self._names
                if "".join(cells).strip() and not is_comment:
                    yield lines_above + reader.line_num, cells
        except csv.Error as cause:
            raise self.error(f", line {lines_above + reader.line_num}: not CSV text ({cause})") from cause


def csv_text(columns: Mapping[str, Array]) -> str:
    """Return columns of numbers as CSV text. Numbers have all digits, and NaN becomes an empty cell.

    Args:
        columns: Columns by their names, each of shape (n,).
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)  # the keys of `columns`, which are the names
    rows = np.column_stack(list(columns.values())).tolist()
    writer.writerows(["" if math.isnan(value) else value for value in row] for row in rows)
    return buffer.getvalue()


def _is_row_of_units(cells: list[str]) -> bool:
    """Return whether all cells are units of known columns, such as pC, mm or [N], and at least one is pC."""
    units = {cell.strip().strip("[]()") for cell in cells}
    return "pC" in units and units <= _UNITS


def _find_header(lines: Sequence[str], names: Collection[str]) -> tuple[int, str, str]:
    """Find the header at the beginning of a text, and the separator of the columns.

    The header is the first line that is not a comment and contains a name but no number. If there is no such line, the
    header is the first comment that contains a name but no number, because `numpy.savetxt` writes such headers. If
    there is no such comment, the header is the first line of the text.

    Args:
        lines: First lines of the text, at least one.
        names: Known names of columns.

    Returns:
        The number of lines above the header, the separator, and the header without the comment sign #.
    """
    # Search first without the comments, and then with the texts of the comments. In both lists, the index of a line is
    # the number of lines above it.
    lines_without_comments = ["" if line.startswith("# ") else line for line in lines]
    lines_without_sign = [line.removeprefix("# ") for line in lines]
    for lines_above, line in chain(enumerate(lines_without_comments), enumerate(lines_without_sign)):
        separator = _best_separator(line, names)
        name_count, _cell_count = _header_score(line, names, separator)
        if name_count > 0:  # the line contains a known name and no number, because with a number the count is 0
            return lines_above, separator, line
    return 0, _best_separator(lines[0], names), lines[0]


def _best_separator(line: str, names: Collection[str]) -> str:
    """Return the separator that gives the most known names in a line. The number of cells decides a tie."""
    return max(_SEPARATORS, key=partial(_header_score, line, names))


def _header_score(line: str, names: Collection[str], separator: str) -> tuple[int, int]:
    """Return the number of known names and the number of cells in a line. A line with a number has no names.

    Equal cells are counted once.

    Args:
        line: The line.
        names: Known names of columns.
        separator: Separator of the cells.
    """
    try:
        cells = {cell.strip() for cell in next(csv.reader([line], delimiter=separator))}
    except csv.Error:  # is raised again when the table is read
        return 0, 0
    # A name of a column may look like a number.
    has_number = any(map(_NUMBER.fullmatch, cells.difference(names)))
    return 0 if has_number else len(cells.intersection(names)), len(cells)


def _spellings(name: str) -> set[str]:
    """Return spellings of the name of a column. Similar names have at least one spelling in common.

    A spelling consists of the letters and digits of the name in lower case, with or without a unit at the end. For
    example, `x_mm` gives `xmm` and `x`, and `X (cm)` gives `xcm` and `x`.
    """
    text = name.casefold()
    return {re.sub(r"[\W_]+", "", spelling) for spelling in (text, _UNIT_AT_END.sub("", text))}


@contextmanager
def open_table(path: Path, names: Collection[str], error_class: type[InputError], expected: str) -> Iterator[CsvTable]:
    """Open a CSV file for the `with` block, and read its header.

    Args:
        path: The file, which is text in UTF-8, with or without a byte order mark. The path `-` is standard input.
        names: Names of columns that have a meaning.
        error_class: Class of the error that is raised for every mistake in the file.
        expected: Description of the expected header, for error messages.

    Yields:
        The table. Its columns have not been read yet.

    Raises:
        error_class: If the file cannot be read, either when it is opened or when the block reads the columns.
    """
    is_stdin = str(path) == "-"
    where = "stdin" if is_stdin else str(path)
    file_or_descriptor = STDIN_FILENO if is_stdin else path
    try:
        # The CSV reader handles the line ends. A byte that is not UTF-8 becomes a surrogate character, which the table
        # refuses. Standard input remains open after the block.
        with open(
            file_or_descriptor, encoding="utf-8", errors="surrogateescape", newline="", closefd=not is_stdin
        ) as text:
            yield CsvTable(bounded_lines(text), where, names, error_class, expected)
    except IsochargeError:  # some errors of isocharge, such as OutputError, inherit from OSError
        raise
    except OSError as cause:
        raise error_class(
            f"{where}: cannot be read ({cause.strerror or cause}); expected a CSV file of presses"
        ) from cause
