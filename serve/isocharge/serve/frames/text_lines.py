"""Functions that parse the lines of text that boards send, and functions that write frames as lines of text.

A board may send its lines in any of the following notations.

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
"""Name under which the time of a Teleplot line is stored, because it has no name in Teleplot."""

MAX_JSON_LEVEL = 3
"""Largest number of nested objects and lists in JSON from which numbers are read."""

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
    """Content of a line of text.

    Attributes:
        notation: Notation of the line.
        names: Names of the values, or of the columns in a header; empty for CSV.
        values: The numbers; empty for a header.
    """

    notation: Notation
    names: tuple[str, ...] = ()
    values: tuple[float, ...] = ()


LINE_WITHOUT_VALUES = Line(Notation.nothing)
"""Content of a line without values, such as a comment."""


def parse_line(data: bytes) -> Line:
    """Recognise the notation of a line of text from its characters, and parse the line.

    Args:
        data: Bytes of the line, without the line feed at its end.

    Raises:
        ValueError: If the line has no supported notation, or is not valid in its notation.
    """
    text = data.decode("utf-8").strip()
    if not text or text[0] == "#":  # a blank line or a comment
        return LINE_WITHOUT_VALUES
    # The first character is tested before the separators, because JSON and Teleplot lines also contain colons.
    if text[0] in "{[":
        return _parse_json(text)
    if text[0] == ">":
        return _parse_teleplot(text)
    if text[0] == "$":
        return _parse_sentence(text)
    if ":" in text or "=" in text:
        return _parse_pairs(text)
    return _parse_csv(text)


def _parse_csv(text: str) -> Line:
    """Parse a line of CSV, which contains either numbers or, in a header, the names of the columns.

    The cells of the line may be separated by commas, semicolons, tabs or blanks. Separators at the end of the line are
    ignored.

    Raises:
        ValueError: If the line contains neither only numbers nor only names that all differ.
    """
    cells = _SEPARATOR.split(text.rstrip(",; \t"))
    try:
        return Line(Notation.csv, values=tuple(map(parse_number, cells)))
    except ValueError:  # a cell is not a number, but the line may be a header
        are_names = all(_NAME.fullmatch(cell) for cell in cells)
        are_different = len(set(cells)) == len(cells)
        if are_names and are_different:
            return Line(Notation.header, names=tuple(cells))
        raise


def _parse_sentence(text: str) -> Line:
    """Parse a sentence such as `$FILM,1.5,2.5*3A`, which consists of a name and numbers.

    The sentence may end with `*` and a checksum. The checksum is the exclusive or of all bytes between `$` and `*`,
    written as two hexadecimal digits.

    Raises:
        ValueError: If the checksum is wrong, or the sentence does not consist of a name and numbers.
    """
    text_after_dollar = text[1:]
    content, star, sent_checksum = text_after_dollar.partition("*")
    has_checksum = star != ""
    if has_checksum:
        computed_checksum = reduce(xor, content.encode(), 0)
        if len(sent_checksum) != 2 or int(sent_checksum, 16) != computed_checksum:
            raise ValueError(f"expected the checksum of the sentence, got {text[-100:]!r}")
    _name, *cells = _SEPARATOR.split(content.rstrip(",; \t"))
    if not cells:
        raise ValueError(f"expected numbers after the first word, got {text[:100]!r}")
    return Line(Notation.sentence, values=tuple(map(parse_number, cells)))


def _parse_pairs(text: str) -> Line:
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


def _parse_teleplot(text: str) -> Line:
    """Parse a Teleplot line of the form `>name:time:value;time:value§unit|flags`, and return its latest value.

    The time, the unit and the flags may be missing. If the line is a text (flag `t`) or contains points of an x-y plot
    (flag `xy`), the result contains no value.

    Raises:
        ValueError: If the line has another form.
    """
    content, _, flags = text[1:].partition("|")  # without the first character ">"
    name, _, values = content.partition(":")
    if not name.strip() or not values:
        raise ValueError(f"expected >name:value, got {text!r}")
    if "t" in flags or "xy" in flags:
        return LINE_WITHOUT_VALUES

    _earlier_values, _, latest_value = values.rstrip("; ").rpartition(";")
    time_and_value, _, _unit = latest_value.partition("§")
    *times, value = time_and_value.split(":")  # one time, or none
    if len(times) > 1:
        raise ValueError(f"expected >name:time:value, got {text!r}")
    pairs = {}
    if times:
        pairs[TELEPLOT_TIME] = parse_number(times[0])
    pairs[name.strip()] = parse_number(value)
    return Line(Notation.teleplot, names=tuple(pairs), values=tuple(pairs.values()))


def _parse_json(text: str) -> Line:
    """Parse a JSON text, and return all numbers in it, each with its path in the text as its name.

    A list that contains only numbers has the notation CSV in the result, because its numbers have no names.

    Raises:
        ValueError: If the text is not valid JSON, or contains no numbers.
    """
    try:
        # Integers are parsed as floats, so that integers of hundreds of digits become infinite, as in other notations.
        content = json.loads(text, parse_int=float)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if isinstance(content, list) and content and all(isinstance(item, float) for item in content):
        return Line(Notation.csv, values=tuple(content))
    numbers_by_path = dict(_json_numbers("", content))
    if not numbers_by_path:
        raise ValueError(f"expected numbers, got {text!r}")
    return Line(Notation.json, names=tuple(numbers_by_path), values=tuple(numbers_by_path.values()))


def _json_numbers(path: str, content: Any, level: int = 0) -> list[tuple[str, float]]:
    """Return all numbers in a JSON value, each with its path, such as `charge.A` or `charge.0.re`.

    Numbers that are nested in more than `MAX_JSON_LEVEL` objects and lists are ignored.

    Args:
        path: Path of the value; empty for the whole text.
        content: The value, which is a number, a list, an object or a value that contains no number.
        level: Number of objects and lists in which the value is nested.
    """
    if isinstance(content, float):  # integers were read as floats
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
    prefix = f"{path}." if level > 0 else ""  # the whole text has no path
    for key, value in items:
        numbers += _json_numbers(prefix + key, value, level + 1)
    return numbers


def _named_values(frame: Frame) -> list[tuple[str, str]]:
    """Return the name and the value of the frame counter, of the clock and of each channel as texts.

    Channels without names are called A, B, C, and so on. The values of channels have seven significant digits.
    """
    named_values = []
    if frame.seq is not None:
        named_values.append((SEQ, str(frame.seq)))
    if frame.t_us is not None:
        named_values.append(("t_us", str(frame.t_us)))
    channel_names = frame.names
    if not channel_names:
        channel_names = tuple(chr(ord("A") + channel) for channel in range(len(frame.values)))
    for name, value in zip(channel_names, frame.values, strict=True):
        named_values.append((name, f"{value:.7g}"))
    return named_values


def _write_csv(frame: Frame) -> str:
    """Return the values of the channels with commas between them. The counter and the clock are left out."""
    return ",".join(f"{value:.7g}" for value in frame.values)


def _write_pairs(frame: Frame) -> str:
    """Return a pair `name:value` for the counter, the clock and each channel, with commas between the pairs."""
    return ",".join(f"{name}:{value}" for name, value in _named_values(frame))


def _write_teleplot(frame: Frame) -> str:
    """Return a line `>name:time:value` for the counter and for each channel. The time is the clock in ms."""
    time = "" if frame.t_us is None else f"{frame.t_us / 1e3:.3f}:"
    return "\n".join(f">{name}:{time}{value}" for name, value in _named_values(frame) if name not in TIMES_US)


def _write_json(frame: Frame) -> str:
    """Return a JSON object that contains the counter, the clock and the channels."""
    fields = ", ".join(f"{json.dumps(name)}: {value}" for name, value in _named_values(frame))
    return "{" + fields + "}"


TEXT_FORMATS: dict[str, Callable[[Frame], str]] = {
    "csv": _write_csv,
    "pairs": _write_pairs,
    "teleplot": _write_teleplot,
    "json": _write_json,
}
"""Functions that write a frame, by the name of the notation. The CSV contains only the channels and has no header."""


def encode_text(frame: Frame, notation: str) -> bytes:
    """Encode a frame as a line of text, or as several lines for Teleplot.

    The values of the channels are written with seven significant digits.

    Args:
        frame: Frame to write.
        notation: A key of `TEXT_FORMATS`.
    """
    return (TEXT_FORMATS[notation](frame) + "\n").encode()
