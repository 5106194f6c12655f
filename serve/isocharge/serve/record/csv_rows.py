"""Conversion of records to CSV, with a separate column for each number."""

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

from isocharge.serve.record.fields import Field
from isocharge.serve.record.record import DECIMALS, PredictionRecord, selected_fields


def csv_header(electrodes: Sequence[str], *, with_tracking: bool = False, with_film: bool = False) -> str:
    """Return the header of a CSV file of records, which contains the names of the columns, without the line end.

    A field with several numbers has one column for each number, such as `charge_pC.A` for the electrode A.

    Args:
        electrodes: Names of the electrodes.
        with_tracking: Whether the records have the fields of the tracking.
        with_film: Whether the records have the fields of the film follower.
    """
    columns: list[str] = []
    for field in selected_fields(with_tracking=with_tracking, with_film=with_film):
        part_names = _part_names(field, electrodes)
        if part_names is None:  # the field has one column
            columns.append(field.name)
        else:
            columns += [f"{field.name}.{part_name}" for part_name in part_names]
    return _line(columns)


def csv_row(record: PredictionRecord, electrodes: Sequence[str]) -> str:
    """Convert a record to a line of a CSV file, without the line end.

    Numbers have six decimals, flags are separated by blanks, and the cells of unknown values are empty.

    Args:
        record: Record to convert.
        electrodes: Names of the electrodes, in the order of the header.
    """
    fields = selected_fields(with_tracking=record.tracking is not None, with_film=record.film is not None)
    cells: list[str] = []
    for field in fields:
        value = getattr(record, field.name)
        part_names = _part_names(field, electrodes)
        if part_names is None:  # the field has one column
            cells.append(_cell(value))
        elif value is None:  # the cells of all parts are empty
            cells += [""] * len(part_names)
        elif field.kind == "charges":  # a dictionary of the charges by electrode
            cells += [_cell(value[electrode]) for electrode in electrodes]
        else:  # an object, whose parts are attributes
            cells += [_cell(getattr(value, part_name)) for part_name in part_names]
    return _line(cells)


def _part_names(field: Field, electrodes: Sequence[str]) -> Sequence[str] | None:
    """Return the names of the parts of a field that has several columns in a CSV file.

    If the value of the field is a set of charges, the parts are the charges of the electrodes. If the value is an
    object, the parts are the fields of the object. Each part has one column.

    Args:
        field: Field of a record.
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
