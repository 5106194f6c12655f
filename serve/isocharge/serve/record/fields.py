"""Descriptions of the fields of a record, which are read from the annotations of the record class."""

from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from msgspec import Struct

Kind = Literal["number", "integer", "boolean", "text", "words", "charges", "object"]
"""Kind of a value. `words` is a list of texts, `charges` has a number for each electrode, and `object` has fields."""

KINDS: dict[Any, Kind] = {float: "number", int: "integer", bool: "boolean", str: "text"}


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
    """Return the fields of a struct in the order of their declaration."""
    return tuple(_flat_fields(struct))


def _flat_fields(struct: type[Struct]) -> Iterator[Field]:
    """Yield the fields of a struct, in the order of their declaration.

    The value of a field may be a nested struct. If the field is marked as `is_flattened`, the fields of the nested
    struct are yielded in its place. Otherwise, a single field of the kind `object` is yielded, whose parts are the
    fields of the nested struct. In both cases, the group of the yielded fields is the name of the field that contains
    the nested struct. A record has the fields of a group only if it has this nested struct.
    """
    annotations = get_type_hints(struct, include_extras=True)  # with the metadata of `Annotated`
    for name in struct.__struct_fields__:
        declared_type, meaning = _type_and_meaning(annotations[name], f"{struct.__name__}.{name}")
        value_type, may_be_null = _without_none(declared_type)  # the type without the alternative None
        is_struct = isinstance(value_type, type) and issubclass(value_type, Struct)
        if meaning.is_flattened:
            for nested_field in _flat_fields(value_type):
                yield nested_field._replace(group=name)
        elif is_struct:
            yield Field(name, "object", meaning, may_be_null, fields_of(value_type), group=name)
        else:
            yield Field(name, _kind(value_type), meaning, may_be_null)


def _type_and_meaning(annotation: Any, where: str) -> tuple[Any, Meaning]:
    """Return the type and the meaning that an annotation `Annotated[type, Meaning(...)]` contains.

    Args:
        annotation: Annotation of a field.
        where: Name of the struct and of the field, for the error message.

    Raises:
        TypeError: If the annotation has another form.
    """
    if get_origin(annotation) is Annotated:
        declared_type, *metadata = get_args(annotation)
        for item in metadata:
            if isinstance(item, Meaning):
                return declared_type, item
    raise TypeError(f"{where}: expected Annotated[type, Meaning(...)]")


def _without_none(declared_type: Any) -> tuple[Any, bool]:
    """Remove the alternative None from a type. Return the resulting type, and whether None was removed.

    For example, the type `float | None` gives the results `float` and True.
    """
    is_union = get_origin(declared_type) in (Union, UnionType)  # either class, depending on how the type is written
    if not is_union:
        return declared_type, False
    alternatives = get_args(declared_type)
    # The fields of a record have only unions of None and one other type.
    (value_type,) = [alternative for alternative in alternatives if alternative is not NoneType]
    return value_type, True


def _kind(value_type: Any) -> Kind:
    """Return the kind of the values of a type.

    Raises:
        TypeError: If fields of a record cannot have this type.
    """
    if value_type in KINDS:
        return KINDS[value_type]
    generic_type = get_origin(value_type)  # for example dict for dict[str, float]
    if generic_type is dict:
        return "charges"
    if generic_type is tuple:
        return "words"
    raise TypeError(f"{value_type}: a record has no fields of this type")
