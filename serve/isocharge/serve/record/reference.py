"""Markdown table of the fields of a record for the documentation.

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
"""Description of each kind of value in the table."""

GROUPS = {"tracking": " Only with `[track]`.", "film": " Only with `[follow]`."}
"""Sentence about the condition under which a record has the fields of a group."""


def record_table() -> str:
    """Return a Markdown table of all fields of a record.

    If a field is an object, the rows of the object's fields follow the row of the field.
    """
    header = ["| field | type | unit | meaning |", "|---|---|---|---|"]
    return "\n".join([*header, *_rows(RECORD_FIELDS)]) + "\n"


def _rows(fields: Iterable[Field], prefix: str = "") -> Iterator[str]:
    """Yield a row of the Markdown table for each field.

    If a field is an object, the rows of the object's fields follow the row of the field.

    Args:
        fields: Fields of the record or of an object.
        prefix: Text before the names of the fields, which is the name of the object that contains the fields, and a
            point. Empty for the fields of the record itself.
    """
    for field in fields:
        full_name = f"{prefix}{field.name}"
        condition = GROUPS.get(field.group, "")
        value_type = TYPES[field.kind]
        if field.may_be_null:
            value_type += " or null"
        cells = (f"`{full_name}`", value_type, field.meaning.unit, f"{field.meaning.text}{condition}")
        yield f"| {' | '.join(cells)} |"
        yield from _rows(field.parts, f"{full_name}.")


if __name__ == "__main__":
    print(record_table(), end="")
