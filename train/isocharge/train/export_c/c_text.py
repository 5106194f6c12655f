"""Numbers, arrays and texts in the syntax of C99."""

import re
from importlib import resources
from string import Template
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray


def source_text(name: str, /, **values: object) -> str:
    """Read a file in `sources/`, and replace each `$name` by its value."""
    file = resources.files(__package__) / "sources" / name
    template = Template(file.read_text("utf-8"))
    return template.substitute(values)


def c_float(value: float) -> str:
    """Return the shortest C literal of a finite number that is rounded to single precision."""
    return str(np.float32(value)) + "f"


def c_array(name: str, values: NDArray[Any]) -> str:
    """Return the C definition of a constant array with one dimension.

    Args:
        name: Name of the array.
        values: Array of any shape, written row by row; int8 numbers become `signed char`, uint32 numbers `unsigned`,
            and all others `float`, to which they are rounded.
    """
    number_type = {"int8": "signed char", "uint32": "unsigned"}.get(values.dtype.name, "float")
    as_text = c_float if number_type == "float" else str
    literals = ", ".join(map(as_text, values.ravel()))
    # While the lines are broken, a comma follows the last number, too. The last number then counts with the same length
    # as the other numbers. The last comma is removed afterwards. Lines are not broken after a minus sign.
    lines = wrap(f"{literals},", break_on_hyphens=False)
    numbers = "\n    ".join(lines).rstrip(",")
    return f"static const {number_type} {name}[{values.size}] = {{\n    {numbers}\n}};\n"


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
