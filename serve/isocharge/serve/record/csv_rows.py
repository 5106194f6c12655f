"""Conversion of records to CSV, with a separate column for each number."""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from isocharge.serve.record.record import DECIMALS, PredictionRecord, selected_fields


def csv_header(electrodes: Sequence[str], *, with_tracking: bool = False, with_film: bool = False) -> str:
    """Return the header of a CSV file of records, which contains the names of the columns, without the line end.

    A field with several numbers has one column for each number, such as `charge_pC.A` for the electrode A.

    Args:
        electrodes: Names of the electrodes.
        with_tracking: Whether the records have the fields of the tracking.
        with_film: Whether the records have the fields of the film follower.
    """
    columns = _columns(electrodes, with_tracking=with_tracking, with_film=with_film)
    return _line(name if part is None else f"{name}.{part}" for name, part in columns)


def csv_row(record: PredictionRecord, electrodes: Sequence[str]) -> str:
    """Convert a record to a line of a CSV file, without the line end.

    Numbers have six decimals, flags are separated by blanks, and the cells of unknown values are empty.

    Args:
        record: Record to convert.
        electrodes: Names of the electrodes, in the order of the header.
    """
    has_tracking = record.tracking is not None
    has_film = record.film is not None
    cells: list[str] = []
    for name, part in _columns(electrodes, with_tracking=has_tracking, with_film=has_film):
        value = getattr(record, name)
        if part is not None and value is not None:
            value = value[part] if isinstance(value, dict) else getattr(value, part)
        cells.append(_cell(value))
    return _line(cells)


def _columns(electrodes: Sequence[str], *, with_tracking: bool, with_film: bool) -> Iterator[tuple[str, str | None]]:
    """Yield the name of the field and the name of its part for each column.

    The parts of charges are the electrodes, and the parts of an object are its fields. The part is None for a field
    with one column.
    """
    for field in selected_fields(with_tracking=with_tracking, with_film=with_film):
        parts: Iterable[str | None] = [None]
        if field.kind == "charges":
            parts = electrodes
        elif field.kind == "object":
            parts = [part.name for part in field.parts]
        for part in parts:
            yield field.name, part


def _line(cells: Iterable[str]) -> str:
    """Join cells with commas, and put cells in quotation marks where CSV requires it."""
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue().removesuffix("\r\n")


def _cell(value: Any) -> str:
    """Convert a value to the text of a cell.

    The value None becomes an empty text. The words of a tuple are joined with blanks. A floating-point number gets six
    decimals.
    """
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.{DECIMALS}f}"
    return str(value)
