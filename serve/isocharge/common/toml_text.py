"""Tables of settings to TOML: the writer beside `isocharge.common.structs`, which reads them.

Not a library's: tomli-w gives each number of a list a line, so that the position of an electrode takes four, and writes
no comments; tomlkit is made to change files and keep their style.
"""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from isocharge.common.printable_text import printable

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def to_toml(tables: Mapping[str, Any], comment: Iterable[str] = ()) -> str:
    """The text of a TOML file: comments, keys without a table, then a section for each table.

    Args:
        tables: Texts, finite or infinite numbers, true and false, lists and tables, by names that may be any text. A
            table in a section, or in a list, stands on one line.
        comment: Lines for the head of the file, without #.

    Raises:
        TypeError: If a value is of another type.
    """
    lines = [f"# {printable(line)}".rstrip() for text in comment for line in text.splitlines() or [""]]
    lines += [""] * bool(lines)
    lines += [_pair(key, value) for key, value in tables.items() if not isinstance(value, Mapping)]
    for name, table in tables.items():
        if isinstance(table, Mapping):
            lines += ["", f"[{_key(name)}]", *(_pair(key, value) for key, value in table.items())]
    return "\n".join(lines).lstrip("\n") + "\n"


def _pair(key: str, value: object) -> str:
    return f"{_key(key)} = {_value(value)}"


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(_pair(key, item) for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return _text(value)
    raise TypeError(f"expected a text, a number, true or false, a list or a table, got {value!r:.100}")


def _text(text: str) -> str:
    """A basic string: that of JSON, which leaves one control character bare that TOML does not."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
