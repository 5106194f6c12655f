"""The files `isocharge_model.h`, `isocharge_model.c` and `self_test.c` of a model.

The first layer gets the logarithm of one charge and the differences of the other logarithms from it. The result is the
same function of the charges, but with smaller rounding errors. The charges of a film rise and fall together, and the
position changes their ratios. A first layer therefore has large weights of both signs on logarithms that are nearly
equal, and its sums nearly cancel:

    sum_k w_k ln q_k = (sum_k w_k) ln q_0 + sum_k w_k ln(q_k / q_0).

On the right-hand side the subtraction comes first. The difference of two charges is exact if their ratio is at most two
(Sterbenz 1974). The logarithm of 1 + (q_k - q_0) / q_0 therefore has all its digits. The logarithm of a charge is
larger, so its last digits are lost in the sums.
"""

from itertools import cycle, islice, pairwise

import numpy as np

from isocharge.common.arrays import Array, Singles
from isocharge.common.charge_features import ChargeFeatures
from isocharge.serve import Contact, ModelMetadata
from isocharge.serve.model.golden import Golden
from isocharge.serve.model.session import CORRELATION, N_WITHOUT_CORRELATION
from isocharge.train.export_c.c_text import c_array, c_comment, c_float, c_string, source_text
from isocharge.train.export_c.layer_source import LayerSource, find_blocks
from isocharge.train.training.folded_network import (
    COSINES_TO_CORRELATIONS,
    LOG_STD,
    MISFIT_UNIT,
    POSITION,
    FoldedNetwork,
)


def model_header(metadata: ModelMetadata, network: FoldedNetwork) -> str:
    """Return the text of `isocharge_model.h`."""
    features = network.features
    is_logarithmic = features.mean is None
    n_number = _contact_size(network)
    return source_text(
        "isocharge_model.h",
        label=c_comment(metadata.label),
        model=c_string(metadata.label),
        sensor=c_string(metadata.frame_id),
        electrodes=len(metadata.electrodes),
        names=", ".join(map(c_string, metadata.electrodes)),
        fields=", ".join(f'"{name}"' for name in Contact._fields[:n_number]),
        numbers=n_number,
        all=source_text("isocharge_all.h") if network.n_angle else "",
        low=f"{features.low_pC:g}" if is_logarithmic else "LOW",
        high=f"{features.high_pC:g}" if is_logarithmic else "HIGH (isocharge_model.c)",
    )


def model_source(metadata: ModelMetadata, network: FoldedNetwork) -> str:
    """Return the text of `isocharge_model.c`.

    Args:
        metadata: Metadata of the model. The label of the model appears in a comment.
        network: The network.
    """
    hidden, skip, last = _layer_sources(network)
    activation = network.layers.activation
    widest = max(layer.weight.shape[1] for layer in hidden)

    # The hidden layers read and write two buffers alternately; the first one reads the logarithms of the charges.
    buffers = ["logs", *islice(cycle(["one", "other"]), len(hidden))]
    calls = []
    for layer, (input_buffer, output_buffer) in zip(hidden, pairwise(buffers), strict=True):
        calls.append(f"{layer.name}({input_buffer}, {layer.name}_bias, {output_buffer});")
    calls.append(f"skip({buffers[0]}, skip_bias, skipped);")
    calls.append(f"last({buffers[-1]}, skipped, answers);")
    hidden_buffers = dict.fromkeys(buffers[1:])  # each name once, in order
    return source_text(
        "isocharge_model.c",
        label=c_comment(metadata.label),
        activation=activation.c_source,
        features=_features_source(network.features),
        layers="\n".join(layer.text() for layer in (*hidden, skip, last)),
        rows=", ".join(f"{buffer}[{widest}]" for buffer in hidden_buffers),
        calls="\n    ".join(calls),
        electrodes=network.features.n_electrode,
        plane=POSITION.stop,
        logs=LOG_STD.stop,
        known=network.angle_columns.stop,
        answers=last.weight.shape[1],
        all=_correlations_source(network) if network.n_angle else "",
        misfit_unit=c_float(MISFIT_UNIT),
    )


def _layer_sources(network: FoldedNetwork) -> tuple[list[LayerSource], LayerSource, LayerSource]:
    """Return the hidden layers, the skip layer and the output layer of a network.

    The weights are single-precision numbers. If the features are logarithms, the layers that read the features are
    changed by `_weights_on_differences`.

    Args:
        network: The network.
    """
    perceptron = network.layers
    is_logarithmic = network.features.mean is None
    weights_on_inputs = _weights_on_differences if is_logarithmic else _single_precision
    first, *others = perceptron.hidden
    other_weights = [_single_precision(layer.weight) for layer in others]
    last_weight = _single_precision(perceptron.last.weight)
    # The outputs before the misfit vector belong to the contact perceptron.
    n_contact_output = network.angle_columns.stop
    *other_blocks, last_blocks = find_blocks([*other_weights, last_weight], n_contact_output)

    first_weight = weights_on_inputs(first.weight)
    hidden = [LayerSource("layer_0", first_weight, _single_precision(first.bias), activation=perceptron.activation)]
    for layer, weight, blocks in zip(others, other_weights, other_blocks, strict=True):
        name = f"layer_{len(hidden)}"
        bias = _single_precision(layer.bias)
        hidden.append(LayerSource(name, weight, bias, blocks, perceptron.activation))
    # The bias of the output layer is added with the skip layer.
    skip = LayerSource("skip", weights_on_inputs(perceptron.skip), _single_precision(perceptron.last.bias))
    last = LayerSource("last", last_weight, blocks=last_blocks)
    return hidden, skip, last


def _contact_size(network: FoldedNetwork) -> int:
    """Return the number of fields of a `Contact` that a network computes."""
    return len(Contact._fields) if network.n_angle else N_WITHOUT_CORRELATION


def _correlations_source(network: FoldedNetwork) -> str:
    """Return the C function that computes the correlations as well."""
    text = source_text(
        "isocharge_all.c",
        table=c_array("COSINES", COSINES_TO_CORRELATIONS.astype(np.float32)),
        cosines=network.n_angle,
        first=network.angle_columns.start,
        answers=network.layers.skip.shape[1],
    )
    return f"\n{text}"


def self_test(golden: Golden) -> str:
    """Return the text of `self_test.c`, which contains golden vectors and their tolerances."""
    # A Contact ends with the correlations. False is sorted before True, and other names keep their order.
    names = sorted(golden.outputs, key=lambda name: name == CORRELATION)
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


def _features_source(features: ChargeFeatures) -> str:
    """Return the C function `features`, which computes the inputs of the first layer from the charges.

    Logarithmic features have the same limits for all electrodes. Features of charges of both signs have limits and a
    mean for each electrode.

    Args:
        features: Typical charges, limits and means of the features.
    """
    factor = _single_precision(1.0 / features.typical_pC)
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
        c_array("LOW", _single_precision(features.low_pC)),
        c_array("HIGH", _single_precision(features.high_pC)),
        c_array("MEAN", _single_precision(features.mean)),
    ]
    return source_text("features_signed.c", arrays="\n".join(arrays), electrodes=features.n_electrode)


def _single_precision(values: Array) -> Singles:
    """Return values in single precision."""
    return np.asarray(values, dtype=np.float32)


def _weights_on_differences(weight: Array) -> Singles:
    """Return weights on (ln q_0, ln(q_1 / q_0), ...) that give the same sums as weights on (ln q_0, ln q_1, ...).

    The equation in the description of this module shows that only the weights on ln q_0 change.

    Args:
        weight: Weights on the logarithms, shape (inputs, outputs).

    Returns:
        Weights on the first logarithm and on the differences from it, same shape.
    """
    changed = np.array(weight)
    changed[0] = weight.sum(axis=0)
    return changed.astype(np.float32)
