"""`isocharge_model.h`, `isocharge_model.c` and `self_test.c` of a model.

A layer has weights as (inputs, outputs), a few rows at a time added to all outputs: the inner loop runs over
neighbouring outputs and a constant count, so compilers work on several at once from -O2 on without changing the order
of any sum. Two perceptrons that run side by side have two blocks of weights; the zeros beside them are left out.
Weights that training rounded to 8 bits take a byte each.

The first layer takes one logarithm of the charges and the others' distances from it: the same function, with less
rounding. The charges of a film rise and fall together, and position is in what tells them apart. So a first layer has
large weights of both signs on logarithms that are nearly equal, and its sums nearly cancel:

    sum_k w_k ln q_k = (sum_k w_k) ln q_0 + sum_k w_k ln(q_k / q_0).

On the right the subtraction comes first. The difference of two charges within a factor of two is exact (Sterbenz 1974),
and the logarithm of 1 + (q_k - q_0) / q_0 has all its digits, where that of a charge has lost some to its size.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, cycle, islice, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Singles
from isocharge.serve import Contact, ModelMetadata
from isocharge.serve.model.golden import Golden
from isocharge.serve.model.session import CORRELATION, SEVEN
from isocharge.train.export_c.c_text import c_array, c_comment, c_float, c_string, source_text
from isocharge.train.export_c.network import LOGS, PLANE, Network

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


def model_header(metadata: ModelMetadata, network: Network) -> str:
    """The text of `isocharge_model.h`."""
    return source_text(
        "isocharge_model.h",
        label=c_comment(metadata.label),
        model=c_string(metadata.label),
        sensor=c_string(metadata.frame_id),
        electrodes=len(metadata.electrodes),
        names=", ".join(map(c_string, metadata.electrodes)),
        fields=", ".join(f'"{name}"' for name in Contact._fields[: _numbers(network)]),
        numbers=_numbers(network),
        all=source_text("isocharge_all.h") if len(network.cosines) else "",
        low=f"{network.low:g}" if network.mean is None else "LOW",
        high=f"{network.high:g}" if network.mean is None else "HIGH (isocharge_model.c)",
    )


def model_source(metadata: ModelMetadata, network: Network) -> str:
    """The text of `isocharge_model.c`."""
    (weights, bias), *behind = network.hidden
    *blocks, of_last = blocks_of([*(weights for weights, _ in behind), network.last], network.known)
    as_inputs = _of_differences if network.mean is None else np.asarray
    hidden = [Layer("layer_0", as_inputs(weights), bias, activation="tanh_of")]
    hidden += [
        Layer(f"layer_{number}", weights, bias, parts, "tanh_of")
        for number, ((weights, bias), parts) in enumerate(zip(behind, blocks, strict=True), 1)
    ]
    skip = Layer("skip", as_inputs(network.skip[0]), network.skip[1])
    rows = ["logs", *islice(cycle(["one", "other"]), len(hidden))]
    calls = [
        *(f"{layer.name}({x}, {layer.name}_bias, {y});" for layer, (x, y) in zip(hidden, pairwise(rows), strict=True)),
        "skip(logs, skip_bias, skipped);",
        f"last({rows[-1]}, skipped, answers);",
    ]
    width = max(len(bias) for _, bias in network.hidden)
    return source_text(
        "isocharge_model.c",
        label=c_comment(metadata.label),
        features=_features(network),
        layers="\n".join(layer.text() for layer in (*hidden, skip, Layer("last", network.last, None, of_last))),
        rows=", ".join(f"{row}[{width}]" for row in dict.fromkeys(rows[1:])),
        calls="\n    ".join(calls),
        electrodes=network.factor.size,
        plane=PLANE,
        logs=PLANE + LOGS,
        known=network.known,
        answers=network.last.shape[1],
        all=_all_source(network) if len(network.cosines) else "",
        misfit_unit=c_float(network.misfit_unit),
    )


def _numbers(network: Network) -> int:
    """Numbers of a Contact that a model gives."""
    return len(Contact._fields) if len(network.cosines) else SEVEN


def _all_source(network: Network) -> str:
    """The function that gives the correlations, too."""
    table, (_, answers) = c_array("COSINES", network.cosines), network.last.shape
    values = {"table": table, "cosines": len(network.cosines), "first": PLANE + LOGS, "answers": answers}
    return "\n" + source_text("isocharge_all.c", **values)


def self_test(golden: Golden) -> str:
    """The text of `self_test.c`: golden vectors, and how far an answer may be from them."""
    names = sorted(golden.outputs, key=CORRELATION.__eq__)  # the order of a Contact
    answers = np.concatenate([golden.outputs[name] for name in names], axis=1)
    floors = np.array([floor for name in names for floor in golden.floors[name]], np.float32)
    return source_text(
        "self_test.c",
        vectors=len(answers),
        numbers=answers.shape[1],
        function="isocharge_predict_all" if CORRELATION in names else "isocharge_predict",
        relative=c_float(golden.relative),
        floors=c_array("FLOOR", floors),
        charges=c_array("CHARGE_PC", golden.charge_pC),
        contacts=c_array("CONTACT", answers),
    )


def _features(network: Network) -> str:
    """The function `features`: from charges to what the first layer takes."""
    arrays = {"FACTOR": network.factor}
    if network.mean is not None:
        arrays |= {"LOW": network.low, "HIGH": network.high, "MEAN": network.mean}
        return source_text("features_signed.c", arrays=_arrays(arrays), electrodes=network.factor.size)
    low, high = c_float(network.low.item()), c_float(network.high.item())
    return source_text("features.c", arrays=_arrays(arrays), electrodes=network.factor.size, low=low, high=high)


def _arrays(arrays: Mapping[str, Singles]) -> str:
    return "\n".join(c_array(name, values) for name, values in arrays.items())


def _of_differences(weights: Singles) -> Singles:
    """Weights on (ln q_0, ln(q_1 / q_0), ...) instead of on the logarithms."""
    values = weights.astype(np.float64)
    values[0] = values.sum(axis=0)
    return values.astype(np.float32)
