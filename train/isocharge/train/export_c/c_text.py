"""Numbers, arrays and texts as C99."""

from collections.abc import Iterable
from importlib import resources
from string import Template
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

LINE = 109
"""Columns of a line of numbers."""


def source_text(name: str, **values: object) -> str:
    """A file of `sources/` with values for its `$names`."""
    return Template((resources.files(__package__) / "sources" / name).read_text("utf-8")).substitute(values)


def c_float(value: float) -> str:
    """A finite float32 as the shortest literal that gives it back, bit by bit."""
    return _with_point(str(np.float32(value))) + "f"


def c_double(value: float) -> str:
    """A finite double as a literal."""
    return _with_point(repr(float(value)))


def _with_point(digits: str) -> str:
    return digits if any(mark in digits for mark in ".e") else digits + ".0"


def c_doubles(values: Iterable[float]) -> str:
    """An initialiser of doubles in one line: `{1.0, 2.0}`."""
    return "{" + ", ".join(map(c_double, values)) + "}"


def c_array(name: str, values: NDArray[Any]) -> str:
    """A constant array of one dimension, of float or signed char, from values of any shape, in the order of rows."""
    whole = values.dtype == np.int8
    words = ", ".join(map(str if whole else c_float, values.ravel()))
    numbers = "\n    ".join(wrap(f"{words},", LINE, break_on_hyphens=False)).rstrip(",")
    return f"static const {'signed char' if whole else 'float'} {name}[{values.size}] = {{\n    {numbers}\n}};\n"


def c_string(text: str) -> str:
    """A text as a C string; all but letters, digits and blanks by their octal codes, so no compiler reads them."""
    plain = (chr(byte) if chr(byte).isalnum() and byte < 128 else f"\\{byte:03o}" for byte in text.encode())
    return '"' + "".join(plain).replace("\\040", " ") + '"'


def c_comment(text: str) -> str:
    """A text that may stand in a comment: what could end it, or begin another, is left out."""
    return "".join(sign if sign.isascii() and (sign.isalnum() or sign in " ._-,:()=/") else "_" for sign in text)
