"""Golden vectors of a model, which are input charges and the outputs that the model computed when it was exported.

The checksum shows whether `model.onnx` is still the released file. The outputs show whether another machine or another
version of onnxruntime computes the same results. A computed output a and a stored output b are the same if
|a - b| <= 1e-5 max(|b|, floor).
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import onnxruntime as ort
from msgspec import Meta, Struct

from isocharge.common.arrays import Singles
from isocharge.common.errors import ModelError
from isocharge.common.files import sha256_of
from isocharge.common.structs import Finite, NotNegative, Text, WrongKey, read_json
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import CORRELATION, INPUT, OUTPUTS, run

RELATIVE_TOLERANCE = 1e-5
"""Largest difference of two outputs, relative to max(|output|, floor), dimensionless."""

FLOORS = {
    "contact": (1.0, 1.0, 0.1),  # mm, mm, N
    "contact_std": (1.0, 1.0, 0.1),
    # A correlation is computed from terms that nearly cancel. Versions of onnxruntime differ by 1e-4.
    CORRELATION: (10.0, 10.0, 10.0),
    # Near zero, the misfit is computed from terms that nearly cancel. Versions of onnxruntime differ by 1e-4.
    "misfit": (20.0,),
}
"""Floor for each column of an output, in the unit of the column. Below it, differences are compared absolutely."""

REFERENCE_RADIUS_MM = 20.0
"""Radius of the working area up to which the floors of x and y are constant, mm. Above it, they grow in proportion."""

REFERENCE_FORCE_N = 2.0
"""Largest force up to which the floor of the force is constant, N. Above it, the floor grows in proportion."""


def contact_floors(metadata: ModelMetadata) -> tuple[float, float, float]:
    """Return the floors of x and y, mm, and of the force, N, for the outputs `contact` and `contact_std` of a model.

    When outputs are compared, their tolerance is relative to the larger of the absolute value and the floor of the
    output. The floors of a small film are constants. For larger films, the floors of the position grow with the radius
    of the working area, or with the position error of the model if this gives larger floors. The floor of the force
    grows with the largest force.
    """
    x_floor_mm, y_floor_mm, force_floor_N = FLOORS["contact"]
    radius_mm = max(math.hypot(x_mm, y_mm) for x_mm, y_mm in metadata.working_area_mm)
    position_rms_mm = metadata.errors.get("position_rms_mm", 0.0)
    _, max_force_N = metadata.force_range_N
    position_factor = max(1.0, radius_mm / REFERENCE_RADIUS_MM, position_rms_mm / x_floor_mm)
    force_factor = max(1.0, max_force_N / REFERENCE_FORCE_N)
    return x_floor_mm * position_factor, y_floor_mm * position_factor, force_floor_N * force_factor


@dataclass(frozen=True)
class Golden:
    """Golden vectors of one model.

    Attributes:
        sha256: Checksum of the model file.
        charge_pC: Input charges, shape (n, electrodes), pC.
        outputs: Outputs of the model by name, each of shape (n, width).
        relative: Tolerance relative to max(|output|, floor).
        floors: Floor for each column of an output, by output name.
        companion_sha256: Checksums of the files that lie beside the model, by file name. None for a model that was
            written before these files had checksums.
    """

    sha256: str
    charge_pC: Singles
    outputs: dict[str, Singles]
    relative: float
    floors: dict[str, tuple[float, ...]]
    companion_sha256: Mapping[str, str] | None = None

    def to_json(self) -> str:
        """Return the text of `golden.json`."""
        content: dict[str, Any] = {
            "sha256": self.sha256,
            "tolerance": {
                "rule": "|a - b| <= relative * max(|b|, floor)",
                "relative": self.relative,
                "floor": self.floors,
            },
            "inputs": {INPUT: self.charge_pC.tolist()},
            "outputs": {name: rows.tolist() for name, rows in self.outputs.items()},
        }
        if self.companion_sha256 is not None:
            content["files"] = dict(self.companion_sha256)
        return json.dumps(content, indent=1, allow_nan=False) + "\n"


def make_golden(
    session: ort.InferenceSession, onnx_model: bytes, charge_pC: Singles, contact_floor: tuple[float, float, float]
) -> Golden:
    """Compute the golden vectors of a new model, which are input charges with the outputs that the model must give.

    Args:
        session: Session of the model.
        onnx_model: Content of `model.onnx`, of which the checksum is computed.
        charge_pC: Input charges, shape (n, electrodes), pC.
        contact_floor: Floors of x and y, mm, and of the force, N, as `contact_floors` returns them.

    Raises:
        ModelError: If an output is not finite.
    """
    outputs = run(session, charge_pC)
    for name, rows in outputs.items():
        bad_rows = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad_rows.size:
            row = bad_rows[0]  # the message shows the first of them
            raise ModelError(
                f"the new model: {name}: expected finite outputs, got {rows[row]} for the charges {charge_pC[row]} pC"
            )
    floors = FLOORS | {"contact": contact_floor, "contact_std": contact_floor}
    return Golden(
        sha256=sha256_of(onnx_model),
        charge_pC=charge_pC,
        outputs=outputs,
        relative=RELATIVE_TOLERANCE,
        floors={name: floors[name] for name in outputs},
    )


def read_golden(path: Path) -> Golden:
    """Read the golden vectors of a model, which are stored charges and outputs, from its file `golden.json`.

    Raises:
        ModelError: If the file is missing or damaged.
    """
    if not path.exists():
        raise ModelError(f"{path}: missing; every model has this file: copy the whole folder of the model again")
    try:
        content = read_json(path, "golden vectors", ModelError, _GoldenFile)
    except ModelError as error:
        raise ModelError(f"{error}; the file is damaged: copy or export the model again") from error
    # An output that the model does not have, such as the correlations of an older model, is None in the file.
    present_outputs = [name for name in OUTPUTS if getattr(content.outputs, name) is not None]
    return Golden(
        sha256=content.sha256,
        charge_pC=_float32_array(content.inputs.charge_pC),
        outputs={name: _float32_array(getattr(content.outputs, name)) for name in present_outputs},
        relative=content.tolerance.relative,
        floors={name: getattr(content.tolerance.floor, name) for name in present_outputs},
        companion_sha256=content.files,
    )


Triple = tuple[Finite, Finite, Finite]
"""Three finite numbers, one for each column of an output."""


class _Inputs(Struct):
    """The object `inputs` of `golden.json`."""

    charge_pC: Annotated[list[list[Finite]], Meta(min_length=1)]

    def __post_init__(self) -> None:
        lengths = {len(row) for row in self.charge_pC}
        if len(lengths) > 1:
            raise WrongKey(INPUT, "rows of one length", self.charge_pC)


class _Outputs(Struct):
    """The object `outputs` of `golden.json`."""

    contact: list[Triple]
    contact_std: list[Triple]
    misfit: list[tuple[Finite]]
    contact_correlation: list[Triple] | None = None


class _Floors(Struct):
    """The object `tolerance.floor` of `golden.json`."""

    contact: Triple
    contact_std: Triple
    misfit: tuple[Finite]
    contact_correlation: Triple = (10.0, 10.0, 10.0)


class _Tolerance(Struct):
    """The object `tolerance` of `golden.json`."""

    relative: NotNegative
    floor: _Floors


class _GoldenFile(Struct):
    """The content of `golden.json`. The number of rows of the outputs is checked when the model is read."""

    sha256: Text
    inputs: _Inputs
    outputs: _Outputs
    tolerance: _Tolerance
    files: dict[Text, Text] | None = None


def _float32_array(rows: Sequence[Sequence[float]]) -> Singles:
    """Return rows of numbers as a float32 array of shape (n, width).

    Numbers that are too large for float32 become infinite, so that they differ from every output of a model.
    """
    if not rows:
        return np.zeros((0, 0), dtype=np.float32)
    with np.errstate(over="ignore"):
        return np.array(rows, dtype=np.float64).astype(np.float32)


def check_outputs(golden: Golden, outputs: dict[str, Singles], where: str) -> None:
    """Compare the outputs that a model has computed from the golden charges with the stored outputs.

    Args:
        golden: Golden vectors.
        outputs: Computed outputs by name, each of shape (n, width).
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If an output differs by more than the tolerance. The message names the largest difference.
    """
    for name, expected in golden.outputs.items():
        actual = outputs[name].astype(np.float64)
        # Below its floor, a value has a constant tolerance, because a relative tolerance would approach 0.
        tolerance = golden.relative * np.maximum(np.abs(expected), golden.floors[name])
        with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 with a tolerance of 0 is reported as a difference
            ratio = np.abs(actual - expected) / tolerance  # shape (n, width)
        if (ratio <= 1.0).all():
            continue

        ratio[np.isnan(ratio)] = np.inf  # a value that is not a number is the largest difference
        row, column = np.unravel_index(np.argmax(ratio), ratio.shape)
        raise ModelError(
            f"{where}: {name}[{row}, {column}]: expected {expected[row, column]:.9g} +- {tolerance[row, column]:.1g} "
            f"(golden.json), got {actual[row, column]:.9g}; copy or export the model again"
        )
