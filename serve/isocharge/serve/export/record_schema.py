"""The JSON Schema of a prediction record, as MCAP files carry it.

Foxglove and Lichtblick take the fields of a topic from `properties` and read one `type` for each, so that a number
that may be null has to be a plain "number" there. Validators of draft 7 pass over everything beside a `$ref` and check
`definitions/record`, which allows null wherever a record has it. So viewers list all fields, and all records are valid.
"""

from typing import Any

NAME = "isocharge.PredictionRecord"
"""Name of the schema."""

NUMBERS = {
    "timestamp": "Time of the reading, unix seconds.",
    "x_mm": "Position x in the frame frame_id, mm; null out of contact.",
    "y_mm": "Position y, mm; null out of contact.",
    "force_N": "Force, N; 0 out of contact.",
    "x_std_mm": "Standard deviation of x, mm.",
    "y_std_mm": "Standard deviation of y, mm.",
    "force_std_N": "Standard deviation of the force, N.",
    "misfit": "Distance from the nearest single contact, in standard deviations.",
    "latency_us": "From the last byte of the reading to this record, us.",
}
"""Fields that are a number or null, with what they mean."""

WHOLES = {
    "t_device_us": "Clock of the device, us, without its wraps.",
    "seq": "Sequence number, as the device sent it.",
}
"""Fields that are a whole number or null."""

CHARGES = {
    "charge_pC": "Touch charges by electrode, the model's input, pC.",
    "charge_raw_pC": "Charges by electrode as the device sent them, pC.",
    "tare_pC": "Charges at rest that were subtracted, by electrode, pC.",
}
"""Fields that are an object of charges or null."""

OTHERS: dict[str, dict[str, Any]] = {
    "contact": {"type": "boolean", "description": "Whether something touches."},
    "flags": {"type": "array", "items": {"type": "string"}, "description": "Words, each one a reason for care."},
    "model": {"type": "string", "description": "The model, name/version."},
    "frame_id": {"type": "string", "description": "Name of the sensor, the frame of x and y."},
}
"""Fields that always have a value."""


def record_schema(electrodes: tuple[str, ...]) -> dict[str, Any]:
    """The schema of the records of a sensor with these electrodes.

    Further fields are allowed: a later version may add some.
    """
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": NAME,
        "$ref": "#/definitions/record",
        "definitions": {"record": _object(electrodes, or_null=True)},
        **_object(electrodes, or_null=False),
    }


def _object(electrodes: tuple[str, ...], *, or_null: bool) -> dict[str, Any]:
    """A record whose fields have one type each, or may be null where a record's may."""

    def kind(name: str) -> Any:
        return [name, "null"] if or_null else name

    charge = {"type": kind("number")}
    properties: dict[str, dict[str, Any]] = {
        **{name: {"type": kind("number"), "description": text} for name, text in NUMBERS.items()},
        **{name: {"type": kind("integer"), "description": text} for name, text in WHOLES.items()},
        **{
            name: {"type": kind("object"), "properties": dict.fromkeys(electrodes, charge), "description": text}
            for name, text in CHARGES.items()
        },
        **OTHERS,
    }
    return {"type": "object", "properties": properties, "required": sorted(properties)}
