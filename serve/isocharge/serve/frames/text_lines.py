"""One line of text from a board: which of the usual notations it is, and its names and numbers; and lines from frames.

| notation | example |
|---|---|
| CSV, also with semicolons, tabs or blanks; header or not | `12, 801.2, 799.5, 803.3` |
| name:value, several in a line or one | `A:801.2,B:799.5,C:803.3` |
| Teleplot (github.com/nesnes/teleplot) | `>A:1627551892437:801.2§pC` (time in ms and unit are optional) |
| JSON object or list | `{"seq": 12, "A": 801.2}` |
| sentence in the manner of NMEA 0183, checksum or not | `$PZT,801.2,799.5,803.3*5D` |

Blank lines and lines that begin with # hold no values. A number is what `isocharge.common.number_text` reads.
"""

import json
import re
from collections.abc import Callable
from enum import StrEnum
from functools import reduce
from operator import xor
from typing import Any, NamedTuple

from isocharge.common.number_text import number_of
from isocharge.serve.frames.frame import SEQ, TIMES_US, Frame

TELEPLOT_TIME = "t_ms"
"""Name of the clock in Teleplot's lines."""

DEEPEST_LEVEL = 3
"""Levels of a JSON object in which numbers are looked for."""

_CELL = re.compile(r"\s*[,;\t]\s*|\s+")

_PAIR = re.compile(r"\s*([^\s:=,;]+)\s*[:=]\s*([^\s:=,;]+)\s*(?:[,;]\s*|\s|$)")

_NAME = re.compile(r"[^\W\d][\w.\[\]/-]*")


class Notation(StrEnum):
    """How a line is written."""

    csv = "CSV"
    header = "CSV header"
    pairs = "name:value"
    teleplot = "Teleplot"
    json = "JSON"
    sentence = "sentences"
    nothing = "nothing"


class Line(NamedTuple):
    """The content of a line.

    Attributes:
        notation: How it is written.
        names: Names of the values, or of the columns in a header; empty for CSV.
        values: Numbers; empty for a header.
    """

    notation: Notation
    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()


NOTHING = Line(Notation.nothing)


def parse_line(data: bytes) -> Line:
    """Read a line without its end.

    Raises:
        ValueError: If it is written in no known notation.
    """
    text = data.decode("utf-8").strip()
    if not text or text[0] == "#":
        return NOTHING
    if text[0] in "{[":
        return _json(text)
    if text[0] == ">":
        return _teleplot(text)
    if text[0] == "$":
        return _sentence(text)
    return _pairs(text) if ":" in text or "=" in text else _csv(text)


def _csv(text: str) -> Line:
    cells = _CELL.split(text.rstrip(",; \t"))
    try:
        return Line(Notation.csv, (), tuple(map(number_of, cells)))
    except ValueError:
        if all(map(_NAME.fullmatch, cells)) and len(set(cells)) == len(cells):
            return Line(Notation.header, tuple(cells))
        raise


def _sentence(text: str) -> Line:
    """The numbers after the first word, which says what they are; `*` and the xor of all bytes may end a sentence."""
    content, star, check = text[1:].partition("*")
    if star and (len(check) != 2 or int(check, 16) != reduce(xor, content.encode(), 0)):
        raise ValueError(f"expected the checksum of the sentence, got {text[-100:]!r}")
    _, *cells = _CELL.split(content.rstrip(",; \t"))
    if not cells:
        raise ValueError(f"expected numbers after the first word, got {text[:100]!r}")
    return Line(Notation.sentence, (), tuple(map(number_of, cells)))


def _pairs(text: str) -> Line:
    pairs, at = {}, 0
    while at < len(text):
        match = _PAIR.match(text, at)
        if match is None or match[1] in pairs:
            raise ValueError(f"expected name:value, got {text[at:]!r}")
        pairs[match[1]] = number_of(match[2])
        at = match.end()
    return Line(Notation.pairs, tuple(pairs), tuple(pairs.values()))


def _teleplot(text: str) -> Line:
    """The latest value of a line; texts and points of x-y plots are no readings."""
    content, _, flags = text[1:].partition("|")
    name, _, values = content.partition(":")
    if not name.strip() or not values:
        raise ValueError(f"expected >name:value, got {text!r}")
    if "t" in flags or "xy" in flags:
        return NOTHING
    *stamp, value = values.rstrip("; ").rpartition(";")[2].partition("§")[0].split(":")
    if len(stamp) > 1:
        raise ValueError(f"expected >name:time:value, got {text!r}")
    pairs = {TELEPLOT_TIME: number_of(stamp[0])} if stamp else {}
    pairs[name.strip()] = number_of(value)
    return Line(Notation.teleplot, tuple(pairs), tuple(pairs.values()))


def _json(text: str) -> Line:
    try:
        content = json.loads(text, parse_int=float)  # hundreds of digits become infinite, as those of other notations
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if isinstance(content, list) and content and all(isinstance(number, float) for number in content):
        return Line(Notation.csv, (), tuple(content))
    numbers = dict(_numbers("", content))
    if not numbers:
        raise ValueError(f"expected numbers, got {text!r}")
    return Line(Notation.json, tuple(numbers), tuple(numbers.values()))


def _numbers(name: str, content: Any, level: int = 0) -> list[tuple[str, float]]:
    """Every number of a JSON value by the path to it, `charge.A` or `charge.0.re`, at most three levels deep."""
    if isinstance(content, float):  # as integers were read, too
        return [(name, content)]
    if level >= DEEPEST_LEVEL or not isinstance(content, dict | list):
        return []
    items = content.items() if isinstance(content, dict) else enumerate(content)
    paths = ((f"{name}.{key}" if level else str(key), value) for key, value in items)
    return [pair for path, value in paths for pair in _numbers(path, value, level + 1)]


def _teleplot_lines(frame: Frame) -> str:
    stamp = "" if frame.t_us is None else f"{frame.t_us / 1e3:.3f}:"
    return "\n".join(f">{name}:{stamp}{value}" for name, value in _fields(frame) if name not in TIMES_US)


def _fields(frame: Frame) -> list[tuple[str, str]]:
    """Number, clock and channels with their names, as text; channels without names are A, B, C, ..."""
    names = frame.names or tuple(chr(ord("A") + k) for k in range(len(frame.values)))
    values = [(name, f"{value:.7g}") for name, value in zip(names, frame.values, strict=True)]
    head = [(SEQ, frame.seq), ("t_us", frame.t_us)]
    return [(name, str(number)) for name, number in head if number is not None] + values


TEXT_FORMATS: dict[str, Callable[[Frame], str]] = {
    "csv": lambda frame: ",".join(f"{value:.7g}" for value in frame.values),
    "pairs": lambda frame: ",".join(f"{name}:{value}" for name, value in _fields(frame)),
    "teleplot": _teleplot_lines,
    "json": lambda frame: "{" + ", ".join(f"{json.dumps(name)}: {value}" for name, value in _fields(frame)) + "}",
}
"""Notations by name, with their writers. CSV has only the channels and no header, as the simplest boards send it."""


def encode_text(frame: Frame, notation: str) -> bytes:
    """A frame as a line of text, or as several for Teleplot, line ends included; numbers to seven digits."""
    return (TEXT_FORMATS[notation](frame) + "\n").encode()
