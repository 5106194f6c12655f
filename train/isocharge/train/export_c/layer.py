"""A layer in C: weights as (inputs, outputs), a few rows at a time added to all outputs.

The inner loop runs over neighbouring outputs and a constant count, so compilers work on several at once from -O2 on
without changing the order of any sum. Two perceptrons that run side by side have two blocks of weights; the zeros
beside them are left out. Weights that training rounded to 8 bits take a byte each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Singles
from isocharge.train.export_c.c_text import c_array

ROWS = 4
"""Rows of weights that are added at a time: each output is loaded and stored once for all of them."""

LARGEST_INT8 = 127
"""The largest weight of a column in units of its scale, where weights are rounded to 8 bits."""

Block = tuple[slice, slice]
"""Rows and columns, each from a first."""

WHOLE: Block = (slice(0, None), slice(0, None))


@dataclass(frozen=True)
class Layer:
    """A function `name(x, c, y)` in C: y = f(x W + c), shapes (inputs,) and (outputs,).

    Attributes:
        name: Of the function.
        weights: W, shape (inputs, outputs), float32.
        bias: c where it is constant, written as the array `name_bias`.
        blocks: Outside which W is zero.
        activation: Name of f in C; "" for none.
    """

    name: str
    weights: Singles
    bias: Singles | None = None
    blocks: tuple[Block, ...] = (WHOLE,)
    activation: str = ""

    def text(self) -> str:
        """Constant arrays and the function; c is added last, lest each sum be rounded to the digits of a large c."""
        inputs, outputs = self.weights.shape
        values, scale = rounded_to_int8(self.weights)
        names = [f"{self.name}_weights_{number}" for number in range(len(self.blocks))]
        arrays = [c_array(name, values[block]) for name, block in zip(names, self.blocks, strict=True)]
        constants = {"scale": scale, "bias": self.bias}
        arrays += [c_array(f"{self.name}_{word}", row) for word, row in constants.items() if row is not None]
        answer = "y[j] + c[j]" if scale is None else f"y[j] * {self.name}_scale[j] + c[j]"
        lines = [
            f"/* {inputs} numbers x to {outputs} numbers y */",
            f"static void {self.name}(const float *restrict x, const float *restrict c, float *restrict y)",
            "{",
            f"    for (int j = 0; j < {outputs}; ++j)",
            "        y[j] = 0.0f;",
            *chain(*(_product(name, block, values[block]) for name, block in zip(names, self.blocks, strict=True))),
            f"    for (int j = 0; j < {outputs}; ++j)",
            f"        y[j] = {f'{self.activation}({answer})' if self.activation else answer};",
            "}",
            "",
        ]
        return "\n".join([*arrays, *lines])


def blocks_of(weights: Sequence[Singles], answers: int) -> list[tuple[Block, ...]]:
    """The blocks of layers one behind the other: two where two perceptrons run side by side, one where they do not.

    Args:
        weights: Of each layer but the first, whose inputs both perceptrons share.
        answers: Columns of the last that the first perceptron gives.
    """
    blocks: list[tuple[Block, ...]] = []
    column = answers
    for matrix in reversed(weights):
        row = int(matrix[:, column:].any(axis=1).argmax())  # the first that the second perceptron has
        if row == 0 or matrix[row:, :column].any():
            row = column = 0
        first, second = (slice(0, row), slice(0, column)), (slice(row, None), slice(column, None))
        blocks.append((first, second) if row else (second,))
        column = row
    return blocks[::-1]


def rounded_to_int8(values: Singles) -> tuple[NDArray[Any], Singles | None]:
    """Weights as int8 and a scale of each column if they are whole multiples of it, else as they are and None."""
    scale = np.abs(values).max(axis=0) / np.float32(LARGEST_INT8)
    multiples = np.round(values / np.where(scale > 0.0, scale, 1.0))
    if np.allclose(multiples * scale, values, rtol=2.0**-21, atol=0.0):  # as far as float32 can tell
        return multiples.astype(np.int8), scale
    return values, None


def _product(name: str, block: Block, values: NDArray[Any]) -> list[str]:
    """Add the product with one block to y: rows in fours, then those that are left."""
    rows, width = values.shape
    first, offset = (part.start for part in block)
    kind, cast = ("signed char", "(float)") if values.dtype == np.int8 else ("float", "")
    lines = []
    for begin, end in ((0, rows - rows % ROWS), (rows - rows % ROWS, rows)):
        count = min(ROWS, end - begin)
        terms = [f"x{k} * {cast}w[{k * width} + j]" for k in range(count)]
        lines += [
            f"    for (int i = {begin}; i < {end}; i += {count}) {{",
            f"        const {kind} *w = {name} + {width} * i;",
            f"        const float {', '.join(f'x{k} = x[{first + k} + i]' for k in range(count))};",
            "",
            f"        for (int j = 0; j < {width}; ++j)",
            f"            y[{offset} + j] += {' + '.join(terms)};",
            "    }",
        ] * (count > 0)
    return lines
