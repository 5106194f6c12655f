"""Description of the fields of a record, read from the annotations of its struct."""

from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from msgspec import Struct

Kind = Literal["number", "integer", "boolean", "text", "words", "charges", "object"]
"""Kind of value: `words` is a list of texts, `charges` has a number for each electrode, `object` has fields."""

KINDS: dict[Any, Kind] = {float: "number", int: "integer", bool: "boolean", str: "text"}


class Meaning(NamedTuple):
    """Annotation of a field with the meaning of its value.

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
        may_be_null: Whether the value may be unknown.
        parts: Fields of the value, if its kind is `object`.
        group: Name of the nested struct that the field belongs to. A record without that struct has no such field.
            Empty for a field that every record has.
    """

    name: str
    kind: Kind
    meaning: Meaning
    may_be_null: bool
    parts: tuple["Field", ...] = ()
    group: str = ""


def fields_of(struct: type[Struct]) -> tuple[Field, ...]:
    """Return the fields of a struct in the order of their declaration."""
    return tuple(_flat_fields(struct))


def _flat_fields(struct: type[Struct]) -> Iterator[Field]:
    """Yield the fields of a struct. The fields of a nested struct with `is_flattened` take the place of the struct."""
    hints = get_type_hints(struct, include_extras=True)
    for name in struct.__struct_fields__:
        declared_type, meaning = _type_and_meaning(hints[name], f"{struct.__name__}.{name}")
        value_type, may_be_null = _without_none(declared_type)
        if meaning.is_flattened:
            for field in _flat_fields(value_type):
                yield field._replace(group=name)
        elif isinstance(value_type, type) and issubclass(value_type, Struct):
            yield Field(name, "object", meaning, may_be_null, fields_of(value_type), group=name)
        else:
            yield Field(name, _kind(value_type), meaning, may_be_null)


def _type_and_meaning(annotation: Any, where: str) -> tuple[Any, Meaning]:
    """Return the type and the meaning in an annotation of the form `Annotated[type, Meaning(...)]`.

    Args:
        annotation: Annotation of a field.
        where: Name of the field, for the error message.

    Raises:
        TypeError: If the annotation has another form.
    """
    if get_origin(annotation) is Annotated:
        declared_type, *metadata = get_args(annotation)
        for item in metadata:
            if isinstance(item, Meaning):
                return declared_type, item
    raise TypeError(f"{where}: expected Annotated[type, Meaning(...)]")


def _without_none(declared: Any) -> tuple[Any, bool]:
    """Return a type without its alternative None, and whether it had this alternative."""
    if get_origin(declared) not in (Union, UnionType):
        return declared, False
    other_types = [alternative for alternative in get_args(declared) if alternative is not NoneType]
    (value_type,) = other_types  # a field has exactly one other type
    return value_type, True


def _kind(value_type: Any) -> Kind:
    """Return the kind of values of a type; raise TypeError for a type that no field of a record has."""
    if value_type in KINDS:
        return KINDS[value_type]
    if get_origin(value_type) is dict:
        return "charges"
    if get_origin(value_type) is tuple:
        return "words"
    raise TypeError(f"{value_type}: a record has no fields of this type")
