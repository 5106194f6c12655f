"""Golden vectors: charges, and a model's answers to them at the time of export.

They show whether a file is still the one that was released (checksum), and whether another machine or runtime computes
the same answers: |a - b| <= 1e-5 max(|b|, floor).
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from isocharge.arrays import Singles
from isocharge.errors import ModelError
from isocharge.files import sha256_of
from isocharge.serve.model.session import INPUT, OUTPUTS, run

RELATIVE = 1e-5
"""Largest difference of two answers, relative to max(|answer|, floor), dimensionless."""

FLOORS = {
    "contact": (1.0, 1.0, 0.1),  # mm, mm, N
    "contact_std": (1.0, 1.0, 0.1),
    # The sinh of a norm whose terms cancel near zero: float32 agrees between runtimes to 1e-4.
    "misfit": (20.0,),
}
"""Floor for each column of an output, in the unit of the column."""


@dataclass(frozen=True)
class Golden:
    """Golden vectors of one model.

    Attributes:
        sha256: Checksum of the model file.
        charge_pC: Inputs, shape (n, electrodes), pC.
        outputs: Answers by output name, shape (n, width).
        relative: Tolerance relative to max(|answer|, floor).
        floors: The floor for each column, by output name.
    """

    sha256: str
    charge_pC: Singles
    outputs: dict[str, Singles]
    relative: float
    floors: dict[str, tuple[float, ...]]

    def to_json(self) -> str:
        """The text of `golden.json`."""
        content = {
            "sha256": self.sha256,
            "tolerance": {
                "rule": "|a - b| <= relative * max(|b|, floor)",
                "relative": self.relative,
                "floor": self.floors,
            },
            "inputs": {INPUT: self.charge_pC.tolist()},
            "outputs": {name: rows.tolist() for name, rows in self.outputs.items()},
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"


def make_golden(session: ort.InferenceSession, onnx_model: bytes, charge_pC: Singles) -> Golden:
    """Run charges of shape (n, electrodes), pC, through a model and keep its answers.

    Raises:
        ModelError: If an answer is not finite.
    """
    outputs = run(session, charge_pC)
    for name, rows in outputs.items():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad.size:
            raise ModelError(f"the new model answers {name} = {rows[bad[0]]} to the charges {charge_pC[bad[0]]} pC")
    return Golden(sha256_of(onnx_model), charge_pC, outputs, RELATIVE, FLOORS)


def read_golden(path: Path) -> Golden:
    """Read `golden.json`.

    Raises:
        ModelError: If it is missing or damaged.
    """
    try:
        return _from_json(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        raise ModelError(f"{path}: missing; a model comes with its golden.json: copy the whole folder") from error
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ModelError(
            f"{path}: damaged ({type(error).__name__}: {error}); copy or export the model again"
        ) from error


def _from_json(content: dict[str, Any]) -> Golden:
    return Golden(
        sha256=str(content["sha256"]),
        charge_pC=np.array(content["inputs"][INPUT], dtype=np.float32),
        outputs={name: np.array(content["outputs"][name], dtype=np.float32) for name in OUTPUTS},
        relative=float(content["tolerance"]["relative"]),
        floors={name: tuple(content["tolerance"]["floor"][name]) for name in OUTPUTS},
    )


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
        excess = np.abs(got - expected) / allowed
        if not (excess <= 1.0).all():
            row, column = np.unravel_index(np.argmax(excess), excess.shape)
            raise ModelError(
                f"{where}: {name}[{row}, {column}] is {got[row, column]:.9g}, golden.json says "
                f"{expected[row, column]:.9g} +- {allowed[row, column]:.1g}; copy or export the model again"
            )
