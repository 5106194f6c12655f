"""The forward map of every film at once: presses of a round probe, solved over the dimensionless groups of the film.

With a the film's radius, E h its stretching stiffness and R the probe's radius, the scaled stress under a press depends
on five numbers (mechanics.scaling):

    distance / a,   F / (E h a),   pretension / E,   h / a,   R / a,

and on Poisson's ratio, which is one number for a family. In the frame of the template, which follows the probe, the
nodal stress is a smooth function of all five: it is solved on a grid of Chebyshev nodes and interpolated. The grid's
stresses have few independent directions, so they are stored as the coefficients of some fifty modes (the proper
orthogonal decomposition, Sirovich 1987). The forward map of one film is a contraction over the last three numbers, and
takes a millisecond.

In a file, coefficients and modes are integers of 16 bits, each mode with its own scale: 3e-5 of a charge.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, cast, get_args

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError, SceneError, SolveError
from isocharge.common.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.family import Family
from isocharge.simulate.forward.film_grid import AXES, COUNTS, FilmGrid, FilmLimits, limits_of
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.readout import touch_charge
from isocharge.simulate.forward.solve_family import check_family
from isocharge.simulate.forward.solve_films import THEORY, decompose, solve_films
from isocharge.simulate.mesh.resolution import Resolution
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.mesh_choice import layer_for
from isocharge.simulate.solver.press import needed_resolution, press
from isocharge.simulate.solver.settings import SolveSettings

LARGEST_ERROR = 2e-3
"""Largest relative error of any charge against direct solves that a family may have, dimensionless: the lightest
presses on the tautest films have it, whose charges are a few pC; a thousandth of 100 pC is 1e-4."""

SMALL = 0.1
"""Floor for the charge that an error is relative to, as a share of the press's largest charge, dimensionless."""

CHECKS = 24
"""Number of direct solves that a family is compared with."""

SLACK = 1e-9
"""Relative tolerance of the limits: rounding of units."""


@dataclass(frozen=True)
class FilmFamily:
    """Scaled stress under presses of a round probe on all films of one Poisson's ratio.

    Attributes:
        poisson: Poisson's ratio.
        surface: Where in the thickness the stress is read: "middle", "top" or "bottom".
        limits: Smallest and largest value along each axis.
        grid: Where it is solved.
        resolution: Mesh of the solves.
        layer: Width of the thin rings at the rim over the film's radius.
        coefficients: Of the modes at the grid's nodes, shape (n_distance, n_load, n_tension, n_thickness, n_reach,
            n_mode).
        modes: Scaled stress C : E' at the nodes of every element, shape (n_mode, n_element * n_local * 3).
        error: Largest relative error of a charge against the direct solves that the build compared with.
    """

    poisson: float
    surface: Surface
    limits: FilmLimits
    grid: FilmGrid
    resolution: Resolution
    layer: float
    coefficients: Array
    modes: Array
    error: float

    @classmethod
    def build(
        cls,
        prior: FilmPrior,
        radius: float = DEFAULT_RADIUS,
        force_range: tuple[float, float] = DEFAULT_FORCE_RANGE,
        *,
        counts: tuple[int, ...] = COUNTS,
        map_jobs: JobMap = map,
        progress: Progress | None = None,
    ) -> "FilmFamily":
        """Solve the films that a calibration may find, some five thousand presses, and check the interpolation.

        Args:
            prior: The films.
            radius: Largest distance of a press from the centre, m.
            force_range: Smallest and largest force, N.
            counts: Nodes along each of `AXES`; a narrow spread needs fewer.
            map_jobs: Runs the solves, in this process by default.
            progress: Called with (done, total) groups of solves.

        Raises:
            SceneError: If some presses cannot exist.
            SolveError: If an equilibrium or the interpolation error is not reached.
        """
        film, limits = prior.sensor.film, limits_of(prior, radius, force_range)
        grid, a = FilmGrid.spread(limits, counts), film.radius
        widest = Circle(limits["reach"][1] * a)
        check_family(film, widest, radius, force_range)
        middle = float(np.sqrt(force_range[0] * force_range[1]))
        layer = layer_for(film, middle)
        settings = SolveSettings(theory=THEORY, layer=layer)
        smallest = Circle(limits["reach"][0] * a)
        resolution = needed_resolution(film, smallest, (radius, 0.0), middle, settings)
        settings = replace(settings, resolution=resolution)
        stress = solve_films(film, prior.sensor.surface, grid, settings, map_jobs, progress)
        coefficients, modes = decompose(stress)
        surface = prior.sensor.surface
        family = cls(film.poisson, surface, limits, grid, resolution, layer, coefficients, modes, np.nan)
        error = _check_against_solves(family, prior, radius, force_range)
        if error > LARGEST_ERROR:
            raise SolveError(
                f"the films of {prior.sensor.name} interpolate to {error:.2g} only, expected {LARGEST_ERROR:g}; ask "
                "for a smaller radius, range of forces or spread"
            )
        return replace(family, error=error)

    def forward_map(self, sensor: Sensor, probe: Circle) -> ForwardMap:
        """The forward map of one film, by interpolation.

        Raises:
            SceneError: If the film or the probe is not one of the family.
        """
        film, a = sensor.film, sensor.film.radius
        groups = {
            "tension": film.pretension / film.young,
            "thickness": film.thickness / a,
            "reach": probe.radius / a,
        }
        self._check_inside(film, sensor.surface, groups)
        tension, thickness, reach = (self.grid.weights(name, value) for name, value in groups.items())
        by_film = np.einsum("t,h,p->thp", tension, thickness, reach).ravel()
        sizes = self.coefficients.shape
        by_press = by_film @ self.coefficients.reshape(sizes[0] * sizes[1], -1, sizes[-1])
        load = film.young * film.thickness * a
        low, high = self.limits["load"]
        family = Family(
            radius=self.limits["distance"][1] * a,
            force_range=(low * load, high * load),
            distance=self.grid.distance * a,
            force=self.grid.load * load,
            turn=np.zeros(1),
            folds=1,
        )
        table = by_press @ self.modes
        return ForwardMap(sensor, probe, family, THEORY, self.resolution, self.layer, table, self.error)

    def to_arrays(self) -> dict[str, Any]:
        """The family as arrays, numbers and texts, for a file."""
        coefficients, scale = _quantised(self.coefficients, axis=(0, 1, 2, 3, 4))
        modes, size = _quantised(self.modes, axis=1)
        return {
            **{name: getattr(self, name) for name in ("poisson", "surface", "layer", "error")},
            "limits": np.array([self.limits[name] for name in AXES]),
            "resolution": np.array(list(asdict(self.resolution).values())),
            "grid_shape": np.array(self.grid.shape),
            "grid": np.concatenate([getattr(self.grid, name) for name in AXES]),
            "coefficients": coefficients,
            "modes": modes,
            "mode_scale": np.float32(scale.ravel()[:, None] * size),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> "FilmFamily":
        """The inverse of `to_arrays`, to the resolution of the file.

        Raises:
            InputError: If something is missing or does not fit together.
        """
        try:
            shape = tuple(int(size) for size in arrays["grid_shape"])
            coefficients, modes, scale = arrays["coefficients"], arrays["modes"], arrays["mode_scale"]
            if coefficients.shape != (*shape, len(modes)) or scale.shape != (len(modes), 1) or len(shape) != len(AXES):
                raise ValueError(f"coefficients {coefficients.shape} and modes {modes.shape} do not fit {shape}")
            sizes = len(arrays["limits"]), arrays["grid"].size, arrays["resolution"].size
            if sizes != (len(AXES), sum(shape), len(fields(Resolution))):
                raise ValueError(f"limits, grid and resolution have {sizes} numbers")
            if str(arrays["surface"]) not in get_args(Surface):
                raise ValueError(f"surface {arrays['surface']!s}")
            return cls(
                poisson=float(arrays["poisson"]),
                surface=cast(Surface, str(arrays["surface"])),
                limits={
                    name: (float(low), float(high)) for name, (low, high) in zip(AXES, arrays["limits"], strict=True)
                },
                grid=FilmGrid(*np.split(np.asarray(arrays["grid"], dtype=float), np.cumsum(shape)[:-1])),
                resolution=Resolution(*(int(value) for value in arrays["resolution"])),
                layer=float(arrays["layer"]),
                coefficients=coefficients.astype(float),
                modes=modes * np.asarray(scale, dtype=float),
                error=float(arrays["error"]),
            )
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f"film family: expected the arrays that to_arrays gives ({error})") from error

    def _check_inside(self, film: Film, surface: Surface, groups: dict[str, float]) -> None:
        if (film.poisson, surface) != (self.poisson, self.surface):
            raise SceneError(
                f"film: expected the family's Poisson's ratio {self.poisson} and surface {self.surface!r}, got "
                f"{film.poisson} and {surface!r}"
            )
        for name, value in groups.items():
            low, high = self.limits[name]
            if not low * (1.0 - SLACK) - 1e-15 <= value <= high * (1.0 + SLACK):
                raise SceneError(f"film: {name} {value:.4g} is outside the family: expected {low:.4g} to {high:.4g}")


def _quantised(values: Array, axis: int | tuple[int, ...]) -> tuple[np.ndarray, Array]:
    """Integers of 16 bits, and the scales along an axis that give the values back: values = integers * scale."""
    scale = np.abs(values).max(axis=axis, keepdims=True) / np.iinfo(np.int16).max
    return np.round(values / scale).astype(np.int16), scale


def _check_against_solves(
    family: FilmFamily, prior: FilmPrior, radius: float, force_range: tuple[float, float], seed: int = 0
) -> float:
    """Largest relative error of a charge over presses of films drawn at random."""
    rng, errors = np.random.default_rng(seed), []
    for number, parameters in enumerate(prior.draw(rng, CHECKS)):
        sensor, probe = prior.film(parameters)
        forward_map = family.forward_map(sensor, probe)
        angle = 2.4 * number
        x, y = radius * np.sqrt((number + 1.0) / CHECKS) * np.array([np.cos(angle), np.sin(angle)])
        force = float(force_range[0] * (force_range[1] / force_range[0]) ** rng.random())
        direct = touch_charge(sensor, press(sensor.film, probe, (x, y), force, forward_map.settings))
        mapped = forward_map.forward(np.array([x]), np.array([y]), np.array([force]))[0]
        scale = np.maximum(np.abs(direct), SMALL * np.abs(direct).max())
        errors.append((np.abs(mapped - direct) / scale).max())
    return float(np.max(errors))
