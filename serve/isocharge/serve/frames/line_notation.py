"""Removal of meaningless marks from the lines of text that boards send, before the numbers in the lines are read.

The marks are colours, quotes around numbers, blanks behind signs, checksums, and the notation of Teleplot.
"""

import re
from functools import reduce
from operator import xor

_QUOTED_NUMBER = r"""(?<!\w)(["'])([-+]?\.?[0-9][0-9.,]*(?:[eE][-+]?[0-9]+)?(?:\s?[pnuµm]?[CV])?)\1(?!\s*[:=])"""
"""Regular expression of a number in quotes, with or without its unit."""

_COMMANDS = r"(?:\x1b\[[0-9;?]*[A-Za-z])+"
"""Regular expression of commands to a terminal, such as those that clear the screen."""

_COLOURS = rf"\x1b\[[0-9;]*m|^{_COMMANDS}|{_COMMANDS}$"
"""Regular expression of the colours that loggers use, and of commands to a terminal at the ends of a line."""

_SIGNED_NUMBERS = r"[^\w.]?(?:[-+]\.?[0-9][0-9.]*(?:[eE][-+]?[0-9]+)?){2,}[^\w.]?"
"""Regular expression of numbers with nothing but their signs between them, such as `<+003.5-003.4+005.8>`."""

_NAMED_NUMBER = r"([A-Za-z]+)([-+]?[0-9]*\.[0-9]+(?:[eE][-+]?[0-9]+(?![.0-9]))?|[-+][0-9]+)[\s,;|]*"
"""Regular expression of a number directly after its name, as in `A+3.5B-3.4`. The number has a sign or a fraction."""

_TELEPLOT = r">([^\s:>][^:]*):(?:[^|]*;)?(?:([0-9.]+):)?([^:;|]*);?(?:\|.*)?"
"""Regular expression of a line of Teleplot. The groups are the name, the latest time and the latest value."""


def clean_text(text: str) -> str:
    """Return the part of a line that may contain numbers; empty for a blank line, a comment or a text of Teleplot.

    Colours, quotes around numbers and other notations without a meaning are removed. Names in capital letters, such as
    `_COLOURS`, are regular expressions.

    Args:
        text: The line.

    Raises:
        ValueError: If the checksum of an NMEA sentence, which begins with `$`, is wrong.
    """
    if "\x1b" in text:
        text = re.sub(_COLOURS, "", text)
    if not text.isascii():
        # Some programs write blanks of fixed width, a byte order mark at the beginning of a file, or dashes as minus.
        text = re.sub("[^\\S\t]|\ufeff", " ", text)  # any blank except a tab, or the mark
        text = re.sub("[\u2010-\u2015\u2212]", "-", text)

    # Join a sign with the number behind it: `A: - 3.5` becomes `A: -3.5`. A sign behind a number is left alone, because
    # it may be a minus between two numbers.
    text = re.sub(r"(^|[:=,;(\[] *)([-+]) +(?=[.0-9])", r"\1\2", text.strip())

    # Separate numbers from each other: `+3.5-3.4` becomes `+3.5 -3.4`.
    if re.fullmatch(_SIGNED_NUMBERS, text):
        text = re.sub(r"(?<=[0-9])(?=[-+])", " ", text)

    # Separate names from numbers: `A+3.5B-3.4` becomes `A=+3.5 B=-3.4`. A line in which a name occurs twice is a header
    # (`ch-1, ch-2`), and remains unchanged.
    if re.fullmatch(f"(?:{_NAMED_NUMBER}){{2,}}", text):
        named_numbers = re.findall(_NAMED_NUMBER, text)
        if len(dict(named_numbers)) == len(named_numbers):  # all names differ
            text = " ".join(f"{name}={number}" for name, number in named_numbers)

    # Remove quotes around numbers, then the notation of Teleplot (`>`), of NMEA sentences (`$`) and of comments (`#`).
    if '"' in text or "'" in text:
        text = re.sub(_QUOTED_NUMBER, r"\2", text)
    if text[:1] == ">":
        return _teleplot_content(text)
    if text[:1] == "$" and "*" in text:
        return _sentence_content(text)
    text = re.sub(r"\*[0-9A-Fa-f]{2}$", "", text)  # a checksum that cannot be checked, because its rule is not known
    return "" if text[:1] == "#" else text


def _teleplot_content(text: str) -> str:
    """Convert a line of the program Teleplot to text with a name before each number.

    A Teleplot line contains a name and one or more values, as in `>A:1000:800.9;1010:801.2§pC|g`. The time of a value,
    in ms, may stand before the value. A unit and flags may follow the last value. The result contains only the latest
    value and its time, as in `t_ms:1010;"A":801.2§pC`.

    The result is empty if the flags state that the value is a text (t) or a point in a plane (xy). A line that is no
    Teleplot line is returned unchanged.

    Args:
        text: A line that begins with `>`.
    """
    _, bar, flags = text.rpartition("|")  # without a bar, the line has no flags
    if bar and {"t", "xy"}.intersection(flags.split(",")):
        return ""
    teleplot = re.fullmatch(_TELEPLOT, text)
    if teleplot is None:
        return text
    name, time, value_with_unit = teleplot.groups()  # the time is None if the line has no times
    named_time = f"t_ms:{time};" if time else ""
    return f'{named_time}"{name}":{value_with_unit}'


def _sentence_content(text: str) -> str:
    """Return a sentence in the style of NMEA 0183, such as `$NAME,1.5,2.5*3A`, without its checksum.

    The checksum is the exclusive or of all bytes between `$` and `*`, as two hexadecimal digits.

    Raises:
        ValueError: If the checksum is wrong.
    """
    content, _, checksum = text.partition("*")
    if len(checksum) != 2 or int(checksum, 16) != reduce(xor, content[1:].encode(), 0):
        raise ValueError(f"expected the checksum of the sentence, got {text[-100:]!r}")
    return content
