"""Errors of a predictor on measured presses: as they come, without noise added, and without a simulator's word."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.alarms import alarm_threshold
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.release.evaluate import Predict

HELD_PRESSES = "measured_presses"
"""Entry of a model's errors: number of measured presses that they were measured on. Simulated errors have none."""


@dataclass(frozen=True)
class MeasuredTest:
    """Measured presses that a model is judged by.

    Attributes:
        held: Contacts as the rig read them, charges as measured; never trained on.
        origin: Section of the card: what the model was fitted to.
        made_with: For the metadata.
        further: More files for the version folder, by name.
    """

    held: LabelledPresses
    origin: str = ""
    made_with: Mapping[str, object] = field(default_factory=dict)
    further: Mapping[str, bytes] = field(default_factory=dict)


def measured_errors(predict: Predict, held: LabelledPresses) -> Mapping[str, float]:
    """Position errors in mm, force errors in percent and coverage of the intervals, on measured presses.

    What the rig does not know of places and forces is in the errors.
    """
    contact, std, _ = predict(held.charge_pC)
    position, force = position_error(contact, held.contact), contact[:, 2] / held.contact[:, 2] - 1.0
    deviation = np.abs(contact - held.contact) / std
    errors = {
        "position_median_mm": np.median(position),
        "position_rms_mm": rms(position),
        "position_p95_mm": np.percentile(position, 95),
        "force_median_percent": 100.0 * np.median(np.abs(force)),
        "force_rms_percent": 100.0 * rms(force),
        "coverage_68": np.mean(deviation < 1.0),
        "coverage_95": np.mean(deviation < 1.96),
        HELD_PRESSES: len(held),
    }
    return {name: float(f"{value:.4g}") for name, value in errors.items()}


def measured_alarm(predict: Predict, presses: LabelledPresses) -> Mapping[str, float]:
    """The misfit that 1 % of these measured presses exceed, as a model's errors have it."""
    return {"misfit_p99": float(f"{alarm_threshold(predict(presses.charge_pC)[2]):.4g}")}
