"""Forward maps of many similar films, interpolated between solved presses on a grid of dimensionless parameters.

Let a be the radius of the film, E its Young's modulus, h its thickness, R the radius of the circular probe and F the
force. The scaled stress under a press depends on Poisson's ratio and on five numbers (see `mechanics.scaling`):

    distance / a,   F / (E h a),   pretension / E,   h / a,   R / a.

All films of a family have the same Poisson's ratio. In a frame that moves with the probe, the stress at the nodes of
the mesh is a smooth function of the five dimensionless numbers. The stress is computed at the nodes of a Chebyshev grid
and interpolated between the nodes. The stresses on the grid are stored as a proper orthogonal decomposition with about
fifty modes (Sirovich 1987). The forward map of a single film is obtained by interpolation over pretension / E, h / a
and R / a. This interpolation takes about one millisecond.

Files contain the coefficients and modes as integers. Modes that contribute little to the stress are stored with fewer
bits than the other modes. The rounding to integers changes a charge by a relative amount of about 3e-5.
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
from isocharge.simulate.forward.family import CheckPress, Family, check_family, solve_films
from isocharge.simulate.forward.film_grid import AXES, THEORY, FilmGrid, FilmLimits, bits_of, decompose, quantise
from isocharge.simulate.forward.film_modes import MODES, FilmModes, ModeMap
from isocharge.simulate.forward.forward_map import ForwardMap, direct_charges
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.sensor.film import Film, Surface
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.solver.load_case import SolveSettings, layer_for
from isocharge.simulate.solver.press import needed_resolution

NODE_COUNTS = (5, 12, 8, 2, 5)
"""Number of grid nodes along each of `AXES`."""

MAX_BITS = 16
"""Number of bits per value of the mode with the largest contribution, in a file; see `bits_of`."""

EXTRA_BITS = 4.0
"""Number of bits that each mode gets in addition to the bits that its contribution requires; see `bits_of`."""

IMPERFECTION_PREFIX = "imperfections."
"""Prefix of the names of the arrays of `FilmModes` in a file."""

MAX_TRUNCATION_ERROR = 8e-5
"""Largest relative error of the stresses that the decomposition may cause (root mean square), dimensionless."""

MAX_FAMILY_ERROR = 2e-3
"""Largest relative error of a charge, with respect to direct solves, that a family may have, dimensionless.

The error is largest for small forces on films with a large pretension, where the charges are only a few pC.
"""

CHECK_COUNT = 24
"""Number of random presses at which the interpolated charges of a family are compared with direct solves."""

LIMIT_TOLERANCE = 1e-9
"""Relative tolerance of the limits of a family, which allows for rounding errors of unit conversions."""


@dataclass(frozen=True)
class FilmFamily:
    """Scaled stress under presses with circular probes, for many films with the same Poisson's ratio.

    Attributes:
        poisson: Poisson's ratio of all films.
        surface: Surface at which the stress is read: "middle", "top" or "bottom" of the film.
        limits: Smallest and largest value along each axis of the grid, dimensionless.
        grid: Grid of films and presses that were solved.
        resolution: Fineness of the mesh of the solves.
        layer: Width of the thin rings at the rim, in film radii.
        coefficients: Coefficients of the modes at the grid nodes, shape (n_distance, n_load, n_tension, n_thickness,
            n_reach, n_mode).
        modes: Modes of the scaled stress at the nodes of every element, shape (n_mode, n_element * n_local * 3),
            dimensionless.
        error: Largest relative error of a charge with respect to the direct solves of `build`, dimensionless.
        imperfections: Stress fields of the imperfections of a film; None if these fields were not solved.
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
        counts: tuple[int, ...] = NODE_COUNTS,
        executor: Executor | None = None,
    ) -> "FilmFamily":
        """Build the family of all films that are possible according to a prior distribution.

        About five thousand presses are solved. Finally, the interpolated charges are compared with direct solves.

        Args:
            prior: Prior distribution of the parameters of the film and of the probe radius.
            radius: Largest distance of a press from the centre, mm.
            force_range: Smallest and largest force, N.
            counts: Number of grid nodes along each of `AXES`. A narrow prior distribution needs fewer nodes.
            executor: Executor that runs the solves; None for this process.

        Raises:
            SceneError: If a press in the domain cannot exist, or the film has a closed back or a static pressure.
            SolveError: If a press has no equilibrium, or the interpolation error exceeds `MAX_FAMILY_ERROR`.
        """
        domain = Domain(radius, force_range)
        film = prior.sensor.film
        surface = prior.sensor.surface
        limits = _needed_limits(prior, domain)
        smallest_reach, largest_reach = limits["reach"]
        smallest_probe = Circle(smallest_reach * film.radius)
        largest_probe = Circle(largest_reach * film.radius)
        _check_back(film)
        check_family(film, largest_probe, domain)

        # All solves use the mesh that the smallest probe needs, because the smallest probe needs the finest mesh.
        min_force, max_force = force_range
        middle_force = float(np.sqrt(min_force * max_force))
        layer = layer_for(film, middle_force)  # width of the thin rings of the mesh at the rim
        settings = SolveSettings(theory=THEORY, layer=layer)
        resolution = needed_resolution(film, smallest_probe, (radius, 0.0), middle_force, settings)
        settings = replace(settings, resolution=resolution)

        # Solve the presses of the grid, and decompose their stresses into modes.
        grid = FilmGrid.spread(limits, counts)
        stress = solve_films(film, surface, grid, settings, executor)
        coefficients, modes = decompose(stress, MAX_TRUNCATION_ERROR)

        # The error is unknown (NaN) until the finished family is compared with direct solves.
        family = cls(film.poisson, surface, limits, grid, resolution, layer, coefficients, modes, error=np.nan)
        error = _check_against_solves(family, prior, domain)
        if error > MAX_FAMILY_ERROR:
            raise SolveError(
                f"the films of {prior.sensor.name} interpolate to {error:.2g} only, expected {MAX_FAMILY_ERROR:g}; ask "
                "for a smaller radius, range of forces or spread"
            )
        return replace(family, error=error)

    def forward_map(self, sensor: Sensor, probe: Circle) -> ForwardMap:
        """Interpolate the forward map of a single film.

        Args:
            sensor: Sensor whose film has parameters within the limits of the family.
            probe: Probe whose radius is within the limits of the family.

        Returns:
            Forward map of the sensor. It covers the distances and the loads of the family.

        Raises:
            SceneError: If the film or the probe does not belong to the family.
        """
        film = sensor.film
        film_parameters = {  # values of the film and its probe along three axes of the grid, dimensionless
            "tension": film.pretension / film.young,
            "thickness": film.thickness / film.radius,
            "reach": probe.radius / film.radius,
        }
        self._check_inside(film, sensor.surface, film_parameters)

        # The weight of each film of the grid is the product of its weights along the axes (tension, thickness, reach).
        tension_weights = self.grid.weights("tension", film_parameters["tension"])
        thickness_weights = self.grid.weights("thickness", film_parameters["thickness"])
        reach_weights = self.grid.weights("reach", film_parameters["reach"])
        film_weights = np.einsum("t,h,r->thr", tension_weights, thickness_weights, reach_weights).ravel()

        # Interpolate the coefficients of the modes: sum over the films of the grid for each press and each mode.
        n_distance, n_load, _, _, _, n_mode = self.coefficients.shape
        coefficients = self.coefficients.reshape(n_distance * n_load, film_weights.size, n_mode)
        press_coefficients = film_weights @ coefficients  # shape (n_distance * n_load, n_mode)
        table = press_coefficients @ self.modes

        # Convert the dimensionless distances and loads of the grid into those of this film.
        force_unit = film.young * film.thickness * film.radius
        min_load, max_load = self.limits["load"]
        _, largest_distance = self.limits["distance"]
        family = Family(
            domain=Domain(largest_distance * film.radius, (min_load * force_unit, max_load * force_unit)),
            film_radius=film.radius,
            distance=self.grid.distance * film.radius,
            force=self.grid.load * force_unit,
            direction=np.zeros(1),
            rotation=np.zeros(1),
            symmetry_order=1,
        )
        return ForwardMap(sensor, probe, family, THEORY, self.resolution, self.layer, table, self.error)

    def mode_map(self, sensor: Sensor, probe: Circle, names: Sequence[str] = tuple(MODES)) -> ModeMap:
        """Return a map that computes the charges caused by the imperfection modes of a single film.

        Only the stress fields that the requested modes need are interpolated.

        Args:
            sensor: Sensor whose film has parameters within the limits of the family.
            probe: Probe whose radius is within the limits of the family.
            names: Names of the requested modes, from `MODES`.

        Raises:
            SceneError: If the film or the probe does not belong to the family, if the family has no imperfections, or
                if a name is not in `MODES`.
        """
        if self.imperfections is None:
            raise SceneError("this family of films has no modes of imperfections; add FilmModes.build")
        return self.imperfections.mode_map(self.forward_map(sensor, probe), names)

    def to_arrays(self) -> dict[str, Any]:
        """Convert the family into arrays, numbers and texts that can be stored in a file.

        Returns:
            Values by their names. The coefficients and the modes are rounded to integers. The array "mode_scale", shape
            (n_mode, 1), is the product of the scale of the coefficients and the scale of the modes.
        """
        # Round the coefficients and the modes to integers, which are multiplied by scales when the file is read. Each
        # mode has one scale for its coefficients at all nodes of the grid, and one scale for its own values. A mode
        # with a large contribution to the stress has many bits per value.
        bits = bits_of(self.coefficients, self.modes, MAX_BITS, EXTRA_BITS)  # shape (n_mode,)
        axes_of_grid = tuple(range(len(AXES)))
        coefficients, coefficient_scale = quantise(self.coefficients, axes_of_grid, bits)
        modes, mode_scale = quantise(self.modes, 1, bits[:, None])
        imperfections = {} if self.imperfections is None else self.imperfections.to_arrays()
        return {
            "poisson": self.poisson,
            "surface": self.surface,
            "layer": self.layer,
            "error": self.error,
            "limits": np.array([self.limits[axis] for axis in AXES]),
            "resolution": np.array(list(asdict(self.resolution).values())),
            "grid_shape": np.array(self.grid.shape),
            "grid": np.concatenate([getattr(self.grid, axis) for axis in AXES]),
            "coefficients": coefficients,
            "modes": modes,
            "mode_scale": np.float32(coefficient_scale.ravel()[:, None] * mode_scale),
            **{IMPERFECTION_PREFIX + name: array for name, array in imperfections.items()},
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> "FilmFamily":
        """Create a family from the result of `to_arrays`.

        Args:
            arrays: Arrays, numbers and texts by their names.

        Returns:
            The family. Its coefficients have integer values, because its modes are multiplied by the scale of the
            modes and by the scale of the coefficients.

        Raises:
            InputError: If an array is missing, or the shapes are inconsistent.
        """
        try:
            _check_shapes(arrays)
            surface = str(arrays["surface"])
            if surface not in get_args(Surface):
                raise ValueError(f"surface {surface}")
            limits = {}
            for axis, (smallest, largest) in zip(AXES, arrays["limits"], strict=True):
                limits[axis] = (float(smallest), float(largest))

            # The nodes of all axes are stored in one array, one axis after the other.
            axis_starts = np.cumsum(arrays["grid_shape"])[:-1]  # starts of all axes but the first, which starts at 0
            axis_nodes = np.split(np.asarray(arrays["grid"], dtype=float), axis_starts)
            modes = arrays["modes"] * np.asarray(arrays["mode_scale"], dtype=float)

            # A family without imperfections has no arrays with this prefix.
            imperfections = None
            imperfection_arrays = {
                name.removeprefix(IMPERFECTION_PREFIX): array
                for name, array in arrays.items()
                if name.startswith(IMPERFECTION_PREFIX)
            }
            if imperfection_arrays:
                imperfections = FilmModes.from_arrays(imperfection_arrays, field_size=modes.shape[1])
            return cls(
                poisson=float(arrays["poisson"]),
                surface=cast(Surface, surface),
                limits=limits,
                grid=FilmGrid(*axis_nodes),
                resolution=Resolution(*(int(count) for count in arrays["resolution"])),
                layer=float(arrays["layer"]),
                coefficients=arrays["coefficients"].astype(float),
                modes=modes,
                error=float(arrays["error"]),
                imperfections=imperfections,
            )
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f"film family: expected the arrays that to_arrays gives ({error})") from error

    def _check_inside(self, film: Film, surface: Surface, film_parameters: dict[str, float]) -> None:
        """Raise an error if a film does not belong to the family.

        Args:
            film: Film to be checked.
            surface: Surface at which the stress of the film is read.
            film_parameters: Values of the film and its probe along the axes "tension", "thickness" and "reach",
                dimensionless.

        Raises:
            SceneError: If Poisson's ratio or the surface differs, if the film is not axisymmetric, if it has a closed
                back or a static pressure, or if a value lies outside the limits of the family.
        """
        if (film.poisson, surface) != (self.poisson, self.surface):
            raise SceneError(
                f"film: expected the family's Poisson's ratio {self.poisson} and surface {self.surface!r}, got "
                f"{film.poisson} and {surface!r}"
            )
        if not film.is_axisymmetric:
            raise SceneError(f"film: expected an axisymmetric film, got {film.asymmetries}; use modes for these")
        _check_back(film)
        for name, value in film_parameters.items():
            smallest, largest = self.limits[name]
            # A relative tolerance has no effect on a limit of zero. The absolute tolerance is 1e-15.
            is_above_smallest = value >= smallest * (1.0 - LIMIT_TOLERANCE) - 1e-15
            is_below_largest = value <= largest * (1.0 + LIMIT_TOLERANCE)
            if not (is_above_smallest and is_below_largest):
                raise SceneError(
                    f"film: {name} {value:.4g} is outside the family: expected {smallest:.4g} to {largest:.4g}"
                )


def _check_shapes(arrays: Mapping[str, Any]) -> None:
    """Raise an error if the arrays of a film family have inconsistent shapes.

    Args:
        arrays: Arrays of a file with the names of `FilmFamily.to_arrays`.

    Raises:
        ValueError: If the coefficients, modes and scales do not have the same number of modes, or the limits, the grid
            or the resolution have a wrong number of values.
    """
    grid_shape = tuple(int(count) for count in arrays["grid_shape"])
    coefficients = arrays["coefficients"]
    modes = arrays["modes"]
    n_mode = len(modes)
    grid_fits = len(grid_shape) == len(AXES)
    coefficients_fit = coefficients.shape == (*grid_shape, n_mode)
    scales_fit = arrays["mode_scale"].shape == (n_mode, 1)
    if not (grid_fits and coefficients_fit and scales_fit):
        raise ValueError(f"coefficients {coefficients.shape} and modes {modes.shape} do not fit {grid_shape}")

    counts = (len(arrays["limits"]), arrays["grid"].size, arrays["resolution"].size)
    expected_counts = (len(AXES), sum(grid_shape), len(fields(Resolution)))
    if counts != expected_counts:
        raise ValueError(f"limits, grid and resolution have {counts} numbers")


def _check_back(film: Film) -> None:
    """Raise an error if a film has a closed back or a static pressure.

    A family of films covers neither a closed back nor a static pressure.

    Args:
        film: Film to be checked.

    Raises:
        SceneError: If the film has a closed back or a static pressure.
    """
    if film.has_back_pressure:
        raise SceneError(
            f"film: expected a vented back without static pressure, got back volume {film.back_volume} mm^3 and static "
            f"pressure {1e6 * film.static_pressure:g} Pa: networks for all films and calibrations do not cover these; "
            "vent the back, or use `press`, `ForwardMap.build` or `isocharge train fit` for this film"
        )


def _check_against_solves(family: FilmFamily, prior: FilmPrior, domain: Domain) -> float:
    """Compare the interpolated charges of a family with direct solves, and return the largest relative error.

    One press is compared on each of `CHECK_COUNT` films, which are drawn at random from the prior distribution.

    Args:
        family: Family from which the charges are interpolated.
        prior: Prior distribution of the films.
        domain: Positions and forces of the presses.

    Returns:
        The largest relative error as defined by `ForwardMap.relative_error`, dimensionless.
    """
    rng = np.random.default_rng(0)
    min_force, max_force = domain.force_range
    errors = []
    for index, parameters in enumerate(prior.draw(rng, CHECK_COUNT)):
        sensor, probe = prior.film(parameters)
        forward_map = family.forward_map(sensor, probe)

        # The square root and the golden angle (2.4 rad) distribute the positions evenly over the disk. The logarithms
        # of the forces are distributed uniformly.
        distance = domain.radius * np.sqrt((index + 1.0) / CHECK_COUNT)
        angle = 2.4 * index
        force = float(min_force * (max_force / min_force) ** rng.random())
        check = CheckPress(float(distance), angle, force, rotation=0.0)
        direct_charge = direct_charges(sensor, probe, forward_map.settings, check)
        errors.append(forward_map.relative_error(check, direct_charge))
    return max(errors)


def _needed_limits(prior: FilmPrior, domain: Domain) -> FilmLimits:
    """Compute the smallest and largest values of the dimensionless parameters that a family must cover.

    Args:
        prior: Prior distribution of the films, with the smallest and largest value of each parameter of a film.
        domain: Positions and forces of the presses on each film.

    Returns:
        Smallest and largest value along each of `AXES`, dimensionless.
    """
    lower_bounds, upper_bounds = prior.bounds
    smallest = dict(zip(prior.names, lower_bounds.tolist(), strict=True))
    largest = dict(zip(prior.names, upper_bounds.tolist(), strict=True))
    film = prior.sensor.film

    # In the prior, the parameters "young" and "thickness" are logarithms of factors, "probe_radius" is a difference in
    # mm, and "pretension" is the pretension itself, whose smallest value is zero.
    min_thickness = film.thickness * np.exp(smallest["thickness"])
    max_thickness = film.thickness * np.exp(largest["thickness"])
    min_young = film.young * np.exp(smallest["young"])
    max_young = film.young * np.exp(largest["young"])
    min_probe_radius = prior.probe.radius + smallest["probe_radius"]
    max_probe_radius = prior.probe.radius + largest["probe_radius"]
    min_force, max_force = domain.force_range
    min_load = min_force / (max_young * max_thickness * film.radius)
    max_load = max_force / (min_young * min_thickness * film.radius)
    return {
        "distance": (0.0, domain.radius / film.radius),
        "load": (min_load, max_load),
        "tension": (smallest["pretension"] / min_young, largest["pretension"] / min_young),
        "thickness": (min_thickness / film.radius, max_thickness / film.radius),
        "reach": (min_probe_radius / film.radius, max_probe_radius / film.radius),
    }
