"""Numbers in the lines of text that boards send.

Text is numbers with something between them. The numbers are taken out of a line, and the rest of the line is its
skeleton. Lines with the same skeleton are frames of one layout, in whatever notation the board writes them:

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
from collections.abc import Collection
from itertools import dropwhile, pairwise
from typing import NamedTuple

from isocharge.serve.frames.frame import OTHER_CHARGE_UNITS, SEQ, TIMES_US

_INDEX = r"\[\w*\](?!\s*[,;]?\s*(?:$|[^\W\d]))"  # not the value in `C[7] A[3]`, which stands before a name or the end

_WORD = rf"(?>\w+(?:[./-]\w+)*(?:{_INDEX})*)"

_QUOTED = r'"(?:[^"\\]|\\.)*"' + r"|(?<!\w)'[^']*'(?!\w)"

_DATE = r"[0-9]{1,4}[-/.][0-9]{1,2}[-/.][0-9]{1,4}[T ,;]+"

_SECONDS = r"[0-9]{2}(?:\.[0-9]+(?:,[0-9]{3}(?=\]))?|,[0-9]{3}(?=\s))?"  # 56, 56.789, 56.789,012] or 56,789

_TIME = rf"(?:{_DATE})?([0-9]{{1,2}}:[0-9]{{2}}:{_SECONDS})(?:Z|[-+][0-9]{{2}}:?[0-9]{{2}}(?![\w.]))?"


def _number_pattern(decimal_marks: str) -> str:
    """Return the regular expression of a decimal number, which also matches `nan`, `inf` and the `ovf` of Arduino."""
    digits = rf"[0-9]+(?:[{decimal_marks}][0-9]*)?|[{decimal_marks}][0-9]+"
    return rf"((?>[-+]?(?:(?:{digits})(?:[eE][-+]?[0-9]+)?|(?<!<)(?i:nan|inf(?:inity)?|ovf)(?!\w))))"


_PATTERNS = {
    "time": _TIME,
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

_CODES = {kind: chr(code) for code, kind in enumerate(_PATTERNS)}
"""Control characters that stand for these parts in a skeleton. A line with control characters is not parsed."""

_END = r"[\s,;]*+"
"""Regular expression of marks without a meaning at the end of a line."""

_UNCLEAR_SIGN = r"(?:^|[\s;])[-+]?[0-9.]+(?:(?:\s*[fnpuµμm]?[CV])?\s+-\s+[.0-9]|-(?:[\s,;]|$))"
"""Regular expression of a minus after a number, as in `3.5 - 2.5` and `3.5-`, which may be a sign or a separator."""

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

_SHAPES = {"number": "0", "hexadecimal": "0", "time": "", "uptime": "", "word": "w", "key": "k", "quoted": "k"}
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


_EDGE = _Token("", "", 0, False)
"""Token that stands for the beginning and the end of a line."""


class Line(NamedTuple):
    """Places and names of the numbers in a line of text, and the skeleton of the line.

    Attributes:
        text: The line.
        skeleton: The parts of the line that are the same in each line of a layout, with one control character for each
            number, each other part that may change, and optional blanks.
        names: Name of each number; empty for a number without a name.
        starts: Position in the line at which each number begins.
        is_prose: Whether the line resembles a message; see `_is_prose`.
        words: The keys, words and texts in quotes.
    """

    text: str
    skeleton: str
    names: tuple[str, ...]
    starts: tuple[int, ...]
    is_prose: bool
    words: tuple[str, ...]


def parse_line(text: str, *, has_header: bool = False, counters: Collection[str] = (SEQ,)) -> Line:
    """Take the numbers out of a line of text.

    A line with an unclear minus is returned without numbers.

    Args:
        text: The line, as `clean_text` returns it.
        has_header: Whether a header names the numbers, so that words between the numbers are not names.
        counters: Names of counters and clocks. They are names even if no other number of the line has one.

    Raises:
        ValueError: If the line contains characters that are not printable.
    """
    if not text.replace("\t", " ").isprintable():
        raise ValueError(f"expected printable characters, got {text[:100]!r}")
    number_kind = "number with a decimal comma" if _has_decimal_commas(text) else "number"
    tokens = [] if re.search(_UNCLEAR_SIGN, text) else _tokens(text.rstrip(",; \t"), number_kind)
    tokens = _with_alternating_names(tokens, has_header=has_header)
    names = _names(tokens, counters)
    starts = tuple(token.start for token in tokens if token.kind in _NUMBER_KINDS)
    words = tuple(token.name for token in tokens if token.kind not in ("mark", *_NUMBER_KINDS))
    skeleton = _skeleton(tokens, names, number_kind)
    return Line(text, skeleton, tuple(_with_units(names, tokens)), starts, _is_prose(tokens), words)


def _skeleton(tokens: list[_Token], names: list[str], number_kind: str) -> str:
    """Return the skeleton of a line; see `Line`.

    Args:
        tokens: Parts of the line.
        names: Names of the numbers.
        number_kind: Kind of the numbers in the line, a key of `_TOKENS`.
    """
    fixed_words = {*names, *_ALL_CHARGE_UNITS}  # a line with another unit has another layout
    skeleton = ""
    for previous, token in pairwise([_EDGE, *tokens]):
        if "mark" in (previous.kind, token.kind):
            skeleton += _CODES["optional blanks"]
        elif token.is_after_blank:
            skeleton += _CODES["blanks"]
        if token.kind in ("key", "name", "mark") or (token.kind == "word" and token.content in fixed_words):
            skeleton += token.content
        else:
            skeleton += _CODES[number_kind if token.kind == "number" else token.kind]
    return skeleton


def _is_prose(tokens: list[_Token]) -> bool:
    """Return whether a line resembles a message of a board instead of a frame.

    A message has at least as many words as numbers, as in `Channel 3 is ready`. Keys, units of charge, and words after
    a comma or another mark are not counted as words. A line with a decimal number after a hexadecimal number is a
    message, too. For example, boards print the address of a part of their program and then its size.

    Args:
        tokens: Parts of the line.
    """
    number_kinds = [token.kind for token in tokens if token.kind in _NUMBER_KINDS]
    words = [
        token
        for previous, token in pairwise([_EDGE, *tokens])
        if token.kind in ("word", "name") and previous.kind != "mark" and token.content not in _ALL_CHARGE_UNITS
    ]
    has_address_and_size = "number" in dropwhile(lambda kind: kind != "hexadecimal", number_kinds)
    return has_address_and_size or len(words) >= len(number_kinds)


def _has_decimal_commas(text: str) -> bool:
    """Return whether the commas between digits are decimal commas, as in `3,1;-2,0` and `A: 3,1 pC, B: -2,0 pC`.

    They are separators if a number has a decimal point or two commas, if a comma stands before a sign, beside a blank
    or before a name, if nothing else separates two numbers, or if the line has brackets and a colon or an equals sign
    does not stand before each number. In `A:4,3`, the comma is a decimal comma, because a name belongs to one number.
    """
    runs = re.findall(r"[0-9]+(?:[.,][0-9]+)*", re.sub(_TIME, "", text))
    are_decimal = all("." not in run and run.count(",") <= 1 for run in runs)
    named_runs = re.findall(r"[:=]\s*[-+]?[0-9]+,", text)
    are_named = 1 < sum("," in run for run in runs) == len(named_runs)
    has_one_name = re.fullmatch(r"[^:=]+[:=]\s*[-+]?[0-9]+,[0-9]+\D*", text) is not None
    return (
        are_decimal
        and (len(runs) > 1 or has_one_name)
        and any("," in run for run in runs)
        and (are_named or re.search(r"[\[({]", text) is None)
        and re.search(r"[0-9],[-+.]|,[0-9]+\s*[:=]|,0[xX]|[0-9]\s*,\s+[-+.0-9]|[0-9]\s+,", text) is None
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
        content = match[2] if kind == "time" else match[0]  # the second group is a time without its date
        is_after_blank = text[match.start() - 1 : match.start()].isspace()
        tokens.append(_Token(kind, content.strip(), match.start(), is_after_blank))

    for position in _index_positions(tokens):
        tokens[position] = tokens[position]._replace(kind="key")
    return tokens


def _index_positions(tokens: list[_Token]) -> list[int]:
    """Return the positions of the numbers that are indices of channels, and therefore names.

    If a line ends with pairs such as `1:801,2:799` or `ch 1 = 801 pC`, the first number of each pair is an index. In
    pairs such as `pad #1 801 pad #2 799`, the indices count from 0 or 1, and follow the same word or mark.

    Args:
        tokens: Parts of the line.
    """
    shape = _shape(tokens)
    numbers = [position for position, token in enumerate(tokens) if _SHAPES.get(token.kind) == "0"]
    before_colons = re.search(r"(?:[^0]*+0[)\]]?[:=]0)+[^0]*+$", shape)
    if before_colons is not None and (before_colons.start() == 0 or before_colons[0].count("0") > 2):
        return numbers[-before_colons[0].count("0") :: 2]

    after_words = re.search(r"(?:[^0]*[w#(\[=]0[)\]>(\[]?0)+[^0]*$", shape)
    positions = numbers[-after_words[0].count("0") :: 2] if after_words is not None else []
    indices = [tokens[position].content for position in positions]
    counts = [str(count) for count in range(len(indices) + 1)]
    are_counts = len(indices) > 1 and indices in (counts[:-1], counts[1:])
    is_prefix_equal = len({tokens[position - 1].content for position in positions}) == 1
    return positions if are_counts and is_prefix_equal else []


def _shape(tokens: list[_Token]) -> str:
    """Return one character for each part of a line."""
    return "".join(_SHAPES.get(token.kind, token.content) for token in tokens)


def _names(tokens: list[_Token], counters: Collection[str]) -> list[str]:
    """Return the names of the numbers. A number without a name has an empty text.

    If `_with_alternating_names` has marked names, these are the names. Otherwise, the name of a number is the last word
    or key between this number and the previous number or separator, as in `A: 3.5`, `A -> 3.5` and `<A>3.5</A>`. These
    rules apply in this order:

    - If several numbers have the same name, the word or key before it is the name, as in `{"A": {"pC": 3.5}}`. A name
      that still occurs several times is removed.
    - If no word precedes the first number, but a word follows the last number, the words are units and no names.
    - If only one of several numbers has a name, the name is a label of the line and is removed. This applies if the
      name is a word or belongs to the first number. Names of counters and clocks are kept.

    Args:
        tokens: Parts of the line.
        counters: Names of counters and clocks.
    """
    kinds = [token.kind for token in tokens if token.kind in _NUMBER_KINDS]
    marked_names = [token.name for token in tokens if token.kind == "name"]
    if marked_names:
        next_names = iter(marked_names)
        return [_NAMES_OF_TIMES.get(kind) or next(next_names) for kind in kinds]

    # The last two words before each number, which are empty if there are fewer
    paths = [
        ["", "", *(token.name for token in path if token.kind != "quoted")] for path in _paths(tokens, _SEPARATORS)
    ]
    inner_names = [_NAMES_OF_TIMES.get(kind, path[-1]) for kind, path in zip(kinds, paths, strict=True)]
    outer_names = [path[-2] for path in paths]
    names = [name or outer_name for name, outer_name in zip(_unique(inner_names), _unique(outer_names), strict=True)]

    # Remove the units and the label of the line.
    words = {token.name for token in tokens if token.kind == "word"}
    channels = [index for index, name in enumerate(names) if name not in TIMES_US]
    contents = [token for token in tokens if token.kind != "mark"]
    if channels and not names[channels[0]] and contents[-1].kind == "word":
        names = ["" if name in words else name for name in names]
    named = [index for index in channels if names[index]]
    is_single = len(channels) > 1 and len(named) == 1 and names[named[0]] not in counters
    if is_single and (named[0] == channels[0] or names[named[0]] in words):
        names[named[0]] = ""
    return names


def _with_units(names: list[str], tokens: list[_Token]) -> list[str]:
    """Return the names of the numbers with their units of charge or voltage, as `A_nC`.

    The unit is directly behind the number, or between the name of the number and the number. The unit pC is not added.

    Args:
        names: Name of each number; empty for a number without a name.
        tokens: Parts of the line.
    """
    parts = [token for token in tokens if token.content not in ":="]
    following_words = [
        following.content for token, following in pairwise([*parts, _EDGE]) if token.kind in _NUMBER_KINDS
    ]
    # The word `C` may be the name of an electrode, but a word behind several numbers is not a name.
    known_units = OTHER_CHARGE_UNITS if following_words.count("C") > 1 else _CHARGE_UNITS
    names_with_units = []
    for number, (name, following_word, path) in enumerate(zip(names, following_words, _paths(tokens), strict=True), 1):
        # The first word after the previous number is a name, or the unit of the previous number.
        possible_units = (following_word, *(token.name.strip("[]") for token in path[1:]))
        unit = next((unit for unit in possible_units if unit in known_units), "")
        ending = "coulomb" if unit == "C" else unit  # `A_C` would be an electrode with the name C
        is_added = unit and ending not in names
        names_with_units.append(f"{name or f'ch{number}'}_{ending}" if is_added else name)
    return names_with_units


def _with_alternating_names(tokens: list[_Token], *, has_header: bool) -> list[_Token]:
    """Mark the names in a line in which names and numbers alternate, and return the parts of the line.

    The name of a number is the word that is next to the number, either before each number, as in `C,7,A,3` and
    `C[7] A[3]`, or behind each number, as in `7 C, 3 A`. All names are different, because words that repeat are units
    or states. Times have no names. Words of another meaning that alternate with the numbers are taken for names, too.

    A single word and a single number are a name and its value only if a mark separates them and nothing else follows,
    as in `A,3.5`. Then the word is a name even if the board has sent a header, such as `channel,charge_pC`.

    Args:
        tokens: Parts of the line.
        has_header: Whether a header names the numbers.
    """
    is_pair = re.fullmatch("[,;]?w[,;|]0w?", _shape(tokens)) is not None  # may begin with a time or end with a unit
    if has_header and not is_pair:
        return tokens
    fewest = 1 if is_pair else 2
    without_times = [token for token in tokens if token.kind not in _NAMES_OF_TIMES]
    for ordered_tokens in (without_times, without_times[::-1]):
        paths = _paths(ordered_tokens)
        named = [path[-1] for path in paths if path]
        names = {token.name for token in named}
        if len(names) == len(paths) >= fewest and _CHARGE_UNITS.isdisjoint(names):
            return [token._replace(kind="name") if token in named else token for token in tokens]
    return tokens


def _paths(tokens: list[_Token], separators: str = "") -> list[list[_Token]]:
    """Return the words, keys and texts between each number and the previous number or separator.

    Args:
        tokens: Parts of the line.
        separators: Marks that separate columns.
    """
    paths = []
    path: list[_Token] = []
    for token in tokens:
        if token.kind in _NUMBER_KINDS:
            paths.append(path)
        if token.kind in _NUMBER_KINDS or token.content in separators:
            path = []
        elif token.kind != "mark":
            path.append(token)
    return paths


def _unique(names: list[str]) -> list[str]:
    """Replace every name that occurs several times by an empty name, except the names of clocks."""
    return [name if name in TIMES_US or names.count(name) == 1 else "" for name in names]


def skeleton_pattern(line: Line) -> re.Pattern[str]:
    """Return the regular expression of all lines with the skeleton of a line. Each number is a group."""
    patterns = {_CODES[kind]: pattern for kind, pattern in _PATTERNS.items()}
    return re.compile("".join(patterns.get(part) or re.escape(part) for part in line.skeleton) + _END)


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
    """Return the value of a number, which is NaN for `ovf`, or the seconds since midnight of a time of day."""
    if ":" in number:
        hours, minutes, seconds = number.split(":")
        fraction = re.sub("[.,]", "", seconds[2:])  # two digits are before the fraction
        return 3600.0 * int(hours) + 60.0 * int(minutes) + float(f"{seconds[:2]}.{fraction}")
    if "x" in number.lower():
        return float(int(number, 16))
    if number[-3:].lower() == "ovf":
        return math.nan
    return float(number.replace(",", "."))


def _separator(text: str) -> str | None:
    """Return the mark that separates the columns of a text; None if only blanks separate them."""
    return next((mark for mark in "\t;," if mark in text), None)


def header_names(header: str, line: Line) -> tuple[str, ...]:
    """Return the names that a header states for the numbers without names in a line.

    The result is empty if the text is no header of the line. A column of the header is a name, which begins with a
    letter. Columns of the line that contain a text, and a label before the first column, are ignored. Words with only
    blanks between them, such as `the tare is done`, are no header of a line with another separator.

    Args:
        header: A line without numbers.
        line: The line.
    """
    starts = [start for start, name in zip(line.starts, line.names, strict=True) if not name]
    separator = _separator(header)  # None: blanks
    line_separator = "\t" if "\t" in line.text else _separator(line.skeleton)
    if separator is None and line_separator is not None:
        return ()
    columns = [column for column in header.split(separator) if column.strip()]
    if len(columns) != len(starts):  # select the columns of the numbers without names
        first_column = 0 if line_separator is None else -1  # the part before the first separator is the first column
        indices = [len(line.text[:start].split(line_separator)) + first_column for start in starts]
        columns = [columns[index] for index in indices if index < len(columns)]
    # A label with a colon may stand before a name, as in `Data: A, B, C`.
    names = tuple(column.rpartition(":")[2].strip(" \"'") for column in columns)
    are_names = all(re.match(r"[^\W\d]", name) for name in names)
    are_different = len(names) == len(set(names)) == len(starts)
    return names if are_names and are_different else ()
