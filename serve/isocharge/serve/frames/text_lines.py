"""Parsers for the lines of text that boards send, and functions that write frames as such lines.

A board may use one of the following notations.

| notation | example |
|---|---|
| CSV, also with semicolons, tabs or blanks; with or without a header | `12, 801.2, 799.5, 803.3` |
| one or several pairs name:value in a line | `A:801.2,B:799.5,C:803.3` |
| Teleplot (github.com/nesnes/teleplot) | `>A:1627551892437:801.2§pC` (time in ms and unit are optional) |
| JSON object or list | `{"seq": 12, "A": 801.2}` |
| sentence in the style of NMEA 0183, with or without a checksum | `$PZT,801.2,799.5,803.3*5D` |

Blank lines and lines that begin with # have no values. `isocharge.common.number_text` parses the numbers.
"""

import json
import re
from collections.abc import Callable
from enum import StrEnum
from functools import reduce
from operator import xor
from typing import Any, NamedTuple

from isocharge.common.number_text import parse_number
from isocharge.serve.frames.frame import SEQ, TIMES_US, Frame

TELEPLOT_TIME = "t_ms"
"""Name of the time of a Teleplot line, which has no name in Teleplot."""

MAX_JSON_LEVEL = 3
"""Largest depth in a JSON object at which numbers are read."""

_SEPARATOR = re.compile(r"\s*[,;\t]\s*|\s+")

_PAIR = re.compile(r"\s*(?P<name>[^\s:=,;]+)\s*[:=]\s*(?P<value>[^\s:=,;]+)\s*(?:[,;]\s*|\s|$)")

_NAME = re.compile(r"[^\W\d][\w.\[\]/-]*")


class Notation(StrEnum):
    """Notation of a line of text."""

    csv = "CSV"
    header = "CSV header"
    pairs = "name:value"
    teleplot = "Teleplot"
    json = "JSON"
    sentence = "sentences"
    nothing = "nothing"


class Line(NamedTuple):
    """Content of a line.

    Attributes:
        notation: Notation of the line.
        names: Names of the values, or of the columns in a header; empty for CSV.
        values: The numbers; empty for a header.
    """

    notation: Notation
    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()


NO_READING = Line(Notation.nothing)
"""Content of a line without values, such as a comment."""


def parse_line(data: bytes) -> Line:
    """Parse a line of text in any of the notations. The first characters determine the notation.

    Args:
        data: The line without the characters that end it.

    Raises:
        ValueError: If the line has no known notation.
    """
    text = data.decode("utf-8").strip()
    if not text or text[0] == "#":
        return NO_READING
    # The first character is tested before the separators, because JSON and Teleplot lines also contain colons.
    if text[0] in "{[":
        return _json(text)
    if text[0] == ">":
        return _teleplot(text)
    if text[0] == "$":
        return _sentence(text)
    if ":" in text or "=" in text:
        return _pairs(text)
    return _csv(text)


def _csv(text: str) -> Line:
    """Parse a line of numbers between separators, or a header with the names of the columns.

    Raises:
        ValueError: If the line consists neither of numbers nor of different names.
    """
    cells = _SEPARATOR.split(text.rstrip(",; \t"))
    try:
        return Line(Notation.csv, values=tuple(map(parse_number, cells)))
    except ValueError:  # a cell is not a number, so that the line may be a header
        are_names = all(map(_NAME.fullmatch, cells))
        are_different = len(set(cells)) == len(cells)
        if are_names and are_different:
            return Line(Notation.header, names=tuple(cells))
        raise


def _sentence(text: str) -> Line:
    """Parse the numbers of a sentence such as `$FILM,1.5,2.5*3A`, whose first word is a name.

    The sentence may end in `*` and a checksum, which is the exclusive or of all bytes between `$` and `*`.
    """
    content, star, checksum = text[1:].partition("*")
    if star:
        expected_checksum = reduce(xor, content.encode(), 0)
        if len(checksum) != 2 or int(checksum, 16) != expected_checksum:
            raise ValueError(f"expected the checksum of the sentence, got {text[-100:]!r}")
    _name, *cells = _SEPARATOR.split(content.rstrip(",; \t"))
    if not cells:
        raise ValueError(f"expected numbers after the first word, got {text[:100]!r}")
    return Line(Notation.sentence, values=tuple(map(parse_number, cells)))


def _pairs(text: str) -> Line:
    """Parse a line of one or several pairs `name:value` or `name=value`.

    Raises:
        ValueError: If a part of the line is not a pair, or a name occurs twice.
    """
    pairs: dict[str, float] = {}
    position = 0
    while position < len(text):
        match = _PAIR.match(text, position)
        if match is None or match["name"] in pairs:
            raise ValueError(f"expected name:value, got {text[position:]!r}")
        pairs[match["name"]] = parse_number(match["value"])
        position = match.end()
    return Line(Notation.pairs, names=tuple(pairs), values=tuple(pairs.values()))


def _teleplot(text: str) -> Line:
    """Parse the latest value of a Teleplot line, `>name:time:value;time:value§unit|flags`.

    The time, the unit and the flags may be missing. Lines with texts (flag `t`) or with points of x-y plots (flag `xy`)
    have no values.
    """
    content, _, flags = text[1:].partition("|")
    name, _, values = content.partition(":")
    if not name.strip() or not values:
        raise ValueError(f"expected >name:value, got {text!r}")
    if "t" in flags or "xy" in flags:
        return NO_READING

    _, _, latest_value = values.rstrip("; ").rpartition(";")
    reading, _, _unit = latest_value.partition("§")
    *times, value = reading.split(":")
    if len(times) > 1:
        raise ValueError(f"expected >name:time:value, got {text!r}")
    pairs = {}
    if times:
        pairs[TELEPLOT_TIME] = parse_number(times[0])
    pairs[name.strip()] = parse_number(value)
    return Line(Notation.teleplot, names=tuple(pairs), values=tuple(pairs.values()))


def _json(text: str) -> Line:
    """Parse a JSON object with numbers at any level, or a JSON list of numbers."""
    try:
        # As floats, integers with hundreds of digits become infinite, as they do in the other notations.
        content = json.loads(text, parse_int=float)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if isinstance(content, list) and content and all(isinstance(number, float) for number in content):
        return Line(Notation.csv, values=tuple(content))
    numbers = dict(_json_numbers("", content))
    if not numbers:
        raise ValueError(f"expected numbers, got {text!r}")
    return Line(Notation.json, names=tuple(numbers), values=tuple(numbers.values()))


def _json_numbers(path: str, content: Any, level: int = 0) -> list[tuple[str, float]]:
    """Return every number of a JSON value with the path to it, such as `charge.A` or `charge.0.re`.

    The function ignores numbers that are more than `MAX_JSON_LEVEL` levels deep.

    Args:
        path: Path to the value; empty for the whole text.
        content: The value: a number, a list, an object, or a value that contains no number.
        level: Number of objects and lists that contain the value.
    """
    if isinstance(content, float):  # Integers were read as floats.
        return [(path, content)]
    if level >= MAX_JSON_LEVEL:
        return []
    if isinstance(content, dict):
        items = [(str(key), value) for key, value in content.items()]
    elif isinstance(content, list):
        items = [(str(index), value) for index, value in enumerate(content)]
    else:
        return []

    numbers = []
    prefix = f"{path}." if level > 0 else ""
    for key, value in items:
        numbers += _json_numbers(prefix + key, value, level + 1)
    return numbers


def _named_values(frame: Frame) -> list[tuple[str, str]]:
    """Return the names and the values of the frame counter, the clock and the channels, as text.

    Channels without names are called A, B, C, and so on.
    """
    fields = []
    if frame.seq is not None:
        fields.append((SEQ, str(frame.seq)))
    if frame.t_us is not None:
        fields.append(("t_us", str(frame.t_us)))
    names = frame.names or tuple(chr(ord("A") + channel) for channel in range(len(frame.values)))
    for name, value in zip(names, frame.values, strict=True):
        fields.append((name, f"{value:.7g}"))
    return fields


def _write_csv(frame: Frame) -> str:
    return ",".join(f"{value:.7g}" for value in frame.values)


def _write_pairs(frame: Frame) -> str:
    return ",".join(f"{name}:{value}" for name, value in _named_values(frame))


def _write_teleplot(frame: Frame) -> str:
    time = "" if frame.t_us is None else f"{frame.t_us / 1e3:.3f}:"
    return "\n".join(f">{name}:{time}{value}" for name, value in _named_values(frame) if name not in TIMES_US)


def _write_json(frame: Frame) -> str:
    fields = ", ".join(f"{json.dumps(name)}: {value}" for name, value in _named_values(frame))
    return "{" + fields + "}"


TEXT_FORMATS: dict[str, Callable[[Frame], str]] = {
    "csv": _write_csv,
    "pairs": _write_pairs,
    "teleplot": _write_teleplot,
    "json": _write_json,
}
"""Function that writes a frame, by the name of the notation. CSV has only the channels and no header."""


def encode_text(frame: Frame, notation: str) -> bytes:
    """Return a frame as a line of text, or as several lines for Teleplot. Numbers have seven digits.

    Args:
        frame: The frame.
        notation: A key of `TEXT_FORMATS`.
    """
    return (TEXT_FORMATS[notation](frame) + "\n").encode()
