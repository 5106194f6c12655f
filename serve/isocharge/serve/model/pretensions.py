"""The file `pretensions.npz` beside a calibrated model: the network's weights at several pretensions of the film.

    about                JSON: the numbers of `Pretensions`, and the names of the weights in the order of the layers
    node_MPa             pretensions at which the weights are given, that of the calibration among them
    typical_pC           charges by which the charges are divided before the logarithm
    <constant>           values of the graph's constant of this name at each of these pretensions

Between these pretensions the weights are interpolated by a polynomial. The graph `model.onnx` stays the same for every
pretension: onnxruntime gets other constants, so a prediction takes as long as before.
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
from isocharge.common.npz import DAMAGED, finite_array, npz_arrays, text_item
from isocharge.common.perceptron import Layer, Perceptron, evaluate
from isocharge.common.structs import NotNegative, Positive, Text, parse_json
from isocharge.serve.model.companion_files import read_companion_file

FILE = "pretensions.npz"
"""Name of the file in a version folder."""

FORMAT = 1
"""Version of the file's format."""

MAX_CONSTANTS = 100
"""Largest number of weight arrays."""

MAX_NODES = 50
"""Largest number of pretensions at which weights are given."""

MAX_PRETENSION_MPa = 50.0
"""Largest pretension, MPa; PVDF yields at about 45 MPa."""

MAX_WEIGHT = 1e6
"""Largest absolute value of a weight; those of trained networks are below 100."""

CHECKED_PRETENSIONS = 50
"""Number of pretensions at which the misfits of a file are checked to be finite."""

MIN_NODE_DISTANCE_MPa = 1e-3
"""Smallest distance of two pretensions, MPa, between which the interpolation is well conditioned."""

MIN_LENGTH = 1e-12
"""Length below which a misfit vector counts as having this length, so that no division by zero occurs."""


@dataclass(frozen=True, kw_only=True)
class Pretensions:
    """The network of one film at every pretension of a range.

    Attributes:
        node_MPa: Pretensions at which the weights are given, shape (k,), rising.
        calibrated_MPa: Pretension that the calibration found; one of `node_MPa`.
        std_MPa: Standard deviation of the pretension when a stream begins: the uncertainty of the calibration and of
            the drift since then.
        floor_MPa: Standard deviation of the pretension that many touches estimate, caused by errors of the film's other
            parameters.
        misfit_rms: Root mean square of the misfits of good touches, in standard deviations of the noise.
        misfit_unit: Scale of the misfit: misfit = misfit_unit * sinh(|misfit vector|).
        limits_pC: Smallest and largest charge, to which charges are clipped, pC.
        typical_pC: Charge by which each charge is divided before the logarithm, shape (n_electrode,), pC.
        weights: Arrays of each layer by the name of the graph's constant, float32. First the hidden layers, weight of
            shape (k, n_input, n_output) and bias of shape (k, n_output) each; then the skip layer, shape
            (k, n_electrode, n_answer), the bias and the weight of the output layer.
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
        """Return the content of the file."""
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        about = json.dumps({"format_version": FORMAT, "constants": [*self.weights], **numbers}, allow_nan=False)
        file = io.BytesIO()
        arrays: dict[str, Any] = {"node_MPa": self.node_MPa, "typical_pC": self.typical_pC, **self.weights}
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
        """The perceptrons of all k pretensions, with weights of shape (k, n_input, n_output)."""
        *hidden_arrays, skip, bias, weight = self.weights.values()
        hidden = [
            Layer(hidden_weight, hidden_bias[:, None])
            for hidden_weight, hidden_bias in zip(hidden_arrays[::2], hidden_arrays[1::2], strict=True)
        ]
        return Perceptron(tuple(hidden), Layer(weight, bias[:, None]), skip, ACTIVATIONS[self.activation])

    def interpolation_weights(self, pretension_MPa: Array) -> Array:
        """Evaluate the Lagrange polynomials of the k pretensions.

        Args:
            pretension_MPa: Shape (n,).

        Returns:
            Shape (n, k). Each row sums to 1.
        """
        is_other = ~np.eye(self.node_MPa.size, dtype=bool)
        node_distance = self.node_MPa[:, None] - self.node_MPa
        distance = pretension_MPa[:, None, None] - self.node_MPa
        factors = distance / np.where(is_other, node_distance, 1.0)
        return np.asarray(np.prod(factors, axis=2, where=is_other))

    def at(self, node_MPa: Array) -> "Pretensions":
        """Return the same network with its weights given at other pretensions of the range, shape (k,)."""
        factors = self.interpolation_weights(node_MPa)
        weights = {name: np.tensordot(factors, rows, axes=1).astype(np.float32) for name, rows in self.weights.items()}
        return replace(self, node_MPa=node_MPa, weights=weights)

    def constants(self, pretension_MPa: float) -> dict[str, Singles]:
        """Return the graph's constants by name for one pretension of the range."""
        single = self.at(np.array([pretension_MPa]))
        return {name: rows[0] for name, rows in single.weights.items()}

    def misfits(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """Compute the misfit of one press at several pretensions.

        Args:
            charge_pC: Shape (n_electrode,), pC.
            pretension_MPa: Shape (n,).

        Returns:
            Shape (n,), in standard deviations of the noise.
        """
        (vectors,) = self.vectors(charge_pC[None], pretension_MPa)
        return np.asarray(np.linalg.norm(vectors, axis=1))

    def vectors(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """Compute the vectors whose lengths are the misfits of presses at several pretensions.

        The vectors are interpolated linearly between the pretensions of `node_MPa`, which must therefore lie close to
        each other; `at` provides that.

        Args:
            charge_pC: Shape (m, n_electrode), pC.
            pretension_MPa: Shape (n,).

        Returns:
            Shape (m, n, n_electrode), in standard deviations of the noise.
        """
        inputs = self.features.evaluate(charge_pC).astype(np.float32)
        _, misfit_vectors = np.split(evaluate(self.perceptron, inputs), [-inputs.shape[1]], axis=-1)
        upper = np.clip(np.searchsorted(self.node_MPa, pretension_MPa), 1, self.node_MPa.size - 1)
        lower = upper - 1
        gap_MPa = self.node_MPa[upper] - self.node_MPa[lower]
        fraction = np.clip((pretension_MPa - self.node_MPa[lower]) / gap_MPa, 0.0, 1.0)[:, None, None]
        interpolated = (1.0 - fraction) * misfit_vectors[lower] + fraction * misfit_vectors[upper]
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
    data = read_companion_file(
        version_folder,
        FILE,
        "a film is followed from a model that `isocharge train calibrate` made of presses on it, with four electrodes "
        "or more: calibrate it, or again with this version",
    )
    try:
        return _pretensions(npz_arrays(data))
    except (ModelError, *DAMAGED) as error:
        advice = "copy the model's folder again, or calibrate again"
        raise ModelError(f"{path}: {cut(str(error))}; {advice}") from error


def _pretensions(arrays: Mapping[str, np.ndarray]) -> Pretensions:
    """Return what the arrays of a file describe; raise ValueError or ModelError if they do not fit together."""
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
    with np.errstate(over="ignore"):
        weights = {name: arrays[name].astype(np.float32) for name in _checked_weights(arrays, about, node_MPa.size)}
    pretensions = Pretensions(node_MPa=node_MPa, typical_pC=typical_pC, weights=weights, **numbers)
    between_MPa = np.linspace(*pretensions.range_MPa, CHECKED_PRETENSIONS)
    with np.errstate(over="ignore", invalid="ignore"):
        charges_pC = np.outer([0.5, 1.0, 2.0], typical_pC)
        misfits = pretensions.at(between_MPa).vectors(charges_pC, between_MPa)
    if not np.isfinite(misfits).all():
        raise ValueError("the weights give misfits that are not finite")
    return pretensions


def _check_nodes(node_MPa: Array, calibrated_MPa: float) -> None:
    """Refuse pretensions between which weights cannot be interpolated."""
    is_rising = node_MPa.size >= 2 and bool((np.diff(node_MPa) >= MIN_NODE_DISTANCE_MPa).all())
    in_range = node_MPa.size <= MAX_NODES and bool((np.abs(node_MPa) <= MAX_PRETENSION_MPa).all())
    if not (is_rising and in_range and calibrated_MPa in node_MPa):
        raise ValueError(
            f"node_MPa: expected 2 to {MAX_NODES} rising pretensions up to {MAX_PRETENSION_MPa:g} MPa with "
            f"{calibrated_MPa:g} MPa among them, got {cut(str(node_MPa))}"
        )


def _checked_weights(arrays: Mapping[str, np.ndarray], about: _About, n_node: int) -> list[str]:
    """Return the names of the weights in the order of the layers, after a check of their shapes.

    The hidden layers are pairs of a matrix and a vector; then follow the matrix that bypasses them, the vector and the
    matrix of the last layer.
    """
    *hidden, skip, bias, last = about.constants
    if len(hidden) % 2 or len(set(about.constants)) < len(about.constants):
        raise ValueError(f"constants: expected pairs of names that differ, got {cut(str(about.constants))}")
    n_electrode = finite_array(arrays, "typical_pC", (None,)).size
    width = n_electrode
    for matrix, vector in zip(hidden[::2], hidden[1::2], strict=True):
        next_width = finite_array(arrays, matrix, (n_node, width, None)).shape[2]
        finite_array(arrays, vector, (n_node, next_width))
        width = next_width
    n_output = finite_array(arrays, last, (n_node, width, None)).shape[2]
    finite_array(arrays, bias, (n_node, n_output))
    finite_array(arrays, skip, (n_node, n_electrode, n_output))
    if n_output < n_electrode:
        raise ValueError(f"{last}: expected at least {n_electrode} outputs, got {n_output}")
    for name in about.constants:
        largest = np.abs(arrays[name].astype(float)).max()
        if largest > MAX_WEIGHT:
            raise ValueError(f"{name}: expected weights up to {MAX_WEIGHT:g}, got {largest:g}")
    return about.constants
