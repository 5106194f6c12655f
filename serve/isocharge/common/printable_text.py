"""Text that is safe to print on a terminal.

Names and units from boards, headers of files, metadata of models and contents of recordings may contain characters that
a terminal executes or hides. Examples are escape sequences that move the cursor or change the title of the window,
marks that reverse the direction of writing, and characters without width. Such characters are replaced by their escape
sequences in JSON, as in `\\u001b`, so that JSON remains valid.
"""

IGNORABLE_RANGES = (
    (0x034F, 0x034F),
    (0x115F, 0x1160),
    (0x17B4, 0x17B5),
    (0x180B, 0x180F),
    (0x3164, 0x3164),
    (0xFE00, 0xFE0F),
    (0xFFA0, 0xFFA0),
    (0xE0100, 0xE01EF),
)
"""First and last code point of characters that `str.isprintable` accepts although they are invisible.

These characters have the property Default_Ignorable_Code_Point (Unicode 15, DerivedCoreProperties.txt), but they are
letters or marks, which `str.isprintable` accepts.
"""

INVISIBLE = frozenset(chr(code) for first, last in IGNORABLE_RANGES for code in range(first, last + 1))
"""The characters in `IGNORABLE_RANGES`."""

SHORT_ESCAPES = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}
"""Escape sequences of the usual white space."""


def is_printable(text: str) -> bool:
    """Return whether a text contains no character that a terminal executes or hides."""
    return text.isprintable() and INVISIBLE.isdisjoint(text)


def printable(text: str) -> str:
    """Escape all characters of a text that a terminal would execute or hide, including line feeds.

    Use this function for text from other sources within a line, such as the name of a channel.

    Example:
        >>> print(printable("A\\x1b[2J\\u202e"))
        A\\u001b[2J\\u202e
    """
    if is_printable(text):
        return text
    return "".join(character if is_printable(character) else _escape(character) for character in text)


def printable_lines(text: str) -> str:
    """Escape all characters of a text that a terminal would execute or hide, except for line feeds."""
    return "\n".join(map(printable, text.split("\n")))


def _escape(character: str) -> str:
    """Return the escape sequence of a character in JSON. A character beyond U+FFFF has two sequences, as in UTF-16."""
    if character in SHORT_ESCAPES:
        return SHORT_ESCAPES[character]
    utf16 = character.encode("utf-16-be", "surrogatepass")  # a single surrogate is accepted, too
    code_units = (utf16[position : position + 2] for position in range(0, len(utf16), 2))  # two bytes each
    return "".join(f"\\u{code_unit.hex()}" for code_unit in code_units)
