"""Reading and writing of columns of numbers as Parquet.

First, the number of rows and the types of the requested columns are checked in the metadata of the file. Then only the
requested columns are decoded. A requested column may contain integers, floating-point numbers or decimal numbers of any
width. Null and NaN stand for empty cells. The other columns of the file may have any type.
"""

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import cut, shown
from isocharge.common.extras import require
from isocharge.serve.presses.number_table import ColumnRule, NumberColumns, NumberTable, TableSource

if TYPE_CHECKING:
    from pyarrow import Array as ArrowArray
    from pyarrow import DataType

SUFFIX = ".parquet"
"""End of the names of Parquet files."""

MARK = b"PAR1"
"""First and last four bytes of a Parquet file."""

SIZE_FIELD_BYTES = 4
"""Length of the field near the end of a Parquet file that contains the size of the metadata, bytes."""

MAX_FOOTER_BYTES = 16 << 20
"""Largest size of the metadata at the end of a file."""

ROWS_PER_BATCH = 1 << 16
"""Number of rows of a column that are decoded in one batch."""

FIRST_INEXACT_INTEGER = 2**53
"""Smallest positive integer that may be the result of rounding in float64, because 2^53 + 1 is rounded to 2^53."""


class ParquetTable(NumberTable):
    """Table of numbers that is read from a Parquet file."""

    row_noun = "row"

    def __init__(self, file: BinaryIO, source: TableSource) -> None:
        """Read the metadata of the file, which must remain open until the columns have been read.

        Raises:
            InputError: If the file is not Parquet, is damaged, or has too many columns.
            MissingExtra: If pyarrow is not installed.
        """
        require_pyarrow()
        from pyarrow.parquet import ParquetFile

        _check_ends(file, source)
        with _pyarrow_errors_converted(source):
            self._parquet = ParquetFile(file)
            self._metadata = self._parquet.metadata
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
        row_count = self._metadata.num_rows
        if row_count > max_rows:
            self._refuse_row_count(max_rows)
        values = {name: self._read_column(name, rule) for name, rule in rules.items()}
        row_numbers = np.arange(1, row_count + 1, dtype=np.intp)
        return NumberColumns(values, row_numbers, self.row_noun)

    def _read_column(self, name: str, rule: ColumnRule) -> Array:
        """Read one column, and check its type.

        Args:
            name: Name of the column.
            rule: Rule of the column, whose description appears in error messages.

        Returns:
            The numbers of the column as float64, shape (n,); NaN for null.

        Raises:
            InputError: If the type of the column is not a number type, if the conversion may have rounded an integer,
                or if the file is damaged.
        """
        from pyarrow.types import is_integer

        field = self._schema.field(self.header.index(name))
        if not _is_number_type(field.type):
            raise self.source.error(
                f", column {shown(name)}: expected numbers ({rule.description}), got a column of type "
                f"{cut(str(field.type))}; convert it to float64"
            )
        with _pyarrow_errors_converted(self.source):
            numbers = self._decode(self._leaf_index(field.name), name)
        if is_integer(field.type):
            self._refuse_rounded_integers(numbers, name)
        return numbers

    def _decode(self, leaf_index: int, name: str) -> Array:
        """Decode one column in batches of rows, in order to limit the memory.

        Args:
            leaf_index: Index under which Parquet stores the numbers of the column; see `_leaf_index`.
            name: Name of the column, for error messages.

        Returns:
            The numbers of the column as float64, shape (n,); NaN for null.

        Raises:
            InputError: If the column has another number of rows than the metadata declare.
        """
        declared_row_count = self._metadata.num_rows
        numbers = np.empty(declared_row_count)
        row_count = 0  # number of rows that are decoded so far
        all_groups = list(range(self._metadata.num_row_groups))
        for batch in self._parquet.reader.iter_batches(ROWS_PER_BATCH, all_groups, [leaf_index], use_threads=False):
            first_row = row_count
            row_count += batch.num_rows
            if row_count > declared_row_count:  # the column has more rows than the metadata declare
                break
            numbers[first_row:row_count] = _as_float64(batch.column(0))  # the only column of the batch
        if row_count != declared_row_count:
            raise self.source.error(
                f", column {shown(name)}: expected {declared_row_count:,} rows as in the metadata of the "
                "file, got another number; the file is damaged, write it again"
            )
        return numbers

    def _leaf_index(self, field_name: str) -> int:
        """Return the index under which Parquet stores the numbers of a column.

        The index may be larger than the position of the column in the header. A nested column, such as a column of
        records, counts once in the header, but Parquet stores each of its parts under a separate index.

        Args:
            field_name: Name of the column in the file.

        Raises:
            InputError: If no column, or more than one column, is stored under this name.
        """
        schema = self._parquet.schema
        indices = [index for index in range(len(schema)) if schema.column(index).path == field_name]
        if len(indices) != 1:
            raise self.source.error(
                f": expected one column {shown(field_name)}, got {len(indices)} that are stored under "
                "this name; rename the others"
            )
        return indices[0]

    def _refuse_rounded_integers(self, numbers: Array, name: str) -> None:
        """Refuse a column with integers that the conversion to float64 may have rounded.

        Args:
            numbers: The converted integers of the column, shape (n,); NaN for null.
            name: Name of the column, for the error message.

        Raises:
            InputError: If the magnitude of a number is at least `FIRST_INEXACT_INTEGER`.
        """
        inexact_rows = np.flatnonzero(np.abs(numbers) >= FIRST_INEXACT_INTEGER)
        if inexact_rows.size:
            row = inexact_rows[0]
            raise self.source.error(
                f", row {row + 1}, column {shown(name)}: expected an integer of a magnitude below 2^53, "
                f"which float64 holds exactly, got {numbers[row]:.0f}; convert the column to float64"
            )


def parquet_bytes(columns: Mapping[str, Array]) -> bytes:
    """Return the bytes of a Parquet file with columns of numbers. NaN is written as null.

    Args:
        columns: Columns by their names, each of shape (n,), float64.

    Raises:
        MissingExtra: If pyarrow is not installed.
    """
    require_pyarrow()
    import pyarrow
    from pyarrow.parquet import write_table

    # The option `from_pandas` converts NaN to null.
    arrow_columns = {name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()}
    file = io.BytesIO()
    write_table(pyarrow.table(arrow_columns), file)
    return file.getvalue()


def require_pyarrow() -> None:
    """Check that pyarrow is installed.

    Raises:
        MissingExtra: If pyarrow is not installed.
    """
    with require("parquet"):
        import pyarrow.parquet  # noqa: F401


def _check_ends(file: BinaryIO, source: TableSource) -> None:
    """Check the marks at both ends of a Parquet file, and the size of the metadata.

    The size is checked before pyarrow reads the metadata, because large metadata need much memory.

    Args:
        file: The file, which is open for reading. Its position is 0 before and after the call.
        source: Name of the file and class of the error, for error messages.

    Raises:
        InputError: If the file is not Parquet, is incomplete, or has very large metadata.
    """
    first_mark = file.read(len(MARK))

    # A Parquet file ends with the size of its metadata (u32, little-endian) and the mark.
    file_bytes = file.seek(0, io.SEEK_END)
    file.seek(max(0, file_bytes - SIZE_FIELD_BYTES - len(MARK)))
    metadata_bytes = int.from_bytes(file.read(SIZE_FIELD_BYTES), "little")
    last_mark = file.read(len(MARK))
    file.seek(0)  # pyarrow reads the file from its beginning

    if first_mark != MARK or last_mark != MARK:
        raise source.error(": not a Parquet file, or one that was cut off; write it again, or as CSV")
    if metadata_bytes > MAX_FOOTER_BYTES:
        raise source.error(
            f": expected metadata of at most {MAX_FOOTER_BYTES:,} bytes, got {metadata_bytes:,}; write the file "
            "with fewer columns or row groups"
        )


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
    except source.error_class:  # the block has raised an error with its own message; it may also be a ValueError
        raise
    except (ArrowException, OSError, ValueError, MemoryError, OverflowError) as cause:
        reason = cut(" ".join(str(cause).split()))
        raise source.error(f": not a Parquet file, or a damaged one ({reason}); write it again, or as CSV") from cause


def _is_number_type(given_type: "DataType") -> bool:
    """Return whether a type of pyarrow contains only numbers and null. A column of nulls is an empty column."""
    from pyarrow import types

    checks = (types.is_integer, types.is_floating, types.is_decimal, types.is_null)
    return any(check(given_type) for check in checks)


def _as_float64(column: "ArrowArray") -> Array:
    """Convert a column of pyarrow to float64, shape (n,). Null becomes NaN.

    Args:
        column: Column of integers, floating-point numbers, decimal numbers or nulls.
    """
    import pyarrow

    if pyarrow.types.is_decimal(column.type):
        column = column.cast(pyarrow.string())  # the conversion from text rounds to the nearest number
    float_column = column.cast(pyarrow.float64(), safe=False)  # integers may be rounded
    numbers: Any = float_column.to_numpy(zero_copy_only=False)  # a column with nulls must be copied
    return np.asarray(numbers, dtype=np.float64)
