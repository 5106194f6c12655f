"""Tables of settings from TOML or JSON, read key by key: the one place that checks what a file says.

A `Table` knows the file it comes from, its own name in it, and the error to raise. So every message has one form:

    mine.toml: film.radius_mm: expected a positive number, got -45
    mine.toml: unknown key 'film.radius'; known are radius_mm, thickness_um
    mine.toml: key 'film.radius_mm' is missing

A number is an int or a float, never a bool, and finite; a whole number has 63 bits at most. Long values are cut in
messages. Tables and lists that are nested deeper than `DEEPEST` are refused where the text is read, so that nothing
behind it, which may go down into them by recursion, has to think of that.
"""

import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn, TypeGuard

from isocharge.common.errors import LONGEST_VALUE as LONGEST_VALUE
from isocharge.common.errors import InputError
from isocharge.common.errors import cut as cut
from isocharge.common.errors import shown as shown
from isocharge.common.files import read_whole

REQUIRED: Final = object()
"""The default of a key that must be there."""

LONGEST_TEXT = 1000
"""Characters of a text: names stand in messages, records and pages."""

DEEPEST = 32
"""Levels of tables and lists in each other; our files have up to six."""

_TOO_DEEP = f"nested in more than {DEEPEST} levels"

_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
_DEEP_KEY = re.compile(rf"(?<![\w-])(?:{_PART}\.[ \t]*+){{{DEEPEST}}}")
"""A key with more dots than `DEEPEST`, before it is parsed: Python needs memory as the square of their number."""

MOST_TOML_BYTES, MOST_JSON_BYTES = 1 << 18, 1 << 22
"""Largest file of settings, bytes; Python reads TOML a hundred times slower than JSON."""


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a finite int or float; a bool is not."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an int beyond the largest float
        return False


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a value is an int of 64 bits; a bool is not."""
    return isinstance(value, int) and not isinstance(value, bool) and -(1 << 63) <= value < 1 << 63


def read_toml(path: Path, what: str, error: type[InputError]) -> dict[str, Any]:
    """The tables of a TOML file.

    Args:
        path: The file.
        what: What the file should be, for messages: "a device file".
        error: Raised if it cannot be read, or is no TOML in UTF-8.
    """
    return parse_toml(_text(path, MOST_TOML_BYTES, what, "TOML", error), str(path), error)


def read_json(path: Path, what: str, error: type[InputError]) -> Any:
    """The value in a JSON file; the arguments are those of `read_toml`."""
    return parse_json(_text(path, MOST_JSON_BYTES, what, "JSON", error), str(path), error)


def _text(path: Path, most: int, what: str, language: str, error: type[InputError]) -> str:
    try:
        return read_whole(path, most).decode("utf-8")
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror}); expected {what} in {language}") from cause
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a {language} file: not text in UTF-8: {cause}") from cause


def parse_toml(text: str, where: str, error: type[InputError]) -> dict[str, Any]:
    """The tables of a text in TOML; `where` opens the message of the error that is raised if it is none."""
    try:
        if _DEEP_KEY.search(text):
            raise ValueError(_TOO_DEEP)
        tables: dict[str, Any] = _flat_enough(tomllib.loads(text))
        return tables
    except (ValueError, RecursionError) as cause:
        raise error(f"{where}: not a TOML file: {cut(str(cause))}") from cause


def parse_json(text: str | bytes, where: str, error: type[InputError]) -> Any:
    """The value of a text in JSON; `where`, if not empty, opens the message of the error that is raised otherwise."""
    try:
        return _flat_enough(json.loads(text))
    except (ValueError, RecursionError) as cause:
        raise error(f"{where + ': ' if where else ''}expected JSON, got {shown(text)} ({cut(str(cause))})") from cause


def _flat_enough(value: Any) -> Any:
    """A value, unless it is nested deeper than `DEEPEST`; without recursion, as it may be nested a million times."""
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [item for holder in level for item in _items(holder)]
        if not level:
            return value
    raise ValueError(_TOO_DEEP)


def _items(holder: Any) -> Iterable[Any]:
    if isinstance(holder, dict):
        return holder.values()
    return holder if isinstance(holder, list) else ()


class Table:
    """One table of a file, read key by key.

    Attributes:
        values: Its keys and values.
        where: The file, as messages name it; empty where the caller adds it.
        path: The table's own name in the file with dots, empty for the whole file.
        error: The error of a wrong key or value.
    """

    def __init__(self, values: object, where: str, error: type[InputError], path: str = "") -> None:
        self.where, self.path, self.error = where, path, error
        if not isinstance(values, Mapping):
            name = ": ".join(filter(None, (where, path)))
            raise error(f"{name + ': ' if name else ''}expected a table, got {shown(values)}")
        self.values: Mapping[str, Any] = values

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def only(self, *known: str) -> "Table":
        """This table, if it has no other keys than these.

        Raises:
            error: Names the first unknown key, and the known ones.
        """
        for key in self.values:
            if key not in known:
                self._fail(f"unknown key {shown(self._name(key))}; known are {cut(', '.join(known))}")
        return self

    def get(self, key: str, default: Any = REQUIRED) -> Any:
        """The value of a key as it stands; the default where it is absent.

        Raises:
            error: If it is absent and there is no default.
        """
        if key in self.values:
            return self.values[key]
        if default is REQUIRED:
            self._fail(f"key {self._name(key)!r} is missing")
        return default

    def refuse(self, key: str, expected: str, value: object = REQUIRED) -> NoReturn:
        """Raise the error of a key; `value` is what is shown, the key's own if absent."""
        got = self.values.get(key) if value is REQUIRED else value
        self._fail(f"{self._name(key)}: expected {expected}, got {shown(got)}")

    def number(
        self,
        key: str,
        default: Any = REQUIRED,
        *,
        least: float = -math.inf,
        most: float = math.inf,
        above: float = -math.inf,
        or_infinite: bool = False,
        not_zero: bool = False,
    ) -> float:
        """A finite number from `least` to `most`, and greater than `above`; or, where that has a meaning, infinity."""
        value = self.get(key, default)
        if or_infinite and value == math.inf:
            return math.inf
        if not is_number(value) or not least <= value <= most or not value > above or (not_zero and value == 0):
            kind = _kind_of_number("number", least, most, above)
            self.refuse(key, kind + " or inf" * or_infinite + " that is not 0" * not_zero, value)
        return float(value)

    def whole(self, key: str, default: Any = REQUIRED, *, least: int | None = None, most: int | None = None) -> int:
        """A whole number from `least` to `most`."""
        value = self.get(key, default)
        low, high = -math.inf if least is None else least, math.inf if most is None else most
        if not is_whole(value) or not low <= value <= high:
            self.refuse(key, _kind_of_number("whole number", low, high, -math.inf), value)
        return value

    def flag(self, key: str, default: Any = REQUIRED) -> bool:
        """True or false."""
        value = self.get(key, default)
        if not isinstance(value, bool):
            self.refuse(key, "true or false", value)
        return value

    def text(self, key: str, default: Any = REQUIRED, *, or_empty: bool = False) -> str:
        """A text that is not empty, unless it may be, and not longer than `LONGEST_TEXT`."""
        value = self.get(key, default)
        if not isinstance(value, str) or not (value or or_empty):
            self.refuse(key, "a text", value)
        if len(value) > LONGEST_TEXT:
            self.refuse(key, f"a text of at most {LONGEST_TEXT} characters", value)
        return value

    def choice(self, key: str, options: Sequence[str], default: Any = REQUIRED) -> str:
        """One of some words."""
        value = self.get(key, default)
        if not isinstance(value, str) or value not in options:
            self.refuse(key, f"one of {', '.join(options)}", value)
        return value

    def sequence(self, key: str, default: Any = REQUIRED, *, of: str = "values") -> list[Any]:
        """A list; `of` says of what, for the message."""
        value = self.get(key, default)
        if not isinstance(value, list | tuple):
            self.refuse(key, f"a list of {of}", value)
        return list(value)

    def texts(self, key: str, default: Any = REQUIRED, *, of: str = "texts", or_empty: bool = False) -> tuple[str, ...]:
        """A list of texts that are not empty, unless they may be."""
        values = self.sequence(key, default, of=of)
        if not all(isinstance(value, str) and (value or or_empty) for value in values):
            self.refuse(key, f"a list of {of}", values)
        return tuple(values)

    def numbers(self, key: str, default: Any = REQUIRED, *, count: int, of: str) -> tuple[float, ...]:
        """A list of `count` finite numbers; `of` names them: "[x, y] in mm"."""
        return self.as_numbers(key, self.get(key, default), count=count, of=of)

    def as_numbers(self, key: str, value: object, *, count: int, of: str) -> tuple[float, ...]:
        """As `numbers`, of a value inside the key's own."""
        if not isinstance(value, list | tuple) or len(value) != count or not all(map(is_number, value)):
            self.refuse(key, of, value)
        return tuple(map(float, value))

    def table(self, key: str, default: Any = REQUIRED) -> "Table":
        """The table of a key."""
        return Table(self.get(key, default), self.where, self.error, self._name(key))

    def tables(self, key: str, default: Any = REQUIRED) -> list["Table"]:
        """The tables of a list; messages number them from 1."""
        values = self.sequence(key, default, of="tables")
        return [
            Table(value, self.where, self.error, f"{self._name(key)}[{number}]")
            for number, value in enumerate(values, start=1)
        ]

    def _fail(self, message: str) -> NoReturn:
        raise self.error(f"{self.where}: {message}" if self.where else message)

    def _name(self, key: str) -> str:
        return cut(f"{self.path}.{key}" if self.path else key)


def _kind_of_number(noun: str, least: float, most: float, above: float) -> str:
    if above == 0.0 and most == math.inf:
        return f"a positive {noun}"
    if above > -math.inf:
        return f"a {noun} above {above:g}" + (f" and at most {most:g}" if most < math.inf else "")
    if least > -math.inf and most < math.inf:
        return f"a {noun} from {_plain(least)} to {_plain(most)}"
    if least > -math.inf:
        return f"a {noun} from {_plain(least)}"
    if most < math.inf:
        return f"a {noun} of at most {_plain(most)}"
    return f"a {noun}" if noun == "whole number" else f"a finite {noun}"


def _plain(bound: float) -> str:
    """A bound as people write it: whole numbers with all their digits, up to a million."""
    return f"{bound:g}" if isinstance(bound, float) else str(bound)
