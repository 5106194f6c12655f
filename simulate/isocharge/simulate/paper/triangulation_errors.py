"""How well triangulation finds presses spread over the working area: the paper's way and from the field."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array
from isocharge.progress import Progress
from isocharge.simulate.contours.fix import Fix, Meeting
from isocharge.simulate.contours.graphical_method import DrawnTriangulation
from isocharge.simulate.contours.triangulation import Triangulation
from isocharge.simulate.execution.workers import Workers
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.paper.choices import PAPER
from isocharge.simulate.paper.solves import FORCE, Solves, sample

LAYOUTS = ("three", "four")

DEGREES = (2, 3, 4)

BEYOND = 1.15
"""Radius over the working area's within which contours are followed: presses at its edge meet there too."""

SEED = 0


@dataclass(frozen=True)
class Errors:
    """What triangulation made of presses.

    Attributes:
        fix: Positions.
        at: Where was pressed, shape (n, 2), m.
    """

    fix: Fix
    at: Array

    @property
    def found_mm(self) -> Array:
        """Position errors of those that were found, rising, mm."""
        errors = 1e3 * np.hypot(self.fix.x - self.at[:, 0], self.fix.y - self.at[:, 1])
        return np.sort(errors[self.fix.found])

    @property
    def share_found(self) -> float:
        """Share of the presses whose contours met."""
        return float(self.fix.found.mean())

    def percentile(self, share: float) -> float:
        """Error below which so many percent of those found lie, mm."""
        return float(np.percentile(self.found_mm, share)) if self.found_mm.size else float("nan")

    def share_below(self, error_mm: float) -> float:
        """Percent of those found whose error is at most this."""
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
        drawn: The paper's way without noise, by layout and degree of the polynomials.
        field: From the field without noise, by layout.
        noisy: From the field with the reference noise, by layout.
        drawn_noisy: The paper's way with the reference noise, by layout.
        mistaken: From the field, presses of a variation of probe or film with the contours of our choice.
    """

    drawn: Mapping[tuple[str, int], Errors]
    field: Mapping[str, Errors]
    noisy: Mapping[str, Errors]
    drawn_noisy: Mapping[str, Errors]
    mistaken: Mapping[str, Errors]

    @classmethod
    def of(cls, study: Solves, workers: Workers, progress: Progress | None = None) -> "Accuracy":
        """Triangulate; `progress` is told how many of the methods are done."""
        degrees = [degree for degree in DEGREES if degree <= study.choices.degree]
        jobs = [(study, layout, degree, False) for layout in LAYOUTS for degree in degrees]
        jobs += [(study, layout, study.choices.degree, True) for layout in LAYOUTS]
        found = []
        for errors in workers.in_order(_draw, [_light(*job) for job in jobs]):
            found.append(errors)
            if progress:
                progress(len(found), len(jobs) + len(LAYOUTS))
        drawn = {(layout, degree): errors for (_, layout, degree, _), errors in zip(jobs[:-2], found, strict=False)}
        field, noisy, mistaken = {}, {}, {}
        for layout in LAYOUTS:
            film = study.film("triangle", study.choices.sensor(layout))
            contours = Triangulation.from_map(film, radius=BEYOND * study.choices.radius, spacing=study.choices.spacing)
            charge = study.charges("triangle", film.sensor, study.places)
            field[layout] = Errors(contours.locate(charge, FORCE), study.places)
            noisy[layout] = Errors(contours.locate(_noisy(charge), FORCE), study.places)
            if layout == "three":
                at = np.array(sample(study.choices))
                mistaken = {name: Errors(contours.locate(q[0], FORCE), at) for name, q in study.variants.items()}
            if progress:
                progress(len(jobs) + len(field), len(jobs) + len(LAYOUTS))
        return cls(drawn, field, noisy, dict(zip(LAYOUTS, found[-2:], strict=True)), mistaken)


def _noisy(charge: Array) -> Array:
    return noise_model("reference").add(charge, np.random.default_rng(SEED))


def _light(study: Solves, layout: str, degree: int, noise: bool) -> tuple[DrawnTriangulation, Array, Array]:
    """A task that carries curves and charges, not the maps."""
    sensor = study.choices.sensor(layout)
    charge = study.charges("triangle", sensor, study.places)
    return (
        DrawnTriangulation(study.scheme("triangle", sensor), degree),
        study.places,
        _noisy(charge) if noise else charge,
    )


def _draw(job: tuple[DrawnTriangulation, Array, Array]) -> Errors:
    contours, at, charge = job
    return Errors(contours.locate(charge), at)


def largest_change(study: Solves, name: str) -> float:
    """Largest relative change of a charge that a variation makes, over the presses of the variations."""
    at = np.array(sample(study.choices))
    charge = study.charges("triangle", study.choices.sensor("three"), at)
    return float(np.abs(study.variants[name][0] / charge - 1.0).max())
