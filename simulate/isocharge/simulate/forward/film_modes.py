"""Charges of the imperfections of a film, to first order: of every film of a family, for any contact.

A film may pull more in one direction than in another, be stiffer along one axis, have another Poisson's ratio or an
oval clamp; its coefficients may have turned axes and its wires crosstalk. About the isotropic round film each of these
is a mode. `MODES` declares each mode once, and `ModeMap` computes its charges. The modes of the film's mechanics use
fields of stress (`solver.sensitivity`), which are solved like the family itself on a grid of distance, load and tension
for the family's middle thickness and probe, since they are corrections.
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
from isocharge.simulate.forward.forward_map import EVEN, ForwardMap
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.mesh.blocks import Resolution
from isocharge.simulate.mesh.template import template_for
from isocharge.simulate.sensor.film import Film, Piezo, Surface
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.sensitivity import FIELDS, ODD, stress_changes


@dataclass(frozen=True)
class PressedFilm:
    """Presses on one film as modes take them.

    Attributes:
        film: Forward map of the film.
        contact: (x, y, F), shape (n, 3), mm and N.
        fields: Charges of the solved fields by kind of imperfection, each of shape (n, n_electrode), pC per unit: the
            even field, and the odd one of a kind with two axes. Only the fields that the modes need are there.
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
        """Tension that one unit of the tension fields stands for, shape (n, 1), MPa."""
        film = self.film.sensor.film
        return np.asarray(film.young * amplitude_squared(film, self.contact[:, 2]) + film.pretension)[:, None]

    def even_and_odd(self, kind: str) -> tuple[Array, Array]:
        """Return the charges of the two fields of an imperfection with two axes, per unit of its modes."""
        even, odd = self.fields[kind]
        if kind == "tension":
            return even / self.tension_scale, odd / self.tension_scale
        return even, odd


def _along(kind: str) -> Callable[[PressedFilm], Array]:
    """Return the charges of an imperfection with two axes, along x and y."""

    def charges(press: PressedFilm) -> Array:
        even, odd = press.even_and_odd(kind)
        return np.cos(press.twice_angle) * even - np.sin(press.twice_angle) * odd

    return charges


def _across(kind: str) -> Callable[[PressedFilm], Array]:
    """Return the charges of an imperfection with two axes, along the diagonals."""

    def charges(press: PressedFilm) -> Array:
        even, odd = press.even_and_odd(kind)
        return np.sin(press.twice_angle) * even + np.cos(press.twice_angle) * odd

    return charges


def _poisson(press: PressedFilm) -> Array:
    """Return the charges of another Poisson's ratio."""
    (even,) = press.fields["poisson"]
    return even


def _d12(press: PressedFilm) -> Array:
    """Return the charges of shear."""
    shear_sensor = replace(press.film.sensor, piezo=Piezo(0.0, 0.0, d12=1.0))
    return np.asarray(replace(press.film, sensor=shear_sensor).by_field(press.contact, EVEN)[..., 0])


def _crosstalk(press: PressedFilm) -> Array:
    """Return the charges of all other electrodes."""
    own = press.film.by_field(press.contact, EVEN)[..., 0]
    return np.asarray(own.sum(axis=1, keepdims=True) - own)


@dataclass(frozen=True)
class Mode:
    """Declaration of one mode of imperfection.

    Attributes:
        meaning: What the value of the mode is.
        unit: Unit of the mode.
        std: Standard deviation over films that have imperfections, in this unit.
        charges: Function that returns the derivative of the charges by the mode at none of it, shape (n, n_electrode),
            pC per unit of the mode.
        field: Kind of imperfection of `sensitivity.FIELDS` whose fields the mode needs; empty if none.
        is_uneven_tension: Whether the mode lowers the tension of the film to second order.
    """

    meaning: str
    unit: str
    std: float
    charges: Callable[[PressedFilm], Array]
    field: str = ""
    is_uneven_tension: bool = False


OVAL = "e of a rim at radius * (1 + e cos 2 (angle - alpha)), times"
STIFFNESS = "ln(E1 / E2), axis 1 at an angle from x, times"

MODES = {
    "tension_difference": Mode(
        "(T11 - T22) / 2", "MPa", 0.25, _along("tension"), field="tension", is_uneven_tension=True
    ),
    "tension_shear": Mode("T12", "MPa", 0.15, _across("tension"), field="tension", is_uneven_tension=True),
    "stiffness_x": Mode(f"{STIFFNESS} cos of twice the angle", "1", 0.12, _along("stiffness"), field="stiffness"),
    "stiffness_xy": Mode(f"{STIFFNESS} sin of twice the angle", "1", 0.06, _across("stiffness"), field="stiffness"),
    "poisson": Mode("added to the family's Poisson's ratio", "1", 0.03, _poisson, field="poisson"),
    "oval_x": Mode(f"{OVAL} cos 2 alpha", "1", 0.006, _along("oval"), field="oval"),
    "oval_xy": Mode(f"{OVAL} sin 2 alpha", "1", 0.006, _across("oval"), field="oval"),
    "d12": Mode(
        "charge of shear, 2 d12 s12: (d31 - d32) / 2 times sin of twice the angle of the axes", "pC/N", 0.3, _d12
    ),
    "crosstalk": Mode("share of every other electrode's charge that an electrode reads", "1", 0.01, _crosstalk),
}
"""All modes by name, in the order of their coefficients."""

COUNTS = (5, 8, 7, 1, 1)
"""Nodes along each of `AXES`."""

LEFT_OUT = 3e-3
"""Share of the fields that their decomposition may leave out."""


BITS, SPARE_BITS = 9, 2.0
"""Bits of a part's values in a file, relative to the node's own size; see `bits_of`."""


@dataclass(frozen=True)
class ModeMap:
    """Charges of the modes of one film.

    Attributes:
        names: Of the modes, from `MODES`.
        film: The film's own charges.
        fields: A map with the table of the fields that the modes need, if any.
        which: Numbers of these fields, in the order of `FIELDS`.
    """

    names: tuple[str, ...]
    film: ForwardMap
    fields: ForwardMap | None
    which: tuple[int, ...]

    def by_mode(self, contact: Array) -> Array:
        """Derivatives of the charges by the modes at none of them.

        Args:
            contact: (x, y, F), shape (n, 3), mm and N, of the domain of `film`.

        Returns:
            Shape (n, n_electrode, n_mode), pC per unit of the mode.

        Raises:
            SceneError: If a press lies outside the domain.
        """
        contact = np.asarray(contact, dtype=float)
        self.film.domain.check(contact, "film's modes")
        press = PressedFilm(self.film, contact, self._charges_of_fields(contact))
        return np.stack([MODES[name].charges(press) for name in self.names], axis=2)

    def _charges_of_fields(self, contact: Array) -> dict[str, tuple[Array, ...]]:
        """Return the charges of the fields, each of shape (n, n_electrode), by kind of imperfection."""
        if self.fields is None:
            return {}
        by_field = self.fields.by_field(contact, ODD[list(self.which)])
        charges: dict[str, tuple[Array, ...]] = {}
        for number, charge in zip(self.which, np.moveaxis(by_field, 2, 0), strict=True):
            charges[KINDS[number]] = (*charges.get(KINDS[number], ()), charge)
        return charges


KINDS = [kind for kind, fields in FIELDS.items() for _ in fields]
"""Kind of imperfection of each field, in the order of their numbers; of the two of a kind the even one comes first."""


class SolvedFilms(Protocol):
    """The films of a family, as far as the fields of their modes depend on them; see `FilmFamily`."""

    @property
    def surface(self) -> Surface:
        """Where in the thickness the stress is read."""

    @property
    def limits(self) -> FilmLimits:
        """Smallest and largest value along each axis of the grid."""

    @property
    def resolution(self) -> Resolution:
        """Mesh of the solves."""

    @property
    def layer(self) -> float:
        """Width of the thin rings at the rim over the film's radius."""


@dataclass(frozen=True)
class FilmModes:
    """Changes of the scaled stress by each of `FIELDS` over the films of a family.

    Attributes:
        grid: Where they are solved.
        coefficients: Of the parts at the grid's nodes, shape (*grid.shape, n_part).
        parts: Shape (n_part, n_field * n_element * n_local * 3).
    """

    grid: FilmGrid
    coefficients: Array
    parts: Array

    @classmethod
    def build(cls, family: SolvedFilms, film: Film, executor: Executor | None = None) -> "FilmModes":
        """Solve the fields, for some three hundred presses.

        Args:
            family: The films.
            film: One of them: its radius counts.
            executor: Runs the solves; None for this process.
        """
        grid = FilmGrid.spread(family.limits, COUNTS)
        settings = SolveSettings(theory=THEORY, resolution=family.resolution, layer=family.layer)
        changes = solve_films(film, family.surface, grid, settings, executor, stress_changes)
        return cls(grid, *decompose(changes, LEFT_OUT))

    def mode_map(self, film: ForwardMap, names: Sequence[str] = tuple(MODES)) -> ModeMap:
        """The modes of one film; only the fields that the names need are computed.

        Args:
            film: Its forward map, from the family.
            names: Some of `MODES`.

        Raises:
            SceneError: If there is no such mode.
        """
        unknown = sorted(set(names) - set(MODES))
        if unknown:
            raise SceneError(f"modes: expected some of {', '.join(MODES)}, got {', '.join(unknown)}")
        kinds = {MODES[name].field for name in names}
        which = tuple(number for number, kind in enumerate(KINDS) if kind in kinds)
        return ModeMap(tuple(names), film, self._table(film, which) if which else None, which)

    def _table(self, film: ForwardMap, which: tuple[int, ...]) -> ForwardMap:
        """The fields of one film as the table of a forward map."""
        described, a = film.sensor.film, film.sensor.film.radius
        by_tension = self.grid.weights("tension", described.pretension / described.young)
        by_press = np.einsum("t,dltm->dlm", by_tension, self.coefficients[:, :, :, 0, 0])
        mesh = template_for(film.probe, film.resolution)
        parts = self.parts.reshape(len(self.parts), ODD.size, mesh.n_element, -1, 3)[:, list(which)]
        table = by_press.reshape(-1, len(parts)) @ np.moveaxis(parts, 1, 3).reshape(len(parts), -1)
        load = described.young * described.thickness * a
        domain = Domain(film.domain.radius, film.domain.force_range)
        family = Family(domain, self.grid.distance * a, self.grid.load * load, np.zeros(1), 1)
        return replace(film, probe=Circle(float(self.grid.reach[0]) * a), family=family, table=table)

    def to_arrays(self) -> dict[str, Any]:
        """As arrays, for a file."""
        coefficients, scale = quantised(self.coefficients, (0, 1, 2, 3, 4), 16)
        by_node = self.parts.reshape(len(self.parts), -1, 3)
        node_size = np.sqrt((by_node**2).sum(axis=(0, 2), keepdims=True)) + np.finfo(np.float32).tiny
        node_size = np.float32(np.exp2(np.round(np.log2(node_size))))  # a power of two: little to write
        relative = (by_node / node_size).reshape(len(self.parts), -1)
        parts, size = quantised(relative, 1, bits_of(self.coefficients, relative, BITS, SPARE_BITS)[:, None])
        return {
            "grid_shape": np.array(self.grid.shape),
            "grid": np.concatenate([getattr(self.grid, name) for name in AXES]),
            "coefficients": coefficients,
            "parts": parts,
            "part_scale": np.float32(scale.ravel()[:, None] * size),
            "node_size": node_size.ravel(),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any], field_size: int) -> "FilmModes":
        """Return the modes that `to_arrays` gave, to the resolution of the file.

        Args:
            arrays: The arrays of the file.
            field_size: Number of values of one field, three for each node of the family's mesh.

        Raises:
            InputError: If an array is missing, the arrays do not fit together, or they are those of other fields.
        """
        try:
            shape = tuple(arrays["grid_shape"])
            parts = arrays["parts"]
            scale = arrays["part_scale"]
            if arrays["coefficients"].shape != (*shape, len(parts)) or scale.shape != (len(parts), 1):
                raise ValueError(f"coefficients {arrays['coefficients'].shape} and parts {parts.shape} do not fit")
            if parts.shape[1] != ODD.size * field_size:
                raise ValueError(
                    f"a part has {parts.shape[1]} values, expected those of the {ODD.size} fields of "
                    f"{', '.join(FIELDS)}; train the network for all films again"
                )
            n_size = arrays["node_size"].size
            if 3 * n_size != parts.shape[1]:
                raise ValueError(f"{n_size} sizes of nodes do not fit {parts.shape[1]} values of a part")
            grid = FilmGrid(*np.split(np.asarray(arrays["grid"], dtype=float), np.cumsum(shape)[:-1]))
            size = np.repeat(np.asarray(arrays["node_size"], dtype=float), 3)
            return cls(grid, arrays["coefficients"].astype(float), parts * np.asarray(scale, dtype=float) * size)
        except (KeyError, ValueError, TypeError, AttributeError, IndexError) as error:
            raise InputError(f"film modes: expected the arrays that to_arrays gives ({error})") from error
