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
from typing import Annotated, Any, NoReturn

import numpy as np
from msgspec import Meta, Struct

from isocharge.common.arrays import Array, Singles
from isocharge.common.errors import ModelError, cut
from isocharge.common.files import read_whole
from isocharge.common.npz import DAMAGED, npz_arrays
from isocharge.common.structs import NotNegative, Positive, Text, parse_json

FILE = "pretensions.npz"
"""Name of the file in a version folder."""

FORMAT = 1
"""Version of the file's format."""

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
    format_version: Annotated[int, Meta(ge=1)]
    constants: Annotated[list[Text], Meta(min_length=5)]
    calibrated_MPa: NotNegative
    std_MPa: Positive
    floor_MPa: NotNegative
    misfit_rms: Positive
    misfit_unit: Positive
    limits_pC: tuple[Positive, Positive]


def read_pretensions(version_folder: Path) -> Pretensions:
    """Read the file beside a model.

    Raises:
        ModelError: If it is missing, damaged, or of another format.
    """
    path = version_folder / FILE
    try:
        data = read_whole(path)
    except OSError as error:
        raise ModelError(
            f"{path}: cannot be read ({error.strerror}); a film is followed from a model that `isocharge train "
            "calibrate` made of presses on it, with four electrodes or more: calibrate it, or again with this version"
        ) from error
    try:
        file = npz_arrays(data)
        about = parse_json(str(file["about"][()]), "about", ModelError, _About)
        if about.format_version != FORMAT:
            _refuse(path, f"format {about.format_version} is not supported (this version reads {FORMAT})")
        node, typical = file["node_MPa"].astype(float), file["typical_pC"].astype(float)
        weights = {name: file[name].astype(np.float32) for name in about.constants}
    except ModelError as error:
        _refuse(path, str(error))
    except DAMAGED as error:
        _refuse(path, cut(str(error)))
    if node.ndim != 1 or node.size < 2 or not (np.diff(node) > 0.0).all() or about.calibrated_MPa not in node:
        _refuse(path, f"expected rising pretensions with {about.calibrated_MPa} among them, got {cut(str(node))}")
    if any(len(rows) != node.size or not np.isfinite(rows).all() for rows in weights.values()):
        _refuse(path, f"expected finite weights for each of {node.size} pretensions")
    numbers = {name: getattr(about, name) for name in _About.__struct_fields__[2:]}
    return Pretensions(node_MPa=node, typical_pC=typical, weights=weights, **numbers)


def _refuse(path: Path, why: str) -> NoReturn:
    raise ModelError(f"{path}: {why}; copy the model's folder again, or calibrate again")
