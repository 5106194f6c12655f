"""Tables of presses as Parquet: the columns of the CSV file, by the same names, with the same checks.

A Parquet file is read as the lines of CSV that it stands for: one reader says what is wrong with either.
"""

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError, cut
from isocharge.common.extras import require

SUFFIX = ".parquet"
"""End of the names of Parquet files."""


def parquet_lines(path: Path) -> Iterator[str]:
    """A Parquet file as lines of CSV; null and NaN are empty cells.

    Raises:
        PressError: If the file is none, or cannot be read.
        MissingExtra: If pyarrow is not installed.
    """
    with require("parquet"):
        from pyarrow import ArrowException
        from pyarrow.parquet import ParquetFile
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    try:
        with ParquetFile(path) as file:
            writer.writerow(file.schema_arrow.names)
            for batch in file.iter_batches():
                columns = [column.to_pylist() for column in batch.columns]
                writer.writerows(map(_cells, zip(*columns, strict=True)))
                yield from _taken(text)
    except OSError as error:
        raise PressError(f"{path}: cannot be read ({cut(str(error))})") from error
    except ArrowException as error:
        raise PressError(f"{path}: not a Parquet file ({cut(str(error))}); write it again, or as CSV") from error
    yield from _taken(text)


def parquet_bytes(columns: Mapping[str, Array]) -> bytes:
    """A Parquet file of columns of shape (n,), float64; NaN is written as null.

    Raises:
        MissingExtra: If pyarrow is not installed.
    """
    with require("parquet"):
        import pyarrow
        from pyarrow.parquet import write_table
    data = io.BytesIO()
    write_table(
        pyarrow.table({name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()}), data
    )
    return data.getvalue()


def _cells(row: tuple[object, ...]) -> list[object]:
    return ["" if value is None or value != value else value for value in row]


def _taken(text: io.StringIO) -> list[str]:
    """The lines that were written, which are then gone."""
    lines = text.getvalue().splitlines(keepends=True)
    text.seek(0)
    text.truncate()
    return lines
