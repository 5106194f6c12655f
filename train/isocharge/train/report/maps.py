"""Where the errors are: over the film, over the force, the worst regions; and whether the deviations hold."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines import ReleasedModel
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import noisy_charges
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.report.bench import EvaluationScene
from isocharge.train.report.limits import CRAMER_RAO
from isocharge.train.report.measures import coverage, rounded

DRAW_SEED = 90_000
"""Seed of the noise draws, relative to the scene's seed."""

RINGS, SECTORS, FORCES = 4, 12, 3
"""Cells that the worst regions are looked for in: rings of equal area, sectors, equal steps of log force."""

WORST = 8
"""Regions that are listed."""

LEVELS = np.array([0.05, *np.arange(0.1, 0.95, 0.1), 0.95, 0.99])
"""Nominal levels of the calibration plot."""

SHARES = (0.68, 0.95)
"""Nominal levels of the table."""

FORCE_BINS = 12
"""Bins of the error against force."""


class Draws:
    """The released model's answers to the test presses under several draws of the noise.

    Attributes:
        truth: Presses, repeated, shape (n draws, 3).
        contact: Answers, of the same shape.
        std: Their standard deviations.
    """

    def __init__(self, released: ReleasedModel, clean: LabelledPresses, bench: EvaluationScene, draws: int) -> None:
        answers = [
            released.answer(noisy_charges(clean, bench.noise, bench.seed + DRAW_SEED + draw))[:2]
            for draw in range(draws)
        ]
        self.truth = np.tile(clean.contact, (draws, 1))
        self.contact, self.std = (np.concatenate(part) for part in zip(*answers, strict=True))

    @property
    def position_mm(self) -> Array:
        """Position errors, shape (n draws,)."""
        return position_error(self.contact, self.truth)

    @property
    def force_percent(self) -> Array:
        """Relative force errors, shape (n draws,)."""
        error: Array = 100.0 * (self.contact[:, 2] / self.truth[:, 2] - 1.0)
        return error


def force_bins(domain: ContactDomain, force_N: Array, bins: int = FORCE_BINS) -> tuple[Array, Integers]:
    """Middles of bins of equal steps of log force, shape (bins,), N, and the bin of each press."""
    edges = np.geomspace(*domain.force_range_N, bins + 1)
    number = np.clip(np.searchsorted(edges, force_N, side="right") - 1, 0, bins - 1)
    return np.sqrt(edges[:-1] * edges[1:]), number


def by_force(domain: ContactDomain, truth: Array, contacts: dict[str, Array], cramer_rao_mm: Array) -> dict[str, Any]:
    """Root-mean-square position error, mm, of several methods and Cramér-Rao's in bins of the force."""
    middle, number = force_bins(domain, truth[:, 2])
    lines = {}
    for name, contact in contacts.items():
        error = position_error(contact, truth[: len(contact)])
        in_bins = [error[(number[: len(contact)] == k) & np.isfinite(error)] for k in range(len(middle))]
        lines[name] = [rounded(rms(part)) if part.size else None for part in in_bins]
    lines[CRAMER_RAO] = [rounded(rms(cramer_rao_mm[number == k])) for k in range(len(middle)) if (number == k).any()]
    return {"force_N": [rounded(value) for value in middle], "position_rms_mm": lines}


def worst_regions(
    domain: ContactDomain, draws: Draws, bayes: Array | None, contact: Array, truth: Array
) -> list[dict[str, Any]]:
    """The cells in which the released model errs most.

    Args:
        domain: Cut into cells.
        draws: Its answers.
        bayes: The limit's answers to the first of the test presses.
        contact: Its answers to the same noisy charges.
        truth: Those presses.
    """
    cell, error, force = _cells(domain, draws.truth), draws.position_mm, draws.force_percent
    number = np.unique(cell)
    ranked = sorted(number, key=lambda k: -rms(error[cell == k]))[:WORST]
    few = _cells(domain, truth[: len(bayes)]) if bayes is not None else None
    return [
        {
            **_cell_limits(domain, int(k)),
            "position_rms_mm": rounded(rms(error[cell == k])),
            "force_rms_percent": rounded(rms(force[cell == k])),
            "over_bayes": _over_bayes(bayes, contact, truth, few == k)
            if bayes is not None and few is not None
            else None,
        }
        for k in ranked
    ]


def _over_bayes(bayes: Array, contact: Array, truth: Array, cell: np.ndarray) -> float | None:
    if not cell.any():
        return None
    rows = np.flatnonzero(cell)
    mine, limit = (rms(position_error(each[rows], truth[rows])) for each in (contact, bayes))
    return rounded(mine / limit, 3)


def _cells(domain: ContactDomain, truth: Array) -> Integers:
    ring = np.minimum(RINGS * (np.hypot(*truth[:, :2].T) / domain.radius_mm) ** 2, RINGS - 1).astype(np.intp)
    angle = np.mod(np.arctan2(truth[:, 1], truth[:, 0]), 2.0 * np.pi)
    sector = np.minimum(SECTORS * angle / (2.0 * np.pi), SECTORS - 1).astype(np.intp)
    cell: Integers = (ring * SECTORS + sector) * FORCES + force_bins(domain, truth[:, 2], FORCES)[1]
    return cell


def _cell_limits(domain: ContactDomain, cell: int) -> dict[str, Any]:
    ring, sector, force = cell // (SECTORS * FORCES), cell // FORCES % SECTORS, cell % FORCES
    radii = domain.radius_mm * np.sqrt(np.array([ring, ring + 1]) / RINGS)
    edges = np.geomspace(*domain.force_range_N, FORCES + 1)[force : force + 2]
    return {
        "radius_mm": [rounded(value, 3) for value in radii],
        "angle_deg": [360 * sector // SECTORS, 360 * (sector + 1) // SECTORS],
        "force_N": [rounded(value, 3) for value in edges],
    }


def calibration(domain: ContactDomain, draws: Draws) -> dict[str, Any]:
    """Coverage of the central intervals: at many levels, and at 68 and 95 % in terciles of force and radius."""
    covered = coverage(draws.contact, draws.std, draws.truth, LEVELS)
    return {
        "levels": [rounded(level, 3) for level in LEVELS],
        "coverage": {name: [rounded(share) for share in covered[:, k]] for k, name in enumerate(COORDINATES)},
        "parts": list(_parts(domain, draws)),
    }


COORDINATES = ("x", "y", "force")


def _parts(domain: ContactDomain, draws: Draws) -> Iterator[dict[str, Any]]:
    distance, force = np.hypot(*draws.truth[:, :2].T), draws.truth[:, 2]
    radii = domain.radius_mm * np.sqrt(np.arange(4) / 3)
    newtons = np.geomspace(*domain.force_range_N, 4)
    yield _part("everywhere", draws, np.full(force.size, True))
    for low, high in pairwise(newtons):
        yield _part(f"{low:.2g} to {high:.2g} N", draws, (force >= low) & (force <= high))
    for low, high in pairwise(radii):
        yield _part(f"{low:.1f} to {high:.1f} mm from the centre", draws, (distance >= low) & (distance <= high))


def _part(name: str, draws: Draws, rows: np.ndarray) -> dict[str, Any]:
    covered = coverage(draws.contact[rows], draws.std[rows], draws.truth[rows], np.array(SHARES))
    return {
        "where": name,
        **{
            f"coverage_{round(100 * share)}": {c: rounded(covered[i, k]) for k, c in enumerate(COORDINATES)}
            for i, share in enumerate(SHARES)
        },
    }
