"""First-order changes that small imperfections of a film cause in the charges.

The tension or the stiffness of a film may depend on the direction. The clamp may be oval, and the piezoelectric axes
may be rotated. Poisson's ratio may differ from the assumed value, and the wires may have crosstalk. Each mode describes
one such imperfection by the change that the imperfection causes in the charges.

`MODES` declares each mode, and `ModeMap` computes the charges of the modes for any film of a family. For some modes,
the module `solver.sensitivity` computes the change of the stress field. The change of the stress field is computed on a
grid of distances, loads and tensions. The charges of the modes are small corrections. The change of the stress field is
therefore computed only for the middle thickness and the middle probe radius of the family.
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
from isocharge.simulate.forward.film_grid import AXES, THEORY, FilmGrid, FilmLimits, bits_of, decompose, quantise
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
    """Presses on one film, and the charges of the stress fields that the imperfections of the film cause.

    The functions `Mode.charges` compute the charges of the modes from an object of this class.

    Attributes:
        film: Forward map of the film without imperfections.
        contact: Presses (x, y, F), shape (n, 3), mm and N.
        fields: Charges of the stress fields, by the kind of imperfection, such as "tension". Each kind has an even
            field, and some kinds also have an odd field, with respect to a reflection in the direction of the press.
            The charges of a field have the shape (n, n_electrode) and the unit pC per unit of the imperfection. Only
            the fields that the requested modes need are present.
    """

    film: ForwardMap
    contact: Array
    fields: Mapping[str, tuple[Array, ...]]

    @cached_property
    def twice_angle(self) -> Array:
        """Twice the angle between the x axis and the direction from the centre to each press, shape (n, 1), rad."""
        return 2.0 * np.arctan2(self.contact[:, 1], self.contact[:, 0])[:, None]

    @cached_property
    def tension_scale(self) -> Array:
        """Tension by which the fields of an uneven tension are scaled, for each press, shape (n, 1), MPa."""
        film = self.film.sensor.film
        return np.asarray(film.young * amplitude_squared(film, self.contact[:, 2]) + film.pretension)[:, None]

    def even_and_odd(self, kind: str) -> tuple[Array, Array]:
        """Return the charges of the even field and of the odd field of an imperfection, per unit of its modes.

        Args:
            kind: Name of an imperfection with two axes, from `FIELDS`.

        Returns:
            Charges of the even field, and charges of the odd field, each of shape (n, n_electrode), pC per unit of the
            modes.
        """
        even, odd = self.fields[kind]
        if kind == "tension":
            # The unit of the fields is `tension_scale`, and the unit of the modes is 1 MPa.
            return even / self.tension_scale, odd / self.tension_scale
        return even, odd


def _component_along_axes(kind: str) -> Callable[[PressedFilm], Array]:
    """Return a function that computes the charges of an imperfection whose axes are x and y.

    The axes of the even field are along and across the direction of the press. The axes of the odd field are rotated by
    45 degrees from the direction of the press. Let t be the angle from the x axis to the direction of the press. An
    imperfection with the axes x and y causes cos(2 t) times the even field minus sin(2 t) times the odd field.

    Args:
        kind: Name of an imperfection with two axes, from `FIELDS`.

    Returns:
        Function of a `PressedFilm`. It returns charges, shape (n, n_electrode), pC per unit of the mode.
    """

    def charges(press: PressedFilm) -> Array:
        even, odd = press.even_and_odd(kind)
        return np.cos(press.twice_angle) * even - np.sin(press.twice_angle) * odd

    return charges


def _component_along_diagonals(kind: str) -> Callable[[PressedFilm], Array]:
    """Return a function that computes the charges of an imperfection whose axes are the diagonals between x and y.

    The axes of the even field are along and across the direction of the press. The axes of the odd field are rotated by
    45 degrees from the direction of the press. Let t be the angle from the x axis to the direction of the press. An
    imperfection along the diagonals causes sin(2 t) times the even field plus cos(2 t) times the odd field.

    Args:
        kind: Name of an imperfection with two axes, from `FIELDS`.

    Returns:
        Function of a `PressedFilm`. It returns charges, shape (n, n_electrode), pC per unit of the mode.
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
    """Return the derivative of the charges with respect to the coefficient d12, shape (n, n_electrode), pC per pC/N."""
    # The charges are proportional to d12 if all other coefficients are zero.
    shear_sensor = replace(press.film.sensor, piezo=Piezo(0.0, 0.0, d12=1.0))
    return np.asarray(replace(press.film, sensor=shear_sensor).field_charges(press.contact, EVEN_FIELD)[..., 0])


def _crosstalk_charges(press: PressedFilm) -> Array:
    """Return the derivative of the charges with respect to the crosstalk, shape (n, n_electrode), pC.

    The derivative for each electrode is the sum of the charges of all other electrodes.
    """
    own_charge = press.film.field_charges(press.contact, EVEN_FIELD)[..., 0]
    total_charge = own_charge.sum(axis=1, keepdims=True)
    return np.asarray(total_charge - own_charge)


@dataclass(frozen=True)
class Mode:
    """Declaration of one mode, which is a small imperfection of a film such as an oval clamp.

    Attributes:
        meaning: Definition of the value of the mode, as a formula or a short text.
        unit: Unit of the value of the mode.
        std: Standard deviation of the value over films that have imperfections, in the unit of the mode.
        charges: Function that returns the derivative of the charges with respect to the value of the mode, for a film
            without imperfections, shape (n, n_electrode), pC per unit of the mode.
        field: Key in `sensitivity.FIELDS` of the stress fields that the mode needs; empty if the mode needs no fields.
        is_uneven_tension: Whether the mode is an uneven tension. To second order, an uneven tension has the effect of
            a lower mean tension.
    """

    meaning: str
    unit: str
    std: float
    charges: Callable[[PressedFilm], Array]
    field: str = ""
    is_uneven_tension: bool = False


OVAL_MEANING = "e of a rim at radius * (1 + e cos 2 (angle - alpha)), times"
"""First words of the meaning of the modes of an oval clamp."""

STIFFNESS_MEANING = "ln(E1 / E2), axis 1 at an angle from x, times"
"""First words of the meaning of the modes of a stiffness that depends on the direction."""

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
"""All modes by name. Calibration files contain the values of the modes in this order."""

NODE_COUNTS = (5, 8, 7, 1, 1)
"""Number of grid nodes along each of `AXES`."""

MAX_TRUNCATION_ERROR = 3e-3
"""Largest relative error of the fields that the decomposition may cause (root mean square), dimensionless."""

MAX_BITS = 9
"""Number of bits per value of the component with the largest contribution, in a file; see `bits_of`."""

EXTRA_BITS = 2.0
"""Number of bits that each component gets in addition to the bits that its contribution requires; see `bits_of`."""

SCALE_BITS = 16
"""Number of bits of each coefficient of a component in a file."""


@dataclass(frozen=True)
class ModeMap:
    """Map that computes the charges caused by the imperfection modes of one film.

    Attributes:
        names: Names of the modes, from `MODES`.
        film: Forward map of the film without imperfections.
        fields: Forward map whose table contains the stress fields that the modes need; None if no mode needs a field.
        field_numbers: Index in `KINDS` of each stress field of the table.
    """

    names: tuple[str, ...]
    film: ForwardMap
    fields: ForwardMap | None
    field_numbers: tuple[int, ...]

    def mode_jacobian(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to the values of the modes.

        The derivatives are computed for a film without imperfections.

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

        A stress field is the change of the stress that an imperfection of the film causes. A kind of imperfection, such
        as "tension", has one or two stress fields.

        Args:
            contact: Presses (x, y, F) in the domain of `film`, shape (n, 3), mm and N.

        Returns:
            Charges of the fields of each kind of imperfection, as in `PressedFilm.fields`. The charges of each field
            have the shape (n, n_electrode).
        """
        if self.fields is None:
            return {}
        is_odd = IS_ODD[list(self.field_numbers)]  # with respect to a reflection in the direction of the press
        charges = self.fields.field_charges(contact, is_odd)  # shape (n, n_electrode, n_field)
        charges_of_kind: dict[str, list[Array]] = {}
        for field_index, field_number in enumerate(self.field_numbers):
            kind = KINDS[field_number]
            charges_of_kind.setdefault(kind, []).append(charges[..., field_index])
        return {kind: tuple(field_charges) for kind, field_charges in charges_of_kind.items()}


KINDS = [kind for kind, fields in FIELDS.items() for _ in fields]
"""Kind of imperfection of each stress field, in the order of `FIELDS`.

The even field of a kind precedes its odd field.
"""


class SolvedFilms(Protocol):
    """Interface of a family of films, with the properties on which the stress fields of the modes depend.

    `FilmFamily` implements this interface.
    """

    @property
    def surface(self) -> Surface:
        """Surface at which the stress is read: "middle", "top" or "bottom" of the film."""

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
    """Stress fields that imperfections cause in the films of a family, decomposed into a few components.

    A stress field is the change of the scaled stress that one of the imperfections in `FIELDS` causes. At each node of
    the grid, the fields are a weighted sum of the components.

    Attributes:
        grid: Grid of films and presses at which the fields are solved.
        coefficients: Coefficients of the components at the nodes of the grid, shape (*grid.shape, n_component).
        components: Components of the fields, shape (n_component, n_field * n_element * n_local * 3), dimensionless.
    """

    grid: FilmGrid
    coefficients: Array
    components: Array

    @classmethod
    def build(cls, family: SolvedFilms, film: Film, executor: Executor | None = None) -> "FilmModes":
        """Solve the stress fields for about three hundred presses, and decompose the fields into components.

        Args:
            family: Family of films that defines the limits of the grid and the mesh.
            film: Film that defines the radius, Young's modulus and Poisson's ratio of all films of the grid.
            executor: Executor that runs the solves; None for this process.
        """
        grid = FilmGrid.spread(family.limits, NODE_COUNTS)
        settings = SolveSettings(theory=THEORY, resolution=family.resolution, layer=family.layer)
        changes = solve_films(film, family.surface, grid, settings, executor, stress_changes)
        coefficients, components = decompose(changes, MAX_TRUNCATION_ERROR)
        return cls(grid, coefficients, components)

    def mode_map(self, forward_map: ForwardMap, names: Sequence[str] = tuple(MODES)) -> ModeMap:
        """Return a map that computes the charges caused by the imperfection modes of one film.

        Only the stress fields that the requested modes need are interpolated.

        Args:
            forward_map: Forward map of the film, from the same family.
            names: Names of the requested modes, from `MODES`.

        Raises:
            SceneError: If a name is not in `MODES`.
        """
        unknown = sorted(set(names) - set(MODES))
        if unknown:
            raise SceneError(f"modes: expected some of {', '.join(MODES)}, got {', '.join(unknown)}")
        # A mode needs all stress fields of one kind of imperfection. A mode that needs no field has the kind "", which
        # is not in `KINDS`.
        needed_kinds = {MODES[name].field for name in names}
        field_numbers = tuple(number for number, kind in enumerate(KINDS) if kind in needed_kinds)
        fields = self._field_map(forward_map, field_numbers) if field_numbers else None
        return ModeMap(tuple(names), forward_map, fields, field_numbers)

    def _field_map(self, forward_map: ForwardMap, field_numbers: tuple[int, ...]) -> ForwardMap:
        """Interpolate stress fields for one film, and return them as a forward map.

        A stress field is the change of the stress that an imperfection of the film causes. In a grid of films and
        presses, the stress fields of each press are a weighted sum of the same components. Each component contains all
        fields, and the weights are called coefficients.

        A forward map contains a table of the stress, and interpolates the table between presses. The table of the
        returned map contains stress fields in place of the stress, so the fields are interpolated in the same way.

        Args:
            forward_map: Forward map of the film.
            field_numbers: Index of each required field among all fields.

        Returns:
            Forward map whose table has one row for each press of the grid. A row contains the values of all fields at
            the first node of the mesh, then those at the next node, and so on.
        """
        film = forward_map.sensor.film
        n_component = len(self.components)

        # Interpolate the coefficients at the tension of the film. The grid has one thickness and one reach only.
        tension_weights = self.grid.weights("tension", film.pretension / film.young)
        grid_coefficients = self.coefficients.reshape(*self.grid.shape[:3], n_component)  # distance, load and tension
        press_coefficients = np.moveaxis(grid_coefficients, 2, -1) @ tension_weights  # (distance, load, component)

        # Select the fields in each component, order their values by node, and sum over the components.
        mesh = template_for(forward_map.probe, forward_map.resolution)
        n_field = IS_ODD.size
        all_fields = self.components.reshape(n_component, n_field, mesh.n_element, -1, 3)
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
            direction=np.zeros(1),
            rotation=np.zeros(1),
            symmetry_order=1,
        )
        probe = Circle(float(self.grid.reach[0]) * film.radius)
        return replace(forward_map, probe=probe, family=family, table=table)

    def to_arrays(self) -> dict[str, Any]:
        """Convert the decomposition into arrays that can be stored in a file.

        Returns:
            Arrays by their names. The coefficients and the components ("parts") are divided by scales and rounded to
            integers. The array "part_scale", shape (n_component, 1), is the product of the scales of both. The array
            "node_size" contains the size of the stress at each node. The components are divided by this size before
            they are rounded.
        """
        # Round the coefficients. Each component has one scale for its coefficients at all nodes of the grid.
        axes_of_grid = tuple(range(len(AXES)))
        coefficients, coefficient_scale = quantise(self.coefficients, axes_of_grid, SCALE_BITS)

        # The components are divided by the size of the stress at each node. This size is rounded to a power of two,
        # which compresses well. A tiny number is added to the size, because the logarithm of zero does not exist.
        n_component = len(self.components)
        node_stress = self.components.reshape(n_component, -1, 3)
        node_norm = np.sqrt((node_stress**2).sum(axis=(0, 2), keepdims=True))  # shape (1, n_node, 1)
        node_exponent = np.round(np.log2(node_norm + np.finfo(np.float32).tiny))
        node_size = np.float32(np.exp2(node_exponent))
        relative_components = (node_stress / node_size).reshape(n_component, -1)

        # Round the components. A component with a large contribution to the stress has many bits per value.
        bits = bits_of(self.coefficients, relative_components, MAX_BITS, EXTRA_BITS)
        components, component_scale = quantise(relative_components, 1, bits[:, None])
        return {
            "grid_shape": np.array(self.grid.shape),
            "grid": np.concatenate([getattr(self.grid, name) for name in AXES]),
            "coefficients": coefficients,
            "parts": components,
            "part_scale": np.float32(coefficient_scale.ravel()[:, None] * component_scale),
            "node_size": node_size.ravel(),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], field_size: int) -> "FilmModes":
        """Create a decomposition from the result of `to_arrays`.

        Args:
            arrays: Arrays of the file by their names.
            field_size: Number of values of one stress field, which are three for each node of each element of the mesh.

        Raises:
            InputError: If an array is missing, the shapes are inconsistent, or the file contains other fields.
        """
        try:
            _check_shapes(arrays, field_size)
            # The nodes of all axes are stored in one array, one axis after the other.
            axis_starts = np.cumsum(tuple(arrays["grid_shape"]))[:-1]  # starts of all axes but the first, which is at 0
            grid = FilmGrid(*np.split(np.asarray(arrays["grid"], dtype=float), axis_starts))

            # In the file, the components are integers. They were divided by a scale and by the size of the stress at
            # each node.
            component_scale = np.asarray(arrays["part_scale"], dtype=float)
            node_size = np.asarray(arrays["node_size"], dtype=float)
            value_size = np.repeat(node_size, 3)  # each node has three stress components
            components = arrays["parts"] * component_scale * value_size
            return cls(grid, arrays["coefficients"].astype(float), components)
        except (KeyError, ValueError, TypeError, AttributeError, IndexError) as error:
            raise InputError(f"film modes: expected the arrays that to_arrays gives ({error})") from error


def _check_shapes(arrays: Mapping[str, Any], field_size: int) -> None:
    """Raise an error if the arrays of film modes have inconsistent shapes.

    The arrays describe stress fields at the nodes of a mesh. For each press, the fields are a weighted sum of
    components, which are called parts in the file. Each component contains all fields.

    Args:
        arrays: Arrays of a file with the names of `FilmModes.to_arrays`.
        field_size: Number of values of one stress field.

    Raises:
        ValueError: If the numbers of components or nodes differ, or a component does not contain all fields.
    """
    grid_shape = tuple(arrays["grid_shape"])
    coefficients = arrays["coefficients"]
    parts = arrays["parts"]  # the components, shape (n_component, part_size)
    n_component = len(parts)
    coefficients_fit = coefficients.shape == (*grid_shape, n_component)
    scales_fit = arrays["part_scale"].shape == (n_component, 1)
    if not (coefficients_fit and scales_fit):
        raise ValueError(f"coefficients {coefficients.shape} and parts {parts.shape} do not match")

    # Each component contains all fields (one per element of `IS_ODD`), with three stress components at each node.
    part_size = parts.shape[1]
    if part_size != IS_ODD.size * field_size:
        raise ValueError(
            f"a part has {part_size} values, expected those of the {IS_ODD.size} fields of {', '.join(FIELDS)}; train "
            "the network for all films again"
        )
    n_node = np.asarray(arrays["node_size"], dtype=float).size
    if 3 * n_node != part_size:
        raise ValueError(f"{n_node} node sizes do not match {part_size} values of a part")
