"""Generator of the files `isocharge_model.h`, `isocharge_model.c` and `self_test.c` of a model.

Features
--------

In C, the inputs of the first layer are the logarithm of one charge, ln q_0, and the logarithms ln(q_k / q_0) for the
other charges q_k. The network remains the same function of the charges, but its rounding errors are smaller. The force
changes all charges of a film together, and the position changes the ratios of the charges. The first layer of a trained
network therefore has large weights of both signs. The logarithms are nearly equal, so that the terms of the sums in
this layer nearly cancel:

    sum_k w_k ln q_k = (sum_k w_k) ln q_0 + sum_k w_k ln(q_k / q_0).

On the right-hand side, the charges are subtracted before a logarithm is computed, because ln(q_k / q_0) is computed as
log1p((q_k - q_0) / q_0). The difference of two charges is exact if their ratio is at most two (Sterbenz 1974). All
digits of the logarithm are then correct. On the left-hand side, the logarithms are larger, and their last digits are
lost in the sums.

Layers
------

A layer computes its outputs y = f(x W + c) from its inputs x. W are the weights, shape (inputs, outputs), c is the
bias, and f is the hyperbolic tangent or the identity. The C function processes a few inputs at a time. Each input is
multiplied by its row of W, which gives one product for each output, to which it is added. The inner loop of the C
function runs over neighbouring outputs, and its number of iterations is constant. With -O2 or a higher level of
optimisation, compilers therefore vectorise the loop without changing the order of any sum. If two perceptrons run side
by side, the weight matrix consists of two blocks, and the zeros outside the blocks are left out. Each weight that the
training rounded to 8 bits is stored in one byte.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, cycle, islice, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Array, Singles
from isocharge.serve.flags import BEYOND, MISFIT, OUTSIDE, STRESS
from isocharge.serve.model.contact import Contact, Contacts
from isocharge.serve.model.golden import Golden
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import COLUMNS
from isocharge.serve.model.validity import Validity
from isocharge.train.export_c.c_text import c_array, c_comment, c_float, c_string, source_text
from isocharge.train.training.activations import Activation
from isocharge.train.training.folded_network import (
    ANGLES,
    COSINES_TO_CORRELATIONS,
    LARGEST_INT8,
    LARGEST_LOGARITHM,
    LOG_STD,
    MISFIT_UNIT,
    POSITION,
    ChargeFeatures,
    FoldedNetwork,
)

N_ROWS = 4
"""Number of rows of the weights whose products are added to the outputs at a time.

The program then reads and writes each output only once for all of these rows."""


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
        """Return the C text of the constant arrays, and of the function that computes y = f(x @ weight + c).

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
    are_multiples = np.allclose(multiples * scale, values, atol=0.0)
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


FLAG_BITS = {OUTSIDE: 0x100, BEYOND: 0x200, MISFIT: 0x400, STRESS: 0x800}
"""Bits of the flags that the C function `isocharge_flags` returns."""


def model_header(metadata: ModelMetadata, network: FoldedNetwork) -> str:
    """Return the text of `isocharge_model.h`.

    Args:
        metadata: Metadata of the model.
        network: The network of the model.
    """
    features = network.features
    is_logarithmic = features.mean is None
    return source_text(
        "isocharge_model.h",
        label=c_comment(metadata.label),
        model=c_string(metadata.label),
        sensor=c_string(metadata.frame_id),
        electrodes=len(metadata.electrodes),
        names=", ".join(map(c_string, metadata.electrodes)),
        fields=", ".join(f'"{name}"' for name in Contact._fields),
        numbers=len(Contact._fields),
        **_validity_literals(Validity.of(metadata)),
        low=f"{features.low_pC:g}" if is_logarithmic else "LOW",
        high=f"{features.high_pC:g}" if is_logarithmic else "HIGH (isocharge_model.c)",
    )


def _validity_literals(validity: Validity) -> dict[str, object]:
    """Return the limits of a model as C literals, by the names of their placeholders in `isocharge_model.h`.

    Args:
        validity: The working area and the limits of the model.
    """
    squared_distance_mm2, implausible_force_N = validity.implausible_limits
    numbers = {
        "min_force": validity.force_range_N[0],
        "max_force": validity.force_range_N[1],
        "misfit_limit": validity.misfit_limit,
        "centre_x": validity.centre_mm[0],
        "centre_y": validity.centre_mm[1],
        "beyond_mm": math.sqrt(squared_distance_mm2),
        "beyond_N": implausible_force_N,
    }
    has_yield_force = math.isfinite(validity.yield_force_N)
    return {name: c_float(value) for name, value in numbers.items()} | {
        "corner_count": len(validity.corners_mm),
        "corners": ", ".join(c_float(coordinate) for coordinate in validity.corners_mm.ravel()),
        "yield_force": c_float(validity.yield_force_N) if has_yield_force else "HUGE_VALF",
    }


def model_source(metadata: ModelMetadata, network: FoldedNetwork) -> str:
    """Return the text of `isocharge_model.c`.

    Args:
        metadata: Metadata of the model. The label of the model appears in a comment.
        network: The network.
    """
    hidden, skip, last = _layer_sources(network)
    widest = max(layer.weight.shape[1] for layer in hidden)

    # Write the C calls of the layers. The first hidden layer reads the inputs of the network from the buffer `logs`.
    # The hidden layers write alternately to the buffers `one` and `other`, and each layer reads the buffer that the
    # layer before it wrote.
    buffers = ["logs", *islice(cycle(["one", "other"]), len(hidden))]
    calls = []
    for layer, (input_buffer, output_buffer) in zip(hidden, pairwise(buffers), strict=True):
        calls.append(f"{layer.name}({input_buffer}, {layer.name}_bias, {output_buffer});")
    calls.append(f"skip({buffers[0]}, skip_bias, skipped);")
    calls.append(f"last({buffers[-1]}, skipped, answers);")
    hidden_buffers = dict.fromkeys(buffers[1:])  # removes repeated names, and keeps the order

    # The template of the file contains a placeholder for each of these arguments. The arguments `plane`, `logs`
    # and `known` are the numbers of outputs of the last layer up to the position, up to the standard deviations, and up
    # to the angles of the correlations.
    return source_text(
        "isocharge_model.c",
        label=c_comment(metadata.label),
        activation=network.layers.activation.c_source,
        features=_features_source(network.features),
        layers="\n".join(layer.text() for layer in (*hidden, skip, last)),
        rows=", ".join(f"{buffer}[{widest}]" for buffer in hidden_buffers),
        calls="\n    ".join(calls),
        electrodes=network.features.n_electrode,
        plane=POSITION.stop,
        logs=LOG_STD.stop,
        largest_logarithm=c_float(LARGEST_LOGARITHM),
        known=ANGLES.stop,
        answers=last.weight.shape[1],
        table=c_array("COSINES", COSINES_TO_CORRELATIONS.astype(np.float32)),
        cosines=len(COSINES_TO_CORRELATIONS),
        first=ANGLES.start,
        misfit_unit=c_float(MISFIT_UNIT),
    )


def _layer_sources(network: FoldedNetwork) -> tuple[list[LayerSource], LayerSource, LayerSource]:
    """Return the hidden layers, the skip layer and the output layer of a network.

    The weights and biases are converted to single precision. The first hidden layer and the skip layer read the
    features, which are the inputs of the network. If the features are logarithms, the weights of these two layers are
    also changed by `_convert_to_differences`.

    Args:
        network: The network.
    """
    perceptron = network.layers
    is_logarithmic = network.features.mean is None
    convert_input_weights = _convert_to_differences if is_logarithmic else _to_single_precision

    # From the second layer on, the contact perceptron and the misfit perceptron run side by side, so that the weights
    # consist of blocks. The outputs of the last layer before the misfit vector belong to the contact perceptron.
    first_layer, *other_layers = perceptron.hidden
    other_weights = [_to_single_precision(layer.weight) for layer in other_layers]
    last_weight = _to_single_precision(perceptron.last.weight)
    n_contact_output = ANGLES.stop
    *other_blocks, last_blocks = find_blocks([*other_weights, last_weight], n_contact_output)

    # The hidden layers
    first_weight = convert_input_weights(first_layer.weight)
    hidden = [
        LayerSource("layer_0", first_weight, _to_single_precision(first_layer.bias), activation=perceptron.activation)
    ]
    for layer, weight, blocks in zip(other_layers, other_weights, other_blocks, strict=True):
        name = f"layer_{len(hidden)}"
        bias = _to_single_precision(layer.bias)
        hidden.append(LayerSource(name, weight, bias, blocks, activation=perceptron.activation))

    # The skip layer and the output layer. The bias of the output layer is added with the skip layer.
    skip = LayerSource("skip", convert_input_weights(perceptron.skip), _to_single_precision(perceptron.last.bias))
    last = LayerSource("last", last_weight, blocks=last_blocks)
    return hidden, skip, last


def self_test(golden: Golden, metadata: ModelMetadata) -> str:
    """Return the text of `self_test.c`, which contains golden vectors, their tolerances and their flags.

    Args:
        golden: Golden vectors of the model.
        metadata: Metadata of the model.
    """
    answers = np.concatenate([golden.outputs[name] for name in COLUMNS], axis=1)
    contacts = Contacts(*answers.T)
    flags = [sum(FLAG_BITS[flag] for flag in words) for words in Validity.of(metadata).batch_flags(contacts)]
    floors = np.array([floor for name in COLUMNS for floor in golden.floors[name]], np.float32)
    return source_text(
        "self_test.c",
        vectors=len(answers),
        numbers=answers.shape[1],
        relative=c_float(golden.relative_tolerance),
        floors=c_array("FLOOR", floors),
        charges=c_array("CHARGE_PC", golden.charge_pC),
        contacts=c_array("CONTACT", answers),
        flags=c_array("FLAGS", np.array(flags, np.uint32)),
    )


def _features_source(features: ChargeFeatures) -> str:
    """Return the text of the C function `features`, which computes the inputs of the first layer from the charges.

    Logarithmic features have the same limits for all electrodes. Features of charges of both signs have limits and a
    mean for each electrode.

    Args:
        features: Typical charges, limits and means of the features.
    """
    factor = _to_single_precision(1.0 / features.typical_pC)
    if features.mean is None:
        return source_text(
            "features.c",
            arrays=c_array("FACTOR", factor),
            electrodes=features.n_electrode,
            low=c_float(features.low_pC.item()),
            high=c_float(features.high_pC.item()),
        )
    arrays = [
        c_array("FACTOR", factor),
        c_array("LOW", _to_single_precision(features.low_pC)),
        c_array("HIGH", _to_single_precision(features.high_pC)),
        c_array("MEAN", _to_single_precision(features.mean)),
    ]
    return source_text("features_signed.c", arrays="\n".join(arrays), electrodes=features.n_electrode)


def _to_single_precision(values: Array) -> Singles:
    """Convert values to single precision."""
    return np.asarray(values, dtype=np.float32)


def _convert_to_differences(weight: Array) -> Singles:
    """Convert weights of (ln q_0, ln q_1, ...) into weights of (ln q_0, ln(q_1 / q_0), ...) that give the same sums.

    The equation in the docstring of the module shows that only the weights of ln q_0 change.

    Args:
        weight: Weights of the logarithms, shape (inputs, outputs).

    Returns:
        Weights of the first logarithm and of the logarithms of the ratios, same shape, float32.
    """
    new_weight = np.array(weight)
    new_weight[0] = weight.sum(axis=0)
    return new_weight.astype(np.float32)
