"""JSON Schema of the records of a sensor.

Foxglove and Lichtblick read the fields of a topic from `properties` and expect one `type` for each field, so a number
that may be null has to be a plain "number" there. Validators of draft 7 ignore everything beside a `$ref` and check
`definitions/record`, which allows null wherever a record may have it. Viewers therefore list all fields, and all
records are valid.
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
    """Return the schema of the record; the fields that every record has are required."""
    properties = {field.name: _property(field, electrodes, allows_null=allows_null) for field in RECORD_FIELDS}
    required = sorted(field.name for field in RECORD_FIELDS if not field.group)
    return {"type": "object", "properties": properties, "required": required}


def _property(field: Field, electrodes: Sequence[str], *, allows_null: bool) -> dict[str, Any]:
    json_type: str | list[str] = JSON_TYPES[field.kind]
    number: dict[str, Any] = {"type": "number"}
    if allows_null:
        number = {"type": ["number", "null"]}
        if field.may_be_null:
            json_type = [JSON_TYPES[field.kind], "null"]
    described: dict[str, Any] = {"type": json_type}
    if field.kind == "words":
        described["items"] = {"type": "string"}
    if field.kind == "charges":
        described["properties"] = dict.fromkeys(electrodes, number)
    if field.kind == "object":
        described["properties"] = dict.fromkeys([part.name for part in field.parts], number)
    described["description"] = field.meaning.text
    return described
