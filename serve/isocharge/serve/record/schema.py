"""JSON Schema of the records of a sensor.

The schema describes the fields twice. The viewers Foxglove and Lichtblick read the top-level key `properties`, and
expect a single `type` for each field. A number that may be null is therefore declared as "number" in `properties`.
Validators of draft 7 of JSON Schema follow the top-level `$ref` to `definitions/record` and ignore all other top-level
keys. In this definition, null is allowed for every field that may be null. Viewers therefore list all fields, and
validators accept all records.
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
    """Return the schema of the records of a sensor with these electrodes.

    Further fields are allowed, because a later version may add some.
    """
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": SCHEMA_NAME,
        "$ref": "#/definitions/record",
        "definitions": {"record": _object(electrodes, allows_null=True)},
        **_object(electrodes, allows_null=False),
    }


def _object(electrodes: Sequence[str], *, allows_null: bool) -> dict[str, Any]:
    """Return the schema of the record, in which the fields that every record has are required.

    Args:
        electrodes: Names of the electrodes.
        allows_null: Whether fields that may be unknown may be null.
    """
    properties = {field.name: _property(field, electrodes, allows_null=allows_null) for field in RECORD_FIELDS}
    required = sorted(field.name for field in RECORD_FIELDS if not field.group)
    return {"type": "object", "properties": properties, "required": required}


def _property(field: Field, electrodes: Sequence[str], *, allows_null: bool) -> dict[str, Any]:
    """Return the schema of one field.

    Args:
        field: The field.
        electrodes: Names of the electrodes.
        allows_null: Whether the field may be null if it may be unknown, and whether numbers in objects may be null.
    """
    json_type: str | list[str] = JSON_TYPES[field.kind]
    number_in_object: dict[str, Any] = {"type": "number"}
    if allows_null:
        number_in_object = {"type": ["number", "null"]}
        if field.may_be_null:
            json_type = [JSON_TYPES[field.kind], "null"]
    schema: dict[str, Any] = {"type": json_type}
    if field.kind == "words":
        schema["items"] = {"type": "string"}
    if field.kind == "charges":
        schema["properties"] = dict.fromkeys(electrodes, number_in_object)
    if field.kind == "object":
        part_names = [part.name for part in field.parts]
        schema["properties"] = dict.fromkeys(part_names, number_in_object)
    schema["description"] = field.meaning.text
    return schema
