"""Table of the fields of a record for the documentation, in Markdown.

The command `python -m isocharge.serve.record.reference` prints the table.
"""

from collections.abc import Iterable, Iterator

from isocharge.serve.record.fields import Field
from isocharge.serve.record.record import RECORD_FIELDS

TYPES = {
    "number": "number",
    "integer": "integer",
    "boolean": "boolean",
    "text": "text",
    "words": "list of texts",
    "charges": "object: a number for each electrode",
    "object": "object",
}
"""Words for the kinds of values."""

GROUPS = {"tracking": "with `[track]`", "film": "with `[follow]`"}
"""Condition under which a record has the fields of a group."""


def record_table() -> str:
    """Return the table of all fields of a record. The fields of a nested object follow this object."""
    header = ["| field | type | unit | meaning | present |", "|---|---|---|---|---|"]
    return "\n".join([*header, *_rows(RECORD_FIELDS)]) + "\n"


def _rows(fields: Iterable[Field], prefix: str = "", group: str = "") -> Iterator[str]:
    """Yield a row of the table for each field. If a field contains further fields, their rows follow.

    Args:
        fields: The fields.
        prefix: Text before the names of the fields: the name of the object that contains the fields, and a point.
        group: Group of the object that contains the fields.
    """
    for field in fields:
        present = GROUPS.get(field.group or group, "always")
        value_type = TYPES[field.kind]
        if field.may_be_null:
            value_type += " or null"
        cells = (f"`{prefix}{field.name}`", value_type, field.meaning.unit, field.meaning.text, present)
        yield f"| {' | '.join(cells)} |"
        yield from _rows(field.parts, f"{prefix}{field.name}.", field.group or group)


if __name__ == "__main__":
    print(record_table(), end="")
