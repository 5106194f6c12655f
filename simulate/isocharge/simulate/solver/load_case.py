"""A press with everything that is decided about it before it is solved, but the mesh."""

from dataclasses import dataclass
from time import process_time
from typing import Self

import numpy as np

from isocharge.common.errors import SceneError
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.mechanics.theory import Theory, bending_length, choose_theory
from isocharge.simulate.mesh.placed_mesh import PlacedMesh, place
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.mesh.template import corners_of
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.probe import Probe, farthest
from isocharge.simulate.solver.settings import SolveSettings

LAYER = 6.0
"""Width of the thin rings at the rim in bending lengths: any width from 4 to 14 changes a charge by at most 1e-4."""

LAYER_REUSE = (0.75, 2.0)
"""Width of the start's thin rings over six bending lengths: between these ratios the width is kept, so that the start's
field still fits."""

LARGEST_AMPLITUDE2 = 0.1
"""A^2, the size of the strains, dimensionless, above which St. Venant-Kirchhoff elasticity fails: 100 N at 25 um."""

SMALLEST_PROBE = 1e-5
"""Probe reach over film radius: below it the grading of the template exceeds what float64 resolves."""


def check_press(film: Film, probe: Probe, at: tuple[float, float], force: float) -> None:
    """Refuse presses that cannot exist or that stretch the film beyond the range of St. Venant-Kirchhoff elasticity.

    Raises:
        SceneError: If the footprint is too small or not wholly on the film, the force is not positive and finite, or
            the film is stretched beyond small strains.
    """
    if not (np.isfinite(force) and force > 0.0):
        raise SceneError(f"force: expected a positive number of newtons (F > 0 pushes), got {force}")
    if not np.isfinite(at).all():
        raise SceneError(f"position: expected two finite numbers, got {at}")
    if probe.reach < SMALLEST_PROBE * film.radius:
        raise SceneError(
            f"probe: expected a reach of at least {SMALLEST_PROBE:g} of the film's radius ({film.radius:.4g} mm), got "
            f"{probe.reach:.4g} mm"
        )
    if farthest(probe, at) >= film.radius * (1.0 - 1e-6):
        raise SceneError(
            f"probe off the film: centre ({at[0]:.4g}, {at[1]:.4g}) mm, farthest point of {probe.notation} "
            f"{farthest(probe, at):.4g} mm from the film's centre, film radius {film.radius:.4g} mm"
        )
    amplitude2 = amplitude_squared(film, force)
    if amplitude2 > LARGEST_AMPLITUDE2:
        raise SceneError(
            f"force {force:.4g} N stretches a film of {film.thickness:.4g} mm beyond small strains: expected "
            f"(F / (E h a))^(2/3) up to {LARGEST_AMPLITUDE2:g}, got {amplitude2:.3g}"
        )


def layer_for(film: Film, force: float) -> float:
    """Width of the thin rings at the rim over the film's radius."""
    return LAYER * bending_length(film, force)


@dataclass(frozen=True)
class LoadCase:
    """A press with all that is decided about it but the mesh.

    Attributes:
        film: The film.
        probe: The footprint.
        at: Its centroid (x, y), mm.
        force: N.
        theory: Which terms to model.
        layer: Width of the thin rings at the rim over the film's radius.
        accuracy: Target for the relative error of a charge.
        tolerance: Out-of-balance force over load.
        began: Process CPU time when the work on the press began, s.
    """

    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    theory: Theory
    layer: float
    accuracy: float
    tolerance: float
    began: float

    @classmethod
    def of(
        cls,
        film: Film,
        probe: Probe,
        at: tuple[float, float],
        force: float,
        settings: SolveSettings,
        start: PlacedMesh | None,
    ) -> Self:
        """Decide what the settings leave open; `start` is the mesh of the equilibrium that the solve starts from.

        Raises:
            SceneError: If the press cannot exist.
        """
        began = process_time()
        check_press(film, probe, at, force)
        theory = settings.theory
        if theory == "auto":
            theory = choose_theory(film, probe, force, settings.accuracy)
        layer = settings.layer
        if layer == "auto":
            layer = _layer(film, force, probe, settings, start)
        return cls(film, probe, at, force, theory, layer, settings.accuracy, settings.tolerance, began)

    def place(self, resolution: Resolution) -> PlacedMesh:
        """A mesh under this press."""
        return place(self.film, self.probe, self.at, resolution, self.layer)


def _layer(film: Film, force: float, probe: Probe, settings: SolveSettings, start: PlacedMesh | None) -> float:
    """Width of the thin rings: six bending lengths, or the start's width if that is near and its mesh the same."""
    layer = layer_for(film, force)
    if start is None or not LAYER_REUSE[0] < start.layer / layer < LAYER_REUSE[1]:
        return layer
    same_mesh = settings.resolution in ("auto", start.resolution) and corners_of(probe) == start.template.corners
    return start.layer if same_mesh else layer
