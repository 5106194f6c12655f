"""Advice for headers whose columns are named almost as expected: in another case, another language, or another unit."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from isocharge.common.errors import shown

OTHER_UNITS = {
    "mm": ("m", "cm", "um", "µm", "μm", "in"),
    "N": ("mN", "kN", "g", "kg", "gf", "kgf", "lbf"),
    "pC": ("fC", "nC", "µC", "μC", "uC", "C", "V", "mV"),
}
"""Units of the same quantity that are not accepted, by the unit that is."""

GENERAL_WORDS = frozenset(
    {"position", "pos", "coordinate", "koordinate", "in"}
    | {"charge", "ladung", "carga", "carica", "q"}
    | {"electrode", "elektrode", "channel", "kanal", "canal", "ch"}
)
"""Words of a header that do not change which column is meant."""

MAX_COLUMN_CHARACTERS = 100
"""Largest number of characters of a column for which advice is given; a longer one is no name of a quantity."""

_LABEL_AND_UNIT = re.compile(r"(.*?)(?:\s*[\[(]\s*([^\[\]()]+?)\s*[\])]|[\s_/]+([^\s_/\[\]()]+))")


@dataclass(frozen=True)
class ColumnMeaning:
    """How a column may be called by other programs.

    Attributes:
        noun: What the column is, for messages: "column" or "electrode".
        unit: Unit of its numbers; empty if it has none.
        words: Words of which one is in a header that means this column, in lower case.
        is_known_by_unit: Whether a header with this unit in brackets means this column, whatever its words are.
    """

    noun: str = "column"
    unit: str = ""
    words: frozenset[str] = frozenset()
    is_known_by_unit: bool = False


def header_advice(columns: Iterable[str], absent: Mapping[str, ColumnMeaning]) -> Iterator[str]:
    """Yield what to do with each column that probably stands for an absent one.

    Args:
        columns: Columns of the file that have no other meaning.
        absent: Meanings of the columns that the file does not have, by name.
    """
    remaining = dict(absent)
    for column in columns:
        if len(column) > MAX_COLUMN_CHARACTERS:
            continue
        for name, meaning in remaining.items():
            advice = _advice(column, name, meaning)
            if advice:
                yield advice
                del remaining[name]
                break


def _advice(column: str, name: str, meaning: ColumnMeaning) -> str:
    """Return what to do with a column that stands for the column `name`; an empty text if it probably does not."""
    if column.casefold() == name.casefold():
        return (
            f"column {shown(column)} differs from {meaning.noun} {shown(name)} only by case: rename it to {shown(name)}"
        )
    rename = f"rename {shown(column)} to {shown(name)}"
    if meaning.noun == "electrode":
        meaning = replace(meaning, words=_words(name))

    words = _words(column)
    if _is_named(words, meaning) and words <= meaning.words | GENERAL_WORDS:
        return rename
    match = _LABEL_AND_UNIT.fullmatch(column)
    if match is None:
        return ""
    label, bracketed_unit, last_word = match.groups()
    unit = bracketed_unit or last_word
    is_named = _is_named(_words(label), meaning)
    if unit == meaning.unit and (is_named or (meaning.is_known_by_unit and bracketed_unit)):
        return rename
    if unit in OTHER_UNITS.get(meaning.unit, ()) and is_named:
        return f"column {shown(column)} is in {unit}: convert it to {meaning.unit} and rename it to {shown(name)}"
    return ""


def _is_named(words: frozenset[str], meaning: ColumnMeaning) -> bool:
    """Return whether the words of a header name a quantity, or all words of an electrode's name."""
    if meaning.noun == "electrode":
        return bool(meaning.words) and meaning.words <= words
    return bool(meaning.words & words)


def _words(text: str) -> frozenset[str]:
    return frozenset(word for word in re.split(r"[\W_]+", text.casefold()) if word)
