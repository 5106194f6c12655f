"""Records as CSV: one column for each number, such as `charge_pC.A` or `tracked.vx_mm_s`."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

from isocharge.serve.record.fields import Field
from isocharge.serve.record.record import DECIMALS, PredictionRecord, selected_fields


def csv_header(electrodes: Sequence[str], *, with_tracking: bool = False, with_film: bool = False) -> str:
    """Return the header of the rows that `csv_row` returns.

    Args:
        electrodes: Names of the electrodes.
        with_tracking: Whether the records have the fields of the tracking.
        with_film: Whether the records have the fields of the film follower.
    """
    columns: list[str] = []
    for field in selected_fields(with_tracking=with_tracking, with_film=with_film):
        parts = _part_names(field, electrodes)
        if parts is None:
            columns.append(field.name)
        else:
            columns += [f"{field.name}.{part}" for part in parts]
    return _line(columns)


def csv_row(record: PredictionRecord, electrodes: Sequence[str]) -> str:
    """Return a record as a row of a CSV file.

    Numbers have six decimals, flags are separated by blanks, and the cells of unknown values are empty.

    Args:
        record: The record.
        electrodes: Names of the electrodes, in the order of the header.
    """
    fields = selected_fields(with_tracking=record.tracking is not None, with_film=record.film is not None)
    cells: list[str] = []
    for field in fields:
        value = getattr(record, field.name)
        parts = _part_names(field, electrodes)
        if parts is None:
            cells.append(_cell(value))
        elif value is None:
            cells += [""] * len(parts)
        elif field.kind == "charges":
            cells += [_cell(value[part]) for part in parts]
        else:
            cells += [_cell(getattr(value, part)) for part in parts]
    return _line(cells)


def _part_names(field: Field, electrodes: Sequence[str]) -> Sequence[str] | None:
    """Return the names of the parts of a field that has several columns.

    Args:
        field: The field.
        electrodes: Names of the electrodes.

    Returns:
        The names; None if the field has one column.
    """
    if field.kind == "charges":
        return electrodes
    if field.kind == "object":
        return [part.name for part in field.parts]
    return None


def _line(cells: Iterable[str]) -> str:
    """Return cells separated by commas, quoted where necessary."""
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue().removesuffix("\r\n")


def _cell(value: Any) -> str:
    """Return the text of one cell: empty for None, words separated by blanks, and numbers with six decimals."""
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(value)
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.{DECIMALS}f}" if isinstance(value, float) else str(value)
