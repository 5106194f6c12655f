"""Writing of settings as TOML. The module `isocharge.common.structs` reads TOML.

The module uses no library that writes TOML. The library tomli-w cannot write comments, and writes each number of a list
on a separate line. The library rtoml writes a table inside a section as another section. Lines that a user appends to
the first section would then belong to another table. The library tomlkit is intended for changes of existing files.
"""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from isocharge.common.errors import printable

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
"""Key that needs no quotation marks."""


def to_toml(tables: Mapping[str, Any], comment: Iterable[str] = ()) -> str:
    """Return the text of a TOML file.

    The text begins with the comment. The keys outside of all tables follow, and then a section for each table.

    Args:
        tables: Values by name. A value is a text, a number, a truth value, a list or a table. A table becomes a
            section. A table inside a section or inside a list is written on one line.
        comment: Lines of the comment at the beginning of the file, without the character #.

    Raises:
        TypeError: If a value has another type.
    """
    # An item of `comment` may have several lines. An empty item has none, and becomes an empty comment line.
    lines = [f"# {printable(line)}".rstrip() for text in comment for line in text.splitlines() or [""]]
    if lines:
        lines.append("")

    # Keys without a table must precede all tables, because TOML assigns later keys to the last table.
    # `_pair` returns a line "key = value".
    lines += [_pair(key, value) for key, value in tables.items() if not isinstance(value, Mapping)]

    for name, table in tables.items():
        if isinstance(table, Mapping):
            lines += ["", f"[{toml_key(name)}]", *(_pair(key, value) for key, value in table.items())]
    content = "\n".join(lines).lstrip("\n")  # remove the blank line if the file begins with a section
    return content + "\n"


def _pair(key: str, value: object) -> str:
    """Return a key and its value in the notation of TOML."""
    return f"{toml_key(key)} = {_toml_value(value)}"


def toml_key(key: str) -> str:
    """Return a key in the notation of TOML, with quotation marks if they are necessary."""
    return key if _BARE_KEY.fullmatch(key) else _json(key)


def _toml_value(value: object) -> str:
    """Return a value in the notation of TOML. A table becomes an inline table, such as `{a = 1, b = 2}`.

    `_pair` writes a key and a value of the table, and `_json` writes a text or a truth value.

    Args:
        value: Text, number, truth value, list, tuple or table.

    Raises:
        TypeError: If the value has another type.
    """
    if isinstance(value, Mapping):
        return "{" + ", ".join(_pair(key, item) for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    if isinstance(value, bool | str):  # before the numbers, because bool is a subclass of int
        return _json(value)
    if isinstance(value, int | float):
        return repr(value)
    raise TypeError(f"expected a text, a number, true or false, a list or a table, got {value!r:.100}")


def _json(value: bool | str) -> str:
    """Return a truth value or a text in the notation of JSON, which is also valid in TOML.

    The only difference between the two notations is that TOML requires an escape sequence for the character U+007F.
    """
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
