"""C source of a layer of a network: a function with constant arrays.

A layer computes y = f(x W + c). The weights W have the shape (inputs, outputs). The products with a few rows of W are
added to all outputs at a time. The inner loop runs over neighbouring outputs, and its number of iterations is constant.
With -O2 or a higher level of optimisation, compilers therefore vectorise the loop without changing the order of any
sum. If two perceptrons run side by side, the weights are two blocks, and the zeros beside the blocks are left out.
Weights that training rounded to 8 bits take one byte each.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.activations import Activation
from isocharge.common.arrays import Singles
from isocharge.train.export_c.c_text import c_array

N_ROWS = 4
"""Number of rows of the weights whose products are added at a time.

Each output is then loaded and stored only once for these rows."""

LARGEST_INT8 = 127
"""Largest absolute value of a weight that is rounded to 8 bits, in units of the scale of its column."""

INT8_TOLERANCE = 2.0**-21
"""Relative difference from a multiple of the scale that float32 arithmetic can cause."""

Block = tuple[slice, slice]
"""Rows and columns of a part of a matrix."""

WHOLE_MATRIX: Block = (slice(0, None), slice(0, None))
"""The block that contains all rows and columns."""


@dataclass(frozen=True)
class LayerSource:
    """The C function `void name(x, c, y)`, which computes y = f(x W + c).

    Attributes:
        name: Name of the function.
        weight: W, shape (inputs, outputs), float32.
        bias: c if it is constant, shape (outputs,), written as the array `name_bias`; otherwise None.
        blocks: Blocks outside which W is zero.
        activation: The function f; None for the identity.
    """

    name: str
    weight: Singles
    bias: Singles | None = None
    blocks: tuple[Block, ...] = (WHOLE_MATRIX,)
    activation: Activation | None = None

    def text(self) -> str:
        """Return the C text of the constant arrays, and of the function that computes y = activation(x @ weight + c).

        The function adds c last, because intermediate sums would otherwise be rounded to the digits of a large c.
        """
        n_input, n_output = self.weight.shape
        values, scale = round_to_int8(self.weight)
        block_names = [f"{self.name}_weights_{block_index}" for block_index in range(len(self.blocks))]
        named_blocks = list(zip(block_names, self.blocks, strict=True))
        arrays = [c_array(name, values[block]) for name, block in named_blocks]
        if scale is not None:
            arrays.append(c_array(f"{self.name}_scale", scale))
        if self.bias is not None:
            arrays.append(c_array(f"{self.name}_bias", self.bias))

        # The sums over integer weights are multiplied by the scale of their column.
        result = "y[j] + c[j]" if scale is None else f"y[j] * {self.name}_scale[j] + c[j]"
        if self.activation is not None:
            result = f"{self.activation.c_function}({result})"
        products = [_add_product(name, block, values[block]) for name, block in named_blocks]
        lines = [
            f"/* {n_input} numbers x to {n_output} numbers y */",
            f"static void {self.name}(const float *restrict x, const float *restrict c, float *restrict y)",
            "{",
            f"    for (int j = 0; j < {n_output}; ++j)",
            "        y[j] = 0.0f;",
            *chain.from_iterable(products),
            f"    for (int j = 0; j < {n_output}; ++j)",
            f"        y[j] = {result};",
            "}",
            "",
        ]
        return "\n".join([*arrays, *lines])


def find_blocks(weights: Sequence[Singles], first_width: int) -> list[tuple[Block, ...]]:
    """Find the blocks of consecutive layers: two where two perceptrons run side by side, otherwise one.

    Where two perceptrons run side by side, a weight matrix is block diagonal: the inputs and outputs of the first
    perceptron come first, and no weight connects both perceptrons. The layers are examined from the last to the first
    one. For the last layer, it is known which outputs belong to which perceptron. The rows of a layer then show which
    of its inputs belong to which perceptron.

    Args:
        weights: Weights of each layer except the first one, whose inputs both perceptrons share.
        first_width: Number of outputs of the last layer that belong to the first perceptron.

    Returns:
        Blocks of each layer, as slices of the rows (inputs) and the columns (outputs) of its weights.
    """
    blocks: list[tuple[Block, ...]] = []
    n_first_output = first_width  # number of outputs of the examined layer that belong to the first perceptron
    for matrix in reversed(weights):
        # The inputs of the second perceptron follow those of the first perceptron. They begin at the first row with a
        # weight for the outputs of the second perceptron.
        is_used_by_second = matrix[:, n_first_output:].any(axis=1)
        n_first_input = int(is_used_by_second.argmax())  # index of the first true value
        connects_second_to_first = matrix[n_first_input:, :n_first_output].any()
        is_block_diagonal = n_first_input > 0 and not connects_second_to_first
        if is_block_diagonal:
            first = (slice(0, n_first_input), slice(0, n_first_output))
            second = (slice(n_first_input, None), slice(n_first_output, None))
            blocks.append((first, second))
            n_first_output = n_first_input  # the inputs of this layer are the outputs of the layer before it
        else:
            # Both perceptrons share the inputs of this layer, so all layers before it have a single block, too.
            blocks.append((WHOLE_MATRIX,))
            n_first_output = 0
    return blocks[::-1]


def round_to_int8(values: Singles) -> tuple[NDArray[Any], Singles | None]:
    """Convert weights to 8-bit integers with a scale for each column, if all weights are multiples of the scale.

    Args:
        values: Weights, shape (inputs, outputs).

    Returns:
        Integers and the scale, shape (outputs,); or the unchanged weights and None, if some weights are no multiples.
    """
    scale = np.abs(values).max(axis=0) / np.float32(LARGEST_INT8)
    divisor = np.where(scale > 0.0, scale, 1.0)  # a column of zeros has the scale 0
    multiples = np.round(values / divisor)
    are_multiples = np.allclose(multiples * scale, values, rtol=INT8_TOLERANCE, atol=0.0)
    if are_multiples:
        return multiples.astype(np.int8), scale
    return values, None


def _add_product(name: str, block: Block, values: NDArray[Any]) -> list[str]:
    """Return the lines of C that add the product of the inputs x and one block of the weights to the outputs y.

    One pass over the outputs adds the products of up to `N_ROWS` inputs, so that y is read and written less often.

    Args:
        name: Name of the array with the weights of the block.
        block: Rows and columns of the block.
        values: Weights of the block.
    """
    n_row, n_column = values.shape
    rows, columns = block
    is_int8 = values.dtype == np.int8
    number_type = "signed char" if is_int8 else "float"
    cast = "(float)" if is_int8 else ""

    # Full groups of N_ROWS rows come first. The remaining rows form one smaller group.
    n_grouped = n_row - n_row % N_ROWS
    lines = []
    for begin, end in ((0, n_grouped), (n_grouped, n_row)):
        group_size = min(N_ROWS, end - begin)
        if group_size == 0:
            continue
        inputs = ", ".join(f"x{row} = x[{rows.start + row} + i]" for row in range(group_size))
        products = " + ".join(f"x{row} * {cast}w[{row * n_column} + j]" for row in range(group_size))
        lines += [
            f"    for (int i = {begin}; i < {end}; i += {group_size}) {{",
            f"        const {number_type} *w = {name} + {n_column} * i;",
            f"        const float {inputs};",
            "",
            f"        for (int j = 0; j < {n_column}; ++j)",
            f"            y[{columns.start} + j] += {products};",
            "    }",
        ]
    return lines
