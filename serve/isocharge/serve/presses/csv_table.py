"""Reading and writing of columns of numbers as CSV text.

The columns are separated by commas, semicolons, tabs or bars. The header is the line, above the numbers, that contains
most of the names that have a meaning. A line below the header may state the units of the columns. The decimal mark is a
point or a comma, and the same in the whole file. A number such as `1,064` may be 1.064 or 1064. A file in which no
number determines the decimal mark is therefore refused.

A line that begins with # is a comment, unless the line is a part of a quoted cell. A line such as `sep=;` is a comment
for spreadsheets. Blank lines are ignored. Blanks before and after a name or a number are also ignored. The texts `nan`
and `inf` are not accepted.
"""

import codecs
import csv
import io
import math
import re
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import chain, islice
from typing import NoReturn

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, shown
from isocharge.serve.presses.header_advice import OTHER_UNITS
from isocharge.serve.presses.number_table import ColumnRule, NumberColumns, NumberTable, TableSource
from isocharge.serve.presses.number_text import parse_number

_SEPARATORS = ",;\t|"
"""Characters that may separate the columns."""

_MAX_LINES_TO_HEADER = 100
"""Number of lines at the beginning of a file among which the header is searched."""

_MARKED_NUMBER = re.compile(r"[-+]?[0-9]*[.,][0-9]*(?:[eE][-+]?[0-9]+)?")
"""Number with one decimal mark, or with one separator of thousands."""

_THOUSANDS = re.compile(r"[-+]?[1-9][0-9]{0,2}[.,][0-9]{3}")
"""Number whose mark may be a separator of thousands."""

_SEPARATOR_LINE = re.compile(r'"?sep=.?"?\s*', re.IGNORECASE)
"""Line that tells a spreadsheet the separator."""

_WITHOUT_MARKS = str.maketrans("", "", ".,' \u00a0\u202f\u2019")
"""Removes all characters that are used as decimal marks or separators of thousands."""

_SWAPPED_MARKS = str.maketrans(".,", ",.")
"""Replaces decimal commas by points. Points become commas, so that a number with a point is then refused."""

_OTHER_FORMATS = {
    codecs.BOM_UTF32_LE: "the file is UTF-32: save it as UTF-8, as with: iconv -f UTF-32 -t UTF-8 FILE > NEW.csv",
    codecs.BOM_UTF16_LE: "the file is UTF-16: save it as UTF-8, as with: iconv -f UTF-16 -t UTF-8 FILE > NEW.csv",
    codecs.BOM_UTF16_BE: "the file is UTF-16: save it as UTF-8, as with: iconv -f UTF-16 -t UTF-8 FILE > NEW.csv",
    b"PK\x03\x04": "the file is a workbook of a spreadsheet or a zip file: save the sheet as CSV in UTF-8",
    b"PAR1": "the file is Parquet: rename it so that its name ends in .parquet",
    b"\x1f\x8b": "the file is compressed: unpack it, as with: gunzip < FILE > NEW.csv",
    b"\xd0\xcf\x11\xe0": "the file is a workbook of a spreadsheet: save the sheet as CSV in UTF-8",
    b"\x89HDF": "the file is HDF5: write its columns as CSV, as with h5py and numpy.savetxt",
    b"MATLAB ": "the file is a MAT-file of MATLAB: write the columns as CSV, as with writetable(TABLE, 'NEW.csv')",
    b"TDSm": "the file is TDMS of LabVIEW: write the columns as CSV, as with as_dataframe of npTDMS",
    b"\x93NUMPY": "the file is an array of NumPy: write it as CSV, as with numpy.savetxt and a header",
}
"""Advice for files that are not text in UTF-8, by the first bytes of the file.

The entry of UTF-32 precedes the entries of UTF-16, because the mark of UTF-32 begins with the mark of UTF-16.
"""

BYTE_ORDER_MARK = "\ufeff"


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
        if first_lines and "\0" in first_lines[0]:
            raise source.error(f": {_null_advice(first_lines[0])}")
        self._separator, header_line = _find_header(first_lines, source.names)
        self._rows = _numbered_rows(chain(first_lines, checked_lines), self._separator, source)
        self._rows_above: list[tuple[int, list[str]]] = []  # rows above the header, which may state units
        header = None
        for line_number, cells in self._rows:
            if line_number >= header_line:
                header = cells
                break
            self._rows_above.append((line_number, cells))
        if header is None:
            raise source.error(f": empty; expected {source.expected}")
        super().__init__(header, source)
        self._mark_changes: dict[int, int] = {}  # `_SWAPPED_MARKS` if the file has decimal commas
        self._is_mark_certain = False
        self._marked_number = ""  # position and text of the first number with a mark, for error messages

    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Convert the cells of the requested columns to numbers, row by row.

        Args:
            rules: Rules of the requested columns, by the names of the columns. This method uses only their
                descriptions, for error messages.
            max_rows: Largest number of rows that is accepted.

        Raises:
            InputError: If there are too many rows, a row has the wrong number of cells, or a cell is not a finite
                number.
        """
        column_indices = {name: self.header.index(name) for name in rules}
        # The arrays of the module `array` need less memory than lists. "q" are 64-bit integers, "d" are 64-bit floats.
        line_numbers = array("q")
        numbers = array("d")  # the numbers of the first row, then the numbers of the second row, and so on
        for line_number, cells in self._rows_above:
            if len(cells) == len(self.header):
                self._is_row_of_units(line_number, cells, rules)  # refuses other units
        for line_number, cells in self._rows:
            if len(line_numbers) == max_rows:  # this row is one row too many
                self._refuse_row_count(max_rows)
            self._check_cell_count(line_number, cells)
            if not line_numbers and self._is_row_of_units(line_number, cells, rules):
                continue
            line_numbers.append(line_number)
            needed_cells = {name: cells[column_index].strip() for name, column_index in column_indices.items()}
            if not self._is_mark_certain:
                self._find_decimal_mark(line_number, needed_cells, cells)
            for name, cell in needed_cells.items():
                number = _number(cell.translate(self._mark_changes) if self._mark_changes else cell)
                if number is None:
                    self._refuse_cell(line_number, name, rules[name], cell)
                numbers.append(number)
        if self._marked_number and not self._is_mark_certain:
            self._refuse_ambiguous_numbers()
        rows = np.asarray(numbers, dtype=np.float64).reshape(len(line_numbers), len(column_indices))
        values = dict(zip(column_indices, rows.T, strict=True))
        return NumberColumns(values, np.array(line_numbers, dtype=np.intp), self.row_noun)

    def _find_decimal_mark(self, line_number: int, needed_cells: Mapping[str, str], cells: list[str]) -> None:
        """Determine the decimal mark, if the row contains numbers with a mark.

        The first number with a mark in a requested column determines it. The mark is certain if a number with the same
        mark cannot have it as a separator of thousands, or if it is a point and commas separate the columns.

        Args:
            line_number: Number of the line.
            needed_cells: Cells of the requested columns, by the names of the columns.
            cells: All cells of the row.
        """
        for name, cell in needed_cells.items():
            if not self._marked_number and _MARKED_NUMBER.fullmatch(cell):
                self._marked_number = f"line {line_number}, column {shown(name)}: {shown(cell)}"
                self._mark_changes = _SWAPPED_MARKS if "," in cell else {}
        mark = "," if self._mark_changes else "."
        marked_numbers = [cell for cell in map(str.strip, cells) if mark in cell and _MARKED_NUMBER.fullmatch(cell)]
        has_certain_number = any(not _THOUSANDS.fullmatch(number) for number in marked_numbers)
        is_comma_separated = mark == "." and self._separator == ","
        self._is_mark_certain = self._marked_number != "" and (has_certain_number or is_comma_separated)

    def _refuse_ambiguous_numbers(self) -> NoReturn:
        """Raise the error for a file whose marks may be decimal marks or separators of thousands.

        Raises:
            InputError: Always.
        """
        separator = repr(self._separator)[1:-1]  # the tab as `tr` expects it
        command = "" if separator == "," else f", as with: tr ',{separator}' '.,' < FILE > NEW.csv"
        raise self.source.error(
            f", {self._marked_number} has a decimal mark or a separator of thousands, and no number in the "
            "file excludes one of them; write commas between the columns, decimal points and no separators of "
            f"thousands{command}"
        )

    def _is_row_of_units(self, line_number: int, cells: list[str], rules: Mapping[str, ColumnRule]) -> bool:
        """Return whether a row states the units of the requested columns, and check the units.

        Args:
            line_number: Number of the line.
            cells: Cells of the row.
            rules: Rules of the requested columns, which contain the units.

        Raises:
            InputError: If the row states another unit than that of a column.
        """
        given_units = {name: cells[self.header.index(name)].strip(" []()°") for name in rules}
        expected_units = {name: rule.meaning.unit for name, rule in rules.items()}
        has_unit = any(
            unit in (expected_units[name], *OTHER_UNITS.get(expected_units[name], ()))
            for name, unit in given_units.items()
            if unit and unit not in self.header  # an electrode may be called C
        )
        if not has_unit:
            return False
        for name, unit in given_units.items():
            expected_unit = expected_units[name] or "-"
            if unit not in ("", expected_unit):
                raise self.source.error(
                    f", line {line_number}, column {shown(name)}: expected the unit {expected_unit}, got "
                    f"{shown(unit)}; convert the column and write {expected_unit}"
                )
        return True

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

    def _refuse_cell(self, line_number: int, name: str, rule: ColumnRule, cell: str) -> NoReturn:
        """Raise the error for a cell that is not a finite number.

        Args:
            line_number: Number of the line of the cell.
            name: Name of the column.
            rule: Rule of the column, whose description appears in the message.
            cell: Content of the cell.

        Raises:
            InputError: Always.
        """
        without_marks = cell.translate(_WITHOUT_MARKS)
        advice = ""
        if self._marked_number and without_marks != cell and _number(without_marks) is not None:
            mark = "comma" if self._mark_changes else "point"
            advice = f"; write a decimal {mark}, as in {self._marked_number}, and no separators of thousands"
        words = cell.split()
        if len(words) == 2 and _number(words[0]) is not None and _number(words[1]) is None:
            advice = f"; write the number without {shown(words[1])}"
        raise self.source.error(
            f", line {line_number}, column {shown(name)}: expected {rule.description}, got {shown(cell)}{advice}"
        )

    def _refuse_header(self, reason: str) -> NoReturn:
        """Raise the error for a wrong header, with advice if blanks separate the columns.

        Args:
            reason: What is wrong with the header, for the error message.

        Raises:
            InputError: Always.
        """
        advice = ""
        if len(self.header) == 1 and " " in self.header[0]:
            advice = "; if blanks separate the columns, write semicolons, as with: tr -s ' ' ';' < FILE > NEW.csv"
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

    def __init__(self, lines: Iterable[str], names: Collection[str], separator: str) -> None:
        """Store the arguments.

        Args:
            lines: Lines of the text, each with its line end.
            names: Names of columns. A line whose first cell is one of these names is not a comment, even if the name
                begins with #.
            separator: Character between the columns.
        """
        self.is_at_row_start = True
        self._lines = iter(lines)
        self._names = names
        self._separator = separator
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
        is_comment = self.is_at_row_start and _is_comment(line, self._names, self._separator)
        self.is_at_row_start = False
        return "\n" if is_comment else line


def _checked_lines(lines: Iterable[str], source: TableSource) -> Iterator[str]:
    """Yield the lines of a text.

    Args:
        lines: Lines of the text, each with its line end.
        source: Name of the file and class of the error, for error messages.

    Raises:
        InputError: If the lines are not text in UTF-8, or a line is too long.
    """
    line_count = 0
    try:
        for line in lines:
            line_count += 1
            yield line
    # InputError and UnicodeDecodeError are subclasses of ValueError, so their clauses must precede the clause of
    # ValueError.
    except InputError:  # the iterator `lines` has raised an error with its own message
        raise
    except UnicodeDecodeError as cause:
        raise source.error(_decoding_advice(cause, line_count)) from cause
    except ValueError as cause:  # the next line is too long
        raise source.error(f", line {line_count + 1}: not CSV text ({cause})") from cause


def _numbered_rows(lines: Iterable[str], separator: str, source: TableSource) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells of each row that is neither blank nor a comment.

    The first line has the number 1. If a row extends over several lines, the line number is the number of its last
    line.

    Args:
        lines: Lines of the text, each with its line end.
        separator: Character between the columns.
        source: Name of the file, its known columns, and the class of errors.

    Raises:
        InputError: If the lines are not CSV text.
    """
    lines_without_comments = _LinesWithoutComments(lines, source.names, separator)
    reader = csv.reader(lines_without_comments, delimiter=separator, strict=True)
    try:
        for cells in reader:
            lines_without_comments.is_at_row_start = True  # the next line begins a row and may be a comment
            if any(cell.strip() for cell in cells):
                yield reader.line_num, cells
    except csv.Error as cause:
        raise source.error(f", line {reader.line_num}: not CSV text ({cause})") from cause


def _find_header(lines: list[str], names: Collection[str]) -> tuple[str, int]:
    """Find the separator of the columns and the header at the beginning of a text.

    The header is the row with most names, among the rows above the first row that contains only numbers. A row that
    contains a number in addition to names is not the header. If no row contains a name, the first row is the header.
    The separator is the one with which the header has most names, and then most cells.

    Args:
        lines: First lines of the text.
        names: Names of columns that have a meaning.

    Returns:
        The separator, and the number of the line of the header.
    """
    source = TableSource(names, "", InputError, "")
    best_score = (-1, 0, 0)
    best_separator = _SEPARATORS[0]
    for separator in _SEPARATORS:
        with suppress(InputError):  # the error is raised again when the table is read
            for line_number, cells in _numbered_rows(lines, separator, source):
                texts = {cell.strip() for cell in cells if cell.strip()}
                numbers = {text for text in texts if _number(text.replace(",", ".")) is not None}
                has_number = bool(numbers.difference(names))
                name_count = 0 if has_number else len(texts.intersection(names))
                score = (name_count, -line_number, len(cells))
                if score > best_score:
                    best_score = score
                    best_separator = separator
                if has_number and numbers == texts:
                    break
    return best_separator, -best_score[1]


def _null_advice(line: str) -> str:
    """Return advice for a file whose first line contains null characters.

    Args:
        line: The first line.
    """
    format_advice = _other_format_advice(line.encode())
    if format_advice:
        return format_advice
    # In UTF-16, one of the two bytes of an ASCII letter is zero: the first in UTF-16BE, the second in UTF-16LE.
    for position, encoding in enumerate(("UTF-16BE", "UTF-16LE")):
        if set(line[position::2]) == {"\0"}:
            return (
                "the header has null characters: the file seems to be UTF-16 without a byte order mark; save it as "
                f"UTF-8, as with: iconv -f {encoding} -t UTF-8 FILE > NEW.csv"
            )
    return "the file has null characters and is not text: write its columns as CSV in UTF-8"


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


def _is_comment(line: str, names: Collection[str], separator: str) -> bool:
    """Return whether a line begins with # and its first cell is not one of the names, or is a line such as `sep=;`.

    Args:
        line: The line, which begins a row.
        names: Names of columns that may begin with #.
        separator: Character between the columns.
    """
    first_cell = line.partition(separator)[0].strip()
    begins_with_mark = first_cell.startswith("#") and first_cell not in names
    return begins_with_mark or _SEPARATOR_LINE.fullmatch(line) is not None


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
