"""Parts of a line of text: numbers, names, keys, quoted texts, words and marks.

The shape of a line is a text with one symbol for each part of the line. For example, the shape of
`A: 801.2 pC, B: -799.5 pC` is `k:0u,k:0u`.
"""

import re
from typing import NamedTuple

from isocharge.serve.frames.frame import OTHER_CHARGE_UNITS

_QUOTED = r'"(?:[^"\\]|\\.)*"' + r"|(?<!\w)'[^']*'(?!\w)"
"""Regular expression of a text in quotes."""

_KEY = r"""(?:[0-9]+(?=[^\W\d_]))?(?![0-9()\[\]+.*$|&/-]|#[0-9])(?>(?:[^\s:=,;|&{}"'<>()]|\([^\s()]*\))+)"""
"""Regular expression of a key without quotes, which is a name before a colon or an equals sign."""

_INDEX = r"\[\w*\](?!\s*[,;]?\s*(?:$|[^\W\d]))"  # not the value in `C[7] A[3]`, which stands before a name or the end

TIME = (
    r"(?:[0-9]{1,4}[-/.][0-9]{1,2}[-/.][0-9]{1,4}[T ,;]+)?"  # a date
    r"[0-9]{1,2}:[0-9]{2}:[0-9]{2}"
)
"""Regular expression of a time in whole seconds, with or without a date."""

FRACTION = r"(?:\.[0-9]+(?:[.,][0-9]{3}(?=\]))?|,[0-9]{3}(?=\s)|,[0-9]+(?=;))"
"""Regular expression of a fraction of a second, as in `56.789`, `56.789,012]`, `56,7;`, or `56,789` before a blank."""

ZONE = r"(?:Z|[-+][0-9]{2}:?[0-9]{2}(?![\w.]))?(?![\w:])"
"""Regular expression of the time zone after a time. The time zone may be missing."""

NUMBER = r"(?>[-+]?(?:(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|(?<!<)(?i:nan|inf(?:inity)?|ovf)(?!\w)))"
"""Regular expression of a decimal number, which also matches `nan`, `inf` and the `ovf` of Arduino."""

NUMBER_WITH_COMMA = NUMBER.replace(r"\.[0-9]*", r"(?:\.[0-9]*|,[0-9]+)")
"""Regular expression of a decimal number that may have a decimal comma instead of a decimal point."""

PATTERNS = {
    "coarse_time": rf"(?<![\w.:]){TIME}(?!{FRACTION}{ZONE}){ZONE}",  # whole seconds, too coarse for a clock
    "time": rf"(?<![\w.:]){TIME}{FRACTION}?{ZONE}",  # some programs omit a fraction that is zero
    "uptime": r"(?<=\b[EWIDV]\s\()[0-9]+(?=\))",
    "key": rf"(?<=^\$)\w+|(?:{_KEY}|{_QUOTED})(?=\s*[:=])",
    "quoted": f"(?:{_QUOTED})",
    "hexadecimal": r"(?<![\w.])[-+]?0[xX][0-9A-Fa-f]{1,16}(?!\w)",
    "number": rf"(?<!\w)(?<!\w\.){NUMBER}(?!\.[0-9])(?=[^\W\d_]*(?!\w))",
    "word": rf"(?>\w+(?:[./-]\w+)*(?:{_INDEX})*)",
    "mark": r"\.{2,}|\S",
}
"""Regular expression of each kind of part of a line, in the order in which the kinds are tried."""

_PART = re.compile("|".join(f"(?P<{kind}>{pattern})" for kind, pattern in PATTERNS.items()))
"""Regular expression of a part of a line. The name of the group that matches is the kind of the part."""

SYMBOLS = {
    "time": "t",
    "coarse_time": " ",
    "uptime": "t",
    "key": "k",
    "quoted": "q",
    "hexadecimal": "0",
    "number": "0",
    "word": "w",
}
"""For each kind of part: the symbol that stands for the part in the shape of a line, such as `k=0,k=0`.

A mark stands for itself. A word or a key that is a unit of charge or voltage has the symbol u.
"""

IGNORED_AT_END = ",; \t"
"""Marks without a meaning at the end of a line."""

UNCLEAR = (
    r"(?:^|[\s;])[-+]?[0-9.]+(?:(?:\s*[fnpuµμm]?[CV])?\s+-\s+[.0-9]|-(?:[\s,;]|$))"
    r"|(?:[:=>]\s*[-+]?[0-9]+,[0-9]++(?!\s*[:=]|,[-+.0-9]).*){2}"
)
"""Regular expression of a text in which a minus or a comma may have two meanings, so that its numbers are not clear.

A minus after a number, as in `3.5 - 2.5` and `3.5-`, may be a sign or a separator. Commas behind several names, as in
`A=18,537 B=18,402 T=23.5`, may be decimal commas, separators of thousands, or separators of columns.
"""

CHARGE_UNITS = {*OTHER_CHARGE_UNITS, "pC"} - {"C"}
"""Units of charge and voltage, except C, which may be the name of an electrode."""


class Part(NamedTuple):
    """Part of a line: a number, a name, a key before a colon or an equals sign, a text in quotes, a word, or a mark.

    Attributes:
        kind: Kind of the part, a key of `PATTERNS`.
        symbol: Character that stands for the part in the shape of a line; see `SYMBOLS`.
        content: Text of the part.
        start: Position in the line at which the part begins.
        is_after_blank: Whether a blank stands before the part.
    """

    kind: str
    symbol: str
    content: str
    start: int
    is_after_blank: bool

    @property
    def name(self) -> str:
        """Content without quotes."""
        return self.content.strip("\"'")

    @property
    def is_number(self) -> bool:
        """Whether the part is a number or a time that is fine enough for a clock."""
        return self.symbol in "0t"


def parts_of(text: str) -> list[Part]:
    """Return the parts of a line; empty if a minus or a comma in the line may have two meanings.

    If a number is the index of a channel, it becomes a key, because the index is the name of the next number.

    Args:
        text: The line, with decimal points instead of decimal commas.
    """
    if re.search(UNCLEAR, text):
        return []
    parts = []
    for match in _PART.finditer(text.rstrip(IGNORED_AT_END)):
        kind = str(match.lastgroup)  # name of the group that matches
        content = match[0]
        symbol = SYMBOLS.get(kind, content[0])  # a mark is not in `SYMBOLS`, because it stands for itself
        if kind in ("word", "key") and content.strip("[]") in CHARGE_UNITS:
            symbol = "u"  # a unit
        start = match.start()
        is_after_blank = text[start - 1 : start].isspace()  # false for the first part, which has no text before it
        parts.append(Part(kind, symbol, content, start, is_after_blank))
    for position in _index_positions(parts):
        parts[position] = parts[position]._replace(kind="key", symbol="k")  # an index is the name of the next number
    return parts


def shape_of(parts: list[Part]) -> str:
    """Return the symbols of the parts of a line; see `SYMBOLS`."""
    return "".join(part.symbol for part in parts)


def _index_positions(parts: list[Part]) -> list[int]:
    """Return the positions of the numbers that are not values but indices of channels.

    In `ch 1 = 801 pC`, the number 801 is a value, and the number 1 is the index of its channel. The last numbers of a
    line are pairs of an index and a value in these cases:

    - A colon or an equals sign stands between the two numbers of each pair, as in `1:801,2:799` and `ch 1 = 801 pC`.
      There are several pairs, or the line has no other numbers.
    - There are several pairs. Their first numbers count up from 0 or 1, and the same word or mark stands before each
      first number, as in `pad #1 801 pad #2 799` and `[1] 801 [2] 799`.

    Args:
        parts: Parts of the line. A position is an index in this list.
    """
    # The shape of a line has one symbol for each part: 0 for a number, w for a word and u for a unit. Marks stand for
    # themselves. A position in the shape is therefore the position of a part.
    shape = shape_of(parts)
    number_positions = [position for position, symbol in enumerate(shape) if symbol == "0"]

    def first_numbers(pair: str) -> list[int]:
        """Return the position of the first number of each pair at the end of the line; empty if there is no pair.

        The pairs contain the last numbers of the line. A word or a mark may follow the last pair. `shape` contains a 0
        for each number of the line, and `number_positions` contains the position of each of these zeros.

        Args:
            pair: Regular expression of the shape of a pair, in which each number is a 0.
        """
        # Parts that are not numbers, [^0]*, may stand before each pair and behind the last pair.
        pairs = re.search(f"(?:[^0]*{pair})+[^0]*$", shape)
        if pairs is None:
            return []
        paired_count = pairs[0].count("0")  # the pairs consist of this many numbers, which are the last of the line
        return number_positions[-paired_count::2]  # every second one is the first number of a pair

    # Find pairs such as `1:801` and `1)=801`, in which a closing bracket may follow the first number. In a line without
    # numbers, both counts are 0, and the empty list is returned.
    positions = first_numbers(r"0[)\]]?[:=]0")
    has_only_pairs = len(number_positions) == 2 * len(positions)
    if len(positions) > 1 or has_only_pairs:
        return positions

    # Find pairs such as `pad 1 801` and `[1] 801`, in which a word or a mark stands before the first number.
    positions = first_numbers(r"[uw#(\[=]0[)\]>(\[]?0")
    first_contents = [parts[position].content for position in positions]
    numerals = [str(number) for number in range(len(positions) + 1)]
    counts_up = first_contents in (numerals[:-1], numerals[1:])  # "0", "1", ... or "1", "2", ...
    labels = {parts[position - 1].content for position in positions}  # the words or marks before the first numbers
    return positions if len(positions) > 1 and counts_up and len(labels) == 1 else []
