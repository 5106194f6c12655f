"""Reading and writing of columns of numbers as CSV text.

A line that begins with # is a comment, unless the line is a part of a quoted cell. Blank lines are ignored. Blanks
before and after a name or a number are also ignored. Numbers must be written with a decimal point, not with a decimal
comma. The texts `nan` and `inf` are not accepted.
"""

import codecs
import csv
import io
import math
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import NoReturn

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, shown
from isocharge.common.number_text import parse_number
from isocharge.common.tables.number_table import ColumnRule, NumberColumns, NumberTable

_SEPARATORS = {";": "tr ',;' '.,'", "\t": r"tr '\t' ','"}
"""Separators other than the comma that spreadsheets use.

The value is the command that converts such a file into CSV with decimal points.
"""

_OTHER_FORMATS = {
    codecs.BOM_UTF32_LE: "the file is UTF-32: save it as UTF-8, as with: iconv -f UTF-32 -t UTF-8 FILE > NEW.csv",
    codecs.BOM_UTF16_LE: "the file is UTF-16: save it as UTF-8, as with: iconv -f UTF-16 -t UTF-8 FILE > NEW.csv",
    codecs.BOM_UTF16_BE: "the file is UTF-16: save it as UTF-8, as with: iconv -f UTF-16 -t UTF-8 FILE > NEW.csv",
    b"PK\x03\x04": "the file is a workbook of a spreadsheet or a zip file: save the sheet as CSV in UTF-8",
    b"PAR1": "the file is Parquet: rename it so that its name ends in .parquet",
    b"\x1f\x8b": "the file is compressed: unpack it, as with: gunzip < FILE > NEW.csv",
}
"""Advice for files that are not text in UTF-8, by the first bytes of the file.

The entry of UTF-32 precedes the entries of UTF-16, because the mark of UTF-32 begins with the mark of UTF-16.
"""

BYTE_ORDER_MARK = "\ufeff"


class CsvTable(NumberTable):
    """Table of numbers that is read from a CSV text."""

    row_noun = "line"

    def __init__(
        self, lines: Iterable[str], names: Collection[str], where: str, error_class: type[InputError], expected: str
    ) -> None:
        """Read the header, which is the first line that is neither blank nor a comment.

        Args:
            lines: Lines of the text.
            names: Names of columns that have a meaning. A header whose first name is one of these names is not a
                comment, even if the name begins with #.
            where: Name of the file, for error messages.
            error_class: Class of the error that is raised for every mistake in the file.
            expected: Description of the expected header, for error messages.

        Raises:
            error_class: If the file is empty, is not CSV text in UTF-8, or has too many columns.
        """
        self._rows = _numbered_rows(lines, names, where, error_class)
        first_row = next(self._rows, None)
        if first_row is None:
            raise error_class(f"{where}: empty; expected {expected}")
        _, header = first_row
        if any("\0" in name for name in header):
            # In UTF-16, one of the two bytes of an ASCII letter is zero: the first in UTF-16BE, the second in UTF-16LE.
            encoding = "UTF-16BE" if header[0].startswith("\0") else "UTF-16LE"
            raise error_class(
                f"{where}: the header has null characters: the file seems to be UTF-16 without a byte order mark; save "
                f"it as UTF-8, as with: iconv -f {encoding} -t UTF-8 FILE > NEW.csv"
            )
        super().__init__(header, names, where, error_class, expected)

    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Convert the cells of the requested columns to numbers, row by row.

        Args:
            rules: Rules of the requested columns, by the names of the columns. This method uses only their
                descriptions, for error messages.
            max_rows: Largest number of rows that is accepted.

        Raises:
            error_class: If there are too many rows, a row has the wrong number of cells, or a cell is not a finite
                number.
        """
        column_indices = {name: self.header.index(name) for name in rules}
        # The arrays of the module `array` need less memory than lists. "q" are 64-bit integers, "d" are 64-bit floats.
        line_numbers = array("q")
        numbers = array("d")  # the numbers of the first row, then the numbers of the second row, and so on
        for line_number, cells in self._rows:
            if len(line_numbers) == max_rows:  # this row is one row too many
                self._refuse_row_count(max_rows)
            self._check_cell_count(line_number, cells)
            line_numbers.append(line_number)
            for name, column_index in column_indices.items():
                number = _number(cells[column_index])
                if number is None:
                    self._refuse_cell(line_number, name, rules[name], cells[column_index])
                numbers.append(number)
        rows = np.array(numbers, dtype=np.float64).reshape(len(line_numbers), len(column_indices))
        values = dict(zip(column_indices, rows.T, strict=True))
        return NumberColumns(values, np.array(line_numbers, dtype=np.intp), self.row_noun)

    def _check_cell_count(self, line_number: int, cells: list[str]) -> None:
        """Check that a row has as many cells as the header. Additional blank cells are accepted.

        Args:
            line_number: Number of the line, for the error message.
            cells: Cells of the row.

        Raises:
            error_class: If the row has too few cells, or additional cells that are not blank.
        """
        additional_cells = cells[len(self.header) :]
        if len(cells) < len(self.header) or any(cell.strip() for cell in additional_cells):
            raise self.error_class(
                f"{self.where}, line {line_number}: expected {len(self.header)} cells as in the header, got "
                f"{len(cells)}: {shown(cells)}"
            )

    def _refuse_cell(self, line_number: int, name: str, rule: ColumnRule, cell: str) -> NoReturn:
        """Raise the error for a cell that is not a finite number.

        Args:
            line_number: Number of the line of the cell.
            name: Name of the column.
            rule: Rule of the column, whose description appears in the message.
            cell: Content of the cell.

        Raises:
            error_class: Always.
        """
        # The cell may contain a comma, because it may be quoted.
        has_decimal_comma = "," in cell and _number(cell.replace(",", ".", 1)) is not None
        advice = "; write a decimal point" if has_decimal_comma else ""
        raise self.error_class(
            f"{self.where}, line {line_number}, column {shown(name)}: expected {rule.description}, got "
            f"{shown(cell)}{advice}"
        )

    def _refuse_header(self, reason: str) -> NoReturn:
        """Raise the error for a wrong header, with advice if the columns are not separated by commas.

        Args:
            reason: What is wrong with the header, for the error message.

        Raises:
            error_class: Always.
        """
        advice = ""
        if len(self.header) == 1:  # the only cell may consist of names with another separator
            for separator, command in _SEPARATORS.items():
                if separator in self.header[0]:
                    advice += (
                        f"; the columns are separated by {separator!r}: save the file with commas between columns and "
                        f"points in numbers, as with: {command} < FILE > NEW.csv"
                    )
        super()._refuse_header(reason + advice)


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
        writer.writerow("" if math.isnan(value) else repr(value) for value in row)
    return buffer.getvalue()


class _LinesWithoutComments:
    """Iterator over the lines of a CSV text that replaces each comment by a blank line.

    The CSV reader therefore ignores the comments, and still counts their lines.

    Attributes:
        is_at_row_start: Whether the next line begins a row. If the next line continues a quoted cell of the previous
            line, it cannot be a comment. The code that reads the rows sets this attribute after each row.
    """

    def __init__(self, lines: Iterable[str], names: Collection[str]) -> None:
        """Store the arguments.

        Args:
            lines: Lines of the text, each with its line end.
            names: Names of columns. A line whose first cell is one of these names is not a comment, even if the name
                begins with #.
        """
        self.is_at_row_start = True
        self._lines = iter(lines)
        self._names = names
        self._is_at_first_line = True

    def __iter__(self) -> Iterator[str]:
        """Return the iterator itself."""
        return self

    def __next__(self) -> str:
        """Return the next line, or a blank line in place of a comment.

        The attribute `is_at_row_start` becomes False, because the following line may continue a quoted cell.
        """
        line = next(self._lines)
        if self._is_at_first_line:
            line = line.removeprefix(BYTE_ORDER_MARK)
            self._is_at_first_line = False
        is_comment = self.is_at_row_start and _is_comment(line, self._names)
        self.is_at_row_start = False
        return "\n" if is_comment else line


def _numbered_rows(
    lines: Iterable[str], names: Collection[str], where: str, error_class: type[InputError]
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each row that is neither blank nor a comment.

    The first line has the number 1. If a row extends over several lines, the line number is the number of its last
    line.

    Args:
        lines: Lines of the text, each with its line end.
        names: Names of columns that have a meaning. A line whose first cell is one of these names is not a comment,
            even if the name begins with #.
        where: Name of the file, for error messages.
        error_class: Class of the error that is raised.

    Raises:
        error_class: If the lines are not CSV text in UTF-8.
    """
    lines_without_comments = _LinesWithoutComments(lines, names)
    reader = csv.reader(lines_without_comments, strict=True)
    try:
        for cells in reader:
            lines_without_comments.is_at_row_start = True  # the next line begins a row and may be a comment
            if any(cell.strip() for cell in cells):
                yield reader.line_num, cells
    # InputError and UnicodeDecodeError are subclasses of ValueError, so their clauses must precede the clause of
    # ValueError.
    except InputError:  # the iterator `lines` has raised an error with its own message
        raise
    except csv.Error as cause:
        raise error_class(f"{where}, line {reader.line_num}: not CSV text ({cause})") from cause
    except UnicodeDecodeError as cause:
        raise error_class(where + _decoding_advice(cause, reader.line_num)) from cause
    except ValueError as cause:  # a line is too long; the reader has not counted this line yet
        raise error_class(f"{where}, line {reader.line_num + 1}: not CSV text ({cause})") from cause


def _decoding_advice(cause: UnicodeDecodeError, lines_before: int) -> str:
    """Return the end of an error message about bytes that are not UTF-8: the line, the reason and what to do.

    If the file begins like a file of another known format, the message names this format and states what to do.

    Args:
        cause: The exception. It contains the part of the file that was decoded last, and the position of the wrong byte
            in this part.
        lines_before: Number of lines before this part.
    """
    part = cause.object
    is_first_part = lines_before == 0  # only the first bytes of the file reveal its format
    format_advice = _other_format_advice(part) if is_first_part else None
    if format_advice:
        return f": {format_advice}"
    complete_lines_in_part = part[: cause.start].count(b"\n")  # before the wrong byte
    line_number = lines_before + complete_lines_in_part + 1
    wrong_byte = part[cause.start]
    return (
        f", line {line_number}: the byte 0x{wrong_byte:02x} is not text in UTF-8: "
        "save the file as UTF-8; if it is Windows or Latin-1 text, as with: iconv -f WINDOWS-1252 -t UTF-8 FILE > "
        "NEW.csv"
    )


def _other_format_advice(data: bytes) -> str | None:
    """Return advice for a file that is not CSV text in UTF-8, or None if its format is not recognised.

    Args:
        data: First bytes of the file.
    """
    for mark, advice in _OTHER_FORMATS.items():
        if data.startswith(mark):
            return advice
    return None


def _is_comment(line: str, names: Collection[str]) -> bool:
    """Return whether a line is a comment, because it begins with # and its first cell is not one of the names.

    Args:
        line: The line, which begins a row.
        names: Names of columns that may begin with #.
    """
    first_cell = line.partition(",")[0].strip()
    return first_cell.startswith("#") and first_cell not in names


def _number(cell: str) -> float | None:
    """Return the number in a cell. The result is NaN for an empty cell, and None for a cell without a finite number."""
    text = cell.strip()
    if not text:
        return math.nan
    try:
        number = parse_number(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
