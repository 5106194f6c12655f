"""Numbers, arrays and texts as C99."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

LINE = 110
"""Columns of a line of numbers."""


def c_float(value: float) -> str:
    """A float32 as the shortest literal that gives it back, bit by bit; it is finite."""
    single = np.float32(value)
    if not np.isfinite(single):
        raise ValueError(f"expected a finite number, got {value}")
    return _with_point(str(single)) + "f"


def c_double(value: float) -> str:
    """A finite double as a literal."""
    return _with_point(repr(float(value)))


def _with_point(digits: str) -> str:
    return digits if any(mark in digits for mark in ".e") else digits + ".0"


def c_string(text: str) -> str:
    """A text as a C string; all but letters, digits and blanks by their octal codes, so no compiler reads them."""
    plain = (chr(byte) if chr(byte).isalnum() and byte < 128 else f"\\{byte:03o}" for byte in text.encode())
    return '"' + "".join(plain).replace("\\040", " ") + '"'


def c_comment(text: str) -> str:
    """A text that may stand in a comment: what could end it, or begin another, is left out."""
    return "".join(sign if sign.isascii() and (sign.isalnum() or sign in " ._-,:()=/") else "_" for sign in text)


def c_array(kind: str, name: str, values: NDArray[Any]) -> str:
    """A constant array of one dimension from values of any shape, in the order of their rows."""
    flat = values.ravel()
    words = [c_float(value) for value in flat] if kind == "float" else [str(int(value)) for value in flat]
    return f"static const {kind} {name}[{flat.size}] = {{\n{wrapped(words)}\n}};\n"


def wrapped(words: Iterable[str]) -> str:
    """Words with commas between them, in lines of at most `LINE` columns."""
    lines, line = [], ""
    for word in words:
        if len(line) + len(word) + 2 > LINE:
            lines.append(line.rstrip())
            line = ""
        line += f"{word}, "
    return "\n".join(f"    {text}" for text in [*lines, line.rstrip().rstrip(",")])


def c_doubles(values: Sequence[float]) -> str:
    """An initialiser of doubles in one line: `{1.0, 2.0}`."""
    return "{" + ", ".join(c_double(value) for value in values) + "}"
