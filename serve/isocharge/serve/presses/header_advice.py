"""Advice for columns whose names differ from the expected names in capital letters, language or unit."""

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
"""Words that the name of a column may contain in addition, without a change of its meaning."""

MAX_COLUMN_CHARACTERS = 100
"""Largest number of characters of a column name for which advice is given. A longer text is not the name of a
quantity."""

_LABEL_AND_UNIT = re.compile(r"(.*?)(?:\s*[\[(]\s*([^\[\]()]+?)\s*[\])]|[\s_/]+([^\s_/\[\]()]+))")


@dataclass(frozen=True)
class ColumnMeaning:
    """Description of a column by which the column is recognised under another name.

    Attributes:
        noun: Noun for the column in messages: "column" or "electrode".
        unit: Unit of the numbers in the column; empty if the numbers have no unit.
        words: Words in lower case. If the name of a column in a file contains one of these words, it probably means
            this column.
        is_known_by_unit: Whether every name with this unit in brackets means this column.
    """

    noun: str = "column"
    unit: str = ""
    words: frozenset[str] = frozenset()
    is_known_by_unit: bool = False


def header_advice(columns: Iterable[str], absent_columns: Mapping[str, ColumnMeaning]) -> Iterator[str]:
    """Yield advice for each column of a file that is probably a missing column under another name.

    If several columns of the file resemble the same missing column, advice is given only for the first of these
    columns.

    Args:
        columns: Names of the columns of the file that have no meaning.
        absent_columns: Meanings of the missing columns, by the names of the missing columns.
    """
    remaining_columns = dict(absent_columns)  # missing columns for which no advice was given yet
    for column in columns:
        if len(column) > MAX_COLUMN_CHARACTERS:  # such a long text is not the name of a quantity
            continue
        for name, meaning in remaining_columns.items():
            advice = _advice(column, name, meaning)
            if advice:
                yield advice
                del remaining_columns[name]  # allowed, because the `break` ends the loop over the dictionary
                break


def _advice(column: str, name: str, meaning: ColumnMeaning) -> str:
    """If a column of a file is probably a given missing column, return advice. Otherwise return an empty text.

    Three kinds of names are recognised in the file. A name of the first kind differs from the missing name only by
    capital letters. A name of the second kind consists of words that mean the missing column. A name of the third kind
    consists of such words and a unit. The unit is either the unit of the missing column, or a unit that can be
    converted to it. Some columns, such as a force in N, are recognised by a unit in brackets after any words.

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
        meaning = replace(meaning, words=words_of(name))  # an electrode is recognised by the words of its name

    # Check whether the name consists only of words that mean the missing column, such as "force", and of general words,
    # such as "position", which do not change the meaning.
    words = words_of(column)
    unknown_words = words - meaning.words - GENERAL_WORDS
    if _is_named(words, meaning) and not unknown_words:
        return advice_to_rename

    # Check whether the name consists of a label and a unit, such as "force (N)" or "force_N".
    match = _LABEL_AND_UNIT.fullmatch(column)
    if match is None:
        return ""
    label, bracketed_unit, last_word = match.groups()
    unit = bracketed_unit or last_word  # only one of them is not None
    is_label_known = _is_named(words_of(label), meaning)
    is_recognised_by_unit = meaning.is_known_by_unit and bracketed_unit is not None
    if unit == meaning.unit and (is_label_known or is_recognised_by_unit):
        return advice_to_rename
    convertible_units = OTHER_UNITS.get(meaning.unit, ())
    if unit in convertible_units and is_label_known:
        return f"column {shown(column)} is in {unit}: convert it to {meaning.unit} and rename it to {shown(name)}"
    return ""


def _is_named(words: frozenset[str], meaning: ColumnMeaning) -> bool:
    """Return whether the words in the name of a column mean the expected column.

    An electrode requires all words of its name, and no other words except general words. Any other column
    requires at least one of its words.

    Args:
        words: Words in the name of the column in the file.
        meaning: Meaning of the expected column.
    """
    if meaning.noun == "electrode":
        return bool(meaning.words) and meaning.words <= words <= meaning.words | GENERAL_WORDS
    return bool(meaning.words & words)


def words_of(text: str) -> frozenset[str]:
    """Return the words of a text in lower case. All characters except letters and digits separate words."""
    return frozenset(word for word in re.split(r"[\W_]+", text.casefold()) if word)
