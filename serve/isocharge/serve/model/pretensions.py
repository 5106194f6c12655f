"""The file `pretensions.npz` of a calibrated model: the weights of its network at several pretensions of the film.

    about                JSON: the numbers of `Pretensions`, and the names of the weights in the order of the layers
    node_MPa             pretensions at which the weights are given, including the pretension of the calibration
    typical_pC           charges by which the charges are divided before the logarithm
    <constant>           values of the constant of the graph with this name, at each of these pretensions

Between these pretensions, the weights are interpolated by a polynomial. All pretensions use the same graph,
`model.onnx`. Only the constants of the graph differ. A prediction therefore takes the same time at every pretension.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.activations import ACTIVATIONS, TANH
from isocharge.common.arrays import Array, Singles
from isocharge.common.charge_features import ChargeFeatures
from isocharge.common.errors import ModelError, cut
from isocharge.common.npz import DAMAGED_FILE_ERRORS, finite_array, npz_arrays, text_item
from isocharge.common.perceptron import Layer, Perceptron, evaluate
from isocharge.common.structs import NotNegative, Positive, Text, parse_json
from isocharge.serve.model.companion_files import read_companion_file

FILE = "pretensions.npz"
"""Name of the file in a version folder."""

FORMAT = 1
"""Version of the format of the file."""

MAX_CONSTANTS = 100
"""Largest number of weight arrays."""

MAX_NODES = 50
"""Largest number of pretensions at which weights are given."""

MAX_PRETENSION_MPa = 50.0
"""Largest pretension, MPa; PVDF yields at about 45 MPa."""

MAX_WEIGHT = 1e6
"""Largest absolute value of a weight. The weights of trained networks are below 100."""

CALIBRATION_ADVICE = (
    "a film is followed from a model that `isocharge train calibrate` made of presses on it, with four electrodes "
    "or more: calibrate it, or again with this version"
)
"""Advice to the user if the file cannot be read."""

CHECKED_PRETENSIONS = 50
"""Number of pretensions at which the misfits of a file are checked to be finite."""

MIN_NODE_DISTANCE_MPa = 1e-3
"""Smallest distance of two pretensions for which the interpolation is well conditioned, MPa."""

MIN_LENGTH = 1e-12
"""Smallest length of a misfit vector. It prevents a division by zero."""


@dataclass(frozen=True, kw_only=True)
class Pretensions:
    """Network of one film for every pretension within a range.

    Attributes:
        node_MPa: Pretensions at which the weights are given, shape (k,), MPa, in ascending order.
        calibrated_MPa: Pretension that the calibration estimated, MPa; one of `node_MPa`.
        std_MPa: Standard deviation of the pretension when a stream begins, MPa. It includes the uncertainty of the
            calibration and of the drift since then.
        floor_MPa: Smallest standard deviation that an estimate from many touches reaches, MPa. Errors of the other
            parameters of the film cause it.
        misfit_rms: Root mean square of the misfits of good touches, in standard deviations of the noise.
        misfit_unit: Scale of the misfit: misfit = misfit_unit * sinh(|misfit vector|).
        limits_pC: Smallest and largest charge, pC. Charges outside this range are clipped.
        typical_pC: Charge by which each charge is divided before the logarithm, shape (n_electrode,), pC.
        weights: Arrays of the layers by the names of the constants in the graph, float32, in this order: weight, shape
            (k, n_input, n_output), and bias, shape (k, n_output), of each hidden layer; weight of the skip layer,
            shape (k, n_electrode, n_answer); bias and weight of the output layer.
        activation: Name of the activation of the hidden layers.
    """

    node_MPa: Array
    calibrated_MPa: float
    std_MPa: float
    floor_MPa: float
    misfit_rms: float
    misfit_unit: float
    limits_pC: tuple[float, float]
    typical_pC: Array
    weights: Mapping[str, Singles]
    activation: str = TANH.name

    def to_bytes(self) -> bytes:
        """Return the content of the file `pretensions.npz`.

        The file contains the pretensions, the typical charges and the weights as arrays. A JSON object with the name
        `about` contains all other numbers, and the names of the weights in the order of the layers.
        """
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        constant_names = list(self.weights)  # the weights are constants of the graph
        about = json.dumps({"format_version": FORMAT, "constants": constant_names, **numbers}, allow_nan=False)
        arrays: dict[str, Any] = {"node_MPa": self.node_MPa, "typical_pC": self.typical_pC, **self.weights}
        file = io.BytesIO()
        np.savez_compressed(file, about=np.array(about), **arrays)
        return file.getvalue()

    @property
    def range_MPa(self) -> tuple[float, float]:
        """Smallest and largest pretension, MPa."""
        return float(self.node_MPa[0]), float(self.node_MPa[-1])

    @property
    def features(self) -> ChargeFeatures:
        """Input features of the network."""
        low_pC, high_pC = self.limits_pC
        return ChargeFeatures(self.typical_pC, np.array(low_pC), np.array(high_pC))

    @property
    def perceptron(self) -> Perceptron[Singles]:
        """Perceptrons of all k pretensions. The weights of a layer have the shape (k, n_input, n_output)."""
        *hidden_arrays, skip, bias, weight = self.weights.values()
        hidden = [
            Layer(hidden_weight, hidden_bias[:, None])
            for hidden_weight, hidden_bias in zip(hidden_arrays[::2], hidden_arrays[1::2], strict=True)
        ]
        return Perceptron(tuple(hidden), Layer(weight, bias[:, None]), skip, ACTIVATIONS[self.activation])

    def interpolation_weights(self, pretension_MPa: Array) -> Array:
        """Return the weights of the interpolation between the values at the k pretensions `node_MPa`.

        The weights are the Lagrange polynomials. The weight of node i is the product of (p - p_j) / (p_i - p_j) over
        all j other than i.

        Args:
            pretension_MPa: Pretensions p, shape (n,), MPa.

        Returns:
            Weights, shape (n, k), dimensionless. Each row sums to 1.
        """
        is_other_node = ~np.eye(self.node_MPa.size, dtype=bool)  # shape (k, k), False where i equals j
        node_difference_MPa = self.node_MPa[:, None] - self.node_MPa  # p_i - p_j, shape (k, k)
        difference_MPa = pretension_MPa[:, None, None] - self.node_MPa  # p - p_j, shape (n, 1, k)

        # The factors with i equal to j are no part of the product. Their denominator is replaced, because it is 0.
        denominator_MPa = np.where(is_other_node, node_difference_MPa, 1.0)
        factors = difference_MPa / denominator_MPa  # shape (n, k nodes i, k nodes j)
        return np.asarray(np.prod(factors, axis=2, where=is_other_node))

    def at(self, node_MPa: Array) -> "Pretensions":
        """Return the same network with interpolated weights, which belong to other pretensions.

        Args:
            node_MPa: Pretensions within `range_MPa`, shape (k,), MPa, in ascending order.
        """
        factors = self.interpolation_weights(node_MPa)
        weights = {name: np.tensordot(factors, rows, axes=1).astype(np.float32) for name, rows in self.weights.items()}
        return replace(self, node_MPa=node_MPa, weights=weights)

    def constants(self, pretension_MPa: float) -> dict[str, Singles]:
        """Return a dictionary of the constants of the graph at one pretension within `range_MPa`."""
        single = self.at(np.array([pretension_MPa]))
        return {name: rows[0] for name, rows in single.weights.items()}

    def misfits(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """Compute the misfit of one press at several pretensions.

        Args:
            charge_pC: Charges of the press, shape (n_electrode,), pC.
            pretension_MPa: Pretensions, shape (n,), MPa.

        Returns:
            Misfits, shape (n,), in standard deviations of the noise.
        """
        (vectors,) = self.vectors(charge_pC[None], pretension_MPa)
        return np.asarray(np.linalg.norm(vectors, axis=1))

    def vectors(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """Compute the misfit vectors of presses at several pretensions. The length of a misfit vector is the misfit.

        The network computes a vector u for each pretension of `node_MPa`. The vector u is interpolated linearly between
        these pretensions, which must therefore be close to each other; the method `at` returns such a network. The
        misfit vector has the direction of u and the length misfit_unit * sinh(|u|).

        Args:
            charge_pC: Charges of m presses, shape (m, n_electrode), pC.
            pretension_MPa: Pretensions, shape (n,), MPa.

        Returns:
            Misfit vectors, shape (m, n, n_electrode), in standard deviations of the noise.
        """
        inputs = self.features.evaluate(charge_pC).astype(np.float32)
        # The last outputs of the network are the vectors u, shape (k pretensions, m presses, n_electrode).
        outputs = evaluate(self.perceptron, inputs)
        n_electrode = inputs.shape[1]
        node_vectors = outputs[..., -n_electrode:]

        # Indices of the two neighbouring pretensions of `node_MPa`, and the position between them from 0 to 1.
        upper = np.clip(np.searchsorted(self.node_MPa, pretension_MPa), 1, self.node_MPa.size - 1)
        lower = upper - 1
        gap_MPa = self.node_MPa[upper] - self.node_MPa[lower]
        fraction = np.clip((pretension_MPa - self.node_MPa[lower]) / gap_MPa, 0.0, 1.0)[:, None, None]
        interpolated = (1.0 - fraction) * node_vectors[lower] + fraction * node_vectors[upper]

        # Change the length from |u| to the misfit. A smallest length prevents a division by 0.
        length = np.maximum(np.linalg.norm(interpolated, axis=2, keepdims=True), MIN_LENGTH)
        vectors = interpolated * (self.misfit_unit * np.sinh(length) / length)
        return np.asarray(vectors.swapaxes(0, 1))


class _About(Struct):
    """The JSON object `about` of the file: the numbers of `Pretensions`."""

    format_version: Annotated[int, Meta(ge=1)]
    constants: Annotated[list[Text], Meta(min_length=5, max_length=MAX_CONSTANTS)]
    calibrated_MPa: NotNegative
    std_MPa: Positive
    floor_MPa: NotNegative
    misfit_rms: Positive
    misfit_unit: Positive
    limits_pC: tuple[Positive, Positive]
    activation: str = TANH.name


_NUMBERS = tuple(name for name in _About.__struct_fields__ if name not in ("format_version", "constants"))
"""Attributes of `Pretensions` that the JSON object holds."""


def read_pretensions(version_folder: Path) -> Pretensions:
    """Read the file `pretensions.npz` beside a model.

    Raises:
        ModelError: If the file is missing, damaged, of another format, or belongs to another model.
    """
    path = version_folder / FILE
    data = read_companion_file(version_folder, FILE, CALIBRATION_ADVICE)
    try:
        return _pretensions(npz_arrays(data))
    except (ModelError, *DAMAGED_FILE_ERRORS) as error:
        advice = "copy the model's folder again, or calibrate again"
        raise ModelError(f"{path}: {cut(str(error))}; {advice}") from error


def _pretensions(arrays: Mapping[str, np.ndarray]) -> Pretensions:
    """Create the network from the arrays of a file, and check it.

    Args:
        arrays: Arrays of the file by name. The array `about` is a text, a JSON object with all single numbers.

    Raises:
        ValueError: If an array is missing or not valid, or the arrays do not fit together.
        ModelError: If the JSON object `about` is not valid.
    """
    about = parse_json(text_item(arrays, "about"), "about", ModelError, _About)
    if about.format_version != FORMAT:
        raise ValueError(f"format {about.format_version} is not supported (this version reads {FORMAT})")
    if about.activation not in ACTIVATIONS:
        raise ValueError(f"activation: expected one of {', '.join(ACTIVATIONS)}, got {about.activation!r}")
    node_MPa = finite_array(arrays, "node_MPa", (None,))
    _check_nodes(node_MPa, about.calibrated_MPa)
    typical_pC = finite_array(arrays, "typical_pC", (None,))
    low_pC, high_pC = about.limits_pC
    if not ((typical_pC > 0.0).all() and low_pC < high_pC):
        raise ValueError(
            f"expected positive typical charges and rising limits, got {cut(str(typical_pC))} pC and "
            f"{low_pC:g} to {high_pC:g} pC"
        )
    numbers = {name: getattr(about, name) for name in _NUMBERS}
    weight_names = _checked_weights(arrays, about, node_MPa.size)
    weights = {name: arrays[name].astype(np.float32) for name in weight_names}
    pretensions = Pretensions(node_MPa=node_MPa, typical_pC=typical_pC, weights=weights, **numbers)
    _check_misfits(pretensions)
    return pretensions


def _check_misfits(pretensions: Pretensions) -> None:
    """Raise ValueError if the network computes misfits that are not finite at pretensions within its range."""
    min_MPa, max_MPa = pretensions.range_MPa
    checked_MPa = np.linspace(min_MPa, max_MPa, CHECKED_PRETENSIONS)
    charges_pC = np.outer([0.5, 1.0, 2.0], pretensions.typical_pC)  # a weak, a typical and a strong press
    with np.errstate(over="ignore", invalid="ignore"):  # results that overflow are reported below
        interpolated_network = pretensions.at(checked_MPa)
        misfit_vectors = interpolated_network.vectors(charges_pC, checked_MPa)
    if not np.isfinite(misfit_vectors).all():
        raise ValueError("the weights give misfits that are not finite")


def _check_nodes(node_MPa: Array, calibrated_MPa: float) -> None:
    """Check the pretensions at which the weights are given.

    Args:
        node_MPa: The pretensions, shape (k,), MPa.
        calibrated_MPa: Pretension of the calibration, MPa.

    Raises:
        ValueError: If the weights cannot be interpolated between them, or the calibration is not one of them.
    """
    is_rising = node_MPa.size >= 2 and bool((np.diff(node_MPa) >= MIN_NODE_DISTANCE_MPa).all())
    in_range = node_MPa.size <= MAX_NODES and bool((np.abs(node_MPa) <= MAX_PRETENSION_MPa).all())
    if not (is_rising and in_range and calibrated_MPa in node_MPa):
        raise ValueError(
            f"node_MPa: expected 2 to {MAX_NODES} rising pretensions up to {MAX_PRETENSION_MPa:g} MPa with "
            f"{calibrated_MPa:g} MPa among them, got {cut(str(node_MPa))}"
        )


def _checked_weights(arrays: Mapping[str, np.ndarray], about: _About, n_node: int) -> list[str]:
    """Check the shapes of the weights, and return their names in the order of the layers.

    The list `about.constants` contains the names. The names of the hidden layers are pairs: the weight and the bias of
    each layer. The last three names are those of the skip layer, which connects the inputs with the outputs directly,
    of the bias of the output layer, and of the weight of the output layer. The first axis of each array is the
    pretension.

    Args:
        arrays: Arrays of the file by name.
        about: Description in the file, with the names of the weights.
        n_node: Number of pretensions at which the weights are given.

    Raises:
        ValueError: If an array is missing, or the shapes do not fit together.
    """
    weight_names = about.constants
    *hidden_names, skip_weight, output_bias, output_weight = weight_names
    has_pairs = len(hidden_names) % 2 == 0
    has_equal_names = len(set(weight_names)) < len(weight_names)
    if has_equal_names or not has_pairs:
        raise ValueError(f"constants: expected pairs of names that differ, got {cut(str(weight_names))}")
    n_electrode = finite_array(arrays, "typical_pC", (None,)).size

    # The inputs of the first layer are the charges. The inputs of each later layer are the neurons of the layer before.
    n_input = n_electrode
    hidden_weights = hidden_names[::2]
    hidden_biases = hidden_names[1::2]
    for weight, bias in zip(hidden_weights, hidden_biases, strict=True):
        n_neuron = finite_array(arrays, weight, (n_node, n_input, None)).shape[2]
        finite_array(arrays, bias, (n_node, n_neuron))
        n_input = n_neuron

    n_output = finite_array(arrays, output_weight, (n_node, n_input, None)).shape[2]
    finite_array(arrays, output_bias, (n_node, n_output))
    finite_array(arrays, skip_weight, (n_node, n_electrode, n_output))
    if n_output < n_electrode:
        raise ValueError(f"{output_weight}: expected at least {n_electrode} outputs, got {n_output}")
    for name in weight_names:
        largest = np.abs(arrays[name].astype(float)).max()
        if largest > MAX_WEIGHT:
            raise ValueError(f"{name}: expected weights up to {MAX_WEIGHT:g}, got {largest:g}")
    return weight_names
