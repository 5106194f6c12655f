"""Generator of the files `isocharge_model.h`, `isocharge_model.c` and `self_test.c` of a model.

Features
--------

In C, the inputs of the first layer are the logarithm of one charge, ln q_0, and the logarithms ln(q_k / q_0) for the
other charges q_k. With these inputs, the network remains the same function of the charges, but the rounding errors are
smaller. The force changes all charges of a film together, and the position changes the ratios of the charges. The first
layer of a trained network therefore has large weights of both signs. The logarithms are nearly equal, so that the terms
of the sums in this layer nearly cancel:

    sum_k w_k ln q_k = (sum_k w_k) ln q_0 + sum_k w_k ln(q_k / q_0).

On the right-hand side, the charges are subtracted before a logarithm is computed, because ln(q_k / q_0) is computed as
log1p((q_k - q_0) / q_0). The difference of two charges is exact if their ratio is at most two (Sterbenz 1974). If the
difference is exact, all digits of the logarithm are correct. On the left-hand side, the logarithms are larger, and
their last digits are lost in the sums.

Layers
------

A layer computes its outputs y = f(x W + c) from its inputs x. W are the weights, shape (inputs, outputs), c is the
bias, and f is the hyperbolic tangent or the identity. The C function processes four inputs at a time, so that it reads
and writes each output less often. Each input is multiplied by its row of W, which gives one product for each output.
Each product is added to the sum of its output. The inner loop of the C function runs over neighbouring outputs, and its
number of iterations is constant. With -O2 or a higher level of optimisation, compilers therefore vectorise the loop
without changing the order of any sum. Each weight that the training rounded to 8 bits is stored in one byte.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from isocharge.common.arrays import Array, Singles
from isocharge.serve.flags import BEYOND, MISFIT, OUTSIDE, STRESS
from isocharge.serve.model.contact import MISFIT_LIMIT, Contact, Contacts, Validity
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import COLUMNS, Golden
from isocharge.train.data.channel_noise import LARGEST_LOGARITHM
from isocharge.train.export_c.c_text import (
    c_array,
    c_comment,
    c_float,
    c_numbers,
    c_string,
    c_type,
    source_text,
)
from isocharge.train.training.folded_network import (
    ANGLES,
    COSINES_TO_CORRELATIONS,
    LARGEST_INT8,
    LOG_STD,
    POSITION,
    ChargeFeatures,
    FoldedNetwork,
    Perceptron,
)


def layer_source(name: str, weight: Array, bias: Array | None = None, activation: str = "") -> str:
    """Return C source that defines a layer: its constant arrays, and the function `void name(x, y)`.

    The C function computes the outputs y = f(x W + c) from the inputs x, and adds c last. If a large c were added
    first, the intermediate sums would lose accuracy.

    Args:
        name: Name of the function.
        weight: Weights W, shape (inputs, outputs).
        bias: Bias c, shape (outputs,); None for no bias.
        activation: Name of the C function f; empty for the identity.
    """
    n_input, n_output = weight.shape
    # The values are integers with a scale for each output, or the unchanged weights without a scale (None).
    values, scale = round_to_int8(weight.astype(np.float32))
    arrays = [c_array(f"{name}_weights", values)]

    # C expression for output j. At first, y[j] contains the sum of the products for this output. If the weights are
    # integers, the sum is multiplied by the scale of its column.
    output_expression = "y[j]"
    if scale is not None:
        arrays.append(c_array(f"{name}_scale", scale))
        output_expression += f" * {name}_scale[j]"
    if bias is not None:
        arrays.append(c_array(f"{name}_bias", bias))
        output_expression += f" + {name}_bias[j]"
    return source_text(
        "layer.c",
        name=name,
        arrays="\n".join(arrays),
        number_type=c_type(values),
        n_input=n_input,
        n_grouped=n_input - n_input % 4,  # inputs that are processed four at a time
        n_output=n_output,
        output_expression=f"{activation}({output_expression})",
    )


def round_to_int8(values: Singles) -> tuple[NDArray[Any], Singles | None]:
    """Convert weights to 8-bit integers if the weights of each column are multiples of one number, the scale.

    The scale of a column is its largest absolute weight divided by `LARGEST_INT8`. If the training
    has rounded the weights, they are multiples of the scale. This function does not round other weights.

    Args:
        values: Weights, shape (inputs, outputs).

    Returns:
        Integers and the scales, shape (outputs,). If some weights are not multiples of the scale, the unchanged weights
        and None.
    """
    scale = np.abs(values).max(axis=0) / np.float32(LARGEST_INT8)
    nonzero_scale = np.where(scale > 0.0, scale, 1.0)  # a column of zeros has the scale 0
    multiples = np.round(values / nonzero_scale)  # whole numbers, even if the division rounds
    if np.allclose(multiples * scale, values, atol=0.0):
        return multiples.astype(np.int8), scale
    return values, None


FLAG_BITS = {OUTSIDE: 0x100, BEYOND: 0x200, MISFIT: 0x400, STRESS: 0x800}
"""Bits of the flags that the C function `isocharge_flags` returns."""


def model_header(metadata: ModelMetadata, network: FoldedNetwork) -> str:
    """Return the text of `isocharge_model.h`.

    Args:
        metadata: Metadata of the model.
        network: The network of the model.
    """
    # The template of the file contains a placeholder for each of the arguments of `source_text`.
    features = network.features
    is_logarithmic = features.mean is None  # only features of charges of both signs have a mean
    validity = Validity.of(metadata)
    min_force_N, max_force_N = validity.force_range_N
    centre_x_mm, centre_y_mm = validity.centre_mm
    # Beyond these limits, an answer of the model cannot be a measurement.
    squared_distance_mm2, implausible_force_N = validity.implausible_limits
    return source_text(
        "isocharge_model.h",
        label_comment=c_comment(metadata.label),
        label_string=c_string(metadata.label),
        sensor=c_string(metadata.frame_id),
        electrode_count=len(metadata.electrodes),
        electrode_names=", ".join(map(c_string, metadata.electrodes)),
        field_names=", ".join(f'"{name}"' for name in Contact._fields),
        field_count=len(Contact._fields),
        corner_count=len(validity.corners_mm),
        corners=c_numbers(validity.corners_mm),
        min_force=c_float(min_force_N),
        max_force=c_float(max_force_N),
        misfit_limit=c_float(validity.misfit_limit),
        yield_force=c_float(validity.yield_force_N),
        centre_x=c_float(centre_x_mm),
        centre_y=c_float(centre_y_mm),
        beyond_mm=c_float(math.sqrt(squared_distance_mm2)),
        beyond_N=c_float(implausible_force_N),
        # A comment in the file states the limits of the charges. Limits for each electrode are the arrays LOW and HIGH.
        low=f"{features.low_pC:g}" if is_logarithmic else "LOW",
        high=f"{features.high_pC:g}" if is_logarithmic else "HIGH (isocharge_model.c)",
    )


def model_source(metadata: ModelMetadata, network: FoldedNetwork) -> str:
    """Return the text of `isocharge_model.c`.

    Args:
        metadata: Metadata of the model. The label of the model appears in a comment.
        network: The network.
    """
    # The template of the file contains a placeholder for each of these arguments. The arguments `plane`, `logs`
    # and `known` are the numbers of outputs of the last layer up to the position, up to the standard deviations, and up
    # to the angles of the correlations.
    features = network.features
    return source_text(
        "isocharge_model.c",
        label=c_comment(metadata.label),
        features=_features_source(features),
        contact=_perceptron_source("contact", network.contact, features),
        misfit=_perceptron_source("misfit", network.misfit, features),
        electrodes=features.n_electrode,
        plane=POSITION.stop,
        logs=LOG_STD.stop,
        largest_logarithm=c_float(LARGEST_LOGARITHM),
        known=ANGLES.stop,
        answers=ANGLES.stop + features.n_electrode,
        table=c_array("COSINES", COSINES_TO_CORRELATIONS),
        cosines=len(COSINES_TO_CORRELATIONS),
        first=ANGLES.start,
        misfit_unit=c_float(MISFIT_LIMIT),
    )


def _perceptron_source(name: str, perceptron: Perceptron, features: ChargeFeatures) -> str:
    """Return C source that defines the layers of a perceptron and the function `void name_answers(logs, answers)`.

    The first hidden layer and the skip layer read the features from `logs`. The hidden layers write alternately to two
    rows of a buffer, and each layer reads the row that the layer before it wrote. If the features are logarithms, the
    weights of the first layer and of the skip layer are changed by `_convert_to_differences`. Otherwise, the array
    `logs` contains inverse hyperbolic sines.

    Args:
        name: Beginning of the names of the C functions.
        perceptron: The perceptron.
        features: Features of the network.
    """
    (first_weight, first_bias), *later = perceptron.hidden
    skip_weight = perceptron.skip
    if features.mean is None:  # logarithms of positive charges
        first_weight = _convert_to_differences(first_weight)
        skip_weight = _convert_to_differences(skip_weight)

    layers = []
    calls = []
    row = "logs"
    for index, (weight, bias) in enumerate([(first_weight, first_bias), *later]):
        layers.append(layer_source(f"{name}_{index}", weight, bias, activation="tanh_of"))
        next_row = f"rows[{index % 2}]"
        calls.append(f"{name}_{index}({row}, {next_row});")
        row = next_row

    # The bias of the output layer is added with the skip layer.
    layers.append(layer_source(f"{name}_skip", skip_weight, perceptron.last.bias))
    layers.append(layer_source(f"{name}_last", perceptron.last.weight))
    return source_text(
        "perceptron.c",
        name=name,
        layers="\n".join(layers),
        calls="\n    ".join(calls),
        last_row=row,
        widest=max(bias.size for _, bias in perceptron.hidden),
        n_answer=perceptron.last.bias.size,
    )


def self_test(golden: Golden, metadata: ModelMetadata) -> str:
    """Return the text of `self_test.c`, which contains golden vectors, their tolerances and their flags.

    The C program compares its own answers to the charges with the stored answers. It accepts differences up to
    `relative` times the larger of two numbers: the magnitude of the stored number, and the floor of its column.

    Args:
        golden: Golden vectors of the model, which are charges and the answers to them.
        metadata: Metadata of the model.
    """
    answers = np.concatenate([golden.outputs[name] for name in COLUMNS], axis=1).astype(np.float32)
    contacts = Contacts(*answers.T)  # one array for each column
    flag_bits = [  # one integer for each answer, the sum of the bits of its flags
        sum(FLAG_BITS[flag] for flag in answer_flags) for answer_flags in Validity.of(metadata).batch_flags(contacts)
    ]
    floors = np.concatenate([golden.tolerance.floor[name] for name in COLUMNS])
    return source_text(
        "self_test.c",
        vector_count=len(answers),
        number_count=answers.shape[1],
        relative=c_float(golden.tolerance.relative),
        floors=c_array("FLOOR", floors),
        charges=c_array("CHARGE_PC", golden.charge_pC),
        contacts=c_array("CONTACT", answers),
        flags=c_array("FLAGS", np.array(flag_bits, np.uint32)),
    )


def _features_source(features: ChargeFeatures) -> str:
    """Return the text of the C function `features`, which computes the inputs of the first layer from the charges.

    Args:
        features: Typical charges, limits and means of the features.
    """
    arrays = {"FACTOR": 1.0 / features.typical_pC, "LOW": features.low_pC, "HIGH": features.high_pC}
    template = "features.c"
    if features.mean is not None:  # the charges may have both signs
        arrays["MEAN"] = features.mean
        template = "features_signed.c"
    n_electrode = features.n_electrode
    texts = [c_array(name, np.broadcast_to(values, n_electrode)) for name, values in arrays.items()]
    return source_text(template, arrays="\n".join(texts), electrodes=n_electrode)


def _convert_to_differences(weight: Array) -> Array:
    """Convert weights of (ln q_0, ln q_1, ...) into weights of (ln q_0, ln(q_1 / q_0), ...) that give the same sums.

    The equation in the docstring of the module shows that only the weights of ln q_0 change.

    Args:
        weight: Weights of the logarithms, shape (inputs, outputs).

    Returns:
        Weights of the first logarithm and of the logarithms of the ratios, same shape.
    """
    return np.vstack([weight.sum(axis=0), weight[1:]])
