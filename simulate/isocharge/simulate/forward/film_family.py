"""The forward map of every film at once: presses of a round probe, solved over the dimensionless groups of the film.

With a the film's radius, E h its stretching stiffness and R the probe's radius, the scaled stress under a press depends
on five numbers (mechanics.scaling):

    distance / a,   F / (E h a),   pretension / E,   h / a,   R / a,

and on Poisson's ratio, which is one number for a family. In the frame of the template, which follows the probe, the
nodal stress is a smooth function of all five: it is solved on a grid of Chebyshev nodes and interpolated. The grid's
stresses have few independent directions, so they are stored as the coefficients of some fifty modes (the proper
orthogonal decomposition, Sirovich 1987). The forward map of one film is a contraction over the last three numbers, and
takes a millisecond.

In a file, coefficients and modes are integers, of fewer bits where there is little of a mode: some 3e-5 of a charge.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, cast, get_args

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError, SceneError, SolveError
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.family import Family, check_family, solve_films
from isocharge.simulate.forward.film_grid import AXES, THEORY, FilmGrid, FilmLimits, bits_of, decompose, quantised
from isocharge.simulate.forward.film_modes import MODES, FilmModes, ModeMap
from isocharge.simulate.forward.forward_map import ForwardMap, relative_error
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.load_case import SolveSettings, layer_for
from isocharge.simulate.solver.press import needed_resolution

COUNTS = (5, 12, 8, 2, 5)
"""Nodes along each axis."""

SPARE_BITS = 4.0
"""See `bits_of`."""

IMPERFECTIONS = "imperfections."
"""What the names of their arrays begin with."""

MODES_LEFT = 8e-5
"""Share of the stresses that the modes may leave out: root mean square, each node's stress relative to its own size."""

LARGEST_ERROR = 2e-3
"""Largest relative error of any charge against direct solves that a family may have, dimensionless: the lightest
presses on the tautest films have it, whose charges are a few pC; a thousandth of 100 pC is 1e-4."""

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
        imperfections: The modes of the films' imperfections; None in files of before they were solved.
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
    imperfections: FilmModes | None = None

    @classmethod
    def build(
        cls,
        prior: FilmPrior,
        radius: float = DEFAULT_RADIUS,
        force_range: tuple[float, float] = DEFAULT_FORCE_RANGE,
        *,
        counts: tuple[int, ...] = COUNTS,
        executor: Executor | None = None,
    ) -> "FilmFamily":
        """Solve the films that a calibration may find, some five thousand presses, and check the interpolation.

        Args:
            prior: The films.
            radius: Largest distance of a press from the centre, mm.
            force_range: Smallest and largest force, N.
            counts: Nodes along each of `AXES`; a narrow spread needs fewer.
            executor: Runs the solves; None for this process.

        Raises:
            SceneError: If some presses cannot exist.
            SolveError: If an equilibrium or the interpolation error is not reached.
        """
        domain, film, surface = Domain(radius, force_range), prior.sensor.film, prior.sensor.surface
        limits = _limits_of(prior, domain)
        grid, a = FilmGrid.spread(limits, counts), film.radius
        check_family(prior.sensor.coated_film, Circle(limits["reach"][1] * a), domain)
        middle = float(np.sqrt(force_range[0] * force_range[1]))
        layer = layer_for(film, middle)
        settings = SolveSettings(theory=THEORY, layer=layer)
        smallest = Circle(limits["reach"][0] * a)
        resolution = needed_resolution(film, smallest, (radius, 0.0), middle, settings)
        settings = replace(settings, resolution=resolution)
        coefficients, modes = decompose(solve_films(film, surface, grid, settings, executor), MODES_LEFT)
        family = cls(film.poisson, surface, limits, grid, resolution, layer, coefficients, modes, np.nan)
        error = _check_against_solves(family, prior, domain)
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
        self._check_inside(sensor.coated_film, sensor.surface, groups)
        tension, thickness, reach = (self.grid.weights(name, value) for name, value in groups.items())
        by_film = np.einsum("t,h,p->thp", tension, thickness, reach).ravel()
        sizes = self.coefficients.shape
        by_press = by_film @ self.coefficients.reshape(sizes[0] * sizes[1], -1, sizes[-1])
        load = film.young * film.thickness * a
        low, high = self.limits["load"]
        family = Family(
            domain=Domain(self.limits["distance"][1] * a, (low * load, high * load)),
            distance=self.grid.distance * a,
            force=self.grid.load * load,
            rotation=np.zeros(1),
            folds=1,
        )
        table = by_press @ self.modes
        return ForwardMap(sensor, probe, family, THEORY, self.resolution, self.layer, table, self.error)

    def mode_map(self, sensor: Sensor, probe: Circle, names: Sequence[str] = tuple(MODES)) -> ModeMap:
        """The modes of one film; only what the names need is computed.

        Raises:
            SceneError: If the film or the probe is not one of the family, or it has no such modes.
        """
        if self.imperfections is None:
            raise SceneError("this family of films has no modes of imperfections; add FilmModes.build")
        return self.imperfections.mode_map(self.forward_map(sensor, probe), names)

    def to_arrays(self) -> dict[str, Any]:
        """The family as arrays, numbers and texts, for a file."""
        more = {} if self.imperfections is None else self.imperfections.to_arrays()
        bits = bits_of(self.coefficients, self.modes, 16, SPARE_BITS)
        coefficients, scale = quantised(self.coefficients, (0, 1, 2, 3, 4), bits)
        modes, size = quantised(self.modes, 1, bits[:, None])
        return {
            **{name: getattr(self, name) for name in ("poisson", "surface", "layer", "error")},
            "limits": np.array([self.limits[name] for name in AXES]),
            "resolution": np.array(list(asdict(self.resolution).values())),
            "grid_shape": np.array(self.grid.shape),
            "grid": np.concatenate([getattr(self.grid, name) for name in AXES]),
            "coefficients": coefficients,
            "modes": modes,
            "mode_scale": np.float32(scale.ravel()[:, None] * size),
            **{IMPERFECTIONS + name: value for name, value in more.items()},
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
            more = {name.removeprefix(IMPERFECTIONS): arrays[name] for name in arrays if name.startswith(IMPERFECTIONS)}
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
                imperfections=FilmModes.from_arrays(more, modes.shape[1]) if more else None,
            )
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f"film family: expected the arrays that to_arrays gives ({error})") from error

    def _check_inside(self, film: Film, surface: Surface, groups: dict[str, float]) -> None:
        if (film.poisson, surface) != (self.poisson, self.surface):
            raise SceneError(
                f"film: expected the family's Poisson's ratio {self.poisson} and surface {self.surface!r}, got "
                f"{film.poisson} and {surface!r}"
            )
        if not film.is_axisymmetric:
            raise SceneError(f"film: expected an axisymmetric film, got {film.asymmetries}; use modes for these")
        for name, value in groups.items():
            low, high = self.limits[name]
            if not low * (1.0 - SLACK) - 1e-15 <= value <= high * (1.0 + SLACK):
                raise SceneError(f"film: {name} {value:.4g} is outside the family: expected {low:.4g} to {high:.4g}")


def _check_against_solves(family: FilmFamily, prior: FilmPrior, domain: Domain) -> float:
    """Largest relative error of a charge over presses of films drawn at random."""
    rng, errors, (low, high) = np.random.default_rng(0), [], domain.force_range
    for number, parameters in enumerate(prior.draw(rng, CHECKS)):
        forward_map = family.forward_map(*prior.film(parameters))
        distance, angle = domain.radius * np.sqrt((number + 1.0) / CHECKS), 2.4 * number
        force = float(low * (high / low) ** rng.random())
        errors.append(relative_error(forward_map, distance, angle, force))
    return max(errors)


def _limits_of(prior: FilmPrior, domain: Domain) -> FilmLimits:
    """All that the presses of a domain can be on the films that a calibration may find."""
    low, high = (dict(zip(prior.names, bound.tolist(), strict=True)) for bound in prior.bounds)
    film, a = prior.sensor.film, prior.sensor.film.radius
    stiffness = [film.young * film.thickness * a * np.exp(bound["young"] + bound["thickness"]) for bound in (low, high)]
    softest = film.young * np.exp(low["young"])
    return {
        "distance": (0.0, domain.radius / a),
        "load": (domain.force_range[0] / stiffness[1], domain.force_range[1] / stiffness[0]),
        "tension": (low["pretension"] / softest, high["pretension"] / softest),
        "thickness": (film.thickness / a * np.exp(low["thickness"]), film.thickness / a * np.exp(high["thickness"])),
        "reach": ((prior.probe.radius + low["probe_radius"]) / a, (prior.probe.radius + high["probe_radius"]) / a),
    }
