"""The file `pretensions.npz` beside a calibrated model: its weights at other pretensions. Its writer and reader.

    about                JSON: the numbers of `Pretensions`, and the graph's constants in the order of the layers
    node_MPa             pretensions at which weights are given, that of the calibration among them
    typical_pC           charges over these, and the logarithm, are what the layers see
    <constant>           weights that the graph's constant of this name has at each of the pretensions

In between, weights are interpolated by a polynomial: six pretensions over 2.8 MPa are right to 0.003 mm. `model.onnx`
stays the graph of every film: onnxruntime is handed its constants, so that an answer takes as long as before.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import ModelError, cut
from isocharge.common.npz import DAMAGED, finite_array, npz_arrays, text_item
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

TINY = 1e-12
"""Length that counts as none."""


@dataclass(frozen=True, kw_only=True)
class Pretensions:
    """The network of one film at any pretension of a range.

    Attributes:
        node_MPa: Pretensions at which weights are given, shape (k,), rising.
        calibrated_MPa: That of the model as calibrated, one of these.
        std_MPa: How well it is known when a stream begins: by the calibration, and a drift since.
        floor_MPa: Standard deviation of what touches tell, however many: the film's other parameters are not exact.
        misfit_rms: Root mean square of the misfits of good touches, in units of the noise.
        misfit_unit: Scale of the misfit's arcsinh.
        limits_pC: Smallest and largest charge that the layers see.
        typical_pC: Shape (n_electrode,).
        weights: Of each layer the graph's constants by name, (k, inputs, outputs) and (k, outputs): first those
            followed by tanh, then skip and bias of the last, and its weights.
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

    def to_bytes(self) -> bytes:
        """The file."""
        numbers = {name: getattr(self, name) for name in _About.__struct_fields__[2:]}
        about = json.dumps({"format_version": FORMAT, "constants": [*self.weights], **numbers}, allow_nan=False)
        file = io.BytesIO()
        arrays: dict[str, Any] = {"node_MPa": self.node_MPa, "typical_pC": self.typical_pC, **self.weights}
        np.savez_compressed(file, about=np.array(about), **arrays)
        return file.getvalue()

    @property
    def range_MPa(self) -> tuple[float, float]:
        """Smallest and largest pretension."""
        return float(self.node_MPa[0]), float(self.node_MPa[-1])

    def shares(self, pretension_MPa: Array) -> Array:
        """Lagrange's polynomials at pretensions of shape (n,): what each of the k has in between, (n, k)."""
        others = ~np.eye(self.node_MPa.size, dtype=bool)
        apart = self.node_MPa[:, None] - self.node_MPa
        steps = (pretension_MPa[:, None, None] - self.node_MPa) / np.where(others, apart, 1.0)
        return np.asarray(np.prod(steps, axis=2, where=others))

    def at(self, node_MPa: Array) -> "Pretensions":
        """The same, its weights given at other pretensions of the range, shape (k,)."""
        shares = self.shares(node_MPa)
        weights = {name: np.tensordot(shares, rows, axes=1).astype(np.float32) for name, rows in self.weights.items()}
        return replace(self, node_MPa=node_MPa, weights=weights)

    def constants(self, pretension_MPa: float) -> dict[str, Singles]:
        """The graph's constants at one pretension of the range."""
        return {name: rows[0] for name, rows in self.at(np.array([pretension_MPa])).weights.items()}

    def misfits(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """Misfits of one press, shape (n,), from charges of shape (n_electrode,), at pretensions of shape (n,)."""
        return np.asarray(np.linalg.norm(self.vectors(charge_pC[None], pretension_MPa)[0], axis=1))

    def vectors(self, charge_pC: Array, pretension_MPa: Array) -> Array:
        """The vectors whose lengths the misfits are, in units of the noise.

        They are interpolated linearly: `at` gives weights at pretensions close enough.

        Args:
            charge_pC: Shape (m, n_electrode), pC.
            pretension_MPa: Shape (n,).

        Returns:
            Shape (m, n, n_electrode).
        """
        *hidden, skip, bias, last = self.weights.values()
        logs = np.log(np.clip(charge_pC, *self.limits_pC) / self.typical_pC).astype(np.float32)
        value = logs
        for weight, shift in zip(hidden[::2], hidden[1::2], strict=True):
            value = np.tanh(value @ weight + shift[:, None])
        nodes = (value @ last + logs @ skip + bias[:, None])[..., -logs.shape[1] :]
        after = np.clip(np.searchsorted(self.node_MPa, pretension_MPa), 1, self.node_MPa.size - 1)
        gap = self.node_MPa[after] - self.node_MPa[after - 1]
        share = np.clip((pretension_MPa - self.node_MPa[after - 1]) / gap, 0.0, 1.0)[:, None, None]
        between = (1.0 - share) * nodes[after - 1] + share * nodes[after]
        length = np.maximum(np.linalg.norm(between, axis=2, keepdims=True), TINY)
        return np.asarray((between * (self.misfit_unit * np.sinh(length) / length)).swapaxes(0, 1))


class _About(Struct):
    """The numbers of `Pretensions` in the file."""

    format_version: Annotated[int, Meta(ge=1)]
    constants: Annotated[list[Text], Meta(min_length=5, max_length=MAX_CONSTANTS)]
    calibrated_MPa: NotNegative
    std_MPa: Positive
    floor_MPa: NotNegative
    misfit_rms: Positive
    misfit_unit: Positive
    limits_pC: tuple[Positive, Positive]


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
    node_MPa = finite_array(arrays, "node_MPa", (None,))
    _check_nodes(node_MPa, about.calibrated_MPa)
    typical_pC = finite_array(arrays, "typical_pC", (None,))
    low_pC, high_pC = about.limits_pC
    if not ((typical_pC > 0.0).all() and low_pC < high_pC):
        raise ValueError(
            f"expected positive typical charges and rising limits, got {cut(str(typical_pC))} pC and "
            f"{low_pC:g} to {high_pC:g} pC"
        )
    numbers = {name: getattr(about, name) for name in _About.__struct_fields__[2:]}
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
