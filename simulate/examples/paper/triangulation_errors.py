"""Position errors of triangulation over the working area: by the graphical method and from the field."""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from choices import PAPER
from solves import FORCE, Solves, sample

from isocharge.common.arrays import Array
from isocharge.common.progress import track
from isocharge.simulate import ChargeSpline, Triangulation
from isocharge.simulate.contours.fix import Fix, Meeting
from isocharge.simulate.contours.graphical_method import DrawnTriangulation
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.measuring_chain.noise_file import noise_model

LAYOUTS = ("three", "four")

DEGREES = (2, 3, 4)

BEYOND = 1.15
"""Radius within which contours are followed over that of the working area, dimensionless: contours of a press on its
edge meet too."""

SEED = 0


@dataclass(frozen=True)
class Errors:
    """Errors of triangulated presses.

    Attributes:
        fix: Triangulated positions.
        at: True positions, shape (n, 2), mm.
    """

    fix: Fix
    at: Array

    @property
    def found_mm(self) -> Array:
        """Position errors of the presses with a position, ascending, mm."""
        errors = np.hypot(*(self.fix.contact[:, :2] - self.at).T)
        return np.sort(errors[self.fix.found])

    @property
    def share_found(self) -> float:
        """Share of the presses whose contours met."""
        return float(self.fix.found.mean())

    def percentile(self, share: float) -> float:
        """Percentile of the position errors, mm; `share` in percent."""
        return float(np.percentile(self.found_mm, share)) if self.found_mm.size else float("nan")

    def share_below(self, error_mm: float) -> float:
        """Percentage of the presses with a position whose error is at most `error_mm`."""
        return float(100.0 * np.mean(self.found_mm <= error_mm)) if self.found_mm.size else float("nan")

    def numbers(self) -> dict[str, object]:
        """For programs."""
        states = {meeting.name: int(np.sum(self.fix.status == meeting)) for meeting in Meeting}
        quantiles = {f"p{share}_mm": self.percentile(share) for share in (25, 50, 75, 95)}
        return {
            "presses": len(self.at),
            **states,
            **quantiles,
            "percentile_of_0.122_mm": self.share_below(PAPER.error_mm),
        }


@dataclass(frozen=True)
class Accuracy:
    """Errors over the working area, 1 N, triangular probe, the force known.

    Attributes:
        drawn: Graphical method without noise, by layout and degree of the polynomials.
        field: From the field without noise, by layout.
        noisy: From the field with the reference noise, by layout.
        drawn_noisy: Graphical method with the reference noise, by layout.
        mistaken: From the field, presses with another probe or film than the contours assume, by variation.
    """

    drawn: Mapping[tuple[str, int], Errors]
    field: Mapping[str, Errors]
    noisy: Mapping[str, Errors]
    drawn_noisy: Mapping[str, Errors]
    mistaken: Mapping[str, Errors]

    @classmethod
    def of(cls, solves: Solves, executor: Executor | None) -> "Accuracy":
        """Triangulate."""
        degrees = [degree for degree in DEGREES if degree <= solves.choices.degree]
        jobs = [(solves, layout, degree, False) for layout in LAYOUTS for degree in degrees]
        jobs += [(solves, layout, solves.choices.degree, True) for layout in LAYOUTS]
        located = in_order(executor, _locate, [_graphical_job(*job) for job in jobs])
        results = list(track(located, "triangulating", len(jobs)))
        drawn = {(layout, degree): errors for (_, layout, degree, _), errors in zip(jobs[:-2], results, strict=False)}
        field, noisy, mistaken = {}, {}, {}
        for layout in LAYOUTS:
            forward_map = solves.forward_map("triangle", solves.choices.sensor(layout))
            radius, spacing = BEYOND * solves.choices.radius, solves.choices.spacing
            contours = Triangulation(ChargeSpline.of(forward_map, radius, spacing))
            charge = solves.charges("triangle", forward_map.sensor, solves.places)
            field[layout] = Errors(contours.locate(charge, FORCE), solves.places)
            noisy[layout] = Errors(contours.locate(_noisy(charge), FORCE), solves.places)
            if layout == "three":
                at = np.array(sample(solves.choices))
                mistaken = {name: Errors(contours.locate(q[0], FORCE), at) for name, q in solves.variants.items()}
        return cls(drawn, field, noisy, dict(zip(LAYOUTS, results[-2:], strict=True)), mistaken)


def _noisy(charge: Array) -> Array:
    return noise_model("reference").add(charge, np.random.default_rng(SEED))


def _graphical_job(solves: Solves, layout: str, degree: int, noise: bool) -> tuple[DrawnTriangulation, Array, Array]:
    """A job for a worker process: curves and charges, without the large forward maps."""
    sensor = solves.choices.sensor(layout)
    charge = solves.charges("triangle", sensor, solves.places)
    return (
        DrawnTriangulation(solves.scheme("triangle", sensor), degree),
        solves.places,
        _noisy(charge) if noise else charge,
    )


def _locate(job: tuple[DrawnTriangulation, Array, Array]) -> Errors:
    contours, at, charge = job
    return Errors(contours.locate(charge), at)


def largest_change(solves: Solves, name: str) -> float:
    """Largest relative change of a charge that a variation makes, over the presses of the variations."""
    at = np.array(sample(solves.choices))
    charge = solves.charges("triangle", solves.choices.sensor("three"), at)
    return float(np.abs(solves.variants[name][0] / charge - 1.0).max())
