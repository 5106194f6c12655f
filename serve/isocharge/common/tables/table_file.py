"""Files with columns of numbers. A file is Parquet if its name ends in `.parquet`, and otherwise CSV."""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, IsochargeError
from isocharge.common.files import as_output_errors, bounded_lines, open_regular, write_whole
from isocharge.common.tables.csv_table import CsvTable, csv_text
from isocharge.common.tables.number_table import NumberTable
from isocharge.common.tables.parquet_table import SUFFIX, ParquetTable, parquet_bytes, require_pyarrow


def is_parquet(path: Path) -> bool:
    """Return whether a file is Parquet according to its name."""
    return path.suffix.lower() == SUFFIX


@contextmanager
def open_table(path: Path, names: Collection[str], error: type[InputError], expected: str) -> Iterator[NumberTable]:
    """Open a file and read its header.

    Args:
        path: A Parquet file, which must be a regular file, or CSV in UTF-8 with or without a byte order mark.
        names: Names of columns that have a meaning.
        error: Class of the error that is raised for anything that is wrong with the file.
        expected: The expected header, for messages.

    Raises:
        error: If the file cannot be read, here or while the block reads the columns.
        MissingExtra: If the file is Parquet and pyarrow is not installed.
    """
    if is_parquet(path):
        require_pyarrow()
        with _os_errors_converted(path, error, "a Parquet file of presses"), open_regular(path) as file:
            yield ParquetTable(file, names, str(path), error, expected)
    else:
        with (
            _os_errors_converted(path, error, "a CSV file of presses"),
            path.open(encoding="utf-8-sig", newline="") as text,  # the CSV reader interprets the line ends itself
        ):
            yield CsvTable(bounded_lines(text), names, str(path), error, expected)


def write_columns(path: Path, columns: Mapping[str, Array]) -> None:
    """Write columns to a file. An existing file is replaced.

    Args:
        path: The file.
        columns: Columns by name, each of shape (n,).

    Raises:
        OutputError: If the file cannot be written.
        MissingExtra: If the format is Parquet and pyarrow is not installed.
    """
    data = parquet_bytes(columns) if is_parquet(path) else csv_text(columns).encode()
    with as_output_errors(path):
        write_whole(path, data)


@contextmanager
def _os_errors_converted(path: Path, error: type[InputError], expected: str) -> Iterator[None]:
    """Convert the errors of the file system in the block to `error`.

    Args:
        path: The file, for the error message.
        error: Class of the error that is raised.
        expected: Description of the expected file, for the error message.
    """
    try:
        yield
    except OSError as cause:
        if isinstance(cause, IsochargeError):  # some classes, such as OutputError, inherit from OSError
            raise
        raise error(f"{path}: cannot be read ({cause.strerror or cause}); expected {expected}") from cause
