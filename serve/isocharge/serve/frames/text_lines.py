"""Numbers in the lines of text that boards send.

A line consists of numbers and of its skeleton, which is the text between the numbers. Lines with the same skeleton are
frames of one layout, in whatever notation the board writes them:

| line | names | numbers |
|---|---|---|
| `801.2, -799.5, 803.3` | | 801.2, -799.5, 803.3 |
| `A:801.2 pC, B:-799.5 pC` | A, B | 801.2, -799.5 |
| `3,1;-2,0` | | 3.1, -2.0 |
| `12:34:56.5 -> (0x1F, 0x2E)` | t_s | 45296.5, 31, 46 |
| `{"charge": {"A": 801.2, "B": 3}}` | A, B | 801.2, 3 |

A word directly before a number is the name of the number. If different words and numbers alternate, as in `C,7,A,3` and
`7 C, 3 A`, the words are names, too. Digits in a word, as in `ch3`, are not a number, and an index such as that in
`ch 3: 801` is a name. Words that are neither names nor followed by a colon or an equals sign may change from line to
line, except units of charge and voltage. Quotes around a number have no meaning.
"""

import math
import re
from collections.abc import Collection, Container
from itertools import pairwise, takewhile
from typing import NamedTuple

from isocharge.serve.frames.frame import OTHER_CHARGE_UNITS, SEQ, TIMES_US

_INDEX = r"\[\w*\](?!\s*[,;]?\s*(?:$|[^\W\d]))"  # not the value in `C[7] A[3]`, which stands before a name or the end

_WORD = rf"(?>\w+(?:[./-]\w+)*(?:{_INDEX})*)"

_QUOTED = r'"(?:[^"\\]|\\.)*"' + r"|(?<!\w)'[^']*'(?!\w)"

_DATE = r"[0-9]{1,4}[-/.][0-9]{1,2}[-/.][0-9]{1,4}[T ,;]+"

_SECONDS = r"[0-9]{2}(?:\.[0-9]+(?:,[0-9]{3}(?=\]))?|,[0-9]{3}(?=\s)|,[0-9]+(?=;))?"
"""Regular expression of the seconds of a time, such as 56, 56.789, 56.789,012], 56,789 before a blank, or 56,7;."""

_ZONE = r"(?:Z|[-+][0-9]{2}:?[0-9]{2}(?![\w.]))?"

_TIME = rf"(?:{_DATE})?([0-9]{{1,2}}:[0-9]{{2}}:{_SECONDS}){_ZONE}"


def _number_pattern(decimal_marks: str) -> str:
    """Return the regular expression of a decimal number, which also matches `nan`, `inf` and the `ovf` of Arduino."""
    digits = rf"[0-9]+(?:[{decimal_marks}][0-9]*)?|[{decimal_marks}][0-9]+"
    return rf"((?>[-+]?(?:(?:{digits})(?:[eE][-+]?[0-9]+)?|(?<!<)(?i:nan|inf(?:inity)?|ovf)(?!\w))))"


_PATTERNS = {
    "time": _TIME,
    "whole seconds": rf"(?:{_DATE})?[0-9:]{{7,8}}{_ZONE}",
    "uptime": "([0-9]+)",
    "hexadecimal": "([-+]?0[xX][0-9A-Fa-f]{1,16})",
    "number": _number_pattern("."),
    "number with a decimal comma": _number_pattern(".,"),
    "quoted": f"(?:{_QUOTED})",
    "word": _WORD,
    "blanks": r"\s++",
    "optional blanks": r"\s*+",
}
"""Regular expressions of the parts of a line that may change from line to line. Numbers are in groups."""

_IGNORED_AT_END = ",; \t"
"""Marks without a meaning at the end of a line."""

_UNCLEAR_SIGN = r"(?:^|[\s;])[-+]?[0-9.]+(?:(?:\s*[fnpuµμm]?[CV])?\s+-\s+[.0-9]|-(?:[\s,;]|$))"
"""Regular expression of a minus after a number, as in `3.5 - 2.5` and `3.5-`, which may be a sign or a separator."""

_SEPARATING_COMMA = (
    r"[0-9]\.[0-9]|[0-9],[0-9]+,[0-9]"  # a number with a decimal point or two commas
    r"|[0-9],[-+.]|[0-9]\s*,\s+[-+.0-9]|[0-9]\s+,"  # before a sign or beside a blank
    r"|,[0-9]+\s*[:=]|,0[xX]"  # before a name or a hexadecimal number
)
"""Regular expression of a text that shows that the commas of a line are separators."""

_NUMBER_KINDS = ("time", "uptime", "hexadecimal", "number")

_NAMES_OF_TIMES = {"time": "t_s", "uptime": "t_ms"}
"""Names of a time of day, in seconds since midnight, and of the time in a log prefix such as `I (1234)`."""

_CHARGE_UNITS = {unit for unit in OTHER_CHARGE_UNITS if unit != "C"}  # C may be the name of an electrode

_ALL_CHARGE_UNITS = {"pC", *_CHARGE_UNITS}


def _token_pattern(number: str) -> re.Pattern[str]:
    """Return the regular expression of a part of a line.

    Args:
        number: Regular expression of a decimal number.
    """
    key = r"""(?:[0-9]+(?=[^\W\d_]))?(?![0-9()\[\]+.*$|&/-]|#[0-9])(?>(?:[^\s:=,;{}"'<>()]|\([^\s()]*\))+)"""
    return re.compile(
        rf"(?P<time>(?<![\w.:]){_TIME}(?![\w:]))"
        r"|(?P<uptime>(?<=\b[EWIDV]\s\()[0-9]+(?=\)))"
        rf"|(?P<key>(?<=^\$)\w+|(?:{key}|{_QUOTED})(?=\s*[:=]))"
        rf"|(?P<quoted>{_QUOTED})"
        r"|(?P<hexadecimal>(?<![\w.])[-+]?0[xX][0-9A-Fa-f]{1,16}(?!\w))"
        rf"|(?P<number>(?<!\w)(?<!\w\.){number}(?!\.[0-9])(?=[^\W\d_]*(?!\w)))"
        rf"|(?P<word>{_WORD})"
        r"|(?P<mark>\.{2,}|\S)"
    )


_TOKENS = {kind: _token_pattern(_PATTERNS[kind]) for kind in ("number", "number with a decimal comma")}
"""Regular expressions of a part of a line, by the kind of the numbers in the line."""

_SEPARATORS = ",;|[("
"""Marks that separate columns or begin a list. A word before such a mark does not name the number after the mark."""

_SHAPES = {"number": "0", "hexadecimal": "0", "word": "w", "key": "k", "quoted": "k"} | dict.fromkeys(
    ("time", "whole seconds", "uptime"), ""
)
"""Character that stands for a part of a line in its shape, by the kind of the part. A mark stands for itself."""


class _Token(NamedTuple):
    """Part of a line: a number, a name, a key before a colon or an equals sign, a text in quotes, a word, or a mark."""

    kind: str
    content: str
    start: int
    is_after_blank: bool

    @property
    def name(self) -> str:
        """Content without quotes."""
        return self.content.strip("\"'")

    @property
    def is_number(self) -> bool:
        """Whether the part is a number or a time."""
        return self.kind in _NUMBER_KINDS


_EDGE = _Token("", "", 0, False)
"""Token that stands for the beginning and the end of a line."""


class Line(NamedTuple):
    """Places and names of the numbers in a line of text, and the skeleton of the line.

    Attributes:
        text: The line.
        skeleton: Regular expressions of the parts and of the blanks between them. A part that is the same in each line
            of a layout has a regular expression that matches only this part.
        names: Name of each number; empty for a number without a name.
        starts: Position in the line at which each number begins.
        is_prose: Whether the line resembles a message; see `_is_prose`.
        words: The keys, words and texts in quotes.
    """

    text: str
    skeleton: tuple[str, ...]
    names: tuple[str, ...]
    starts: tuple[int, ...]
    is_prose: bool
    words: tuple[str, ...]


def parse_line(text: str, *, has_header: bool = False, counters: Collection[str] = (SEQ,)) -> Line:
    """Take the numbers out of a line of text.

    A line with an unclear minus is returned without numbers.

    Args:
        text: The line, as `clean_text` returns it.
        has_header: Whether a header names the numbers, so that words that alternate with the numbers are not names.
        counters: Names of counters and clocks. They are names even if no other number of the line has one.

    Raises:
        ValueError: If the line contains characters that are not printable.
    """
    if not text.replace("\t", " ").isprintable():
        raise ValueError(f"expected printable characters, got {text[:100]!r}")
    number_kind = "number with a decimal comma" if _has_decimal_commas(text) else "number"
    tokens = [] if re.search(_UNCLEAR_SIGN, text) else _tokens(text.rstrip(_IGNORED_AT_END), number_kind)
    gaps = _gaps(tokens)
    times = [_NAMES_OF_TIMES.get(token.kind, "") for token in tokens if token.is_number]
    # A single word and a single number, as in `A,3.5`, are a name and its value even below a header with two columns.
    is_pair = re.fullmatch("[,;]?w[,;|]0w?", _shape(tokens)) is not None
    may_alternate = is_pair or (times.count("") > 1 and not has_header)
    names = _alternating_names(times, gaps) if may_alternate else []
    if not names:
        names = _preceding_names(times, gaps, counters)
    starts = tuple(token.start for token in tokens if token.is_number)
    words = tuple(token.name for gap in gaps for token in gap if token.kind != "mark")
    skeleton = _skeleton(tokens, names, number_kind)
    return Line(text, skeleton, tuple(_with_units(names, gaps)), starts, _is_prose(tokens), words)


def _skeleton(tokens: list[_Token], names: list[str], number_kind: str) -> tuple[str, ...]:
    """Return the skeleton of a line; see `Line`.

    Args:
        tokens: Parts of the line.
        names: Names of the numbers.
        number_kind: Kind of the numbers in the line, a key of `_TOKENS`.
    """
    fixed_words = {*names, *_ALL_CHARGE_UNITS}  # a line with another unit has another layout
    patterns = []
    for previous, token in pairwise([_EDGE, *tokens]):
        if "mark" in (previous.kind, token.kind):
            patterns.append(_PATTERNS["optional blanks"])
        elif token.is_after_blank:
            patterns.append(_PATTERNS["blanks"])
        if token.kind in ("key", "mark") or (token.name in fixed_words and not token.is_number):
            patterns.append(re.escape(token.content))
        else:
            patterns.append(_PATTERNS[number_kind if token.kind == "number" else token.kind])
    return tuple(patterns)


def _is_prose(tokens: list[_Token]) -> bool:
    """Return whether a line resembles a message of a board instead of a frame.

    A message has at least as many words as numbers, as in `Channel 3 is ready`. Units of charge, words that follow a
    comma or another mark, and the key of a single number are not counted. A line with a hexadecimal number may be a
    message, too. For example, boards print the address and the size of each part of their program when they start.

    Args:
        tokens: Parts of the line.
    """
    number_kinds = [token.kind for token in tokens if token.is_number]
    word_kinds = ("word", "key") if len(number_kinds) > 1 else ("word",)
    word_count = sum(
        token.kind in word_kinds and previous.kind != "mark" and token.content not in _ALL_CHARGE_UNITS
        for previous, token in pairwise([_EDGE, *tokens])
    )
    return "hexadecimal" in number_kinds or word_count >= len(number_kinds)


def _has_decimal_commas(text: str) -> bool:
    """Return whether the commas between digits are decimal commas, as in `3,1;-2,0` and `A: 3,1 pC, B: -2,0 pC`.

    Commas are separators in a line to which one of these statements applies:

    - A number has a decimal point or two commas.
    - A comma stands before a sign, beside a blank or before a name.
    - Nothing else separates two numbers. In `A:4,3`, it is a decimal comma, because a name belongs to one number.
    - The line has brackets, and not every number has a name with a colon or an equals sign before it.
    """
    text = re.sub(_TIME, "", text)
    numbers = re.findall("[0-9]+(?:,[0-9]+)?", text)
    comma_count = sum("," in number for number in numbers)
    are_named = 1 < comma_count == len(re.findall(r"[:=]\s*[-+]?[0-9]+,", text))
    has_one_name = re.fullmatch(r"[^:=]+[:=]\s*[-+]?[0-9]+,[0-9]+\D*", text) is not None
    return (
        comma_count > 0
        and (len(numbers) > 1 or has_one_name)
        and (are_named or re.search(r"[\[({]", text) is None)
        and re.search(_SEPARATING_COMMA, text) is None
    )


def _tokens(text: str, number_kind: str) -> list[_Token]:
    """Divide a line into its parts.

    Args:
        text: The line.
        number_kind: Kind of the numbers in the line, a key of `_TOKENS`.
    """
    tokens = []
    for match in _TOKENS[number_kind].finditer(text):
        kind = str(match.lastgroup)
        content = match[2] or match[0]  # the second group is a time without its date
        if kind == "time" and content[-3] == ":":  # such a time is too coarse for a clock
            kind = "whole seconds"
        start = match.start()
        tokens.append(_Token(kind, content.strip(), start, text[start - 1 : start].isspace()))

    for position in _index_positions(tokens):
        tokens[position] = tokens[position]._replace(kind="key")
    return tokens


def _index_positions(tokens: list[_Token]) -> list[int]:
    """Return the positions of the numbers that are not values but indices of channels. An index is the name of a value.

    If a line ends with pairs of numbers, the first number of each pair is an index in these cases:

    - A colon or an equals sign follows the number, as in `1:801,2:799` and `ch 1 = 801 pC`. There are several pairs, or
      no other numbers.
    - There are several pairs. Their first numbers count up from 0 or 1, and the same word or mark precedes each,
      as in `pad #1 801 pad #2 799` and `[1] 801 [2] 799`.

    Args:
        tokens: Parts of the line.
    """
    shape = _shape(tokens)
    numbers = [position for position, token in enumerate(tokens) if _SHAPES.get(token.kind) == "0"]

    def first_numbers(pair: str) -> list[int]:  # the pattern of a shape, in which 0 is a number and w is a word
        """Find the pairs of the given shape at the end of the line, and return the position of each first number."""
        pairs = re.search(rf"(?:[^0]*{pair})+[^0]*$", shape)
        return [] if pairs is None else numbers[-pairs[0].count("0") :: 2]

    # The first number, a colon or an equals sign, and the second number
    indices = first_numbers(r"0[)\]]?[:=]0")
    if len(indices) > 1 or 2 * len(indices) == len(numbers):
        return indices

    # A word or a mark, the first number, and the second number
    indices = first_numbers(r"[w#(\[=]0[)\]>(\[]?0")
    contents = [tokens[position].content for position in indices]
    counts = list(map(str, range(len(indices) + 1)))
    are_counts = len(indices) > 1 and contents in (counts[:-1], counts[1:])
    previous_contents = {tokens[position - 1].content for position in indices}
    return indices if are_counts and len(previous_contents) == 1 else []


def _shape(tokens: list[_Token]) -> str:
    """Return one character for each part of a line, as in `k=0,k=0`: 0 for a number, w for a word, k for a key."""
    return "".join(_SHAPES.get(token.kind, token.content) for token in tokens)


def _gaps(tokens: list[_Token]) -> list[list[_Token]]:
    """Divide a line at its numbers, and return the parts before the first number and after each number.

    Args:
        tokens: Parts of the line.

    Returns:
        One list for each number, and a further list with the parts after the last number.
    """
    gaps: list[list[_Token]] = [[]]
    for token in tokens:
        if token.is_number:
            gaps.append([])
        else:
            gaps[-1].append(token)
    return gaps


def _alternating_names(times: list[str], gaps: list[list[_Token]]) -> list[str]:
    """Return the names of the numbers in a line in which names and numbers alternate; empty for another line.

    The name of a number is the word that is next to the number, either before each number, as in `C,7,A,3` and
    `C[7] A[3]`, or behind each number, as in `7 C, 3 A`. If two of the words are equal, no word is a name, because
    words that repeat are units or states. Words of another meaning that alternate with the numbers are taken for names,
    too.

    Args:
        times: Name of each number that is a time; empty for the other numbers.
        gaps: Parts between the numbers.
    """
    words = [[token.name for token in gap if token.kind != "mark"] for gap in gaps]
    words_before = [gap[-1] if gap else "" for gap in words[:-1]]
    words_behind = [gap[0] if gap else "" for gap in words[1:]]
    for next_words in (words_before, words_behind):
        names = [time or word for time, word in zip(times, next_words, strict=True)]
        if all(_unique(names)) and _CHARGE_UNITS.isdisjoint(names):  # each number has a name of its own
            return names
    return []


def _preceding_names(times: list[str], gaps: list[list[_Token]], counters: Collection[str]) -> list[str]:
    """Return the names of the numbers. A number without a name has an empty text.

    The name of a number is the nearest word or key before the number, as in `A: 3.5`, `A -> 3.5` and `<A>3.5</A>`. The
    name must stand behind the previous number and behind the previous separator. If several numbers have the same
    nearest word, as in `{"A": {"pC": 3.5}, "B": {"pC": 4.1}}`, the word before it is the name. A name that still occurs
    several times is removed. In these cases, words are not names, either:

    - If no word stands before the first number, but one stands behind the last number, the words are units.
    - If only one of several numbers would have a name, as in `Data: 3.5, 4.1`, the word is taken for a label of the
      whole line. A word is a label if it is no key, or if it stands before the first number. Counters and clocks keep
      their names.

    Args:
        times: Name of each number that is a time; empty for the other numbers.
        gaps: Parts between the numbers.
        counters: Names of counters and clocks.
    """
    # Choose the nearest name before each number or, if several numbers have the same nearest name, the second nearest.
    nearest_names = []
    second_names = []
    for time, gap in zip(times, gaps[:-1], strict=True):
        parts = takewhile(lambda token: token.content not in _SEPARATORS, reversed(gap))
        candidates = [token.name for token in parts if token.kind in ("word", "key")]
        nearest_name, second_name, *_ = *candidates, "", ""
        nearest_names.append(time or nearest_name)
        second_names.append(second_name)
    names = [nearest or second for nearest, second in zip(_unique(nearest_names), _unique(second_names), strict=True)]

    # Remove words that are units.
    words = {token.name for gap in gaps for token in gap if token.kind == "word"}
    kinds_behind = [token.kind for token in gaps[-1] if token.kind != "mark"]
    channels = [index for index, name in enumerate(names) if name not in TIMES_US]
    if channels and not names[channels[0]] and kinds_behind[-1:] == ["word"]:
        names = ["" if name in words else name for name in names]

    # Remove the only name if it is the label of the whole line.
    named = [index for index in channels if names[index]]
    if len(channels) > 1 and len(named) == 1:
        (index,) = named
        may_be_label = index == channels[0] or names[index] in words
        if may_be_label and names[index] not in counters:
            names[index] = ""
    return names


def _with_units(names: list[str], gaps: list[list[_Token]]) -> list[str]:
    """Add the unit of charge or voltage of each number to its name, as in `A_nC` for `A = 3.5 nC`.

    The unit stands directly behind the number, or between the name and the number. The unit pC is not added.

    Args:
        names: Name of each number; empty for a number without a name.
        gaps: Parts between the numbers.
    """
    following_words = [next((token.content for token in gap if token.content not in ":="), "") for gap in gaps[1:]]
    # The word `C` may be the name of an electrode, but a word behind several numbers is not a name.
    known_units = OTHER_CHARGE_UNITS if following_words.count("C") > 1 else _CHARGE_UNITS
    names_with_units = []
    for number, (name, following_word, gap) in enumerate(zip(names, following_words, gaps, strict=False), 1):
        # The first word after the previous number is a name, or the unit of the previous number.
        later_words = [token.name.strip("[]") for token in gap if token.kind != "mark"][1:]
        unit = next((word for word in (following_word, *later_words) if word in known_units), "")
        ending = "coulomb" if unit == "C" else unit  # `A_C` would be an electrode with the name C
        is_added = unit and ending not in names
        names_with_units.append(f"{name or f'ch{number}'}_{ending}" if is_added else name)
    return names_with_units


def _unique(names: list[str]) -> list[str]:
    """Replace every name that occurs several times by an empty name, except the names of clocks."""
    return [name if name in TIMES_US or names.count(name) == 1 else "" for name in names]


def skeleton_pattern(line: Line) -> re.Pattern[str]:
    """Return the regular expression of all lines with the skeleton of a line. Each number is a group."""
    return re.compile("".join(line.skeleton) + r"[\s,;]*+")


def line_values(pattern: re.Pattern[str], text: str) -> tuple[float, ...] | None:
    """Return the numbers in a line; None if the line has another skeleton.

    Args:
        pattern: Result of `skeleton_pattern`.
        text: The line.
    """
    match = pattern.fullmatch(text)
    if match is None:
        return None
    try:
        return tuple(map(float, match.groups()))
    except ValueError:  # a number is a time of day, is hexadecimal, has a decimal comma, or is `ovf`
        return tuple(map(_value, match.groups()))


def _value(number: str) -> float:
    """Return the value of a number, or the seconds from midnight to a time of day. The value of `ovf` is NaN."""
    if ":" in number:  # a time of day
        hours, minutes, seconds = number.split(":")
        whole_seconds, *fractions = re.split("[.,]", seconds)
        return 3600.0 * int(hours) + 60.0 * int(minutes) + float(f"{whole_seconds}.{''.join(fractions)}")
    if "x" in number.lower():  # a hexadecimal number
        return float(int(number, 16))
    if number[-3:].lower() == "ovf":
        return math.nan
    return float(number.replace(",", "."))


def _separator(text: Container[str]) -> str | None:
    """Return the mark that separates the columns of a text or a skeleton; None if only blanks separate them."""
    return next((mark for mark in "\t;," if mark in text), None)


def header_names(header: str, line: Line) -> tuple[str, ...]:
    """Return the names that a header states for the numbers without names in a line.

    The result is empty if the text is no header of the line. A column of the header is a name, which begins with a
    letter. The mark of a comment, a label before the first column, and columns of the line that contain a text are
    ignored. If the numbers of the line are separated by commas, for example, then words that are only separated by
    blanks, such as `the tare is done`, are not a header but a message.

    Args:
        header: A line without numbers.
        line: The line.
    """
    starts = [start for start, name in zip(line.starts, line.names, strict=True) if not name]
    header = header.lstrip("#%/ ").rstrip(_IGNORED_AT_END)
    separator = _separator(header)  # None: blanks
    line_separator = "\t" if "\t" in line.text else _separator(line.skeleton)
    if separator is None and line_separator is not None:
        return ()
    columns = header.split(separator)
    if len(columns) != len(starts):  # select the columns of the numbers without names
        indices = [len(line.text[: start + 1].split(line_separator)) - 1 for start in starts]
        columns = [columns[index] for index in indices if index < len(columns)]
    # A label with a colon may stand before a name, as in `Data: A, B, C`.
    names = tuple(column.rpartition(":")[2].strip(" \"'") for column in columns)
    are_names = all(re.match(r"[^\W\d]", name) for name in names)
    are_different = len(names) == len(set(names)) == len(starts)
    return names if are_names and are_different else ()
