"""Conversion of text to characters that are safe to print on a terminal.

Text from boards, files, models and recordings may contain characters that a terminal executes or hides. Examples are
escape sequences that move the cursor or change the title of the window, marks that reverse the direction of writing,
and characters without width. Such characters are replaced by the escape sequences that JSON uses, such as `\\u001b`. A
text in JSON therefore remains valid JSON.
"""

import json
import re

INVISIBLE = re.compile("[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]")
"""Invisible characters that `str.isprintable` accepts.

These characters have the property Default_Ignorable_Code_Point (Unicode 15, DerivedCoreProperties.txt). They are
letters or marks, and `str.isprintable` accepts all letters and marks.
"""


def is_printable(text: str) -> bool:
    """Return whether all characters of a text are visible characters or blanks.

    The result is False if the text contains a character that a terminal would execute or hide.
    """
    return text.isprintable() and INVISIBLE.search(text) is None


def printable(text: str) -> str:
    """Escape all characters of a text that a terminal would execute or hide, including line feeds.

    Use this function for text that is inserted into a line, such as the name of a channel.

    Example:
        >>> print(printable("A\\x1b[2J\\u202e"))
        A\\u001b[2J\\u202e
    """
    if is_printable(text):
        return text
    return "".join(character if is_printable(character) else _escape(character) for character in text)


def printable_lines(text: str) -> str:
    """Escape all characters of a text that a terminal would execute or hide, but keep the line feeds."""
    return "\n".join(map(printable, text.split("\n")))


def _escape(character: str) -> str:
    """Return the escape sequence that JSON uses for a character.

    JSON escapes the code units of UTF-16. A character beyond U+FFFF has two code units, and therefore two sequences.
    """
    escaped = json.dumps(character)[1:-1]  # without the quotation marks
    return f"\\u{ord(character):04x}" if escaped == character else escaped  # JSON does not escape U+007F
