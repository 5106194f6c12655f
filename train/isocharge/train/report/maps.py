"""Where the errors are: over the film, over the force, the worst regions; and whether the deviations hold."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate import Domain
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines.networks import ReleasedModel
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.report.case import EvaluationCase
from isocharge.train.report.limits import CRAMER_RAO
from isocharge.train.report.measures import coverage, rounded
from isocharge.train.report.methods import over_bayes

DRAW_SEED = 90_000
"""Seed of the noise draws, relative to the case's seed."""

RINGS, SECTORS, FORCES = 4, 12, 3
"""Cells among which the worst regions are: rings of equal area, sectors, equal steps of log force."""

WORST = 8
"""Regions that are listed."""

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


def force_bins(domain: Domain, force: Array, bins: int = FORCE_BINS) -> tuple[Array, Integers]:
    """Middles of bins of equal steps of log force, shape (bins,), N, and the bin of each press."""
    edges = np.geomspace(*domain.force_range, bins + 1)
    number = np.clip(np.searchsorted(edges, force, side="right") - 1, 0, bins - 1)
    return np.sqrt(edges[:-1] * edges[1:]), number


def by_force(domain: Domain, truth: Array, contacts: Mapping[str, Array], cramer_rao: Array) -> dict[str, Any]:
    """Root-mean-square position error, mm, of several methods and Cramér-Rao's in bins of the force."""
    middle, number = force_bins(domain, truth[:, 2])
    errors = {name: position_error(contact, truth[: len(contact)]) for name, contact in contacts.items()}
    lines = {
        name: [_rms_of(error[(number[: len(error)] == k) & np.isfinite(error)]) for k in range(len(middle))]
        for name, error in {**errors, CRAMER_RAO: cramer_rao}.items()
    }
    return {"force_N": [rounded(value) for value in middle], "position_rms_mm": lines}


def _rms_of(errors: Array) -> float | None:
    return rounded(rms(errors)) if errors.size else None


def worst_regions(
    domain: Domain, draws: Draws, bayes: Array | None, contact: Array, truth: Array
) -> list[dict[str, Any]]:
    """The cells in which the released model errs most.

    Args:
        domain: Cut into cells.
        draws: Its answers.
        bayes: The limit's answers to the first of the test presses.
        contact: Its answers to the same noisy charges.
        truth: Those presses.
    """
    cell, of_truth, error = _cells(domain, draws.truth), _cells(domain, truth), draws.position
    regions = []
    for k in sorted(np.unique(cell).tolist(), key=lambda k: -rms(error[cell == k]))[:WORST]:
        few = None if bayes is None else np.flatnonzero(of_truth[: len(bayes)] == k)
        ratio = over_bayes(contact[few], bayes[few], truth[few]) if bayes is not None and few is not None else None
        ring, sector, force = k // (SECTORS * FORCES), k // FORCES % SECTORS, k % FORCES
        edges = np.geomspace(*domain.force_range, FORCES + 1)
        region = {
            "radius_mm": [rounded(domain.radius * np.sqrt(step / RINGS), 3) for step in (ring, ring + 1)],
            "angle_deg": [360 * step // SECTORS for step in (sector, sector + 1)],
            "force_N": [rounded(value, 3) for value in edges[force : force + 2]],
            "position_rms_mm": rounded(rms(error[cell == k])),
            "force_rms_percent": rounded(rms(draws.force_percent[cell == k])),
            "over_bayes": rounded(ratio, 3),
        }
        regions.append(region)
    return regions


def _cells(domain: Domain, truth: Array) -> Integers:
    ring = np.minimum(RINGS * (np.hypot(*truth[:, :2].T) / domain.radius) ** 2, RINGS - 1).astype(np.intp)
    angle = np.mod(np.arctan2(truth[:, 1], truth[:, 0]), 2.0 * np.pi)
    sector = np.minimum(SECTORS * angle / (2.0 * np.pi), SECTORS - 1).astype(np.intp)
    cell: Integers = (ring * SECTORS + sector) * FORCES + force_bins(domain, truth[:, 2], FORCES)[1]
    return cell


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
