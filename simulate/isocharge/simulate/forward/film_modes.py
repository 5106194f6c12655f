"""What the imperfections of a film do to its charges, to first order: of every film of a family, for any contact.

A film may pull more in one direction than in another, be stiffer along one axis, have another Poisson's ratio or an
oval clamp; its coefficients may have turned axes and its wires crosstalk. About the isotropic round film each of these
is a mode whose charges `ModeMap` gives. Those of the film's mechanics are fields of stress
(`solver.sensitivity`), solved like the family itself on a grid of distance, load and tension, for the family's middle
thickness and probe: they are corrections.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, SceneError
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.family import Family, solve_films
from isocharge.simulate.forward.film_grid import AXES, THEORY, FilmGrid, bits_of, decompose, quantised
from isocharge.simulate.forward.forward_map import EVEN, ForwardMap
from isocharge.simulate.mechanics.scaling import amplitude_squared
from isocharge.simulate.mesh.template import template_for
from isocharge.simulate.sensor.film import Film, Piezo
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.sensitivity import FIELDS, ODD, stress_changes

if TYPE_CHECKING:
    from isocharge.simulate.forward.film_family import FilmFamily

MODES = {
    "tension_difference": "MPa",
    "tension_shear": "MPa",
    "stiffness_x": "1",
    "stiffness_xy": "1",
    "poisson": "1",
    "oval_x": "1",
    "oval_xy": "1",
    "d12": "pC/N",
    "crosstalk": "1",
}
"""Names of the modes and their units.

    tension_difference, tension_shear   (T11 - T22) / 2 and T12
    stiffness_x, stiffness_xy           ln(E1 / E2) times cos and sin of twice the angle of axis 1 from x
    poisson                             added to the family's Poisson's ratio
    oval_x, oval_xy                     e of a rim at radius * (1 + e cos 2 (angle - alpha)), by cos and sin of 2 alpha
    d12                                 charge of shear, 2 d12 s12: (d31 - d32) / 2 times sin of twice the angle of axes
    crosstalk                           share of every other electrode's charge that an electrode reads
"""

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
        angle = 2.0 * np.arctan2(contact[:, 1], contact[:, 0])[:, None]
        columns: dict[str, Array] = {}
        if self.fields is not None:
            sensor = self.film.sensor
            by_field = self.fields.by_field(contact, ODD[list(self.which)])
            charge = dict(zip(self.which, np.moveaxis(by_field, 2, 0), strict=True))
            scale = sensor.film.young * amplitude_squared(sensor.film, contact[:, 2]) + sensor.film.pretension
            for kind, (along, across) in PAIRS.items():
                first = KINDS.index(kind)
                if first in charge:
                    per_unit = scale[:, None] if kind == "tension" else 1.0
                    even, odd = charge[first] / per_unit, charge[first + 1] / per_unit
                    columns[along] = np.cos(angle) * even - np.sin(angle) * odd
                    columns[across] = np.sin(angle) * even + np.cos(angle) * odd
            if "poisson" in self.names:
                columns["poisson"] = charge[KINDS.index("poisson")]
        if "d12" in self.names:
            shear = replace(self.film, sensor=replace(self.film.sensor, piezo=Piezo(0.0, 0.0, d12=1.0)))
            columns["d12"] = shear.by_field(contact, EVEN)[..., 0]
        if "crosstalk" in self.names:
            own = self.film.by_field(contact, EVEN)[..., 0]
            columns["crosstalk"] = own.sum(axis=1, keepdims=True) - own
        return np.stack([columns[name] for name in self.names], axis=2)


KINDS = [kind for kind, fields in FIELDS.items() for _ in fields]
"""Kind of imperfection of each field, in the order of their numbers; of the two of a kind the even one comes first."""

PAIRS = {
    "tension": ("tension_difference", "tension_shear"),
    "stiffness": ("stiffness_x", "stiffness_xy"),
    "oval": ("oval_x", "oval_xy"),
}
"""Modes with two axes."""


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
    def build(cls, family: "FilmFamily", film: Film, executor: Executor | None = None) -> "FilmModes":
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
        kinds = [kind for kind, modes in PAIRS.items() if set(modes) & set(names)]
        kinds += ["poisson"] * ("poisson" in names)
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
            grid = FilmGrid(*np.split(np.asarray(arrays["grid"], dtype=float), np.cumsum(shape)[:-1]))
            size = np.repeat(np.asarray(arrays["node_size"], dtype=float), 3)
            return cls(grid, arrays["coefficients"].astype(float), parts * np.asarray(scale, dtype=float) * size)
        except (KeyError, ValueError, TypeError, AttributeError, IndexError) as error:
            raise InputError(f"film modes: expected the arrays that to_arrays gives ({error})") from error
