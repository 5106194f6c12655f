"""Numbers, arrays and texts in the syntax of C99."""

import math
import re
from importlib import resources
from string import Template
from textwrap import fill
from typing import Any

import numpy as np
from numpy.typing import NDArray


def source_text(name: str, /, **values: object) -> str:
    """Read a file in `sources/`, and replace each `$name` by its value."""
    file = resources.files(__package__) / "sources" / name
    template = Template(file.read_text("utf-8"))
    return template.substitute(values)


def c_float(value: float) -> str:
    """Return the shortest C literal of a number that is rounded to single precision. The number may be infinite."""
    return "HUGE_VALF" if math.isinf(value) else str(np.float32(value)) + "f"


def c_type(values: NDArray[Any]) -> str:
    """Return the C type of the numbers of an array, which is `float` except for int8 and uint32 numbers."""
    return {"int8": "signed char", "uint32": "unsigned"}.get(values.dtype.name, "float")


def c_numbers(values: NDArray[Any]) -> str:
    """Return the numbers of an array of any shape as C literals with commas between them, row by row."""
    as_text = c_float if c_type(values) == "float" else str
    return ", ".join(map(as_text, values.ravel()))


def c_array(name: str, values: NDArray[Any]) -> str:
    """Return the C definition of a constant array with one dimension.

    Args:
        name: Name of the array.
        values: Array of any shape, written row by row. Numbers of the type `float` are rounded to single precision.
    """
    numbers = fill(c_numbers(values), initial_indent="    ", subsequent_indent="    ", break_on_hyphens=False)
    return f"static const {c_type(values)} {name}[{values.size}] = {{\n{numbers}\n}};\n"


def c_string(text: str) -> str:
    """Return a C string literal in which all characters except ASCII letters, digits and blanks are octal codes.

    Args:
        text: Text of the literal.
    """
    escaped = re.sub(rb"[^A-Za-z0-9 ]", lambda match: b"\\%03o" % match[0][0], text.encode())
    return f'"{escaped.decode()}"'


def c_comment(text: str) -> str:
    """Return a text that can be inserted into a C comment.

    Characters that could end the comment or begin another comment are replaced by `_`.
    """
    return re.sub(r"[^A-Za-z0-9 ._,:()=/-]", "_", text)
