"""First-order change of the charges that imperfections of a film cause, for every film of a family and any contact.

The tension or the stiffness of a film may depend on the direction. The clamp may be oval, and the piezoelectric axes
may be rotated. Poisson's ratio may differ from the assumed value, and the wires may have crosstalk. Each of these
imperfections is a mode: a first-order change of the charges about those of an isotropic round film.

`MODES` declares each mode once, and `ModeMap` computes the charges of all modes. Some modes need the change of the
stress field that `solver.sensitivity` solves. These fields are solved on a grid of distance, load and tension. Only the
middle thickness and the middle probe radius of the family are solved, because the charges of the modes are small
corrections.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, SceneError
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.family import Family, solve_films
from isocharge.simulate.forward.film_grid import AXES, THEORY, FilmGrid, FilmLimits, bits_of, decompose, quantised
from isocharge.simulate.forward.forward_map import EVEN_FIELD, ForwardMap
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.template import template_for
from isocharge.simulate.sensor.film import Film, Piezo, Surface
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.sensitivity import FIELDS, IS_ODD, stress_changes


@dataclass(frozen=True)
class PressedFilm:
    """Presses on one film, from which the functions of the modes compute charges.

    Attributes:
        film: Forward map of the film.
        contact: Presses (x, y, F), shape (n, 3), mm and N.
        fields: Charges of the solved stress fields, by kind of imperfection. Each kind has an even field, and some
            kinds also have an odd field, with respect to a reflection in the direction of the press. The charges of a
            field have the shape (n, n_electrode), pC per unit of the imperfection. Only the fields that the requested
            modes need are present.
    """

    film: ForwardMap
    contact: Array
    fields: Mapping[str, tuple[Array, ...]]

    @cached_property
    def twice_angle(self) -> Array:
        """Twice the angle of each press about the centre, shape (n, 1), rad."""
        return 2.0 * np.arctan2(self.contact[:, 1], self.contact[:, 0])[:, None]

    @cached_property
    def tension_scale(self) -> Array:
        """Tension to which the tension fields are scaled, for each press, shape (n, 1), MPa."""
        film = self.film.sensor.film
        return np.asarray(film.young * amplitude_squared(film, self.contact[:, 2]) + film.pretension)[:, None]

    def even_and_odd(self, kind: str) -> tuple[Array, Array]:
        """Return the charges of the even field and of the odd field of an imperfection, for one unit of its modes.

        Args:
            kind: Name of an imperfection with two axes, from `FIELDS`.

        Returns:
            Two arrays of shape (n, n_electrode), pC per unit of the mode.
        """
        even, odd = self.fields[kind]
        if kind == "tension":  # the fields belong to a tension of `tension_scale`, and the mode to 1 MPa
            return even / self.tension_scale, odd / self.tension_scale
        return even, odd


def _component_along_axes(kind: str) -> Callable[[PressedFilm], Array]:
    """Return a function that computes the charges of the component of an imperfection along x and y.

    The axes of the even field are along and across the direction of the press, and those of the odd field are the
    diagonals between them. An imperfection with two axes rotates with twice the angle t of the press. The charges of a
    component along x and y are therefore cos(2 t) * even - sin(2 t) * odd.

    Args:
        kind: Name of an imperfection with two axes, from `FIELDS`.
    """

    def charges(press: PressedFilm) -> Array:
        even, odd = press.even_and_odd(kind)
        return np.cos(press.twice_angle) * even - np.sin(press.twice_angle) * odd

    return charges


def _component_along_diagonals(kind: str) -> Callable[[PressedFilm], Array]:
    """Return a function that computes the charges of the component of an imperfection along the diagonals of x and y.

    The axes of the even field are along and across the direction of the press, and those of the odd field are the
    diagonals between them. An imperfection with two axes rotates with twice the angle t of the press. The charges of a
    component along the diagonals are therefore sin(2 t) * even + cos(2 t) * odd.

    Args:
        kind: Name of an imperfection with two axes, from `FIELDS`.
    """

    def charges(press: PressedFilm) -> Array:
        even, odd = press.even_and_odd(kind)
        return np.sin(press.twice_angle) * even + np.cos(press.twice_angle) * odd

    return charges


def _poisson_charges(press: PressedFilm) -> Array:
    """Return the derivative of the charges with respect to Poisson's ratio, shape (n, n_electrode), pC."""
    (even,) = press.fields["poisson"]
    return even


def _shear_charges(press: PressedFilm) -> Array:
    """Return the charges that the shear stress causes per unit of d12, shape (n, n_electrode), pC per pC/N."""
    shear_sensor = replace(press.film.sensor, piezo=Piezo(0.0, 0.0, d12=1.0))
    return np.asarray(replace(press.film, sensor=shear_sensor).field_charges(press.contact, EVEN_FIELD)[..., 0])


def _crosstalk_charges(press: PressedFilm) -> Array:
    """Return the sum of the charges of all other electrodes, shape (n, n_electrode), pC."""
    own_charge = press.film.field_charges(press.contact, EVEN_FIELD)[..., 0]
    total_charge = own_charge.sum(axis=1, keepdims=True)
    return np.asarray(total_charge - own_charge)


@dataclass(frozen=True)
class Mode:
    """Declaration of one mode of imperfection.

    Attributes:
        meaning: Definition of the value of the mode.
        unit: Unit of the mode.
        std: Standard deviation of the mode over films that have imperfections, in its unit.
        charges: Function that returns the derivative of the charges with respect to the mode, at the value zero, shape
            (n, n_electrode), pC per unit of the mode.
        field: Key of the stress fields in `sensitivity.FIELDS` that the mode needs; empty if it needs none.
        is_uneven_tension: Whether the mode is an uneven tension. Such a mode also has a second-order effect, which is
            that of a lower mean tension.
    """

    meaning: str
    unit: str
    std: float
    charges: Callable[[PressedFilm], Array]
    field: str = ""
    is_uneven_tension: bool = False


OVAL_MEANING = "e of a rim at radius * (1 + e cos 2 (angle - alpha)), times"
"""Beginning of the meaning of the oval modes."""

STIFFNESS_MEANING = "ln(E1 / E2), axis 1 at an angle from x, times"
"""Beginning of the meaning of the stiffness modes."""

MODES = {
    "tension_difference": Mode(
        "(T11 - T22) / 2", "MPa", 0.25, _component_along_axes("tension"), field="tension", is_uneven_tension=True
    ),
    "tension_shear": Mode(
        "T12", "MPa", 0.15, _component_along_diagonals("tension"), field="tension", is_uneven_tension=True
    ),
    "stiffness_x": Mode(
        f"{STIFFNESS_MEANING} cos of twice the angle", "1", 0.12, _component_along_axes("stiffness"), field="stiffness"
    ),
    "stiffness_xy": Mode(
        f"{STIFFNESS_MEANING} sin of twice the angle",
        "1",
        0.06,
        _component_along_diagonals("stiffness"),
        field="stiffness",
    ),
    "poisson": Mode("added to the family's Poisson's ratio", "1", 0.03, _poisson_charges, field="poisson"),
    "oval_x": Mode(f"{OVAL_MEANING} cos 2 alpha", "1", 0.006, _component_along_axes("oval"), field="oval"),
    "oval_xy": Mode(f"{OVAL_MEANING} sin 2 alpha", "1", 0.006, _component_along_diagonals("oval"), field="oval"),
    "d12": Mode(
        "charge of shear, 2 d12 s12: (d31 - d32) / 2 times sin of twice the angle of the axes",
        "pC/N",
        0.3,
        _shear_charges,
    ),
    "crosstalk": Mode("share of every other electrode's charge that an electrode reads", "1", 0.01, _crosstalk_charges),
}
"""All modes by name. The order of the modes is the order of the coefficients in calibration files."""

NODE_COUNTS = (5, 8, 7, 1, 1)
"""Number of grid nodes along each of `AXES`."""

MAX_TRUNCATION_ERROR = 3e-3
"""Largest relative error of the fields by their low-rank decomposition (root mean square), dimensionless."""

MAX_BITS = 9
"""Number of bits of the values of the largest component in a file; see `bits_of`."""

EXTRA_BITS = 2.0
"""Number of bits that each component gets in addition to those that its size requires; see `bits_of`."""

SCALE_BITS = 16
"""Number of bits of the coefficients in a file."""


@dataclass(frozen=True)
class ModeMap:
    """Charges of the modes of one film.

    Attributes:
        names: Names of the modes, from `MODES`.
        film: Forward map of the film without imperfections.
        fields: Map whose table contains the stress fields that the modes need; None if they need none.
        field_numbers: Numbers of these fields, in the order of `FIELDS`.
    """

    names: tuple[str, ...]
    film: ForwardMap
    fields: ForwardMap | None
    field_numbers: tuple[int, ...]

    def mode_jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the modes, for a film without imperfections.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Derivatives, shape (n, n_electrode, n_mode), pC per unit of the mode.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = np.asarray(contact, dtype=float)
        self.film.domain.check(contact, "modes of a film")
        press = PressedFilm(self.film, contact, self._field_charges(contact))
        return np.stack([MODES[name].charges(press) for name in self.names], axis=2)

    def _field_charges(self, contact: Array) -> dict[str, tuple[Array, ...]]:
        """Compute the charges of the stress fields, grouped by the kind of imperfection.

        Args:
            contact: Presses (x, y, F) in the domain of the map, shape (n, 3), mm and N.

        Returns:
            For each kind of imperfection, the charges of its fields, each of shape (n, n_electrode); see
            `PressedFilm.fields`.
        """
        if self.fields is None:
            return {}
        is_odd = IS_ODD[list(self.field_numbers)]
        charges = self.fields.field_charges(contact, is_odd)  # shape (n, n_electrode, n_field)
        charges_of_kind: dict[str, list[Array]] = {}
        for field_index, field_number in enumerate(self.field_numbers):
            kind = KINDS[field_number]
            charges_of_kind.setdefault(kind, []).append(charges[..., field_index])
        return {kind: tuple(field_charges) for kind, field_charges in charges_of_kind.items()}


KINDS = [kind for kind, fields in FIELDS.items() for _ in fields]
"""Kind of imperfection of each field, in the order of the field numbers.

The even field of a kind precedes its odd field.
"""


class SolvedFilms(Protocol):
    """Properties of a family of films on which the stress fields of the modes depend; see `FilmFamily`."""

    @property
    def surface(self) -> Surface:
        """Surface in the thickness of the film at which the stress is read."""

    @property
    def limits(self) -> FilmLimits:
        """Smallest and largest value along each axis of the grid, dimensionless."""

    @property
    def resolution(self) -> Resolution:
        """Fineness of the mesh of the solves."""

    @property
    def layer(self) -> float:
        """Width of the thin rings at the rim, in film radii."""


@dataclass(frozen=True)
class FilmModes:
    """Change of the scaled stress by each of `FIELDS`, for the films of a family, as a low-rank decomposition.

    Attributes:
        grid: Grid of films and presses at which the fields are solved.
        coefficients: Coefficients of the components at the nodes of the grid, shape (*grid.shape, n_component).
        parts: Components of the fields, shape (n_component, n_field * n_element * n_local * 3), dimensionless.
    """

    grid: FilmGrid
    coefficients: Array
    parts: Array

    @classmethod
    def build(cls, family: SolvedFilms, film: Film, executor: Executor | None = None) -> "FilmModes":
        """Solve the fields for about three hundred presses, and decompose them.

        Args:
            family: The family of films.
            film: A film of the family. All films of the grid have its radius.
            executor: Executor that runs the solves; None for this process.
        """
        grid = FilmGrid.spread(family.limits, NODE_COUNTS)
        settings = SolveSettings(theory=THEORY, resolution=family.resolution, layer=family.layer)
        changes = solve_films(film, family.surface, grid, settings, executor, stress_changes)
        coefficients, components = decompose(changes, MAX_TRUNCATION_ERROR)
        return cls(grid, coefficients, components)

    def mode_map(self, film: ForwardMap, names: Sequence[str] = tuple(MODES)) -> ModeMap:
        """Return the map of the modes of one film. Only the fields that these modes need are computed.

        Args:
            film: Forward map of the film, from the same family.
            names: Names of the modes, from `MODES`.

        Raises:
            SceneError: If a name is not in `MODES`.
        """
        unknown = sorted(set(names) - set(MODES))
        if unknown:
            raise SceneError(f"modes: expected some of {', '.join(MODES)}, got {', '.join(unknown)}")
        needed_kinds = {MODES[name].field for name in names}
        field_numbers = tuple(number for number, kind in enumerate(KINDS) if kind in needed_kinds)
        fields = self._field_map(film, field_numbers) if field_numbers else None
        return ModeMap(tuple(names), film, fields, field_numbers)

    def _field_map(self, forward_map: ForwardMap, field_numbers: tuple[int, ...]) -> ForwardMap:
        """Interpolate stress fields for one film, and return them as a forward map.

        A forward map interpolates a table of the stress between presses. The returned map has a table of the fields
        instead, so that the fields are interpolated in the same way.

        Args:
            forward_map: Forward map of the film.
            field_numbers: Numbers of the fields, in the order of `FIELDS`.

        Returns:
            Map with one row of the table for each press of the grid. A row contains the values of all fields at the
            first node of the mesh, then those at the next node, and so on.
        """
        film = forward_map.sensor.film
        n_component = len(self.parts)

        # Interpolate the coefficients at the tension of the film. The grid has one thickness and one reach only.
        tension_weights = self.grid.weights("tension", film.pretension / film.young)
        grid_coefficients = self.coefficients.reshape(*self.grid.shape[:3], n_component)  # distance, load and tension
        press_coefficients = np.moveaxis(grid_coefficients, 2, -1) @ tension_weights  # (distance, load, component)

        # Select the fields, and order their values by node.
        mesh = template_for(forward_map.probe, forward_map.resolution)
        n_field = IS_ODD.size
        all_fields = self.parts.reshape(n_component, n_field, mesh.n_element, -1, 3)
        fields = all_fields[:, list(field_numbers)]  # (component, field, element, local node, stress component)
        fields_by_node = np.moveaxis(fields, 1, 3)  # (component, element, local node, field, stress component)
        table = press_coefficients.reshape(-1, n_component) @ fields_by_node.reshape(n_component, -1)

        # Convert the dimensionless distances, loads and probe radius of the grid into those of this film.
        force_unit = film.young * film.thickness * film.radius
        family = Family(
            domain=Domain(forward_map.domain.radius, forward_map.domain.force_range),
            film_radius=film.radius,
            distance=self.grid.distance * film.radius,
            force=self.grid.load * force_unit,
            rotation=np.zeros(1),
            symmetry_order=1,
        )
        probe = Circle(float(self.grid.reach[0]) * film.radius)
        return replace(forward_map, probe=probe, family=family, table=table)

    def to_arrays(self) -> dict[str, Any]:
        """Return the decomposition as arrays for a file. Coefficients and components are rounded to a few bits."""
        axes_of_grid = tuple(range(len(AXES)))
        coefficients, coefficient_scale = quantised(self.coefficients, axes_of_grid, SCALE_BITS)

        # The components are divided by the size of the stress at each node. This size is rounded to a power of two,
        # which compresses well. A tiny number is added to the size, because the logarithm of zero does not exist.
        n_component = len(self.parts)
        node_stress = self.parts.reshape(n_component, -1, 3)
        node_norm = np.sqrt((node_stress**2).sum(axis=(0, 2), keepdims=True))  # shape (1, n_node, 1)
        node_exponent = np.round(np.log2(node_norm + np.finfo(np.float32).tiny))
        node_size = np.float32(np.exp2(node_exponent))
        relative_parts = (node_stress / node_size).reshape(n_component, -1)
        bits = bits_of(self.coefficients, relative_parts, MAX_BITS, EXTRA_BITS)
        parts, part_scale = quantised(relative_parts, 1, bits[:, None])
        return {
            "grid_shape": np.array(self.grid.shape),
            "grid": np.concatenate([getattr(self.grid, name) for name in AXES]),
            "coefficients": coefficients,
            "parts": parts,
            "part_scale": np.float32(coefficient_scale.ravel()[:, None] * part_scale),
            "node_size": node_size.ravel(),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], field_size: int) -> "FilmModes":
        """Create a decomposition from the result of `to_arrays`.

        Args:
            arrays: Arrays of the file.
            field_size: Number of values of one field, three for each node of each element of the family's mesh.

        Raises:
            InputError: If an array is missing, the shapes are inconsistent, or the file contains other fields.
        """
        try:
            _check_shapes(arrays, field_size)
            # The nodes of all axes are stored in one array, one axis after the other.
            axis_starts = np.cumsum(tuple(arrays["grid_shape"]))[:-1]  # without the first axis, which starts at 0
            grid = FilmGrid(*np.split(np.asarray(arrays["grid"], dtype=float), axis_starts))

            # The file contains the components as integers, divided by the size of the stress at each node.
            part_scale = np.asarray(arrays["part_scale"], dtype=float)
            node_size = np.asarray(arrays["node_size"], dtype=float)
            value_size = np.repeat(node_size, 3)  # each node has three components of the stress
            parts = arrays["parts"] * part_scale * value_size
            return cls(grid, arrays["coefficients"].astype(float), parts)
        except (KeyError, ValueError, TypeError, AttributeError, IndexError) as error:
            raise InputError(f"film modes: expected the arrays that to_arrays gives ({error})") from error


def _check_shapes(arrays: Mapping[str, Any], field_size: int) -> None:
    """Raise an error if the arrays of a file have inconsistent shapes.

    Args:
        arrays: Arrays of `FilmModes.to_arrays`.
        field_size: Number of values of one field.

    Raises:
        ValueError: If the numbers of components or nodes differ, or a component does not contain all fields.
    """
    grid_shape = tuple(arrays["grid_shape"])
    coefficients = arrays["coefficients"]
    parts = arrays["parts"]
    n_component = len(parts)
    coefficients_fit = coefficients.shape == (*grid_shape, n_component)
    scales_fit = arrays["part_scale"].shape == (n_component, 1)
    if not (coefficients_fit and scales_fit):
        raise ValueError(f"coefficients {coefficients.shape} and parts {parts.shape} do not match")

    part_size = parts.shape[1]
    if part_size != IS_ODD.size * field_size:
        raise ValueError(
            f"a part has {part_size} values, expected those of the {IS_ODD.size} fields of {', '.join(FIELDS)}; train "
            "the network for all films again"
        )
    n_node = np.asarray(arrays["node_size"], dtype=float).size
    if 3 * n_node != part_size:
        raise ValueError(f"{n_node} node sizes do not match {part_size} values of a part")
