"""Numbers in the lines of text that boards send.

A line consists of numbers and a skeleton. The skeleton is the text between the numbers. Lines with the same skeleton
are frames with the same layout. Boards write numbers and names in various notations, for example:

| line | names | numbers |
|---|---|---|
| `801.2, -799.5, 803.3` | | 801.2, -799.5, 803.3 |
| `A:801.2 pC, B:-799.5 pC` | A, B | 801.2, -799.5 |
| `3,1;-2,0` | | 3.1, -2.0 |
| `12:34:56.5 -> (0x1F, 0x2E)` | t_s | 45296.5, 31, 46 |
| `{"charge": {"A": 801.2, "B": 3}}` | A, B | 801.2, 3 |

A word directly before a number is the name of the number. If different words and numbers alternate, as in `C,7,A,3` and
`7 C, 3 A`, the words are names, too. Digits inside a word, as in `ch3`, are not a number. The index of a channel, such
as the 3 in `ch 3: 801`, is a name. All lines with one skeleton contain the same names, the same units of charge and
voltage, and the same words before a colon or an equals sign. All other words may change from line to line. Quotes
around a number have no meaning.

The module `text_parts` divides a line into parts. Regular expressions find the names and the units in the shape of the
line, which contains one symbol for each part.
"""

import math
import re
from collections.abc import Container, Mapping
from itertools import takewhile
from types import MappingProxyType
from typing import NamedTuple

from isocharge.serve.frames.frame import SEQ, TIMES_US
from isocharge.serve.frames.text_parts import (
    CHARGE_UNITS,
    FRACTION,
    IGNORED_AT_END,
    NUMBER,
    NUMBER_WITH_COMMA,
    PATTERNS,
    TIME,
    ZONE,
    Part,
    parts_of,
    shape_of,
)

_NAMES_OF_TIMES = {"time": "t_s", "uptime": "t_ms"}
"""Name of a time of day, in seconds since midnight, and name of the time in a log prefix such as `I (1234)`."""

_WORD_BEFORE = r"(?P<word>[kquw])\W*(?P<number>[0t])"
"""Regular expression that finds the last word before a number in the shape of a line."""

_WORD_BEHIND = r"(?P<number>[0t])\W*(?P<word>[kquw])"
"""Regular expression that finds the first word behind a number in the shape of a line."""

_SAME_COLUMN = r"(?:q|[^\w,;|\[(])*"
"""Regular expression of parts in the shape of a line that neither separate columns nor begin a list."""

_NEAREST_NAME = rf"(?P<word>[kuw]){_SAME_COLUMN}(?P<number>[0t])"
"""Regular expression that finds the last word before a number, in the same column, in the shape of a line."""

_SECOND_NAME = rf"(?P<word>[kuw]){_SAME_COLUMN}[(\[]?[kuw]{_SAME_COLUMN}(?P<number>[0t])"
"""Regular expression that finds the last word but one before a number, in the same column, in the shape of a line."""

_UNIT_BEHIND = r"(?P<number>[0t])(?:[\])}]*,?k)?[\]\[(){}:=]*(?P<word>[quw])"
"""Regular expression that finds a word behind a number in the shape of a line. This word may be the unit.

A key may stand between the number and the unit, as in `"value": 3.5, "unit": "nC"`, and the unit may be in brackets.
"""

_UNIT_BEFORE = r"[kquw,]\W*(?P<word>[kquw])(?:\W*k)?\W*(?P<number>[0t])"
"""Regular expression that finds a word between a name and a number in the shape of a line. This word may be the unit.

A comma may take the place of the name, as in `"A": {"raw": 512, "nC": 3.5}`, and a key may stand between the unit and
the number, as in `"unit": "nC", "value": 3.5`.
"""

_SEPARATING_COMMA = (
    r"[0-9]\.[0-9]|[0-9],[0-9]+,[0-9]"  # a number with a decimal point or two commas
    r"|[0-9],[-+.]|[0-9]\s*,\s+[-+.0-9]|[0-9]\s+,"  # before a sign or beside a blank
    r"|,[0-9]+\s*[:=]|,0[xX]"  # before a name or a hexadecimal number
    r"|[^\W\d][0-9]+,"  # behind the digits of a name, as in `ch1,7;ch2,3`
)
"""Regular expression of a text that shows that the commas of a line are separators."""

_DECIMAL_COMMA = rf"(?P<time>{TIME}{FRACTION}?,?)|(?<=[0-9]),(?=[0-9])"
"""Regular expression of a comma between digits.

The expression also matches a whole time, because a comma in a time is not a decimal comma.
"""


class Line(NamedTuple):
    """Places and names of the numbers in a line of text, and the skeleton of the line.

    Attributes:
        text: The line.
        skeleton: Regular expressions of the parts of the line and of the blanks between the parts. If a part is the
            same in all lines of a layout, its regular expression matches only this part.
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

    @property
    def pattern(self) -> re.Pattern[str]:
        """Regular expression that matches every line with the same skeleton. Each number is a group."""
        return re.compile("".join(self.skeleton) + r"[\s,;]*+")


def parse_line(text: str, *, has_header: bool = False, meanings: Mapping[str, str] = MappingProxyType({})) -> Line:
    """Divide a line of text into its numbers and its skeleton, which is the text between the numbers.

    A line in which a minus or a comma may have two meanings (see `text_parts.UNCLEAR`) is returned without numbers,
    because `parts_of` then returns no parts.

    Args:
        text: The line, as `clean_text` returns it.
        has_header: Whether a header names the numbers. Words that alternate with the numbers are then not names.
        meanings: For each name that the board uses for a counter or a clock: the name in isocharge, such as `t_ms`. The
            names of counters and clocks are accepted even if no other number of the line has a name.

    Raises:
        ValueError: If the line contains characters that are not printable.
    """
    if not text.replace("\t", " ").isprintable():
        raise ValueError(f"expected printable characters, got {text[:100]!r}")
    number_pattern = NUMBER  # regular expression of each decimal number in the skeleton
    text_with_points = text
    if _has_decimal_commas(text):
        number_pattern = NUMBER_WITH_COMMA
        # Replace each decimal comma by a point. The expression also matches a time, such as `12:30:05,5`, which remains
        # unchanged. All positions in the text remain the same.
        text_with_points = re.sub(_DECIMAL_COMMA, lambda match: match["time"] or ".", text)
    parts = parts_of(text_with_points)
    counters = {SEQ, *TIMES_US, *meanings}
    names = _alternating_names(parts, has_header=has_header) or _preceding_names(parts, counters)
    names_with_units = _with_units(names, _units(parts, names), counters)
    return Line(
        text=text,
        skeleton=_skeleton(parts, names, number_pattern),
        names=tuple(meanings.get(name, name) for name in names_with_units),
        starts=tuple(part.start for part in parts if part.is_number),
        is_prose=_is_prose(parts),
        words=tuple(part.name for part in parts if part.symbol in "kquw"),  # key, quoted text, unit, word
    )


def _has_decimal_commas(text: str) -> bool:
    """Return whether the commas between digits are decimal commas, as in `3,1;-2,0` and `A: 3,1 pC, B: -2,0 pC`.

    The commas are separators instead of decimal commas if one of these statements applies to the line:

    - A number has a decimal point or two commas, or a comma stands in one of these places: before a sign, before a
      name, beside a blank, or behind a name that ends with a digit. `_SEPARATING_COMMA` describes these cases.
    - The line contains only two numbers, with only a comma between them, as in `4,3`. In `A:4,3`, however, the comma is
      a decimal comma, because a name belongs to one number.
    - The line has brackets, as in `(4,3) (5,2)`. Even in a line with brackets, several commas are decimal commas if
      each number with a comma follows a colon or an equals sign.
    """
    values_text = re.sub(f"{TIME}{FRACTION}?(?:{ZONE})?", "", text)  # the line without its times
    number_count = len(re.findall("[0-9]+(?:,[0-9]+)?", values_text))  # `4,3` counts as one number
    comma_count = len(re.findall("[0-9],[0-9]", values_text))
    named_comma_count = len(re.findall(r"[:=]\s*[-+]?[0-9]+,[0-9]", values_text))  # with a name, as in `A:4,3`
    if comma_count == 0 or re.search(_SEPARATING_COMMA, values_text):
        return False
    if number_count == 1:  # for example `4,3`, which stands for two numbers if it has no name
        return named_comma_count == 1
    are_all_named = comma_count > 1 and named_comma_count == comma_count
    return are_all_named or re.search(r"[\[({]", values_text) is None  # None if the line has no brackets


def _skeleton(parts: list[Part], names: list[str], number_pattern: str) -> tuple[str, ...]:
    """Return the skeleton of a line, which consists of regular expressions that match all lines of the same layout.

    There is one regular expression for each part of the line, and one for the blanks before some parts. The expression
    of a number is a group. The kind of a part is, for example, number, hexadecimal, key (a name before a colon or an
    equals sign), word, or mark (another character, such as a comma).

    Args:
        parts: Parts of the line.
        names: Names of the numbers.
        number_pattern: Regular expression of a decimal number.
    """
    fixed_words = {*names, *CHARGE_UNITS}  # must be the same in all lines of a layout; other words may change
    skeleton = []
    previous_kind = ""
    for part in parts:
        if "mark" in (previous_kind, part.kind):
            skeleton.append(r"\s*+")  # the number of blanks beside a mark may change, and there may be none
        elif part.is_after_blank:
            skeleton.append(r"\s++")
        # A word that directly follows a number, as in `3.5mV`, is the unit of the number.
        is_unit = previous_kind in ("number", "hexadecimal") and not part.is_after_blank
        if part.is_number:
            pattern = number_pattern if part.kind == "number" else PATTERNS[part.kind]
            skeleton.append(f"({pattern})")
        elif part.kind in ("key", "mark") or part.name in fixed_words or is_unit:
            skeleton.append(re.escape(part.content))  # matches only this text
        else:
            skeleton.append(PATTERNS[part.kind])  # matches any text of the same kind
        previous_kind = part.kind
    return tuple(skeleton)


def _is_prose(parts: list[Part]) -> bool:
    """Return whether a line resembles a message of a board instead of a frame.

    A message has at least as many words as numbers, as in `Channel 3 is ready`. Units of charge, words that follow a
    comma or another mark, and the key of a single number are not counted. A line with a hexadecimal number may be a
    message, too. For example, boards print the address and the size of each part of their program when they start.
    """
    shape = shape_of(parts)
    number_count = len(re.findall("[0t]", shape))
    words = re.findall(r"(?<!\W)[kw]" if number_count > 1 else r"(?<!\W)w", shape)
    return len(words) >= number_count or any(part.kind == "hexadecimal" for part in parts)


def _words(parts: list[Part], pattern: str) -> list[str]:
    """Return the word that belongs to each number, or the name of each time; empty for a number without a word.

    Args:
        parts: Parts of the line.
        pattern: Regular expression for the shape of the line. Its group `word` matches a word, and its group `number`
            matches the number to which the word belongs.
    """
    words = {match.start("number"): parts[match.start("word")].name for match in re.finditer(pattern, shape_of(parts))}
    return [
        _NAMES_OF_TIMES.get(part.kind) or words.get(position, "")
        for position, part in enumerate(parts)
        if part.is_number
    ]


def _without_repeated(names: list[str]) -> list[str]:
    """Replace every name that occurs several times by an empty name, except the names of clocks."""
    return [name if name in TIMES_US or names.count(name) == 1 else "" for name in names]


def _alternating_names(parts: list[Part], *, has_header: bool) -> list[str]:
    """Return the names of the numbers if names and numbers alternate in the line; otherwise, return an empty list.

    The names are the words next to the numbers. They stand either before all numbers, as in `C,7,A,3` and `C[7] A[3]`,
    or behind all numbers, as in `7 C, 3 A`. If two of the words are equal, no word is a name, because words that repeat
    are units or states. All other words that alternate with the numbers are taken for names, whatever they mean.

    If a header names the numbers, the words are not names but the contents of other columns. The exception is a line
    with a single word and a single number, as in `A,3.5`: even below a header, the word is the name of the number.

    Args:
        parts: Parts of the line.
        has_header: Whether a header names the numbers.
    """
    # The shape has one symbol for each part: t for a time, u for a unit, w for another word, and 0 for a number. Marks
    # stand for themselves. A time may stand before a single pair, and a unit behind it, as in `12:30:05;A,3.5pC`.
    shape = shape_of(parts)
    is_single_pair = re.fullmatch("[t ,;]*[uw][,;|]0[uw]?", shape) is not None
    if is_single_pair or (shape.count("0") > 1 and not has_header):
        for pattern in (_WORD_BEFORE, _WORD_BEHIND):
            names = _words(parts, pattern)  # the word of each number; empty for a number without a word
            # `_without_repeated` replaces repeated names by empty texts. Every number needs a name of its own, and no
            # name may be a unit.
            if all(_without_repeated(names)) and CHARGE_UNITS.isdisjoint(names):
                return names
    return []


def _preceding_names(parts: list[Part], counters: Container[str]) -> list[str]:
    """Return the name of each number, or an empty text for a number without a name.

    The name of a number is the nearest word or key before the number, as in `A: 3.5`, `A -> 3.5` and `<A>3.5</A>`. The
    name must stand behind the previous number and behind the previous separator. If several numbers have the same
    nearest word, as in `{"A": {"pC": 3.5}, "B": {"pC": 4.1}}`, the word before this word is the name. A name that still
    occurs several times is removed. Words are not taken for names in these cases, either:

    - If no word stands before the first number, but one stands behind the last number, the words are units.
    - If only one of several numbers would have a name, as in `Data: 3.5, 4.1`, the word is taken for a label of the
      whole line, unless it is a key behind the first number. A key stands before a colon or an equals sign. Counters
      and clocks keep their names.

    Args:
        parts: Parts of the line.
        counters: Names of counters and clocks.
    """
    # `_words` returns a word for each number, or an empty text. `_without_repeated` replaces repeated words by empty
    # texts.
    nearest_names = _without_repeated(_words(parts, _NEAREST_NAME))
    second_names = _without_repeated(_words(parts, _SECOND_NAME))
    names = [nearest or second for nearest, second in zip(nearest_names, second_names, strict=True)]
    plain_words = {part.name for part in parts if part.kind == "word"}  # without the keys
    # Indices of all numbers except clocks, whose names are `TIMES_US`
    value_indices = [index for index, name in enumerate(names) if name not in TIMES_US]

    # If a word stands behind the last number, but none before the first, each word is a unit.
    # In the shape of a line, u is a unit and w is another word. Only marks may follow the last word.
    ends_with_word = re.search(r"[uw]\W*$", shape_of(parts)) is not None
    if value_indices and not names[value_indices[0]] and ends_with_word:
        names = ["" if name in plain_words else name for name in names]

    # If only one of several numbers has a name, the name may be a label of the whole line.
    named_indices = [index for index in value_indices if names[index]]
    if len(value_indices) > 1 and len(named_indices) == 1:
        (index,) = named_indices
        may_be_label = index == value_indices[0] or names[index] in plain_words
        if may_be_label and names[index] not in counters:
            names[index] = ""
    return names


def _units(parts: list[Part], names: list[str]) -> list[str]:
    """Return the unit of charge or voltage of each number; empty for a number without such a unit.

    The unit stands behind the number, as in `A=3.5 nC`, or between the name and the number, as in `A (nC): 3.5`. A unit
    before the first name, as in `nC: A=3.5 B=4.1`, is the unit of all numbers that have no unit of their own.

    Args:
        parts: Parts of the line.
        names: Name of each number; empty for a number without a name.
    """
    # For each number: the word behind it, and the word between its name and it; empty if there is no such word
    words_behind = _words(parts, _UNIT_BEHIND)
    words_between = _words(parts, _UNIT_BEFORE)

    # The word `C` behind a number may be the name of an electrode, as in `7 C, 3 A`, and one `C` may be the unit of a
    # temperature (degrees Celsius). If the word occurs more often, it is the unit of the charges (coulomb).
    is_coulomb = words_behind.count("C") > names.count("C") + 1  # a name and a temperature do not suffice
    units = {*CHARGE_UNITS, "C"} if is_coulomb else CHARGE_UNITS

    # Find the unit before the first name. The shape has one symbol for each part, and 0 for a number, so its length up
    # to the first 0 is the number of parts before the first number. A unit may stand in brackets, as in `[nC]`.
    shape_before_numbers, _, _ = shape_of(parts).partition("0")
    texts_before_numbers = [part.name.strip("[]") for part in parts[: len(shape_before_numbers)]]
    texts_before_names = takewhile(lambda text: text not in names, texts_before_numbers)
    common_unit = next((text for text in texts_before_names if text in units), "")

    # Take the word behind each number if it is a unit, else the word before it, else the common unit.
    return [
        next((word for word in (behind.strip("[]"), between.strip("[]")) if word in units), common_unit)
        for behind, between in zip(words_behind, words_between, strict=True)
    ]


def _with_units(names: list[str], units: list[str], counters: Container[str]) -> list[str]:
    """Return the names, and add the unit of charge or voltage of each number, as in `A_nC` for `A = 3.5 nC`.

    A name may be followed by a number without a unit and then by a number with a unit. If this is the case for several
    names, each of these names is first moved to its second number. For example, the names of
    `A: 512 (3.5 nC), B: 498 (4.1 nC)` become "", `A_nC`, "" and `B_nC`. The unit pC is not added, and no unit is added
    to counters and clocks. A unit that is itself one of the names is not added either.

    Args:
        names: Name of each number; empty for a number without a name.
        units: Unit of each number; empty for a number without a unit.
        counters: Names of counters and clocks.
    """
    # Find the numbers without a unit that stand before a number with a unit and without a name.
    movable_indices = [
        index
        for index, name in enumerate(names[:-1])
        if name not in counters and not units[index] and units[index + 1] and not names[index + 1]
    ]
    moved_names = names.copy()
    if len(movable_indices) > 1:
        for index in movable_indices:
            moved_names[index] = ""
            moved_names[index + 1] = names[index]

    names_with_units = []
    for number, (name, unit) in enumerate(zip(moved_names, units, strict=True), 1):
        ending = "coulomb" if unit == "C" else unit  # `A_C` would be an electrode with the name C
        is_unit_added = unit not in ("", "pC") and ending not in names and name not in counters
        # A number without a name is called by its number in the line, such as `ch2_nC`.
        names_with_units.append(f"{name or f'ch{number}'}_{ending}" if is_unit_added else name)
    return names_with_units


def line_values(pattern: re.Pattern[str], text: str) -> tuple[float, ...] | None:
    """Return the numbers in a line; None if the line has another skeleton, which is the text between the numbers.

    Args:
        pattern: The `pattern` of a `Line` that has the expected skeleton.
        text: The line.
    """
    match = pattern.fullmatch(text)
    if match is None:
        return None
    try:
        return tuple(map(float, match.groups()))
    except ValueError:  # a number is a time of day, is hexadecimal, has a decimal comma, or is `ovf`
        return tuple(map(_value, match.groups()))  # `_value` reads these notations, too


def _value(number: str) -> float:
    """Return the value of a number, or the seconds from midnight to a time of day. The value of `ovf` is NaN."""
    if ":" in number:  # a time of day, with or without a date and a time zone, as in `12:34:56.789,012`
        ((hours, minutes, seconds, fraction),) = re.findall("([0-9]+):([0-9]+):([0-9]+)[.,]?([0-9,]*)", number)
        # In the fraction, a comma separates groups of three digits.
        return 3600.0 * int(hours) + 60.0 * int(minutes) + float(f"{seconds}.{fraction.replace(',', '')}")
    if "x" in number.lower():  # a hexadecimal number
        return float(int(number, 16))
    if number[-3:].lower() == "ovf":
        return math.nan
    return float(number.replace(",", "."))


def _separator(text: Container[str]) -> str | None:
    """Return the mark that separates the columns of a text or a skeleton; None if only blanks separate them.

    In a skeleton, a bar is escaped.
    """
    return next((mark for mark in "\t;,|" if mark in text or re.escape(mark) in text), None)


def header_names(header: str, line: Line) -> tuple[str, ...]:
    """Return the names that a header states for the numbers without names in a line.

    The names begin with letters, and differ from each other. If the text states no such name for one of the numbers, it
    is no header of the line, and the result is empty.

    A header may have one name for each number without a name, or one name for each column of the line. In the second
    case, the columns that contain texts or numbers with names are ignored. The mark of a comment and a label before the
    names are always ignored.

    Args:
        header: A line without numbers.
        line: The line.
    """
    # Positions in the line at which the numbers without names begin
    unnamed_starts = [start for start, name in zip(line.starts, line.names, strict=True) if not name]
    header = header.lstrip("#%/ ").rstrip(IGNORED_AT_END)
    separator = _separator(header)  # None for blanks
    line_separator = "\t" if "\t" in line.text else _separator(line.skeleton)
    # Words with blanks between them, above a line with separators, are a message, such as `the tare is done`.
    if separator is None and line_separator is not None:
        return ()
    columns = header.split(separator)
    if len(columns) != len(unnamed_starts):
        # The header has one name for each column of the line. Select the columns that contain the numbers. If a number
        # is in the n-th column, the text of the line up to the first character of the number has n columns.
        column_numbers = [len(line.text[: start + 1].split(line_separator)) for start in unnamed_starts]
        # If the header has fewer columns than the line, some numbers get no name, so that the header is refused below.
        columns = [columns[number - 1] for number in column_numbers if number <= len(columns)]
    # A label with a colon may stand before a name, as in `Data: A, B, C`.
    names = tuple(column.rpartition(":")[2].strip(" \"'") for column in columns)
    are_names = all(re.match(r"[^\W\d]", name) for name in names)
    are_different = len(set(names)) == len(unnamed_starts)  # false, too, if there are fewer names than numbers
    return names if are_names and are_different else ()
