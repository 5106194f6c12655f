"""Errors of a model on measured presses, one by one, beside the deviations that noise and rig explain."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.flags import MISFIT, OUTSIDE
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.prediction.contact import Contacts
from isocharge.serve.prediction.measured_presses import MeasuredPresses
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.prediction.validity import MISFIT_LIMIT, Validity, inside_polygon

NO_CHARGE, NOTHING_KNOWN, NOT_TRAINED = "a charge is unknown", "neither place nor force is known", "not trained for"
"""Reasons why a press does not count."""


@dataclass(frozen=True)
class PressErrors:
    """A model's answers to n measured presses, and how far they are off.

    Attributes:
        lines: Line of each press in its file.
        answer: The numbers of a `Contact`, shape (n, 7); NaN where a charge is unknown.
        error: Predicted less known x and y, mm, and force, a share of the known one, shape (n, 3); NaN where unknown.
        noise_std: The model's own standard deviations, in the units of `error`, shape (n, 3): noise of the charges.
        rig_std: Those of what is known, in the units of `error`, shape (n, 3).
        flags: `outside` (the answer, as `Validity` has it) and `misfit` (beyond 1 % of good presses) of each press.
        left_out: Why a press does not count, empty if it does.
    """

    lines: tuple[int, ...]
    answer: Array
    error: Array
    noise_std: Array
    rig_std: Array
    flags: tuple[tuple[str, ...], ...]
    left_out: tuple[str, ...]

    @property
    def counted(self) -> Booleans:
        """Presses that count, shape (n,)."""
        return np.array([not reason for reason in self.left_out], dtype=np.bool_)

    @property
    def variance(self) -> Array:
        """Expected squares of the errors, shape (n, 3)."""
        return self.noise_std**2 + self.rig_std**2

    @property
    def position_error_mm(self) -> Array:
        """Distance from the known place, shape (n,), mm; NaN where unknown."""
        distance: Array = np.hypot(self.error[:, 0], self.error[:, 1])
        return distance

    def row(self, press: int) -> dict[str, Any]:
        """One press, names with units."""
        error, noise, rig = self.error[press], self.noise_std[press], self.rig_std[press]
        return {
            "line": self.lines[press],
            **dict(zip(Contacts._fields, self.answer[press].tolist(), strict=True)),
            "x_error_mm": error[0],
            "y_error_mm": error[1],
            "position_error_mm": self.position_error_mm[press],
            "force_error_percent": 100.0 * error[2],
            "noise_std_percent": 100.0 * noise[2],
            "position_std_mm": rig[0],
            "force_std_percent": 100.0 * rig[2],
            "flags": list(self.flags[press]),
            "left_out": self.left_out[press] or None,
        }


def press_errors(predictor: Predictor, presses: MeasuredPresses) -> PressErrors:
    """Predict measured presses and compare.

    Raises:
        PressError: If a charge of one of the model's electrodes is missing.
    """
    metadata = predictor.metadata
    presses = presses.of_electrodes(metadata.electrodes, metadata.label)
    answer = _answers(predictor, presses.charge_pC)
    known = presses.contact
    scale = np.column_stack([np.ones((len(presses), 2)), known[:, 2]])
    rig_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
    unknown = np.where(np.isnan(known), np.nan, 1.0)
    return PressErrors(
        presses.lines,
        answer,
        (answer[:, :3] - known) / scale,
        answer[:, 3:6] / scale * unknown,
        rig_std * unknown,
        _flags(metadata, answer),
        _reasons(metadata, presses),
    )


def misfit_limit(metadata: ModelMetadata) -> float:
    """Misfit that 1 % of good presses exceed, as the model states it."""
    return float(metadata.errors.get("misfit_p99", MISFIT_LIMIT))


def _answers(predictor: Predictor, charge_pC: Array) -> Array:
    answer = np.full((len(charge_pC), len(Contacts._fields)), np.nan)
    whole = ~np.isnan(charge_pC).any(axis=1)
    answer[whole] = np.column_stack(predictor.predict_batch(charge_pC[whole]))
    return answer


def _flags(metadata: ModelMetadata, answer: Array) -> tuple[tuple[str, ...], ...]:
    outside = [OUTSIDE in flags for flags in Validity.of(metadata).batch_flags(Contacts(*answer.astype(np.float32).T))]
    misfit, whole = answer[:, -1] > misfit_limit(metadata), ~np.isnan(answer[:, 0])
    return tuple(
        (OUTSIDE,) * (is_outside and is_whole) + (MISFIT,) * is_misfit
        for is_outside, is_misfit, is_whole in zip(outside, misfit.tolist(), whole.tolist(), strict=True)
    )


def _reasons(metadata: ModelMetadata, presses: MeasuredPresses) -> tuple[str, ...]:
    """Why a press does not count; a press is in the model's domain by what is known of it, not by the answer."""
    (x_mm, y_mm, force_N), (low, high) = presses.contact.T, metadata.force_range_N
    off = ~np.isnan(x_mm) & ~inside_polygon(x_mm, y_mm, np.array(metadata.working_area_mm))
    off |= (force_N < low) | (force_N > high)
    nothing = np.isnan(presses.contact).all(axis=1)
    partial = np.isnan(presses.charge_pC).any(axis=1)
    chosen = np.select([partial, nothing, off], [NO_CHARGE, NOTHING_KNOWN, NOT_TRAINED], "")
    return tuple(chosen.tolist())
