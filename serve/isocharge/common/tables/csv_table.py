"""Columns of numbers as CSV text.

A line that begins with # is a comment, unless it is inside a quoted cell. Blank lines, and blanks around a name or a
number, are ignored. Numbers are written with a decimal point. The texts `nan` and `inf` are not accepted.
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
"""Advice for files that are not text in UTF-8, by their first bytes.

UTF-32 precedes UTF-16, because the first bytes of UTF-32 begin with those of UTF-16.
"""

BYTE_ORDER_MARK = "\ufeff"


class CsvTable(NumberTable):
    """The columns of a CSV text."""

    row_noun = "line"

    def __init__(
        self, lines: Iterable[str], names: Collection[str], where: str, error: type[InputError], expected: str
    ) -> None:
        """Read the header.

        Args:
            lines: Lines of the file.
            names: Names that have a meaning. A header that begins with one of them is not a comment, even if the name
                begins with #.
            where: The file, for messages.
            error: Class of the error that is raised for anything that is wrong with the file.
            expected: The expected header, for messages.

        Raises:
            error: If the file is empty, is not CSV text in UTF-8, or has too many columns.
        """
        self._rows = _numbered_rows(lines, names, where, error)
        first_row = next(self._rows, None)
        if first_row is None:
            raise error(f"{where}: empty; expected {expected}")
        _line_number, header = first_row
        if any("\0" in name for name in header):
            # The high byte of an ASCII letter is zero. It is the first byte in UTF-16BE, and the second in UTF-16LE.
            encoding = "UTF-16BE" if header[0].startswith("\0") else "UTF-16LE"
            raise error(
                f"{where}: the header has null characters: the file seems to be UTF-16 without a byte order mark; save "
                f"it as UTF-8, as with: iconv -f {encoding} -t UTF-8 FILE > NEW.csv"
            )
        super().__init__(header, names, where, error, expected)

    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Convert the cells of the requested columns to numbers, row by row.

        Args:
            rules: Rule of each requested column, by its name. The rules only appear in error messages here.
            max_rows: Largest number of rows.

        Raises:
            error: If there are too many rows, or a cell is not a finite number.
        """
        positions = {name: self.header.index(name) for name in rules}  # index of each column in a row
        line_numbers = array("q")  # 64-bit integers, which need less memory than a list
        numbers = array("d")  # 64-bit floats: the numbers of the first row, then those of the second row, and so on
        for line_number, cells in self._rows:
            if len(line_numbers) == max_rows:
                self._refuse_row_count(max_rows)
            self._check_cell_count(line_number, cells)
            line_numbers.append(line_number)
            for name, position in positions.items():
                number = _number(cells[position])
                if number is None:
                    self._refuse_cell(line_number, name, rules[name], cells[position])
                numbers.append(number)
        rows = np.array(numbers, dtype=np.float64).reshape(len(line_numbers), len(positions))
        values = dict(zip(positions, rows.T, strict=True))
        return NumberColumns(values, np.array(line_numbers, dtype=np.intp), self.row_noun)

    def _check_cell_count(self, line_number: int, cells: list[str]) -> None:
        """Raise `error` if a row has fewer cells than the header, or more cells that are not blank."""
        surplus = cells[len(self.header) :]
        if len(cells) < len(self.header) or any(cell.strip() for cell in surplus):
            raise self.error(
                f"{self.where}, line {line_number}: expected {len(self.header)} cells as in the header, got "
                f"{len(cells)}: {shown(cells)}"
            )

    def _refuse_cell(self, line_number: int, name: str, rule: ColumnRule, cell: str) -> NoReturn:
        """Raise `error` for a cell that is not a finite number."""
        has_decimal_comma = "," in cell and _number(cell.replace(",", ".", 1)) is not None
        advice = "; write a decimal point" if has_decimal_comma else ""
        raise self.error(
            f"{self.where}, line {line_number}, column {shown(name)}: expected {rule.description}, got "
            f"{shown(cell)}{advice}"
        )

    def _refuse_header(self, reason: str) -> NoReturn:
        for separator, command in _SEPARATORS.items():
            if len(self.header) == 1 and separator in self.header[0]:
                reason += (
                    f"; the columns are separated by {separator!r}: save the file with commas between columns and "
                    f"points in numbers, as with: {command} < FILE > NEW.csv"
                )
        super()._refuse_header(reason)


def csv_text(columns: Mapping[str, Array]) -> str:
    """Return columns of shape (n,) as CSV text with all digits. NaN becomes an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)  # the names
    rows = np.column_stack(list(columns.values()))  # shape (n, n_column)
    for row in rows.tolist():
        writer.writerow("" if math.isnan(value) else repr(value) for value in row)
    return text.getvalue()


class _LinesWithoutComments:
    """Iterator of the lines of a CSV text, in which each comment line is replaced by a blank line.

    Attributes:
        at_row_start: Whether the next line begins a row. Otherwise the line continues a quoted cell and cannot be a
            comment. The reader of the rows sets this attribute after each row.
    """

    def __init__(self, lines: Iterable[str], names: Collection[str]) -> None:
        """Store the lines and the names of columns.

        A line whose first cell is one of these names is not a comment, even if it begins with #.
        """
        self.at_row_start = True
        self._lines = iter(lines)
        self._names = names
        self._at_first_line = True

    def __iter__(self) -> Iterator[str]:
        """Return the iterator itself."""
        return self

    def __next__(self) -> str:
        """Return the next line, or a blank line in place of a comment.

        After each line, the attribute `at_row_start` is False until the reader of the rows sets it again.
        """
        line = next(self._lines)
        if self._at_first_line:
            line = line.removeprefix(BYTE_ORDER_MARK)
            self._at_first_line = False
        is_comment = self.at_row_start and _is_comment(line, self._names)
        self.at_row_start = False
        return "\n" if is_comment else line


def _numbered_rows(
    lines: Iterable[str], names: Collection[str], where: str, error: type[InputError]
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number, from 1, and the cells of each row that is neither blank nor a comment.

    If a row has several lines, its line number is the number of the last line.

    Args:
        lines: Lines of the text, each with its line end.
        names: Names that have a meaning. A line that begins with # and one of these names is not a comment.
        where: Name of the file, for error messages.
        error: Class of the errors.

    Raises:
        error: If the lines are not CSV text in UTF-8.
    """
    source = _LinesWithoutComments(lines, names)
    reader = csv.reader(source, strict=True)
    try:
        for cells in reader:
            source.at_row_start = True  # the next line begins a row and may be a comment
            if any(cell.strip() for cell in cells):
                yield reader.line_num, cells
    except InputError:  # from the iterator that supplies the lines
        raise
    except csv.Error as cause:
        raise error(f"{where}, line {reader.line_num}: not CSV text ({cause})") from cause
    except UnicodeDecodeError as cause:  # a kind of ValueError, which is therefore caught before
        raise error(where + _decoding_advice(cause, reader.line_num)) from cause
    except ValueError as cause:  # a line that is too long to be held
        raise error(f"{where}, line {reader.line_num + 1}: not CSV text ({cause})") from cause


def _decoding_advice(cause: UnicodeDecodeError, lines_before: int) -> str:
    """Return the end of an error message about bytes that are not UTF-8: the line, the reason and what to do.

    If the file begins like a file of another known format, the message names this format instead.

    Args:
        cause: The error, which contains the piece of the file that was being decoded, and the position of the wrong
            byte in this piece.
        lines_before: Number of lines before this piece.
    """
    piece = cause.object
    is_first_piece = lines_before == 0
    other_format = _other_format(piece) if is_first_piece else None
    if other_format:
        return f": {other_format}"
    line_number = lines_before + piece[: cause.start].count(b"\n") + 1
    wrong_byte = piece[cause.start]
    return (
        f", line {line_number}: the byte 0x{wrong_byte:02x} is not text in UTF-8: "
        "save the file as UTF-8; if it is Windows or Latin-1 text, as with: iconv -f WINDOWS-1252 -t UTF-8 FILE > "
        "NEW.csv"
    )


def _other_format(data: bytes) -> str | None:
    """If the bytes belong to another file format, return a sentence that names the format and states what to do.

    Otherwise return None.

    Args:
        data: First bytes of the file.
    """
    for mark, advice in _OTHER_FORMATS.items():
        if data.startswith(mark):
            return advice
    return None


def _is_comment(line: str, names: Collection[str]) -> bool:
    """Return whether a line begins with # and its first cell is not one of the names."""
    first_cell = line.partition(",")[0].strip()
    return first_cell.startswith("#") and first_cell not in names


def _number(cell: str) -> float | None:
    """Return the number in a cell, NaN for an empty cell, and None for anything that is not a finite number."""
    text = cell.strip()
    if not text:
        return math.nan
    try:
        number = parse_number(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
