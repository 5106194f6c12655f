"""Writing of settings as TOML; `isocharge.common.structs` reads them.

This module uses no library. tomli-w writes no comments, and writes each number of a list on its own line. tomlkit is
intended for changes of existing files.
"""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from isocharge.common.printable_text import printable

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
"""Key that needs no quotation marks."""


def to_toml(tables: Mapping[str, Any], comment: Iterable[str] = ()) -> str:
    """Return the text of a TOML file: comments, keys without a table, and a section for each table.

    Args:
        tables: Texts, numbers, truth values, lists and tables by name. A table in a section or in a list is written on
            one line.
        comment: Lines of the comment at the head of the file, without #.

    Raises:
        TypeError: If a value is of another type.
    """
    lines = []
    for text in comment:
        comment_lines = text.splitlines() or [""]  # an empty text becomes an empty comment line
        lines += [f"# {printable(line)}".rstrip() for line in comment_lines]
    if lines:
        lines.append("")

    # Keys without a table must precede all tables, because TOML assigns later keys to the last table.
    lines += [_pair(key, value) for key, value in tables.items() if not isinstance(value, Mapping)]

    for name, table in tables.items():
        if isinstance(table, Mapping):
            lines.append("")
            lines.append(f"[{_key(name)}]")
            lines += [_pair(key, value) for key, value in table.items()]
    content = "\n".join(lines).lstrip("\n")  # without the blank line before a table at the beginning
    return content + "\n"


def _pair(key: str, value: object) -> str:
    return f"{_key(key)} = {_value(value)}"


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _text(key)


def _value(value: object) -> str:
    """Return a value in the notation of TOML; raise TypeError if TOML has no notation for its type."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(_pair(key, item) for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):  # before the numbers, because bool is a subclass of int
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _text(value)
    raise TypeError(f"expected a text, a number, true or false, a list or a table, got {value!r:.100}")


def _text(text: str) -> str:
    """Return a text as a basic string of TOML: the JSON string of the text, with the character U+007F also escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
