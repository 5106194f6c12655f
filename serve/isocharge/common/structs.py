"""Settings and messages as typed structs, decoded by msgspec from TOML and JSON; errors name the key.

A file's keys are the attributes of a `Settings` class, their types and bounds say what a value may be, and a key that
is not there takes the attribute's default:

    class FilmTable(Settings, frozen=True):
        radius_mm: Positive
        poisson: Annotated[float, Meta(gt=-1.0, le=0.5)] = 0.34

    film = read_toml(path, "a film", SensorError, FilmTable)

Whatever does not fit is an error of one form:

    mine.toml: film.radius_mm: expected a positive number, got -45
    mine.toml: unknown key 'film.radius'; did you mean 'radius_mm'? Known are radius_mm, poisson
    mine.toml: key 'film.radius_mm' is missing

`Meta(description="[x, y] in mm")` replaces the words after "expected". What a type cannot say is checked in
`__post_init__`, which raises `WrongKey`.
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

LARGEST_FLOAT = sys.float_info.max

MOST_TOML_BYTES, MOST_JSON_BYTES = 1 << 18, 1 << 22
"""Largest file of settings, bytes; Python reads TOML a hundred times slower than JSON."""

MOST_EXAMINED = 1000
"""Items of a list in which a fault is looked for; of one in a later item msgspec's own message is given."""

_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
_DEEP_KEY = re.compile(rf"(?<![\w-])(?:{_PART}\.[ \t]*+){{32}}")
"""A key with more dots than a table has levels: Python needs memory as the square of their number to read it."""

Finite = Annotated[float, Meta(ge=-LARGEST_FLOAT, le=LARGEST_FLOAT)]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST_FLOAT)]
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST_FLOAT)]
Text = Annotated[str, Meta(min_length=1, max_length=1000)]
"""Neither empty nor endless: names stand in messages, records and pages."""


class Settings(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of a file; an unknown key is an error. Type checkers want `frozen=True` again in each class."""


class WrongKey(ValueError):
    """Raised in the `__post_init__` of a struct: the value of a key does not go with those of others.

    Without an expectation, the key is missing beside those that are there.
    """

    def __init__(self, key: str, expected: str = "", got: object = None) -> None:
        super().__init__(f"expected {expected}, got {shown(got)}" if expected else "")
        self.key = key


def read_toml(path: Path, what: str, error: type[InputError], kind: type[T]) -> T:
    """The content of a TOML file.

    Args:
        path: The file.
        what: What the file should be, for messages: "a device file".
        error: Raised if it cannot be read, or does not fit.
        kind: The type of its content; `dict[str, Any]` for a table as it stands.
    """
    return parse_toml(_text(path, MOST_TOML_BYTES, what, "TOML", error), str(path), error, kind)


def read_json(path: Path, what: str, error: type[InputError], kind: type[T]) -> T:
    """The content of a JSON file; the arguments are those of `read_toml`."""
    return parse_json(_text(path, MOST_JSON_BYTES, what, "JSON", error), str(path), error, kind)


def _text(path: Path, most: int, what: str, language: str, error: type[InputError]) -> str:
    data = read_needed(path, error, f"expected {what} in {language}", most)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a {language} file: not text in UTF-8: {cause}") from cause


def parse_toml(text: str, where: str, error: type[InputError], kind: type[T]) -> T:
    """The content of a text in TOML; `where` opens the message of the error."""
    if _DEEP_KEY.search(text):
        raise error(f"{where}: not a TOML file: a key of more than 32 parts")
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as cause:
        raise error(f"{where}: not a TOML file: {cut(str(cause))}") from cause
    return convert(content, kind, where, error)


def parse_json(text: str | bytes, where: str, error: type[InputError], kind: type[T]) -> T:
    """The content of a text in JSON; `where`, if not empty, opens the message of the error."""
    try:
        return msgspec.json.decode(text, type=kind)
    except (ValueError, RecursionError) as cause:
        fault = cause
    try:
        content = msgspec.json.decode(text)
    except (ValueError, RecursionError):
        raise error(f"{_opening(where)}expected JSON, got {shown(text)} ({cut(str(fault))})") from fault
    raise error(_opening(where) + _explained(content, kind, fault)) from fault


def convert(value: object, kind: type[T], where: str, error: type[InputError]) -> T:
    """A value of tables, lists, texts and numbers as a type.

    Args:
        value: From TOML or JSON.
        kind: A struct, or another type that msgspec knows.
        where: Opens the message of the error, if not empty.
        error: Raised if the value does not fit.
    """
    try:
        return msgspec.convert(value, kind)
    except (msgspec.ValidationError, RecursionError) as cause:
        raise error(_opening(where) + _explained(value, kind, cause)) from cause


def _opening(where: str) -> str:
    return f"{where}: " if where else ""


def _explained(value: object, kind: Any, cause: Exception) -> str:
    """The first fault of a value; msgspec's own message, which shows no value, if there is none to be found."""
    try:
        return next(_faults(value, kind, ""), cut(str(cause)))
    except RecursionError:
        return "nested too deeply"


def _faults(value: object, kind: Any, path: str) -> Iterator[str]:
    """Sentences on what does not fit in a value, the innermost first."""
    options = list(_options(kind))
    yield from _faults_of_tag(value, options, path)
    for option in options:
        yield from _faults_inside(value, option, path)
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        wrong = error.__cause__
        if isinstance(wrong, WrongKey):
            name = _join(path, wrong.key)
            yield f"{name}: {wrong}" if str(wrong) else f"key {name!r} is missing"
        elif wrong is not None:
            yield f"{_opening(path)}{wrong}"
        else:
            words = get_args(options[0]) if get_origin(options[0]) is Literal else None  # msgspec sorts them
            expected = _one_of(words) if words else _described(inspect.type_info(kind))
            yield f"{_opening(path)}expected {expected}, got {shown(value)}"


def _faults_of_tag(value: object, options: list[Any], path: str) -> Iterator[str]:
    """The key that chooses one of several structs."""
    configs = [
        option.__struct_config__ for option in options if isinstance(option, type) and issubclass(option, Struct)
    ]
    tags = {config.tag: config.tag_field for config in configs if config.tag is not None}
    if isinstance(value, Mapping) and tags:
        field = str(next(iter(tags.values())))
        if field not in value and len(tags) > 1:
            yield f"key {_join(path, field)!r} is missing"
        elif value.get(field) not in (*tags, None):
            yield f"{_join(path, field)}: expected {_one_of(tags)}, got {shown(value[field])}"


def _faults_inside(value: object, kind: Any, path: str) -> Iterator[str]:
    """Faults of the parts of a table or list."""
    if isinstance(value, Mapping) and isinstance(kind, type) and issubclass(kind, Struct):
        yield from _faults_of_keys(value, kind, path)
    elif isinstance(value, Mapping) and get_origin(kind) is dict:
        for key, item in value.items():
            yield from _faults(item, get_args(kind)[1], _join(path, key))
    elif isinstance(value, list | tuple) and get_origin(kind) in (list, tuple):
        kinds = [item for item in get_args(kind) if item is not Ellipsis]
        if len(kinds) in (1, len(value)):
            for number, item in enumerate(value[:MOST_EXAMINED]):
                yield from _faults(item, kinds[number % len(kinds)], f"{path}[{number}]")


def _faults_of_keys(table: Mapping[str, Any], kind: type[Struct], path: str) -> Iterator[str]:
    """Unknown keys, missing ones, and those whose value does not fit."""
    config, hints = kind.__struct_config__, get_type_hints(kind, include_extras=True)
    if config.tag is not None and table.get(str(config.tag_field)) != config.tag:
        return
    known = {item.encode_name: hints[item.name] for item in msgspec.structs.fields(kind)}
    for key in table if config.forbid_unknown_fields else ():
        if key not in known and key != config.tag_field:
            yield unknown_key(_join(path, key), key, [*filter(None, [config.tag_field]), *known])
    for item in msgspec.structs.fields(kind):
        if item.encode_name in table:
            yield from _faults(table[item.encode_name], known[item.encode_name], _join(path, item.encode_name))
        elif item.required:
            yield f"key {_join(path, item.encode_name)!r} is missing"


def unknown_key(name: str, key: str, known: Iterable[str]) -> str:
    """A sentence on a key that nobody knows, with the nearest one that is known."""
    keys = list(known)
    nearest = difflib.get_close_matches(cut(key), keys, n=1)
    return (
        f"unknown key {shown(name)}; "
        + (f"did you mean {nearest[0]!r}? Known" if nearest else "known")
        + (f" are {cut(', '.join(keys))}")
    )


def _options(kind: Any) -> Iterator[Any]:
    """The members of a union, without annotations."""
    if get_origin(kind) is Annotated:
        yield from _options(get_args(kind)[0])
    elif get_origin(kind) in (Union, UnionType):
        for member in get_args(kind):
            yield from _options(member)
    else:
        yield kind


def _join(path: str, key: str) -> str:
    return cut(f"{path}.{key}" if path else str(key))


def _described(kind: inspect.Type) -> str:
    """What a value of a type is, for people."""
    match kind:
        case inspect.Metadata(type=inner, extra_json_schema=extra):
            return (extra or {}).get("description") or _described(inner)
        case inspect.FloatType(gt=above, ge=least, le=most):
            return _number("number", above, least, most)
        case inspect.IntType(gt=above, ge=least, le=most):
            return _number("whole number", above, least, most)
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType(max_length=int(longest)):
            return f"a text of 1 to {longest} characters"
        case inspect.LiteralType(values=values):
            return _one_of(values)
        case inspect.EnumType(cls=cls):
            return _one_of(member.value for member in cls)
        case inspect.UnionType(types=types):
            options = [_described(item) for item in types if not isinstance(item, inspect.NoneType)]
            return " or ".join(dict.fromkeys(options))
        case inspect.TupleType(item_types=items):
            return f"a list of {len(items)} {_noun(items[0])}s"
        case inspect.CollectionType(item_type=item, min_length=least):
            return f"a list of {_noun(item)}s" + (f", {least} or more" if least else "")
    return f"a {_noun(kind)}"


_NOUNS: tuple[tuple[Any, str], ...] = (
    (inspect.StrType, "text"),
    ((inspect.FloatType, inspect.IntType), "number"),
    ((inspect.StructType, inspect.DictType), "table"),
    ((inspect.TupleType, inspect.CollectionType), "list"),
    (inspect.BytesType, "text in base64"),
)


def _noun(kind: inspect.Type) -> str:
    """What a value of a type is, in a word."""
    plain = kind.type if isinstance(kind, inspect.Metadata) else kind
    return next((noun for kinds, noun in _NOUNS if isinstance(plain, kinds)), "value")


def _one_of(words: Iterable[object]) -> str:
    return f"one of {', '.join(map(str, words))}"


def _number(noun: str, above: float | None, least: float | None, most: float | None) -> str:
    least, most = (None if bound is None or abs(bound) == LARGEST_FLOAT else bound for bound in (least, most))
    if above == 0 and most is None:
        return f"a positive {noun}"
    if above is not None:
        return f"a {noun} above {_plain(above)}" + ("" if most is None else f" and at most {_plain(most)}")
    if least is not None:
        return f"a {noun} from {_plain(least)}" + ("" if most is None else f" to {_plain(most)}")
    if most is not None:
        return f"a {noun} of at most {_plain(most)}"
    return f"a {noun}" if noun == "whole number" else f"a finite {noun}"


def _plain(bound: float) -> str:
    """A bound as people write it: whole numbers with all their digits."""
    return f"{bound:g}" if isinstance(bound, float) else str(bound)
