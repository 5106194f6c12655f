"""`isocharge_model.h`, `isocharge_model.c` and `self_test.c` of a model.

The first layer takes one logarithm of the charges and the others' distances from it: the same function, with less
rounding. The charges of a film rise and fall together, and position is in what tells them apart. So a first layer has
large weights of both signs on logarithms that are nearly equal, and its sums nearly cancel:

    sum_k w_k ln q_k = (sum_k w_k) ln q_0 + sum_k w_k ln(q_k / q_0).

On the right the subtraction comes first. The difference of two charges within a factor of two is exact (Sterbenz 1974),
and the logarithm of 1 + (q_k - q_0) / q_0 has all its digits, where that of a charge has lost some to its size.
"""

from itertools import cycle, islice, pairwise

import numpy as np

from isocharge.common.arrays import Singles
from isocharge.serve import Contact
from isocharge.serve.model.golden import Golden
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import OUTPUTS
from isocharge.train.export_c.c_text import c_array, c_comment, c_float, c_string, source_text
from isocharge.train.export_c.layer import Layer, blocks_of
from isocharge.train.export_c.network import LOGS, PLANE, Network


def model_header(metadata: ModelMetadata, network: Network) -> str:
    """The text of `isocharge_model.h`."""
    return source_text(
        "isocharge_model.h",
        label=c_comment(metadata.label),
        model=c_string(metadata.label),
        sensor=c_string(metadata.frame_id),
        electrodes=len(metadata.electrodes),
        names=", ".join(map(c_string, metadata.electrodes)),
        fields=", ".join(f'"{name}"' for name in Contact._fields),
        low=f"{network.low:g}",
        high=f"{network.high:g}",
    )


def model_source(metadata: ModelMetadata, network: Network) -> str:
    """The text of `isocharge_model.c`."""
    (weights, bias), *behind = network.hidden
    *blocks, of_last = blocks_of([*(weights for weights, _ in behind), network.last], PLANE + LOGS)
    hidden = [Layer("layer_0", _of_differences(weights), bias, activation="tanh_of")]
    hidden += [
        Layer(f"layer_{number}", weights, bias, parts, "tanh_of")
        for number, ((weights, bias), parts) in enumerate(zip(behind, blocks, strict=True), 1)
    ]
    skip = Layer("skip", _of_differences(network.skip[0]), network.skip[1])
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
        factor=c_array("FACTOR", network.factor),
        layers="\n".join(layer.text() for layer in (*hidden, skip, Layer("last", network.last, None, of_last))),
        rows=", ".join(f"{row}[{width}]" for row in dict.fromkeys(rows[1:])),
        calls="\n    ".join(calls),
        electrodes=network.factor.size,
        low=c_float(network.low),
        high=c_float(network.high),
        plane=PLANE,
        known=PLANE + LOGS,
        answers=network.last.shape[1],
        misfit_unit=c_float(network.misfit_unit),
    )


def self_test(golden: Golden) -> str:
    """The text of `self_test.c`: golden vectors, and how far an answer may be from them."""
    answers = np.concatenate([golden.outputs[name] for name in OUTPUTS], axis=1)
    floors = np.array([floor for name in OUTPUTS for floor in golden.floors[name]], np.float32)
    return source_text(
        "self_test.c",
        vectors=len(answers),
        relative=c_float(golden.relative),
        floors=c_array("FLOOR", floors),
        charges=c_array("CHARGE_PC", golden.charge_pC),
        contacts=c_array("CONTACT", answers),
    )


def _of_differences(weights: Singles) -> Singles:
    """Weights on (ln q_0, ln(q_1 / q_0), ...) instead of on the logarithms."""
    values = weights.astype(np.float64)
    values[0] = values.sum(axis=0)
    return values.astype(np.float32)
