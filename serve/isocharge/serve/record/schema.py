"""JSON Schema of the records of a sensor.

The schema describes the fields twice, once for viewers and once for validators. The viewers Foxglove and Lichtblick
read the top-level key `properties`, and expect a single `type` for each field. In `properties`, a number that may be
null is therefore declared with the type "number" alone. Validators of draft 7 of JSON Schema follow the top-level
`$ref` to `definitions/record` and ignore all other top-level keys. The definition `record` allows null for every field
that may be null. Because of the two descriptions, viewers can list all fields, and validators accept all records.
"""

from collections.abc import Sequence
from typing import Any

from isocharge.serve.record.fields import Field, Kind
from isocharge.serve.record.record import RECORD_FIELDS

SCHEMA_NAME = "isocharge.PredictionRecord"
"""Title of the schema."""

JSON_TYPES: dict[Kind, str] = {
    "number": "number",
    "integer": "integer",
    "boolean": "boolean",
    "text": "string",
    "words": "array",
    "charges": "object",
    "object": "object",
}


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
    properties = {field.name: _property(field, electrodes, allows_null=allows_null) for field in RECORD_FIELDS}
    required = sorted(field.name for field in RECORD_FIELDS if not field.group)
    return {"type": "object", "properties": properties, "required": required}


def _property(field: Field, electrodes: Sequence[str], *, allows_null: bool) -> dict[str, Any]:
    """Return the JSON Schema of one field.

    Args:
        field: Field of the record.
        electrodes: Names of the electrodes.
        allows_null: Whether the schema allows null for every field that may be unknown, and for every number in an
            object. If not, the schema declares only the type of known values.
    """
    json_type = JSON_TYPES[field.kind]
    number_in_object: dict[str, Any] = {"type": "number"}  # schema of a number in an object
    if allows_null:
        number_in_object = {"type": ["number", "null"]}

    schema: dict[str, Any] = {"type": json_type}
    if allows_null and field.may_be_null:
        schema["type"] = [json_type, "null"]
    if field.kind == "words":  # a list of texts
        schema["items"] = {"type": "string"}
    if field.kind == "charges":  # an object with a number for each electrode
        schema["properties"] = dict.fromkeys(electrodes, number_in_object)
    if field.kind == "object":  # an object whose parts are all numbers
        part_names = [part.name for part in field.parts]
        schema["properties"] = dict.fromkeys(part_names, number_in_object)
    schema["description"] = field.meaning.text
    return schema
