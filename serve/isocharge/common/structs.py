"""Decoding of TOML and JSON into typed structs with msgspec, and conversion of values for JSON.

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
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import Meta, Struct

from isocharge.common.errors import InputError, cut, shown
from isocharge.common.files import StrPath, read_needed

T = TypeVar("T")

MAX_FLOAT = sys.float_info.max
"""Largest finite number."""

MAX_TOML_BYTES = 1 << 18
"""Largest size of a TOML file, bytes. The limit is low, because Python reads TOML a hundred times slower than JSON."""

MAX_JSON_BYTES = 1 << 22
"""Largest size of a JSON file, bytes."""

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

    Each subclass must repeat `frozen=True`, because type checkers require the repetition.
    """


class WrongKey(ValueError):
    """Exception that `__post_init__` of a struct raises if the value of a key is wrong, or if a key is missing.

    Args:
        key: Name of the key.
        expected: Description of the expected value; empty if the key is missing.
        got: The value of the key in the file.
    """

    def __init__(self, key: str, expected: str = "", got: object = None) -> None:
        """Create the error. The message states the expected value and the given value; empty if the key is missing."""
        super().__init__(f"expected {expected}, got {shown(got)}" if expected else "")
        self.key = key


def read_toml(path: StrPath, description: str, error_class: type[InputError], target_type: type[T]) -> T:
    """Read a TOML file, and convert its content to a type.

    Args:
        path: The file.
        description: Description of the expected file for error messages, such as "a device file".
        error_class: Class of the error that is raised.
        target_type: Type to which the content is converted; `dict[str, Any]` for any table.

    Raises:
        error_class: If the file cannot be read or its content is wrong.
    """
    data = read_needed(Path(path), error_class, f"expected {description} in TOML", MAX_TOML_BYTES)
    return parse_toml(data, str(path), error_class, target_type)


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
    data = read_needed(path, error_class, f"expected {description} in JSON", MAX_JSON_BYTES)
    return parse_json(data, str(path), error_class, target_type)


def parse_toml(data: bytes, where: str, error_class: type[InputError], target_type: type[T]) -> T:
    """Parse a text in TOML, and convert its content to a type.

    Args:
        data: The text in UTF-8.
        where: Name of the file, with which the error message begins.
        error_class: Class of the error that is raised.
        target_type: Type to which the content is converted.

    Raises:
        error_class: If the text is not TOML, or its content is wrong.
    """
    try:
        text = data.decode("utf-8-sig")  # some editors begin a file with a byte order mark
        if _DEEP_KEY.search(text):  # parsing such a key needs much memory
            raise ValueError("a key of more than 32 parts")
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
    except (ValueError, RecursionError) as cause:
        # The text is either not JSON, or JSON with wrong content. Decoding without a type distinguishes the two cases.
        # If it also fails, the text is not JSON, and the first error `cause` states why.
        try:
            content = msgspec.json.decode(text)
        except (ValueError, RecursionError):
            raise error_class(f"{_prefix(where)}expected JSON, got {shown(text)} ({cut(str(cause))})") from cause
        return convert(content, target_type, where, error_class)


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
    except msgspec.ValidationError as cause:
        raise error_class(_prefix(where) + _describe_mistake(value, target_type, cause)) from cause


def plain_values(value: object) -> Any:
    """Convert a value to a value that `json.dumps(..., allow_nan=False)` accepts.

    Arrays and tuples become lists. NumPy numbers become Python numbers. Numbers that are not finite become None. The
    keys of dictionaries become texts. The items of lists and dictionaries are converted in the same way.

    Args:
        value: Number, text, truth value, None, array, tuple, list or dictionary.
    """
    # msgspec calls `enc_hook` for arrays and for NumPy numbers, and writes null for numbers that are not finite.
    return msgspec.json.decode(msgspec.json.encode(value, enc_hook=lambda item: item.tolist()))


def _prefix(where: str) -> str:
    """Return the beginning of an error message: `where` and a colon, or an empty text if `where` is empty."""
    return f"{where}: " if where else ""


_LIST_INDEX = re.compile(r".* - at `\$\[(\d+)\][^`]*`$", re.DOTALL)
"""Message of msgspec about a wrong item of a list. The place is at its end, because a key may look like a place."""

_KEY_ERROR = re.compile(r"Object (missing required|contains unknown) field `(.*)`$", re.DOTALL)
"""Message of msgspec about a key that is missing or unknown."""


def _describe_mistake(value: Any, expected_type: Any, error: msgspec.ValidationError, path: str = "") -> str:
    """Return a description of a mistake, with the names of the keys that lead to the wrong value.

    The items of a table are converted separately. Of a list, only the item is converted whose index the message of
    msgspec contains. If an item cannot be converted, the mistake is in this item, and the function calls itself for the
    item. Otherwise, the table or the list itself is wrong, for example because a key is missing.

    Args:
        value: Value from TOML or JSON.
        expected_type: Type to which the value cannot be converted.
        error: Exception of msgspec. If `__post_init__` of a struct has raised a `WrongKey`, this `WrongKey` is the
            cause of `error`.
        path: Names of the keys that lead to the value; empty for the whole content.
    """
    item_types = _item_types(value, expected_type)
    wrong_index = _LIST_INDEX.match(str(error))
    if wrong_index and isinstance(value, list):  # converting each item of a long list would take seconds
        index = int(wrong_index[1])
        item_types = {key: item_type for key, item_type in item_types.items() if key == index}
    for key, item_type in item_types.items():
        try:
            item = value[key]
            msgspec.convert(item, item_type)
        except LookupError:  # the value has no such item; if the item is required, `error` reports that it is missing
            continue
        except msgspec.ValidationError as item_error:
            item_path = f"{path}[{key}]" if isinstance(key, int) else _join(path, key)
            return _describe_mistake(item, item_type, item_error, item_path)

    cause = error.__cause__
    if isinstance(cause, WrongKey):
        key_path = _join(path, cause.key)
        # A `WrongKey` without a message means that the key is missing.
        return f"{key_path}: {cause}" if str(cause) else f"key {key_path!r} is missing"

    key_mistake = _KEY_ERROR.match(str(error))  # matches only a message about a missing or unknown key of a struct
    if key_mistake is None:  # the value has a wrong type, or is beyond its bounds
        expected = _describe_schema(msgspec.json.schema(expected_type))
        return f"{_prefix(path)}expected {expected}, got {shown(value)}"

    kind, name = key_mistake.groups()
    if kind == "missing required":
        return f"key {_join(path, name)!r} is missing"

    known_keys = list(map(str, item_types))
    similar_keys = difflib.get_close_matches(cut(name), known_keys, n=1)
    advice = f"did you mean {similar_keys[0]!r}? Known are" if similar_keys else "known are"
    return f"unknown key {shown(_join(path, name))}; {advice} {cut(', '.join(known_keys))}"


def _item_types(value: Any, expected_type: Any) -> dict[str | int, Any]:
    """Return the expected type of each item of a table (by its key) or of a list (by its index).

    The result also contains keys that the table may have but does not have.

    Args:
        value: Table or list from TOML or JSON. For any other value, the result is empty.
        expected_type: Type that the value should have. It may be a union of several types.
    """
    alternatives = list(_union_members(expected_type))
    # A struct is a class whose attributes are the keys of a table.
    structs = [member for member in alternatives if isinstance(member, type) and issubclass(member, Struct)]
    types: dict[str | int, Any] = {}
    if isinstance(value, Mapping):
        types |= _types_by_key(value, structs)
    for member in alternatives:  # add the types of the items of dictionaries, lists and tuples
        arguments = get_args(member)
        if isinstance(value, Mapping) and get_origin(member) is dict:
            _key_type, item_type = arguments
            types |= dict.fromkeys(value, item_type)
        elif isinstance(value, list | tuple) and get_origin(member) in (list, tuple):
            # All items of list[float] and of tuple[float, ...] have the same type. Each item of tuple[str, float] has a
            # type of its own.
            is_uniform = len(arguments) == 1 or Ellipsis in arguments
            item_types = arguments[:1] * len(value) if is_uniform else arguments
            types.update(enumerate(item_types))
    return types


def _types_by_key(table: Mapping[str, Any], structs: list[Any]) -> dict[str | int, Any]:
    """Return the type of the value of each key that a table may have, as the struct of the table declares it.

    A struct is a class whose attributes are the keys of a table. If several structs are possible, a key of the table
    states which of them applies. This key is called the tag key, and its value is called the tag.

    Args:
        table: Table from TOML or JSON.
        structs: Structs that may apply. If there are several structs, all have the same tag key.

    Returns:
        Types by key. All keys are texts. The caller adds the indices of lists, which are integers.
    """
    tags = tuple(struct.__struct_config__.tag for struct in structs)
    types: dict[str | int, Any] = {}
    for struct in structs:
        config = struct.__struct_config__
        tag_key = config.tag_field  # None if the struct has no tag
        if tag_key is not None:
            types[tag_key] = Literal[tags]  # the tag may be that of any of the structs
        if tag_key is None or table.get(tag_key) == config.tag:  # this struct applies
            types |= {field.encode_name: field.type for field in msgspec.structs.fields(struct)}
    return types


def _union_members(expected_type: Any) -> Iterator[Any]:
    """Yield the members of a union without their annotations.

    If the type is not a union, the function yields only the type itself without its annotations.

    Args:
        expected_type: The type.
    """
    origin = get_origin(expected_type)
    if origin not in (Annotated, Union, UnionType):
        yield expected_type
        return
    arguments = get_args(expected_type)
    # The arguments of a union are its members. Those of `Annotated` are one type and then its annotations.
    for member in arguments[:1] if origin is Annotated else arguments:
        yield from _union_members(member)


def _join(path: str, key: str) -> str:
    """Join the path of a table and the name of one of its keys, for example as "film.radius_mm".

    Args:
        path: Names of the keys that lead to the table; empty for the whole file.
        key: Name of the key.
    """
    return cut(f"{path}.{key}" if path else str(key))


def _describe_schema(schema: Mapping[str, Any]) -> str:
    """Describe the values that a schema allows for error messages, for example as "a list of 2 numbers".

    Args:
        schema: JSON schema that msgspec has derived from a type. If the annotation of the type contains a description,
            the schema contains this description, and the function returns this description.
    """
    match schema:  # the first case that matches is used, so special cases precede general ones
        case {"description": description}:
            return str(description)
        case {"enum": values}:
            return f"one of {', '.join(map(str, values))}"
        # A union. If it has a discriminator, which is the tag key, all members are tables, and the last line applies.
        case {"anyOf": members} if "discriminator" not in schema:
            descriptions = [_describe_schema(member) for member in members if member.get("type") != "null"]
            return " or ".join(dict.fromkeys(descriptions))  # `fromkeys` removes repeated descriptions
        # A tuple has a schema for each item in `prefixItems`, but its items are of one kind. A list has one schema.
        case {"prefixItems": [item, *_]} | {"items": item}:
            # `_noun` returns the word for a kind of value, such as "number".
            items = f"{_noun(item)}s"
            minimum = schema.get("minItems", 0)
            if minimum == schema.get("maxItems"):
                return f"a list of {minimum} {items}"
            return f"a list of {items}, {minimum} or more" if minimum else f"a list of {items}"
        case {"maxLength": length}:  # a text, which must not be empty; see `Text`
            return f"a text of 1 to {length} characters"
        case {"type": "number" | "integer"}:
            return _describe_number(_noun(schema), schema)
        case {"type": "boolean"}:
            return "true or false"
    return f"a {_noun(schema)}"


_NOUNS = {
    "array": "list",
    "boolean": "truth value",
    "integer": "whole number",
    "number": "number",
    "object": "table",
    "string": "text",
}
"""Noun for the values of each type of a JSON schema."""


def _noun(schema: Mapping[str, Any]) -> str:
    """Return the noun for the values that a schema allows, such as "number", or "value" if they have several types."""
    is_struct = "$ref" in schema or "discriminator" in schema
    return _NOUNS.get("object" if is_struct else schema.get("type", ""), "value")


def _describe_number(noun: str, schema: Mapping[str, Any]) -> str:
    """Describe numbers with bounds for an error message, for example as "a number from 0 to 1".

    Args:
        noun: Noun for the numbers: "number" or "whole number".
        schema: JSON schema that contains the bounds.
    """
    # Word before each bound, such as "from 0 to below 1"
    words = {"exclusiveMinimum": "above", "minimum": "from", "maximum": "to", "exclusiveMaximum": "to below"}
    bounds = {}
    for key, word in words.items():
        # The bounds +-`MAX_FLOAT` exclude only infinity, and are not mentioned. A missing bound is treated like these.
        bound = schema.get(key, MAX_FLOAT)
        if abs(bound) != MAX_FLOAT:
            bounds[word] = bound
    if bounds == {"above": 0}:
        return f"a positive {noun}"
    if not bounds and noun == "number":
        return "a finite number"
    phrases = [f"{word} {bound:.16g}" for word, bound in bounds.items()]
    return " ".join([f"a {noun}", *phrases])
