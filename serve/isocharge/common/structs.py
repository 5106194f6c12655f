"""Decoding of TOML and JSON into typed structs with msgspec.

The attributes of a `Settings` class are the keys of a file. The types and bounds of the attributes define the allowed
values. If a key is missing, its attribute has the default value. Error messages name the wrong key and state what was
expected. A description such as `Meta(description="[x, y] in mm")` replaces the words after "expected". Conditions that
a type cannot express are checked in `__post_init__`, which raises `WrongKey`.

The following example defines a table and reads it from a file:

    class FilmTable(Settings, frozen=True):
        radius_mm: Positive
        poisson: Annotated[float, Meta(gt=-1.0, le=0.5)] = 0.34

    film = read_toml(path, "a film", SensorError, FilmTable)

Error messages have one of the following forms:

    mine.toml: film.radius_mm: expected a positive number, got -45
    mine.toml: unknown key 'film.radius'; did you mean 'radius_mm'? Known are radius_mm, poisson
    mine.toml: key 'film.radius_mm' is missing
"""

import difflib
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct, inspect

from isocharge.common.errors import InputError, cut, shown
from isocharge.common.files import read_needed

T = TypeVar("T")

MAX_FLOAT = sys.float_info.max
"""Largest finite number."""

MAX_TOML_BYTES = 1 << 18
"""Largest size of a TOML file, bytes. The limit is low, because Python reads TOML a hundred times slower than JSON."""

MAX_JSON_BYTES = 1 << 22
"""Largest size of a JSON file, bytes."""

MAX_EXAMINED_ITEMS = 1000
"""Number of items of a list that are examined in the search for a mistake.

If only a later item is wrong, the message of msgspec is used.
"""

_KEY_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
_DEEP_KEY = re.compile(rf"(?<![\w-])(?:{_KEY_PART}\.[ \t]*+){{32}}")
"""Dotted key of more than 32 parts.

Such keys are refused, because the memory that Python needs grows with the square of the number of parts.
"""

Finite = Annotated[float, Meta(ge=-MAX_FLOAT, le=MAX_FLOAT)]
NotNegative = Annotated[float, Meta(ge=0.0, le=MAX_FLOAT)]
Positive = Annotated[float, Meta(gt=0.0, le=MAX_FLOAT)]
Text = Annotated[str, Meta(min_length=1, max_length=1000)]
"""Text of 1 to 1000 characters, because names appear in messages, records and pages."""


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """Base class for the tables of a file. An unknown key in such a table is an error.

    Each subclass must repeat `frozen=True`, because type checkers require it.
    """


class WrongKey(ValueError):
    """Exception that `__post_init__` of a struct raises if the value of a key is wrong, or if a key is missing.

    Args:
        key: Name of the key.
        expected: Description of the expected value; empty if the key is missing.
        got: The value of the key in the file.
    """

    def __init__(self, key: str, expected: str = "", got: object = None) -> None:
        super().__init__(f"expected {expected}, got {shown(got)}" if expected else "")
        self.key = key


def read_toml(path: Path, description: str, error_class: type[InputError], target_type: type[T]) -> T:
    """Read a TOML file, and convert its content to a type.

    Args:
        path: The file.
        description: Description of the expected file for error messages, such as "a device file".
        error_class: Class of the error that is raised.
        target_type: Type to which the content is converted; `dict[str, Any]` for any table.

    Raises:
        error_class: If the file cannot be read or its content is wrong.
    """
    text = _read_text(path, MAX_TOML_BYTES, description, "TOML", error_class)
    return parse_toml(text, str(path), error_class, target_type)


def read_json(path: Path, description: str, error_class: type[InputError], target_type: type[T]) -> T:
    """Read a JSON file, and convert its content to a type.

    Args:
        path: The file.
        description: Description of the expected file for error messages, such as "a device file".
        error_class: Class of the error that is raised.
        target_type: Type to which the content is converted; `dict[str, Any]` for any object.

    Raises:
        error_class: If the file cannot be read or its content is wrong.
    """
    text = _read_text(path, MAX_JSON_BYTES, description, "JSON", error_class)
    return parse_json(text, str(path), error_class, target_type)


def _read_text(path: Path, max_bytes: int, description: str, language: str, error_class: type[InputError]) -> str:
    """Read a text file in UTF-8.

    Args:
        path: The file.
        max_bytes: Largest size of the file, bytes.
        description: Description of the expected file for error messages, such as "a device file".
        language: "TOML" or "JSON", for error messages.
        error_class: Class of the error that is raised.

    Raises:
        error_class: If the file cannot be read, is too large, or is not text in UTF-8.
    """
    data = read_needed(path, error_class, f"expected {description} in {language}", max_bytes)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as cause:
        raise error_class(f"{path}: not a {language} file: not text in UTF-8: {cause}") from cause


def parse_toml(text: str, where: str, error_class: type[InputError], target_type: type[T]) -> T:
    """Parse a text in TOML, and convert its content to a type.

    Args:
        text: The text.
        where: Name of the file, with which the error message begins.
        error_class: Class of the error that is raised.
        target_type: Type to which the content is converted.

    Raises:
        error_class: If the text is not TOML, or its content is wrong.
    """
    if _DEEP_KEY.search(text):  # parsing such a key needs much memory
        raise error_class(f"{where}: not a TOML file: a key of more than 32 parts")
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as cause:
        raise error_class(f"{where}: not a TOML file: {cut(str(cause))}") from cause
    return convert(content, target_type, where, error_class)


def parse_json(text: str | bytes, where: str, error_class: type[InputError], target_type: type[T]) -> T:
    """Parse a text in JSON, and convert its content to a type.

    Args:
        text: The text.
        where: Name of the file, with which the error message begins; empty if there is no file.
        error_class: Class of the error that is raised.
        target_type: Type to which the content is converted.

    Raises:
        error_class: If the text is not JSON, or its content is wrong.
    """
    try:
        return msgspec.json.decode(text, type=target_type)
    except (ValueError, RecursionError) as decoding_error:
        cause = decoding_error  # the name after `as` exists only in this clause

    # The text is either not JSON, or JSON with wrong content. Decoding without a type distinguishes the two cases.
    try:
        content = msgspec.json.decode(text)
    except (ValueError, RecursionError):
        raise error_class(f"{_prefix(where)}expected JSON, got {shown(text)} ({cut(str(cause))})") from cause
    raise error_class(_prefix(where) + _first_mistake(content, target_type, cause)) from cause


def convert(value: object, target_type: type[T], where: str, error_class: type[InputError]) -> T:
    """Convert a value from TOML or JSON to a type.

    Args:
        value: Value that consists of tables, lists, texts, numbers and truth values.
        target_type: Type to which the value is converted: a struct, or another type that msgspec supports.
        where: Name of the file, with which the error message begins; empty if there is no file.
        error_class: Class of the error that is raised.

    Raises:
        error_class: If the value does not have the type. The message describes the first mistake.
    """
    try:
        return msgspec.convert(value, target_type)
    except (msgspec.ValidationError, RecursionError) as cause:
        raise error_class(_prefix(where) + _first_mistake(value, target_type, cause)) from cause


def _prefix(where: str) -> str:
    """Return the beginning of an error message: `where` and a colon, or an empty text if `where` is empty."""
    return f"{where}: " if where else ""


def _first_mistake(value: object, target_type: Any, cause: Exception) -> str:
    """Return a description of the first mistake in a value for an error message.

    Args:
        value: Value from TOML or JSON.
        target_type: Type to which the value could not be converted.
        cause: Exception of msgspec. Its message is returned if no mistake is found.
    """
    try:
        return next(_mistakes(value, target_type, ""), cut(str(cause)))
    except RecursionError:
        return "nested too deeply"


def _mistakes(value: object, expected_type: Any, path: str) -> Iterator[str]:
    """Yield a description of each mistake in a value.

    The mistakes in the keys of a table or in the items of a list are yielded before a mistake in the value as a whole.

    Args:
        value: Value from TOML or JSON.
        expected_type: Expected type.
        path: Names of the keys that lead to the value, such as "film.radius_mm".
    """
    members = list(_union_members(expected_type))  # if the type is no union, the list contains only the type itself
    yield from _mistakes_in_tag(value, members, path)
    for member in members:
        yield from _mistakes_in_parts(value, member, path)

    # Check the value as a whole. If `__post_init__` of a struct has raised an exception, msgspec stores the exception
    # as the cause of its own error. A `WrongKey` without a message means that the key is missing.
    try:
        msgspec.convert(value, expected_type)
    except msgspec.ValidationError as error:
        cause = error.__cause__
        if isinstance(cause, WrongKey):
            key_path = _join(path, cause.key)
            yield f"{key_path}: {cause}" if str(cause) else f"key {key_path!r} is missing"
        elif cause is not None:
            yield f"{_prefix(path)}{cause}"
        else:
            yield f"{_prefix(path)}expected {_expected_value(expected_type, members[0])}, got {shown(value)}"


def _expected_value(expected_type: Any, first_member: Any) -> str:
    """Describe the values that a type allows, for error messages.

    Args:
        expected_type: The type.
        first_member: The type without its annotations, or the first member of the type if the type is a union.
    """
    if get_origin(first_member) is Literal:
        return _one_of(get_args(first_member))  # in the declared order, which msgspec does not keep
    return _describe_type(inspect.type_info(expected_type))


def _mistakes_in_tag(value: object, members: list[Any], path: str) -> Iterator[str]:
    """Yield a description of the mistake if the tag of a table is missing or unknown.

    A struct is a class that declares the keys of a table. If a table may belong to one of several structs, one of its
    keys selects the struct, and the value of this key is the tag. If only one struct is possible, the tag may be
    missing.

    Args:
        value: Value from TOML or JSON.
        members: Types that the value may have. If none of them is a struct with a tag, there is no mistake.
        path: Names of the keys that lead to the value.
    """
    structs = [member for member in members if isinstance(member, type) and issubclass(member, Struct)]
    configs = [struct.__struct_config__ for struct in structs]
    configs_with_tag = [config for config in configs if config.tag is not None]
    if not configs_with_tag or not isinstance(value, Mapping):
        return
    allowed_tags = [config.tag for config in configs_with_tag]
    tag_key = str(configs_with_tag[0].tag_field)  # all structs of a union have the same tag key
    is_tag_required = len(allowed_tags) > 1
    if tag_key not in value:
        if is_tag_required:
            yield f"key {_join(path, tag_key)!r} is missing"
        return
    tag = value[tag_key]
    if tag is not None and tag not in allowed_tags:
        yield f"{_join(path, tag_key)}: expected {_one_of(allowed_tags)}, got {shown(tag)}"


def _mistakes_in_parts(value: object, expected_type: Any, path: str) -> Iterator[str]:
    """Yield a description of each mistake in the keys of a table or in the items of a list.

    The function yields nothing if the value is neither a table nor a list, or if the type expects another kind of
    value.

    Args:
        value: Value from TOML or JSON.
        expected_type: Expected type, which must not be a union.
        path: Names of the keys that lead to the value.
    """
    if isinstance(value, Mapping) and isinstance(expected_type, type) and issubclass(expected_type, Struct):
        yield from _mistakes_in_keys(value, expected_type, path)
    elif isinstance(value, Mapping) and get_origin(expected_type) is dict:
        _, item_type = get_args(expected_type)
        for key, item in value.items():
            yield from _mistakes(item, item_type, _join(path, key))
    elif isinstance(value, list | tuple) and get_origin(expected_type) in (list, tuple):
        # `list[T]` and `tuple[T, ...]` have one type for all items. Other tuples have one type for each item.
        item_types = [item_type for item_type in get_args(expected_type) if item_type is not Ellipsis]
        if len(item_types) == 1:
            item_types = item_types * len(value)
        if len(item_types) == len(value):  # `_mistakes` reports a wrong length as a mistake in the value as a whole
            for index, item in enumerate(value[:MAX_EXAMINED_ITEMS]):
                yield from _mistakes(item, item_types[index], f"{path}[{index}]")


def _mistakes_in_keys(table: Mapping[str, Any], struct: type[Struct], path: str) -> Iterator[str]:
    """Yield a description of each unknown key, each missing key and each mistake in the values of a table.

    A struct is a class that declares the keys of a table. If there are several structs, the value of one of the keys
    (the tag) selects the struct. If the tag of the table selects another struct than the given struct, the function
    yields nothing.

    Args:
        table: Table from TOML or JSON.
        struct: Struct that declares the expected keys.
        path: Names of the keys that lead to the table, such as "film"; empty for the whole file.
    """
    config = struct.__struct_config__
    if config.tag is not None:
        selected_tag = table.get(str(config.tag_field))
        if selected_tag != config.tag:  # the table does not belong to this struct
            return

    types_of_fields = get_type_hints(struct, include_extras=True)
    fields = msgspec.structs.fields(struct)
    known_keys = [field.encode_name for field in fields]  # a key may have another name than its attribute
    if config.tag_field:
        known_keys.insert(0, config.tag_field)

    if config.forbid_unknown_fields:
        for key in table:
            if key not in known_keys:
                yield unknown_key(_join(path, key), key, known_keys)

    for field in fields:
        key = field.encode_name
        if key in table:
            yield from _mistakes(table[key], types_of_fields[field.name], _join(path, key))
        elif field.required:
            yield f"key {_join(path, key)!r} is missing"


def unknown_key(name: str, key: str, known: Iterable[str]) -> str:
    """Return an error message about an unknown key, with the most similar known key as a suggestion.

    Args:
        name: Name of the key with the names of the tables that contain it, such as "film.radius".
        key: Name of the key alone, such as "radius".
        known: Names of the known keys.
    """
    known_keys = list(known)
    known_text = cut(", ".join(known_keys))  # `cut` limits the length of a text
    similar_keys = difflib.get_close_matches(cut(key), known_keys, n=1)
    if similar_keys:
        return f"unknown key {shown(name)}; did you mean {similar_keys[0]!r}? Known are {known_text}"
    return f"unknown key {shown(name)}; known are {known_text}"


def _union_members(expected_type: Any) -> Iterator[Any]:
    """Yield the members of a union without their annotations.

    If the type is not a union, the function yields only the type itself without its annotations.

    Args:
        expected_type: The type.
    """
    if get_origin(expected_type) is Annotated:
        type_without_annotations = get_args(expected_type)[0]
        yield from _union_members(type_without_annotations)
    elif get_origin(expected_type) in (Union, UnionType):
        for member in get_args(expected_type):
            yield from _union_members(member)
    else:
        yield expected_type


def _join(path: str, key: str) -> str:
    """Join the path of a table and the name of one of its keys, for example as "film.radius_mm".

    Args:
        path: Names of the keys that lead to the table; empty for the whole file.
        key: Name of the key.
    """
    return cut(f"{path}.{key}" if path else str(key))


def _describe_type(value_type: inspect.Type) -> str:
    """Describe the values that a type allows for error messages, for example as "a list of 2 numbers".

    If the annotation of the type contains a description, this description is returned. Types for which the function has
    no `case`, such as tables, are described by their noun.

    Args:
        value_type: The type, as `msgspec.inspect.type_info` returns it.
    """
    match value_type:
        case inspect.Metadata(type=annotated_type, extra_json_schema=annotation):
            description_in_annotation = (annotation or {}).get("description")
            return description_in_annotation or _describe_type(annotated_type)
        case inspect.FloatType(gt=exclusive_minimum, ge=minimum, le=maximum):
            return _describe_number("number", exclusive_minimum, minimum, maximum)
        case inspect.IntType(gt=exclusive_minimum, ge=minimum, le=maximum):
            return _describe_number("whole number", exclusive_minimum, minimum, maximum)
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType(max_length=int(max_length)):
            return f"a text of 1 to {max_length} characters"
        case inspect.LiteralType(values=values):
            return _one_of(values)
        case inspect.EnumType(cls=cls):
            return _one_of(member.value for member in cls)
        case inspect.UnionType(types=members):
            descriptions = [_describe_type(member) for member in members if not isinstance(member, inspect.NoneType)]
            return " or ".join(dict.fromkeys(descriptions))  # `fromkeys` removes repeated descriptions
        case inspect.TupleType(item_types=item_types):
            return f"a list of {len(item_types)} {_noun(item_types[0])}s"  # all items have the same type
        case inspect.CollectionType(item_type=item_type, min_length=min_length):
            list_description = f"a list of {_noun(item_type)}s"
            return f"{list_description}, {min_length} or more" if min_length else list_description
    return f"a {_noun(value_type)}"


_NOUNS: tuple[tuple[Any, str], ...] = (
    (inspect.StrType, "text"),
    ((inspect.FloatType, inspect.IntType), "number"),
    ((inspect.StructType, inspect.DictType), "table"),
    ((inspect.TupleType, inspect.CollectionType), "list"),
    (inspect.BytesType, "text in base64"),
)
"""Pairs of a type of msgspec, or several types, and the noun for the values of the type."""


def _noun(value_type: inspect.Type) -> str:
    """Return the noun for the values of a type, such as "number". For a type that is not in `_NOUNS`, it is "value".

    Args:
        value_type: The type, as `msgspec.inspect.type_info` returns it.
    """
    type_without_annotation = value_type.type if isinstance(value_type, inspect.Metadata) else value_type
    for types_with_noun, noun in _NOUNS:
        if isinstance(type_without_annotation, types_with_noun):
            return noun
    return "value"


def _one_of(words: Iterable[object]) -> str:
    """Return a list of the allowed words for an error message, as in "one of left, right"."""
    return f"one of {', '.join(map(str, words))}"


def _describe_number(noun: str, exclusive_minimum: float | None, minimum: float | None, maximum: float | None) -> str:
    """Describe numbers with bounds for an error message, for example as "a number from 0 to 1".

    Args:
        noun: Noun for the numbers: "number" or "whole number".
        exclusive_minimum: Lower bound that is not allowed itself; None if there is no such bound.
        minimum: Smallest allowed number; None if there is no such bound.
        maximum: Largest allowed number; None if there is no such bound.
    """
    # The bounds +-`MAX_FLOAT` exclude only infinity, and are not mentioned.
    bounds = {"above": exclusive_minimum, "from": minimum, "to": maximum}
    mentioned = {word: bound for word, bound in bounds.items() if bound is not None and abs(bound) != MAX_FLOAT}
    if mentioned == {"above": 0}:
        return f"a positive {noun}"
    if not mentioned and noun == "number":
        return "a finite number"
    texts = [
        f"{word} {bound:g}" if isinstance(bound, float) else f"{word} {bound}" for word, bound in mentioned.items()
    ]
    return " ".join([f"a {noun}", *texts])
