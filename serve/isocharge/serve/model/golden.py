"""Golden vectors: charges, and a model's answers to them at the time of export.

They show whether a file is still the one that was released (checksum), and whether another machine or runtime computes
the same answers: |a - b| <= 1e-5 max(|b|, floor).
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

RELATIVE = 1e-5
"""Largest difference of two answers, relative to max(|answer|, floor), dimensionless."""

FLOORS = {
    "contact": (1.0, 1.0, 0.1),  # mm, mm, N
    "contact_std": (1.0, 1.0, 0.1),
    CORRELATION: (10.0, 10.0, 10.0),  # the cosine of a sum whose terms nearly cancel: 1e-4 between runtimes
    # The sinh of a norm whose terms cancel near zero: float32 agrees between runtimes to 1e-4.
    "misfit": (20.0,),
}
"""Floor for each column of an output, in the unit of the column."""

USUAL_REACH_MM, USUAL_FORCE_N = 20.0, 2.0
"""Reach of a working area and largest force up to which these floors hold; beyond, they grow in proportion."""


def contact_floors(metadata: ModelMetadata) -> tuple[float, float, float]:
    """Floors of x and y, mm, and force, N: larger for a wide area, large forces, and where millimetres are noise."""
    x_mm, y_mm, force_N = FLOORS["contact"]
    reach_mm = max(math.hypot(x, y) for x, y in metadata.working_area_mm)
    length = max(1.0, reach_mm / USUAL_REACH_MM, metadata.errors.get("position_rms_mm", 0.0) / x_mm)
    return x_mm * length, y_mm * length, force_N * max(1.0, metadata.force_range_N[1] / USUAL_FORCE_N)


@dataclass(frozen=True)
class Golden:
    """Golden vectors of one model.

    Attributes:
        sha256: Checksum of the model file.
        charge_pC: Inputs, shape (n, electrodes), pC.
        outputs: Answers by output name, shape (n, width).
        relative: Tolerance relative to max(|answer|, floor).
        floors: The floor for each column, by output name.
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
        """The text of `golden.json`."""
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
    session: ort.InferenceSession, onnx_model: bytes, charge_pC: Singles, contact: tuple[float, float, float]
) -> Golden:
    """Run charges of shape (n, electrodes), pC, through a model and keep its answers; `contact` are `contact_floors`.

    Raises:
        ModelError: If an answer is not finite.
    """
    outputs = run(session, charge_pC)
    for name, rows in outputs.items():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad.size:
            raise ModelError(f"the new model answers {name} = {rows[bad[0]]} to the charges {charge_pC[bad[0]]} pC")
    floors = FLOORS | {"contact": contact, "contact_std": contact}
    return Golden(sha256_of(onnx_model), charge_pC, outputs, RELATIVE, {name: floors[name] for name in outputs})


def read_golden(path: Path) -> Golden:
    """Read `golden.json`.

    Raises:
        ModelError: If it is missing or damaged.
    """
    if not path.exists():
        raise ModelError(f"{path}: missing; a model comes with its golden.json: copy the whole folder")
    try:
        file = read_json(path, "golden vectors", ModelError, _File)
    except ModelError as error:
        raise ModelError(f"{error}; the file is damaged: copy or export the model again") from error
    given = [name for name in OUTPUTS if getattr(file.outputs, name) is not None]
    return Golden(
        sha256=file.sha256,
        charge_pC=_singles(file.inputs.charge_pC),
        outputs={name: _singles(getattr(file.outputs, name)) for name in given},
        relative=file.tolerance.relative,
        floors={name: getattr(file.tolerance.floor, name) for name in given},
        companion_sha256=file.files,
    )


Three = tuple[Finite, Finite, Finite]


class _Inputs(Struct):
    charge_pC: Annotated[list[list[Finite]], Meta(min_length=1)]

    def __post_init__(self) -> None:
        if len(set(map(len, self.charge_pC))) > 1:
            raise WrongKey(INPUT, "rows of one length", self.charge_pC)


class _Outputs(Struct):
    contact: list[Three]
    contact_std: list[Three]
    misfit: list[tuple[Finite]]
    contact_correlation: list[Three] | None = None


class _Floors(Struct):
    contact: Three
    contact_std: Three
    misfit: tuple[Finite]
    contact_correlation: Three = (10.0, 10.0, 10.0)


class _Tolerance(Struct):
    relative: NotNegative
    floor: _Floors


class _File(Struct):
    """The content of `golden.json`; that there is an answer to each press is checked with the model."""

    sha256: Text
    inputs: _Inputs
    outputs: _Outputs
    tolerance: _Tolerance
    files: dict[Text, Text] | None = None


def _singles(rows: Sequence[Sequence[float]]) -> Singles:
    """An array of shape (n, width); what float32 cannot hold is infinite, and equals no answer."""
    with np.errstate(over="ignore"):
        return np.array(rows, dtype=np.float64).reshape(len(rows), -1 if rows else 0).astype(np.float32)


def check_answers(golden: Golden, answers: dict[str, Singles], where: str) -> None:
    """Compare a model's answers to the golden charges with the golden ones.

    Args:
        golden: Golden vectors.
        answers: By output name, shape (n, width).
        where: The model, for messages.

    Raises:
        ModelError: If an answer differs by more than the tolerance; the worst one is named.
    """
    for name, expected in golden.outputs.items():
        got = answers[name].astype(np.float64)
        allowed = golden.relative * np.maximum(np.abs(expected), golden.floors[name])
        with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 where nothing is allowed: no agreement
            excess = np.abs(got - expected) / allowed
        if not (excess <= 1.0).all():
            worst = np.argmax(np.where(np.isnan(excess), np.inf, excess))
            row, column = np.unravel_index(worst, excess.shape)
            raise ModelError(
                f"{where}: {name}[{row}, {column}] is {got[row, column]:.9g}, golden.json says "
                f"{expected[row, column]:.9g} +- {allowed[row, column]:.1g}; copy or export the model again"
            )
