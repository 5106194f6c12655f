"""Descriptions of the fields of a record, which are read from the annotations of the record class."""

from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from msgspec import Struct

Kind = Literal["number", "integer", "boolean", "text", "words", "charges", "object"]
"""Kind of a value. `words` is a list of texts, `charges` has a number for each electrode, and `object` has fields."""

Charges = dict[str, float | None]
"""Charges by the name of the electrode, pC; None if the device sent no number."""

KINDS: dict[Any, Kind] = {
    float: "number",
    int: "integer",
    bool: "boolean",
    str: "text",
    tuple[str, ...]: "words",
    Charges: "charges",
}
"""Kind of the values of each type. Any other type is a struct."""


class Meaning(NamedTuple):
    """Annotation that describes the value of a field.

    Attributes:
        text: Description of the value, a sentence.
        unit: Unit of the value; empty if it has none.
        is_shown_live: Whether the samples of the live page contain the value.
        is_flattened: Whether the fields of a nested struct are fields of the record instead of fields of an object.
    """

    text: str
    unit: str = ""
    is_shown_live: bool = False
    is_flattened: bool = False


class Field(NamedTuple):
    """One field of a record in JSON.

    Attributes:
        name: Key in JSON.
        kind: Kind of the value.
        meaning: Meaning of the value.
        may_be_null: Whether the value may be null, because it is unknown.
        parts: Fields of the value, if its kind is `object`.
        group: Name of the attribute with the nested struct to which the field belongs. A record has the field only if
            it has this struct. Empty for a field that every record has.
    """

    name: str
    kind: Kind
    meaning: Meaning
    may_be_null: bool
    parts: tuple["Field", ...] = ()
    group: str = ""


def fields_of(struct: type[Struct]) -> tuple[Field, ...]:
    """Return the fields of a struct in the order of their declaration.

    If a field is marked as `is_flattened`, the fields of its nested struct are returned in its place. The group of a
    field of a nested struct, and of a field of the kind `object`, is the name of the field that contains the struct.

    Raises:
        TypeError: If a field has no `Meaning`.
    """
    fields: list[Field] = []
    annotations = get_type_hints(struct, include_extras=True)  # with the metadata of `Annotated`
    for name in struct.__struct_fields__:
        annotation = annotations[name]
        if get_origin(annotation) is not Annotated:
            raise TypeError(f"{struct.__name__}.{name}: expected Annotated[type, Meaning(...)]")
        declared_type, meaning = get_args(annotation)
        may_be_null = isinstance(declared_type, UnionType)  # the other alternative is None
        value_type = get_args(declared_type)[0] if may_be_null else declared_type
        if meaning.is_flattened:
            fields += [nested_field._replace(group=name) for nested_field in fields_of(value_type)]
        elif value_type in KINDS:
            fields.append(Field(name, KINDS[value_type], meaning, may_be_null))
        else:
            fields.append(Field(name, "object", meaning, may_be_null, fields_of(value_type), group=name))
    return tuple(fields)
