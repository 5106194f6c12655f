"""Opening and writing of files with columns of numbers.

The format of a file is Parquet if its name ends in `.parquet`, and CSV otherwise.
"""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, IsochargeError
from isocharge.common.files import as_output_errors, bounded_lines, open_regular, write_whole
from isocharge.serve.presses.csv_table import CsvTable, csv_text
from isocharge.serve.presses.number_table import NumberTable, TableSource
from isocharge.serve.presses.parquet_table import SUFFIX, ParquetTable, parquet_bytes, require_pyarrow


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
            order mark.
        names: Names of columns that have a meaning.
        error_class: Class of the error that is raised for every mistake in the file.
        expected: Description of the expected header, for error messages.

    Yields:
        The table, whose columns have not been read yet.

    Raises:
        error_class: If the file cannot be read, either when it is opened or when the block reads the columns.
        MissingExtra: If the file is Parquet and pyarrow is not installed.
    """
    source = TableSource(names, str(path), error_class, expected)
    kind = "Parquet" if is_parquet(path) else "CSV"
    try:
        if is_parquet(path):
            require_pyarrow()
            with open_regular(path) as file:
                yield ParquetTable(file, source)
        else:
            with path.open(encoding="utf-8-sig", newline="") as text:  # the CSV reader handles the line ends
                yield CsvTable(bounded_lines(text), source)
    except IsochargeError:  # some errors of isocharge, such as OutputError, inherit from OSError
        raise
    except OSError as cause:
        raise error_class(
            f"{path}: cannot be read ({cause.strerror or cause}); expected a {kind} file of presses"
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
