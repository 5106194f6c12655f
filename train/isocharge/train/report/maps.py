"""Where the errors are: over the film, over the force, and whether the deviations hold."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.simulate import Domain
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines.networks import ReleasedModel
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.report.case import EvaluationCase
from isocharge.train.report.limits import CRAMER_RAO
from isocharge.train.report.measures import coverage, rounded

DRAW_SEED = 90_000
"""Seed of the noise draws, relative to the case's seed."""

LEVELS = np.array([0.05, *np.arange(0.1, 0.95, 0.1), 0.95, 0.99])
"""Nominal levels of the calibration plot."""

SHARES = (0.68, 0.95)
"""Nominal levels of the table."""

FORCE_BINS = 12
"""Bins of the error against force."""

COORDINATES = ("x", "y", "force")


@dataclass(frozen=True)
class Draws:
    """The released model's answers to the test presses under several draws of the noise.

    Attributes:
        truth: Presses, repeated, shape (n draws, 3).
        contact: Answers, of the same shape.
        std: Their standard deviations.
    """

    truth: Array
    contact: Array
    std: Array

    @classmethod
    def of(cls, released: ReleasedModel, clean: LabelledPresses, case: EvaluationCase, draws: int) -> "Draws":
        """So many draws of the case's noise."""
        seeds = range(case.seed + DRAW_SEED, case.seed + DRAW_SEED + draws)
        contact, std, _ = released.answer(np.concatenate([clean.noisy(case.noise, seed) for seed in seeds]))
        return cls(np.tile(clean.contact, (draws, 1)), contact, std)

    @property
    def position(self) -> Array:
        """Position errors, shape (n draws,), mm."""
        return position_error(self.contact, self.truth)

    @property
    def force_percent(self) -> Array:
        """Relative force errors, shape (n draws,)."""
        error: Array = 100.0 * (self.contact[:, 2] / self.truth[:, 2] - 1.0)
        return error


def by_force(domain: Domain, truth: Array, contacts: Mapping[str, Array], cramer_rao: Array) -> dict[str, Any]:
    """Root-mean-square position error, mm, of several methods and Cramér-Rao's in bins of equal steps of log force."""
    edges = np.geomspace(*domain.force_range, FORCE_BINS + 1)
    number = np.digitize(truth[:, 2], edges[1:-1])
    errors = {name: position_error(contact, truth[: len(contact)]) for name, contact in contacts.items()}
    lines = {
        name: [_rms_of(error[(number[: len(error)] == k) & np.isfinite(error)]) for k in range(FORCE_BINS)]
        for name, error in {**errors, CRAMER_RAO: cramer_rao}.items()
    }
    return {"force_N": [rounded(value) for value in np.sqrt(edges[:-1] * edges[1:])], "position_rms_mm": lines}


def _rms_of(errors: Array) -> float | None:
    return rounded(rms(errors)) if errors.size else None


def calibration(domain: Domain, draws: Draws) -> dict[str, Any]:
    """Coverage of the central intervals: at many levels, and at 68 and 95 % in terciles of force and radius."""
    covered = coverage(draws.contact, draws.std, draws.truth, LEVELS)
    distance, force = np.hypot(*draws.truth[:, :2].T), draws.truth[:, 2]
    parts = {"everywhere": np.full(force.size, True)}
    for low, high in pairwise(np.geomspace(*domain.force_range, 4)):
        parts[f"{low:.2g} to {high:.2g} N"] = (force >= low) & (force <= high)
    for low, high in pairwise(domain.radius * np.sqrt(np.arange(4) / 3)):
        parts[f"{low:.1f} to {high:.1f} mm from the centre"] = (distance >= low) & (distance <= high)
    return {
        "levels": [rounded(level, 3) for level in LEVELS],
        "coverage": {name: [rounded(share) for share in covered[:, k]] for k, name in enumerate(COORDINATES)},
        "parts": [{"where": name, **_shares(draws, rows)} for name, rows in parts.items()],
    }


def _shares(draws: Draws, rows: Booleans) -> dict[str, dict[str, float | None]]:
    covered = coverage(draws.contact[rows], draws.std[rows], draws.truth[rows], np.array(SHARES))
    return {
        f"coverage_{round(100 * share)}": dict(zip(COORDINATES, map(rounded, line), strict=True))
        for share, line in zip(SHARES, covered, strict=True)
    }
