"""Network weights of a calibrated model at several pretensions, and the file `pretensions.npz` with the weights.

    about                JSON: the numbers of `Pretensions`, and the names of the weights in the order of the layers
    node_MPa             pretensions at which the weights are given, including the pretension of the calibration
    typical_pC           typical charge of each electrode, by which its charges are divided before the logarithm
    <constant>           values of the constant of the graph with this name, at each pretension of `node_MPa`

Between the pretensions of `node_MPa`, the weights are interpolated by a polynomial. All pretensions use the same graph,
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
from isocharge.serve.model.pretension_nodes import check_nodes, interpolation_weights

FILE = "pretensions.npz"
"""Name of the file in a version folder."""

FORMAT = 1
"""Version of the format of the file."""

MAX_CONSTANTS = 100
"""Largest number of weight arrays."""

MAX_WEIGHT = 1e6
"""Largest absolute value of a weight. The weights of trained networks are below 100."""

CALIBRATION_ADVICE = (
    "a film is followed from a model that `isocharge train calibrate` made of presses on it, with four electrodes "
    "or more: calibrate it, or again with this version. A calibration writes no such file if its network explains "
    "good touches too poorly, as on uniaxial and on very imperfect films; update such a film with --from"
)
"""Advice to the user if the file cannot be read."""

CHECKED_PRETENSIONS = 50
"""Number of pretensions at which a reader of the file checks that the misfits are finite."""

MIN_LENGTH = 1e-12
"""Smallest length of a misfit vector. It prevents a division by zero."""


@dataclass(frozen=True, kw_only=True)
class Pretensions:
    """Network that estimates the contacts on one film at every pretension within a range.

    Attributes:
        node_MPa: Pretensions at which the weights are given, shape (k,), MPa, in ascending order.
        calibrated_MPa: Pretension that the calibration estimated, MPa. It is one of `node_MPa`.
        std_MPa: Standard deviation of the pretension when a stream begins, MPa. It includes the uncertainty of the
            calibration and of the drift since the calibration.
        floor_MPa: Smallest standard deviation that an estimate from many touches reaches, MPa. This limit is caused by
            errors of the other parameters of the film.
        misfit_rms: Root mean square of the misfits of good touches, in standard deviations of the noise.
        misfit_unit: Scale of the misfit: misfit = misfit_unit * sinh(|misfit vector|).
        limits_pC: Smallest and largest charge, pC. Charges outside this range are clipped.
        typical_pC: Charge by which each charge is divided before the logarithm, shape (n_electrode,), pC.
        weights: Arrays of the layers by the names of the constants in the graph, float32, in this order: weight, shape
            (k, n_input, n_neuron), and bias, shape (k, n_neuron), of each hidden layer; weight of the skip layer,
            shape (k, n_electrode, n_output); bias, shape (k, n_output), and weight, shape (k, n_neuron, n_output), of
            the output layer. The skip layer connects the inputs directly with the outputs.
        activation: Name of the activation function of the hidden layers.
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

        The file contains the pretensions, the typical charges and the weights as arrays. The JSON object `about`
        contains all other numbers, and the names of the weights in the order of the layers.
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
        """Networks of all k pretensions in one object. The weights of a layer have the shape (k, n_input, n_output)."""
        # The arrays have the order of the layers. The weights and the biases of the hidden layers alternate.
        *hidden_arrays, skip_weight, output_bias, output_weight = self.weights.values()
        hidden_weights = hidden_arrays[::2]
        hidden_biases = hidden_arrays[1::2]

        # The new axis of a bias, shape (k, 1, n_output), stands for the presses.
        hidden_layers = [
            Layer(weight, bias[:, None]) for weight, bias in zip(hidden_weights, hidden_biases, strict=True)
        ]
        output_layer = Layer(output_weight, output_bias[:, None])
        return Perceptron(tuple(hidden_layers), output_layer, skip_weight, ACTIVATIONS[self.activation])

    def interpolated(self, pretension_MPa: Array) -> "Pretensions":
        """Return the same network with weights that are interpolated to other pretensions.

        In the result, the other pretensions replace the pretensions `node_MPa`.

        Args:
            pretension_MPa: The other pretensions, shape (n,), MPa, within `range_MPa` and in ascending order.
        """
        interpolation = interpolation_weights(self.node_MPa, pretension_MPa)  # shape (n, k)
        network_weights = {}
        for name, node_weights in self.weights.items():  # arrays of shape (k, ...), one entry for each of `node_MPa`
            interpolated_weights = np.tensordot(interpolation, node_weights, axes=1)  # shape (n, ...)
            network_weights[name] = interpolated_weights.astype(np.float32)
        return replace(self, node_MPa=pretension_MPa, weights=network_weights)

    def constants(self, pretension_MPa: float) -> dict[str, Singles]:
        """Return the weights of the network at one pretension, by the names of the constants in the graph.

        Args:
            pretension_MPa: The pretension, MPa, within `range_MPa`.
        """
        single_network = self.interpolated(np.array([pretension_MPa]))
        return {name: node_weights[0] for name, node_weights in single_network.weights.items()}

    def misfits(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """Compute the misfit of one press at several pretensions.

        Args:
            charge_pC: Charges of the press, shape (n_electrode,), pC.
            pretension_MPa: Pretensions, shape (n,), MPa.

        Returns:
            Misfits, shape (n,), in standard deviations of the noise.
        """
        charge_rows_pC = charge_pC[None]  # shape (1, n_electrode), because `misfit_vectors` expects several presses
        (misfit_vectors,) = self.misfit_vectors(charge_rows_pC, pretension_MPa)  # one array of shape (n, n_electrode)
        return np.asarray(np.linalg.norm(misfit_vectors, axis=1))

    def misfit_vectors(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """Compute the misfit vectors of presses at several pretensions. The length of a misfit vector is the misfit.

        The network computes a vector u at each pretension of `node_MPa`. At other pretensions, u is interpolated
        linearly between the two nearest pretensions of `node_MPa`. The pretensions of `node_MPa` must therefore be
        close to each other. The method `interpolated` can return such a network. The misfit vector has the direction of
        u and the length misfit_unit * sinh(|u|).

        Args:
            charge_pC: Charges of m presses, shape (m, n_electrode), pC.
            pretension_MPa: Pretensions, shape (n,), MPa.

        Returns:
            Misfit vectors, shape (m, n, n_electrode), in standard deviations of the noise.
        """
        inputs = self.features.evaluate(charge_pC).astype(np.float32)
        # The last `n_electrode` outputs of the network are the vector u. There is one vector for each of the k
        # pretensions of `node_MPa` and each of the m presses.
        outputs = evaluate(self.perceptron, inputs)  # shape (k, m, n_output)
        n_electrode = inputs.shape[1]
        node_vectors = outputs[..., -n_electrode:]  # shape (k, m, n_electrode)

        # Find the two pretensions of `node_MPa` between which each pretension lies. The fraction is 0 at the lower of
        # these two pretensions, and 1 at the upper.
        upper = np.clip(np.searchsorted(self.node_MPa, pretension_MPa), 1, self.node_MPa.size - 1)
        lower = upper - 1
        gap_MPa = self.node_MPa[upper] - self.node_MPa[lower]
        fraction = np.clip((pretension_MPa - self.node_MPa[lower]) / gap_MPa, 0.0, 1.0)  # shape (n,)
        upper_weight = fraction[:, None, None]  # shape (n, 1, 1), the same for all presses and electrodes
        lower_vectors = (1.0 - upper_weight) * node_vectors[lower]  # shape (n, m, n_electrode)
        interpolated = lower_vectors + upper_weight * node_vectors[upper]

        # Change the length of each vector from |u| to the misfit. A lower limit of |u| prevents a division by 0.
        length = np.maximum(np.linalg.norm(interpolated, axis=2, keepdims=True), MIN_LENGTH)
        misfit_over_length = self.misfit_unit * np.sinh(length) / length
        misfit_vectors = interpolated * misfit_over_length  # shape (n, m, n_electrode)
        return np.asarray(misfit_vectors.swapaxes(0, 1))  # shape (m, n, n_electrode)


class _About(Struct):
    """The JSON object `about` of the file: the numbers of `Pretensions`, and the names of the weights (`constants`)."""

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
"""Attributes of `Pretensions` that the JSON object `about` contains."""


def read_pretensions(version_folder: Path) -> Pretensions:
    """Read the network of a film for several pretensions from the file `pretensions.npz` of a model.

    Args:
        version_folder: Folder of the model, which contains `model.onnx`.

    Raises:
        ModelError: If the file is missing, damaged, of another format, or belongs to another model.
    """
    path = version_folder / FILE
    data = read_companion_file(version_folder, FILE, CALIBRATION_ADVICE)
    try:
        return _pretensions_from_arrays(npz_arrays(data))
    except (ModelError, *DAMAGED_FILE_ERRORS) as error:
        advice = "copy the model's folder again, or calibrate again"
        raise ModelError(f"{path}: {cut(str(error))}; {advice}") from error


def _pretensions_from_arrays(arrays: Mapping[str, np.ndarray]) -> Pretensions:
    """Check the arrays of a file, and return the network that they describe.

    Args:
        arrays: Arrays of the file by name. The array `about` is the text of a JSON object, which contains all single
            numbers.

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
    check_nodes(node_MPa, about.calibrated_MPa)
    typical_pC = finite_array(arrays, "typical_pC", (None,))
    low_pC, high_pC = about.limits_pC
    if not ((typical_pC > 0.0).all() and low_pC < high_pC):
        raise ValueError(
            f"expected positive typical charges and rising limits, got {cut(str(typical_pC))} pC and "
            f"{low_pC:g} to {high_pC:g} pC"
        )
    numbers = {name: getattr(about, name) for name in _NUMBERS}
    weight_names = _checked_weight_names(arrays, about, node_MPa.size)
    weights = {name: arrays[name].astype(np.float32) for name in weight_names}
    pretensions = Pretensions(node_MPa=node_MPa, typical_pC=typical_pC, weights=weights, **numbers)
    _check_misfits(pretensions)
    return pretensions


def _check_misfits(pretensions: Pretensions) -> None:
    """Check that the misfits of three typical presses are finite at `CHECKED_PRETENSIONS` pretensions in the range.

    Raises:
        ValueError: If a misfit is not finite.
    """
    min_MPa, max_MPa = pretensions.range_MPa
    checked_MPa = np.linspace(min_MPa, max_MPa, CHECKED_PRETENSIONS)
    charges_pC = np.outer([0.5, 1.0, 2.0], pretensions.typical_pC)  # a weak, a typical and a strong press
    with np.errstate(over="ignore", invalid="ignore"):  # results that overflow are reported below
        interpolated_network = pretensions.interpolated(checked_MPa)
        misfit_vectors = interpolated_network.misfit_vectors(charges_pC, checked_MPa)
    if not np.isfinite(misfit_vectors).all():
        raise ValueError("the weights give misfits that are not finite")


def _checked_weight_names(arrays: Mapping[str, np.ndarray], about: _About, n_node: int) -> list[str]:
    """Check the arrays that contain the weights, and return their names in the order of the layers.

    The list `about.constants` contains the names. The list begins with two names for each hidden layer, which are the
    weight and the bias of the layer. The last three names are the weight of the skip layer, the bias of the output
    layer and the weight of the output layer. The skip layer connects the inputs directly with the outputs. The first
    axis of each array has one entry for each pretension.

    Args:
        arrays: Arrays of the file by name.
        about: The JSON object `about` of the file, which lists the names of the weights.
        n_node: Number of pretensions at which the weights are given.

    Raises:
        ValueError: If names are equal or not in pairs, an array is missing, the shapes do not fit together, or a weight
            is too large.
    """
    weight_names = about.constants
    *hidden_names, skip_weight_name, output_bias_name, output_weight_name = weight_names
    has_pairs = len(hidden_names) % 2 == 0
    has_different_names = len(set(weight_names)) == len(weight_names)
    if not (has_pairs and has_different_names):
        raise ValueError(f"constants: expected pairs of names that differ, got {cut(str(weight_names))}")
    n_electrode = finite_array(arrays, "typical_pC", (None,)).size

    # `finite_array` raises an error if an array has another shape. The inputs of the first layer are the charges. The
    # inputs of each later layer are the neurons of the previous layer.
    n_input = n_electrode
    for weight_name, bias_name in zip(hidden_names[::2], hidden_names[1::2], strict=True):
        n_neuron = finite_array(arrays, weight_name, (n_node, n_input, None)).shape[2]
        finite_array(arrays, bias_name, (n_node, n_neuron))
        n_input = n_neuron

    # The last outputs are a vector with one component for each electrode, from which the misfit is computed.
    n_output = finite_array(arrays, output_weight_name, (n_node, n_input, None)).shape[2]
    finite_array(arrays, output_bias_name, (n_node, n_output))
    finite_array(arrays, skip_weight_name, (n_node, n_electrode, n_output))
    if n_output < n_electrode:
        raise ValueError(f"{output_weight_name}: expected at least {n_electrode} outputs, got {n_output}")
    _check_magnitudes(arrays, weight_names)
    return weight_names


def _check_magnitudes(arrays: Mapping[str, np.ndarray], weight_names: list[str]) -> None:
    """Check that the magnitude of every weight is at most `MAX_WEIGHT`.

    Args:
        arrays: Arrays of the file by name.
        weight_names: Names of the arrays that contain weights.

    Raises:
        ValueError: If a weight is larger.
    """
    for name in weight_names:
        largest_weight = np.abs(arrays[name].astype(float)).max()
        if largest_weight > MAX_WEIGHT:
            raise ValueError(f"{name}: expected weights up to {MAX_WEIGHT:g}, got {largest_weight:g}")
