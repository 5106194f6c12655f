"""Advice for columns whose names differ from the expected names by their case, their language or their unit."""

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from isocharge.common.errors import shown

OTHER_UNITS = {
    "mm": ("m", "cm", "um", "µm", "μm", "in"),
    "N": ("mN", "kN", "g", "kg", "gf", "kgf", "lbf"),
    "pC": ("fC", "nC", "µC", "μC", "uC", "C", "V", "mV"),
}
"""Units that are not accepted, by the accepted unit of the same quantity."""

GENERAL_WORDS = frozenset(
    {"position", "pos", "coordinate", "koordinate", "in"}
    | {"charge", "ladung", "carga", "carica", "q"}
    | {"electrode", "elektrode", "channel", "kanal", "canal", "ch"}
)
"""Words that may be added to the name of a column without changing its meaning."""

MAX_COLUMN_CHARACTERS = 100
"""Largest number of characters of a column name for which advice is given. A longer text is not the name of a
quantity."""

_LABEL_AND_UNIT = re.compile(r"(.*?)(?:\s*[\[(]\s*([^\[\]()]+?)\s*[\])]|[\s_/]+([^\s_/\[\]()]+))")


@dataclass(frozen=True)
class ColumnMeaning:
    """Names that other programs use for a column.

    Attributes:
        noun: What the column is, for messages: "column" or "electrode".
        unit: Unit of its numbers; empty if it has none.
        words: Words in lower case. A column name that contains one of these words probably means this column.
        is_known_by_unit: Whether any column name with this unit in brackets means this column.
    """

    noun: str = "column"
    unit: str = ""
    words: frozenset[str] = frozenset()
    is_known_by_unit: bool = False


def header_advice(columns: Iterable[str], absent: Mapping[str, ColumnMeaning]) -> Iterator[str]:
    """Yield advice for each column that is probably one of the missing columns under another name.

    If several columns of the file resemble the same missing column, only the first of them gets the advice.

    Args:
        columns: Columns of the file that have no other meaning.
        absent: Meanings of the missing columns, by name.
    """
    remaining = dict(absent)  # missing columns that no column resembles yet
    for column in columns:
        if len(column) > MAX_COLUMN_CHARACTERS:  # not the name of a quantity
            continue
        for name, meaning in remaining.items():
            advice = _advice(column, name, meaning)
            if advice:
                yield advice
                del remaining[name]
                break


def _advice(column: str, name: str, meaning: ColumnMeaning) -> str:
    """Return advice for a column that is probably the missing column `name`, or an empty text for any other column.

    Three kinds of names are recognised. The name may differ only in its capital letters. It may consist of words that
    mean the missing column. It may also consist of such words and a unit, which is either that of the missing column or
    can be converted to it.

    Args:
        column: Name of the column in the file.
        name: Name of the missing column.
        meaning: Meaning of the missing column.
    """
    if column.casefold() == name.casefold():
        return (
            f"column {shown(column)} differs from {meaning.noun} {shown(name)} only by case: rename it to {shown(name)}"
        )
    advice_to_rename = f"rename {shown(column)} to {shown(name)}"
    if meaning.noun == "electrode":
        meaning = replace(meaning, words=_words(name))  # an electrode is recognised by its own name

    # The column consists of words only, such as "force applied".
    words = _words(column)
    other_words = words - meaning.words - GENERAL_WORDS  # general words, such as "position", do not change the meaning
    if _is_named(words, meaning) and not other_words:
        return advice_to_rename

    # The column consists of a label and a unit, such as "force (N)" or "force_N".
    match = _LABEL_AND_UNIT.fullmatch(column)
    if match is None:
        return ""
    label, bracketed_unit, last_word = match.groups()
    unit = bracketed_unit or last_word
    is_named = _is_named(_words(label), meaning)
    is_recognised_by_unit = meaning.is_known_by_unit and bracketed_unit is not None
    if unit == meaning.unit and (is_named or is_recognised_by_unit):
        return advice_to_rename
    convertible_units = OTHER_UNITS.get(meaning.unit, ())
    if unit in convertible_units and is_named:
        return f"column {shown(column)} is in {unit}: convert it to {meaning.unit} and rename it to {shown(name)}"
    return ""


def _is_named(words: frozenset[str], meaning: ColumnMeaning) -> bool:
    """Return whether the words of a column name identify a column.

    The words must contain all words of the name of an electrode, or at least one word of any other column.

    Args:
        words: Words of the column name in the file.
        meaning: Meaning of the expected column.
    """
    if meaning.noun == "electrode":
        return bool(meaning.words) and meaning.words <= words
    return bool(meaning.words & words)


def _words(text: str) -> frozenset[str]:
    """Return the words of a text in lower case, separated by anything but letters and digits."""
    return frozenset(word for word in re.split(r"[\W_]+", text.casefold()) if word)
