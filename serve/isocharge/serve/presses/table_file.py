"""Files with columns of numbers: Parquet if the name of the file ends in `.parquet`, and CSV otherwise.

The columns of CSV text are separated by commas, semicolons, tabs or bars. The header is the first row that contains a
name with a meaning; rows above it are ignored. The decimal mark is a point or a comma, and the same in the whole file.
A number such as `1,064` may be 1.064 or 1064. A file in which no number determines the decimal mark is therefore
refused. A point is always the decimal mark if commas separate the columns.

A row that begins with # is a comment. Blank rows, and a row below the header that has the units mm, N and pC in the
columns to read, are ignored. Blanks before and after a name or a number are also ignored. The texts `nan` and `inf` are
not accepted.

Of a Parquet file, only the requested columns are decoded. A requested column may contain integers, floating-point
numbers or decimal numbers of any width. Null and NaN stand for empty cells. The other columns of the file may have any
type.
"""

import csv
import io
import math
import re
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import chain, islice
from pathlib import Path
from pty import STDIN_FILENO
from typing import BinaryIO

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, IsochargeError, cut, require, shown
from isocharge.common.files import bounded_lines, open_regular
from isocharge.serve.presses.number_table import ColumnRule, NumberColumns, NumberTable, TableSource

STDIN = Path("-")
"""Path that stands for standard input, from which CSV text is read."""

SUFFIX = ".parquet"
"""End of the names of Parquet files."""

MAX_METADATA_SIZE = 16 << 20
"""Largest size of a text in the metadata, bytes, and largest number of elements of a list in the metadata."""


_SEPARATORS = ",;\t|"
"""Characters that may separate the columns."""

_UNITS = frozenset({"mm", "N", "pC", "1", "-", ""})
"""Cells of a row of units below the header."""

_MAX_LINES_TO_HEADER = 100
"""Number of lines at the beginning of a file among which the header is searched."""

_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:([.,])[0-9]*)?|([.,])[0-9]+)(?:[eE][-+]?[0-9]+)?")
"""Number with or without a decimal mark, which is a group."""

_WRONG_BYTE = re.compile("[\0\udc80-\udcff]")
"""Zero byte, or a byte that is not UTF-8, which the error handler `surrogateescape` replaces by a surrogate."""

_THOUSANDS = re.compile(r"[-+]?[1-9][0-9]{0,2}[.,][0-9]{3}")
"""Number whose mark may be a separator of thousands."""


class CsvTable(NumberTable):
    """Table of numbers that is read from a CSV text."""

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
                cell = cells[column_index].strip()
                number = self._number(cell)
                if number is None:
                    has_other_mark = self._mark != "" and any(mark in cell for mark in ",." if mark != self._mark)
                    advice = f"; the decimal mark is {self._mark!r}" if has_other_mark else ""
                    raise self.source.error(
                        f", line {line_number}, column {shown(name)}: expected {rules[name].description}, got "
                        f"{shown(cell)}{advice}"
                    )
                numbers.append(number)
            if self._mark and not self._is_mark_certain:  # a fraction in another column, such as 0.5, is no date
                texts = [cell.strip() for cell in cells]
                fractions = [text for text in texts if text.startswith(f"0{self._mark}")]
                self._is_mark_certain = any(map(_NUMBER.fullmatch, fractions))
        if self._mark and not self._is_mark_certain:
            raise self.source.error(
                f": every number with the mark {self._mark!r} may have a decimal mark or a separator of thousands; "
                "write commas between the columns, decimal points and no separators of thousands"
            )
        rows = np.asarray(numbers, dtype=np.float64).reshape(len(line_numbers), len(column_indices))
        values = dict(zip(column_indices, rows.T, strict=True))
        return NumberColumns(values, line_numbers, "line")

    def _number(self, text: str) -> float | None:
        """Return the number in a cell: NaN for an empty cell, and None for a cell without a finite number.

        The first number with a decimal mark determines the decimal mark of the file. The mark is certain as soon as it
        cannot be a separator of thousands.

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
        if mark and not self._is_mark_certain:
            is_point_between_commas = (self._separator, mark) == (",", ".")
            self._is_mark_certain = is_point_between_commas or _THOUSANDS.fullmatch(text) is None
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


def _checked_lines(lines: Iterable[str], source: TableSource) -> Iterator[str]:
    """Yield the lines of a text without a byte order mark.

    Args:
        lines: Lines of the text, each with its line end.
        source: Name of the file and class of the error, for error messages.

    Raises:
        InputError: If the lines are not text in UTF-8, or a line is too long.
    """
    line_number = 0
    try:
        for line_number, line in enumerate(lines, start=1):
            is_plain = line.isascii() and "\0" not in line  # is fast to check, and true for most lines
            wrong_byte = None if is_plain else _WRONG_BYTE.search(line)
            if wrong_byte:  # the file is binary, or text in another encoding
                raise source.error(
                    f", line {line_number}: the byte 0x{ord(wrong_byte[0]) & 0xFF:02x} is not text in UTF-8: export "
                    "the file as CSV in UTF-8; convert other text with: iconv -f UTF-16 (or WINDOWS-1252) -t UTF-8 "
                    "FILE > NEW.csv"
                )
            yield line.removeprefix("\ufeff") if line_number == 1 else line
    except InputError:  # is a ValueError, too
        raise
    except ValueError as cause:  # the next line is too long
        raise source.error(f", line {line_number + 1}: not CSV text in UTF-8 ({cause})") from cause


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


class ParquetTable(NumberTable):
    """Table of numbers that is read from a Parquet file."""

    def __init__(self, file: BinaryIO, source: TableSource) -> None:
        """Read the metadata of the file, which must remain open until the columns have been read.

        Raises:
            InputError: If the file is not Parquet, is damaged, or has too many columns.
        """
        from pyarrow.parquet import ParquetFile

        with _pyarrow_errors_converted(source):
            self._parquet = ParquetFile(
                file,
                thrift_string_size_limit=MAX_METADATA_SIZE,
                thrift_container_size_limit=MAX_METADATA_SIZE,
            )
            self._schema = self._parquet.schema_arrow
            header = self._schema.names
        super().__init__(header, source)

    def _read_columns(self, rules: Mapping[str, ColumnRule], max_rows: int) -> NumberColumns:
        """Decode the requested columns.

        Raises:
            InputError: If there are too many rows, if the type of a column is not a number type, or if the file is
                damaged.
        """
        import pyarrow
        from pyarrow import types

        row_count = self._parquet.metadata.num_rows
        if row_count > max_rows:
            self._refuse_row_count(max_rows)
        fields = {name: self._schema.field(self.header.index(name)) for name in rules}
        # A column of nulls is an empty column.
        is_of_type = (types.is_integer, types.is_floating, types.is_decimal, types.is_null)
        for name, field in fields.items():
            if not any(check(field.type) for check in is_of_type):
                raise self.source.error(
                    f", column {shown(name)}: expected numbers ({rules[name].description}), got a column of type "
                    f"{cut(str(field.type))}; convert it to float64"
                )
        with _pyarrow_errors_converted(self.source):
            table = self._parquet.read([field.name for field in fields.values()], use_threads=False)
            values = {
                name: np.asarray(table.column(field.name).cast(pyarrow.float64(), safe=False).to_numpy())
                for name, field in fields.items()
            }
            if any(len(column) != row_count for column in values.values()):
                raise ValueError(f"the columns do not have {row_count:,} rows as stated in the metadata")
        return NumberColumns(values, range(1, row_count + 1), "row")


def parquet_bytes(columns: Mapping[str, Array]) -> bytes:
    """Return the bytes of a Parquet file with columns of numbers. NaN is written as null.

    Args:
        columns: Columns by their names, each of shape (n,), float64.

    Raises:
        MissingExtra: If pyarrow is not installed.
    """
    with require("parquet"):
        import pyarrow
        from pyarrow.parquet import write_table

    # The option `from_pandas` converts NaN to null.
    arrow_columns = {name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()}
    file = io.BytesIO()
    write_table(pyarrow.table(arrow_columns), file)
    return file.getvalue()


@contextmanager
def _pyarrow_errors_converted(source: TableSource) -> Iterator[None]:
    """If pyarrow raises an exception for a damaged file in the `with` block, raise a given error instead.

    Args:
        source: Name of the file and class of the error, for the error message.

    Raises:
        InputError: If the block raises one of the exceptions of pyarrow.
    """
    from pyarrow import ArrowException

    try:
        yield
    except (ArrowException, OSError, ValueError, MemoryError, OverflowError) as cause:
        reason = cut(" ".join(str(cause).split()))
        raise source.error(f": not a Parquet file, or a damaged one ({reason}); write it again, or as CSV") from cause


def is_parquet(path: Path) -> bool:
    """Return whether the name of a file ends in `.parquet`, in any mixture of capital and small letters."""
    return path.suffix.lower() == SUFFIX


@contextmanager
def open_table(
    path: Path, names: Collection[str], error_class: type[InputError], expected: str
) -> Iterator[NumberTable]:
    """Open a file for the `with` block, and read its header.

    Args:
        path: The file. A Parquet file must be a regular file. A CSV file must be text in UTF-8, with or without a byte
            order mark. The path `-` is standard input.
        names: Names of columns that have a meaning.
        error_class: Class of the error that is raised for every mistake in the file.
        expected: Description of the expected header, for error messages.

    Yields:
        The table, whose columns have not been read yet.

    Raises:
        error_class: If the file cannot be read, either when it is opened or when the block reads the columns.
        MissingExtra: If the file is Parquet and pyarrow is not installed.
    """
    is_stdin = path == STDIN
    source = TableSource(names, "stdin" if is_stdin else str(path), error_class, expected)
    kind = "Parquet" if is_parquet(path) else "CSV"
    try:
        if is_parquet(path):
            with require("parquet"):
                import pyarrow  # noqa: F401 - a missing package is reported before a missing file
            with open_regular(path) as file:
                yield ParquetTable(file, source)
        else:
            file_or_descriptor = STDIN_FILENO if is_stdin else path
            # The CSV reader handles the line ends. The table refuses bytes that are not UTF-8.
            with open(
                file_or_descriptor, encoding="utf-8", errors="surrogateescape", newline="", closefd=not is_stdin
            ) as text:
                yield CsvTable(bounded_lines(text), source)
    except IsochargeError:  # some errors of isocharge, such as OutputError, inherit from OSError
        raise
    except OSError as cause:
        raise error_class(
            f"{source.where}: cannot be read ({cause.strerror or cause}); expected a {kind} file of presses"
        ) from cause
