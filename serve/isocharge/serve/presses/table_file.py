"""Files with columns of numbers: Parquet if the name of the file ends in `.parquet`, and CSV otherwise.

Of a Parquet file, only the requested columns are decoded. A requested column may contain integers, floating-point
numbers or decimal numbers of any width. Null and NaN stand for empty cells. The other columns of the file may have any
type.
"""

import io
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from pty import STDIN_FILENO
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, IsochargeError, cut, require, shown
from isocharge.common.files import as_output_errors, bounded_lines, open_regular, write_whole
from isocharge.serve.presses.csv_table import ColumnRule, CsvTable, NumberColumns, NumberTable, TableSource, csv_text

if TYPE_CHECKING:
    from pyarrow import DataType

STDIN = Path("-")
"""Path that stands for standard input, from which CSV text is read."""

SUFFIX = ".parquet"
"""End of the names of Parquet files."""

MAX_METADATA_SIZE = 16 << 20
"""Largest size of a text in the metadata, bytes, and largest number of elements of a list in the metadata."""


class ParquetTable(NumberTable):
    """Table of numbers that is read from a Parquet file."""

    row_noun = "row"

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

        Args:
            rules: Rules of the requested columns, by the names of the columns. This method uses only their
                descriptions, for error messages.
            max_rows: Largest number of rows that is accepted.

        Raises:
            InputError: If there are too many rows, if the type of a column is not a number type, or if the file is
                damaged.
        """
        import pyarrow

        row_count = self._parquet.metadata.num_rows
        if row_count > max_rows:
            self._refuse_row_count(max_rows)
        fields = {name: self._schema.field(self.header.index(name)) for name in rules}
        for name, field in fields.items():
            if not _is_number_type(field.type):
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
        return NumberColumns(values, np.arange(1, row_count + 1, dtype=np.intp), self.row_noun)


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


def _is_number_type(given_type: "DataType") -> bool:
    """Return whether a type of pyarrow contains only numbers and null. A column of nulls is an empty column."""
    from pyarrow import types

    checks = (types.is_integer, types.is_floating, types.is_decimal, types.is_null)
    return any(check(given_type) for check in checks)


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
            # The CSV reader handles the line ends.
            with open(file_or_descriptor, encoding="utf-8-sig", newline="", closefd=not is_stdin) as text:
                yield CsvTable(bounded_lines(text), source)
    except IsochargeError:  # some errors of isocharge, such as OutputError, inherit from OSError
        raise
    except OSError as cause:
        raise error_class(
            f"{source.where}: cannot be read ({cause.strerror or cause}); expected a {kind} file of presses"
        ) from cause


def write_columns(path: Path, columns: Mapping[str, Array]) -> None:
    """Write columns of numbers to a file. An existing file is replaced.

    Args:
        path: The file, whose name determines the format.
        columns: Columns by their names, each of shape (n,).

    Raises:
        OutputError: If the file cannot be written.
        MissingExtra: If the format is Parquet and pyarrow is not installed.
    """
    data = parquet_bytes(columns) if is_parquet(path) else csv_text(columns).encode()
    with as_output_errors(path):
        write_whole(path, data)
