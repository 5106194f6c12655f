"""Position errors of triangulation over the working area, by the graphical method and from the charge map."""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial

import numpy as np
from choices import ERROR_MM
from drawing import DrawnTriangulation
from solves import Solves, run_all, sample

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeSpline, Triangulation, noise_model
from isocharge.simulate.forward.charge_map import within
from isocharge.simulate.identifiability.triangulation import Fix

LAYOUTS = ("three", "four")

DEGREES = (2, 3, 4)

BEYOND = 1.15
"""Ratio of the radius within which contours are traced to the radius of the working area, dimensionless. It is larger
than one, so that the contours of a press on the edge of the working area meet as well."""

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
        """Percentage of all presses that have a position with an error of at most `error_mm`."""
        return 100.0 * np.count_nonzero(self.found_mm <= error_mm) / len(self.at)

    def numbers(self) -> dict[str, object]:
        """Return the statistics of the errors for programs."""
        return {
            "presses": len(self.at),
            "found": int(self.fix.found.sum()),
            **{f"p{share}_mm": self.percentile(share) for share in (25, 50, 75, 95)},
            "percent_of_all_presses_below_0.122_mm": self.share_below(ERROR_MM),
        }


@dataclass(frozen=True)
class Accuracy:
    """Errors of presses of 1 N by the triangular probe over the working area, for a known force.

    Attributes:
        drawn: Errors of the graphical method without noise, by layout and degree of the polynomials.
        field: Errors of contours from the charge map without noise, by layout.
        noisy: Errors of contours from the charge map with the reference noise, by layout.
        drawn_noisy: Errors of the graphical method with the reference noise, by layout.
        mistaken: Errors of contours from the charge map, for presses with another probe or film than the contours
            assume, by variation.
    """

    drawn: Mapping[tuple[str, int], Errors]
    field: Mapping[str, Errors]
    noisy: Mapping[str, Errors]
    drawn_noisy: Mapping[str, Errors]
    mistaken: Mapping[str, Errors]

    @classmethod
    def of(cls, solves: Solves, executor: Executor | None) -> "Accuracy":
        """Triangulate all presses.

        Args:
            solves: Solved presses and maps.
            executor: Executor that runs the triangulations; this process if None.
        """
        choices = solves.choices
        places = solves.places
        noise = noise_model("reference")
        sensors = {layout: choices.sensor(layout) for layout in LAYOUTS}
        clean = {layout: solves.charges("triangle", sensor, places) for layout, sensor in sensors.items()}
        noisy = {layout: noise.add(charge, np.random.default_rng(SEED)) for layout, charge in clean.items()}
        drawings = [
            (layout, degree, clean[layout]) for layout in LAYOUTS for degree in DEGREES if degree <= choices.degree
        ]
        drawings += [(layout, choices.degree, noisy[layout]) for layout in LAYOUTS]
        schemes = {layout: solves.scheme("triangle", sensor) for layout, sensor in sensors.items()}
        jobs = [
            partial(DrawnTriangulation(schemes[layout], degree).locate, charge) for layout, degree, charge in drawings
        ]
        drawn = [Errors(fix, places) for fix in run_all(jobs, "triangulating", executor)]
        fields = {
            layout: Triangulation(
                within(
                    ChargeSpline.of(solves.forward_map("triangle", sensor), choices.spacing), BEYOND * choices.radius
                )
            )
            for layout, sensor in sensors.items()
        }
        return cls(
            {(layout, degree): errors for (layout, degree, _), errors in zip(drawings[:-2], drawn, strict=False)},
            {layout: Errors(fields[layout].locate(clean[layout]), places) for layout in LAYOUTS},
            {layout: Errors(fields[layout].locate(noisy[layout]), places) for layout in LAYOUTS},
            dict(zip(LAYOUTS, drawn[-2:], strict=True)),
            {name: Errors(fields["three"].locate(charge), sample(choices)) for name, charge in solves.variants.items()},
        )
