"""A matrix product in C: weights as (inputs, outputs), a few rows at a time added to all outputs.

The inner loop runs over neighbouring outputs and a constant count, so compilers work on several at once from -O2 on
without changing the order of any sum. Blocks of zeros are left out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from isocharge.train.export_c.blocks import Block, diagonal_blocks
from isocharge.train.export_c.c_text import c_array
from isocharge.train.export_c.graph import Matrix

ROWS = 4
"""Rows of weights that are added at a time: each output is loaded and stored once for all of them."""

INT8_WORD = "signed char"


@dataclass(frozen=True)
class GemmSource:
    """y = x W + c as C: constant arrays, and a function `name(x, y)`, or `name(x, c, y)` where c is a row.

    Attributes:
        name: Of the function.
        matrix: W.
        bias: c if it is constant, shape (outputs,).
    """

    name: str
    matrix: Matrix
    bias: NDArray[np.float32] | None

    def text(self) -> str:
        """Arrays and function."""
        parts = [self._weights(number, block) for number, block in enumerate(self._blocks)]
        if self.matrix.scale is not None:
            parts.append(c_array("float", f"{self.name}_scale", self.matrix.scale))
        if self.bias is not None:
            parts.append(c_array("float", f"{self.name}_bias", self.bias))
        return "\n".join([*parts, self._function()])

    @property
    def _blocks(self) -> list[Block]:
        return diagonal_blocks(self.matrix)

    def _weights(self, number: int, block: Block) -> str:
        kind = "float" if self.matrix.scale is None else INT8_WORD
        values = self.matrix.values[slice(*block.rows), slice(*block.columns)]
        return c_array(kind, f"{self.name}_weights_{number}", values)

    def _function(self) -> str:
        """c is added last: it may be large, and each number added to it would be rounded as it is."""
        inputs, outputs = self.matrix.values.shape
        added, c = ("", f"{self.name}_bias") if self.bias is not None else ("const float *restrict c, ", "c")
        scale = f" * {self.name}_scale[j]" if self.matrix.scale is not None else ""
        lines = [
            f"/* {inputs} numbers x to {outputs} numbers y */",
            f"static void {self.name}(const float *restrict x, {added}float *restrict y)",
            "{",
            *_loop(outputs, "y[j] = 0.0f;"),
        ]
        for number, block in enumerate(self._blocks):
            lines += _product(f"{self.name}_weights_{number}", block, cast=self.matrix.scale is not None)
        return "\n".join([*lines, *_loop(outputs, f"y[j] = y[j]{scale} + {c}[j];"), "}", ""])


def _product(weights: str, block: Block, *, cast: bool) -> list[str]:
    """Add the product with one block to y."""
    rows, width = block.rows[1] - block.rows[0], block.columns[1] - block.columns[0]
    whole = rows - rows % ROWS
    kind = INT8_WORD if cast else "float"
    lines = []
    if whole:
        lines += [
            f"    for (int i = 0; i < {whole}; i += {ROWS}) {{",
            f"        const {kind} *w = {weights} + {width} * i;",
            f"        const float {_terms(ROWS, 'x{0} = x[{1}i + {0}]', block.rows[0])};",
            "",
            *_loop(width, f"y[{_plus(block.columns[0])}j] += {_sum(ROWS, width, cast)};", 8),
            "    }",
        ]
    if rows % ROWS:
        lines += [
            "    {",
            f"        const {kind} *w = {weights}{f' + {width * whole}' if whole else ''};",
            f"        const float {_terms(rows % ROWS, 'x{0} = x[{1}{0}]', block.rows[0] + whole)};",
            "",
            *_loop(width, f"y[{_plus(block.columns[0])}j] += {_sum(rows % ROWS, width, cast)};", 8),
            "    }",
        ]
    return lines


def _loop(count: int, statement: str, indent: int = 4) -> list[str]:
    blanks = " " * indent
    return [f"{blanks}for (int j = 0; j < {count}; ++j)", f"{blanks}    {statement}"]


def _terms(count: int, pattern: str, first: int) -> str:
    return ", ".join(pattern.format(number, _plus(first)) for number in range(count))


def _sum(count: int, width: int, cast: bool) -> str:
    word = "(float)" if cast else ""
    return " + ".join(f"x{number} * {word}w[{_plus(number * width)}j]" for number in range(count))


def _plus(offset: int) -> str:
    return f"{offset} + " if offset else ""
