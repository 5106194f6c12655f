"""Conversion of records to CSV, with a separate column for each number, and the JSON Schema of the records of a sensor.

The schema describes the fields twice, once for viewers and once for validators. The viewers Foxglove and Lichtblick
read the top-level key `properties`, and expect a single `type` for each field. In `properties`, a number that may be
null is therefore declared with the type "number" alone. Validators of draft 7 of JSON Schema follow the top-level
`$ref` to `definitions/record` and ignore all other top-level keys. The definition `record` allows null for every field
that may be null. Because of the two descriptions, viewers can list all fields, and validators accept all records.
"""

import csv
import io
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

from isocharge.serve.record.record import DECIMALS, RECORD_FIELDS, Field, PredictionRecord, record_fields


def csv_header(electrodes: Sequence[str], sections: tuple[str, ...] = ()) -> str:
    """Return the header of a CSV file of records, which contains the names of the columns, without the line end.

    A field with several numbers has one column for each number, such as `charge_pC.A` for the electrode A.

    Args:
        electrodes: Names of the electrodes.
        sections: Sections of the device file that may add fields to the records.
    """
    return _line(name if part is None else f"{name}.{part}" for name, part in _columns(tuple(electrodes), sections))


def csv_row(record: PredictionRecord, electrodes: Sequence[str]) -> str:
    """Convert a record to a line of a CSV file, without the line end.

    Numbers have six decimals, flags are separated by blanks, and the cells of unknown values are empty.

    Args:
        record: Record to convert.
        electrodes: Names of the electrodes, in the order of the header.
    """
    cells: list[str] = []
    for name, part in _columns(tuple(electrodes), record.sections):
        value = getattr(record, name)
        # `part` is the name of an electrode in a dictionary of charges, or of an attribute of a struct. It is None if
        # the field has a single column.
        if part is not None and value is not None:
            value = value[part] if isinstance(value, dict) else getattr(value, part)
        cells.append(cell_text(value))
    return _line(cells)


@cache
def _columns(electrodes: tuple[str, ...], sections: tuple[str, ...]) -> list[tuple[str, str | None]]:
    """Return two names for each column: the name of the field, and the name of the part that the column contains.

    The parts of charges are the electrodes, and the parts of an object are its fields. The part is None for a field
    with one column.
    """
    return [(field.name, part) for field in record_fields(sections) for part in _part_names(field, electrodes)]


def _part_names(field: Field, electrodes: Sequence[str]) -> Sequence[str | None]:
    """Return the names of the numbers in an object: the fields of a struct, or the electrodes.

    For a field of another type, the result is a single None, because the field has no parts.
    """
    if field.json_type != "object":
        return [None]
    return [part.name for part in field.parts] or electrodes


def _line(cells: Iterable[str]) -> str:
    """Join cells with commas, and put cells in quotation marks where CSV requires it."""
    line = io.StringIO()
    csv.writer(line).writerow(cells)
    return line.getvalue().removesuffix("\r\n")


def cell_text(value: Any) -> str:
    """Convert a value to the text of a cell.

    The value None becomes an empty text. The words of a tuple are joined with blanks. A floating-point number gets six
    decimals.
    """
    if isinstance(value, float):
        return f"{value:.{DECIMALS}f}"
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(value)
    if isinstance(value, bool):
        return str(value).lower()
    return str(value)


SCHEMA_NAME = "isocharge.PredictionRecord"
"""Title of the schema."""


def record_schema(electrodes: Sequence[str]) -> dict[str, Any]:
    """Return the JSON Schema of the records of a sensor.

    The schema allows further fields, because a later version may add fields to the record.

    Args:
        electrodes: Names of the electrodes of the sensor.
    """
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": SCHEMA_NAME,
        "$ref": "#/definitions/record",
        "definitions": {"record": _object(electrodes, allows_null=True)},
        **_object(electrodes, allows_null=False),
    }


def _object(electrodes: Sequence[str], *, allows_null: bool) -> dict[str, Any]:
    """Return the schema of a JSON object that contains a record.

    The schema requires the fields that every record has.

    Args:
        electrodes: Names of the electrodes.
        allows_null: Whether fields that may be unknown may be null.
    """
    properties = {field.name: _field_schema(field, electrodes, allows_null=allows_null) for field in RECORD_FIELDS}
    required = sorted(field.name for field in RECORD_FIELDS if not field.section)
    return {"type": "object", "properties": properties, "required": required}


def _field_schema(field: Field, electrodes: Sequence[str], *, allows_null: bool) -> dict[str, Any]:
    """Return the JSON Schema of one field.

    Args:
        field: Field of the record.
        electrodes: Names of the electrodes.
        allows_null: Whether a value that may be unknown may be null, as may each number in an object. If false, the
            schema declares only the type of known values.
    """
    json_type = field.json_type
    schema: dict[str, Any] = {"type": [json_type, "null"] if allows_null and field.may_be_null else json_type}
    if json_type == "array":  # a list of texts
        schema["items"] = {"type": "string"}
    if json_type == "object":  # its parts are all numbers
        number = {"type": ["number", "null"] if allows_null else "number"}
        schema["properties"] = dict.fromkeys(_part_names(field, electrodes), number)
    schema["description"] = field.meaning
    return schema
