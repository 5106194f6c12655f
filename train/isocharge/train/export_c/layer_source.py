"""Generator of the C source of one layer of a network: a function with its constant arrays.

A layer computes its outputs y = f(x W + c) from its inputs x. W are the weights, shape (inputs, outputs), c is the
bias, and f is the activation. The C function processes a few inputs at a time. Each input is multiplied by its row of
W, and the products are added to all outputs. The inner loop of the C function runs over neighbouring outputs, and its
number of iterations is constant. With -O2 or a higher level of optimisation, compilers therefore vectorise the loop
without changing the order of any sum. If two perceptrons run side by side, the weight matrix consists of two blocks,
and the zeros outside the blocks are left out. Each weight that the training rounded to 8 bits is stored in one byte.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Singles
from isocharge.train.export_c.c_text import c_array
from isocharge.train.training.activations import Activation
from isocharge.train.training.perceptron import LARGEST_INT8

N_ROWS = 4
"""Number of rows of the weights whose products are added to the outputs at a time.

The program then reads and writes each output only once for all of these rows."""

INT8_TOLERANCE = 2.0**-21
"""Largest relative difference between a weight and a multiple of the scale that rounding in float32 can cause."""

Block = tuple[slice, slice]
"""Rows and columns of a part of a matrix."""

WHOLE_MATRIX: Block = (slice(0, None), slice(0, None))
"""The block that contains all rows and columns."""


@dataclass(frozen=True)
class LayerSource:
    """Generator of the C function `void name(x, c, y)`, which computes y = f(x W + c).

    Attributes:
        name: Name of the function.
        weight: Weights W, shape (inputs, outputs), float32.
        bias: Bias c, shape (outputs,), which is written as the array `name_bias`. None if c is not constant.
        blocks: Blocks of W. All weights outside the blocks are zero.
        activation: The function f; None for the identity.
    """

    name: str
    weight: Singles
    bias: Singles | None = None
    blocks: tuple[Block, ...] = (WHOLE_MATRIX,)
    activation: Activation | None = None

    def text(self) -> str:
        """Return the C text of the constant arrays, and of the function that computes y = activation(x @ weight + c).

        The arguments of the C function are the inputs x, the bias c and the outputs y. The function adds c last. If a
        large c were added first, the intermediate sums would lose accuracy.
        """
        n_input, n_output = self.weight.shape

        # The arrays: the weights of each block, the scales if the weights are integers, and the bias if it is constant
        values, scale = round_to_int8(self.weight)
        block_names = [f"{self.name}_weights_{block_index}" for block_index in range(len(self.blocks))]
        named_blocks = list(zip(block_names, self.blocks, strict=True))
        arrays = [c_array(name, values[block]) for name, block in named_blocks]
        if scale is not None:
            arrays.append(c_array(f"{self.name}_scale", scale))
        if self.bias is not None:
            arrays.append(c_array(f"{self.name}_bias", self.bias))

        # C expression for output j. At first, y[j] contains the sum of the products for this output. If the weights are
        # integers, the sum is multiplied by the scale of its column.
        result = "y[j] + c[j]" if scale is None else f"y[j] * {self.name}_scale[j] + c[j]"
        if self.activation is not None:
            result = f"{self.activation.c_function}({result})"

        # The function: set the sums to zero, add the products of each block, and compute the outputs.
        products = [_product_lines(name, block, values[block]) for name, block in named_blocks]
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
    """Find the blocks of the weight matrices of consecutive layers, outside which all weights are zero.

    In some layers, two perceptrons run side by side, and no weight connects them. The weight matrix then has two blocks
    on its diagonal: the upper left block of the first perceptron, and the lower right block of the second one. All
    other layers have a single block, which is the whole matrix.

    The layers are examined from the last to the first. When a layer is examined, the number of its outputs that belong
    to the first perceptron is known. The weights of the layer then show which inputs of the layer belong to the first
    perceptron. These inputs are the outputs of the layer before.

    Args:
        weights: Weights of each layer except the first layer, whose inputs both perceptrons share.
        first_width: Number of outputs of the last layer that belong to the first perceptron.

    Returns:
        Blocks of each layer, as slices of the rows (inputs) and of the columns (outputs) of its weights.
    """
    blocks: list[tuple[Block, ...]] = []
    n_first_output = first_width  # number of outputs of the examined layer that belong to the first perceptron
    for matrix in reversed(weights):
        # Each row of the matrix is an input. The inputs of the second perceptron begin at the first row with a weight
        # for an output of the second perceptron.
        is_used_by_second = matrix[:, n_first_output:].any(axis=1)
        n_first_input = int(is_used_by_second.argmax())  # index of the first true value, or 0 without true values
        # The matrix has two blocks if no later row has a weight for an output of the first perceptron.
        connects_second_to_first = matrix[n_first_input:, :n_first_output].any()
        is_block_diagonal = n_first_input > 0 and not connects_second_to_first
        if is_block_diagonal:
            first_block = (slice(0, n_first_input), slice(0, n_first_output))
            second_block = (slice(n_first_input, None), slice(n_first_output, None))
            blocks.append((first_block, second_block))
            n_first_output = n_first_input  # the inputs of this layer are the outputs of the layer before it
        else:
            # Both perceptrons share the inputs of this layer, so all layers before it have a single block, too.
            blocks.append((WHOLE_MATRIX,))
            n_first_output = 0
    return blocks[::-1]


def round_to_int8(values: Singles) -> tuple[NDArray[Any], Singles | None]:
    """Convert weights to 8-bit integers if the weights of each column are multiples of one number, the scale.

    The scale of a column is its largest absolute weight divided by `LARGEST_INT8`.

    Args:
        values: Weights, shape (inputs, outputs).

    Returns:
        Integers and the scales, shape (outputs,). If some weights are no multiples, the unchanged weights and None.
    """
    scale = np.abs(values).max(axis=0) / np.float32(LARGEST_INT8)
    nonzero_scale = np.where(scale > 0.0, scale, 1.0)  # a column of zeros has the scale 0
    multiples = np.round(values / nonzero_scale)
    are_multiples = np.allclose(multiples * scale, values, rtol=INT8_TOLERANCE, atol=0.0)
    if are_multiples:
        return multiples.astype(np.int8), scale
    return values, None


def _product_lines(name: str, block: Block, values: NDArray[Any]) -> list[str]:
    """Return C lines that multiply the inputs x by one block of the weights, and add the products to the outputs y.

    Each loop over the outputs adds the products of up to `N_ROWS` inputs, so that y is read and written less often.

    Args:
        name: Name of the array with the weights of the block.
        block: Rows and columns of the block in the weight matrix of the layer.
        values: Weights of the block, float32 or int8.
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
