"""Isocharge contours: where presses give an electrode the same charge, for one probe and force.

Contours are traced on the tabulated charges by marching squares; then each point is moved along the slope until the
forward map itself gives the charge there, within ON_CONTOUR. `graphical_method` draws the same contours as the paper
does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from contourpy import LineType, contour_generator

from isocharge.common.arrays import Array
from isocharge.common.errors import SceneError
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.checks import check_forces
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.numerics.disk import onto_disk
from isocharge.simulate.sensor.sensor import electrode_index

GRID = 0.2e-3
"""Side of the squares of the trace, m: contours bend little within one."""

ON_CONTOUR, STEPS = 2e-8, 12
"""Distance from the contour at which a point counts as on it, m, and the largest number of Newton steps to it."""


@dataclass(frozen=True)
class Contour:
    """One connected piece of a contour.

    Attributes:
        electrode: Name of the electrode.
        charge: Its charge on the contour, C.
        points: (x, y) in order along the contour, shape (n, 2), m; the first again at the end if it is closed.
    """

    electrode: str
    charge: float
    points: Array

    @property
    def closed(self) -> bool:
        """Whether the contour ends where it begins."""
        return bool(np.array_equal(self.points[0], self.points[-1]))


@dataclass(frozen=True)
class ContourField:
    """Contours of a sensor under one probe and force, from the field.

    Attributes:
        forward_map: Charges of the sensor under the probe.
        table: The same charges as splines, for slopes and for the first trace.
        force: Force of the presses, N.
    """

    forward_map: ForwardMap
    table: ChargeSpline
    force: float

    @classmethod
    def of(
        cls, forward_map: ForwardMap, force: float, radius: float | None = None, spacing: float | None = None
    ) -> "ContourField":
        """Contours of presses within `radius` (m) of the centre, by default that of the map; see `ChargeSpline.of`.

        Raises:
            SceneError: If the map does not cover the force or the radius.
        """
        check_forces(force, forward_map.force_range, "forward map")
        return cls(forward_map, ChargeSpline.of(forward_map, radius, spacing), force)

    def contours(self, electrode: str, charge: float) -> tuple[Contour, ...]:
        """The pieces of an electrode's contour of a charge (C); an empty tuple if no press gives it.

        Raises:
            SensorError: If there is no such electrode.
            SceneError: If the charge is not finite.
        """
        index = electrode_index(self.forward_map.sensor, electrode)
        if not np.isfinite(charge):
            raise SceneError(f"charge of {electrode!r}: expected a finite number, got {charge * 1e12:g} pC")
        x, y, values = self._squares
        unit = np.abs(values[..., index]).max()
        traced = contour_generator(x, y, values[..., index] / unit, line_type=LineType.Separate).lines(charge / unit)
        pieces = [piece for line in traced for piece in self._inside(np.asarray(line, dtype=float))]
        refined = [self._onto_contour(piece, index, charge) for piece in pieces]
        return tuple(Contour(electrode, charge, points) for points in refined if len(points) > 1)

    def reach(self, electrode: str) -> tuple[float, float]:
        """Smallest and largest charge of an electrode on the corners of the squares, C."""
        values = self._squares[2][..., electrode_index(self.forward_map.sensor, electrode)]
        return float(np.min(values)), float(np.max(values))

    def even_charges(self, electrode: str, count: int) -> Sequence[float]:
        """`count` charges between the smallest and the largest, C: in even ratios, or steps if the sign changes."""
        low, high = self.reach(electrode)
        even = np.geomspace if low * high > 0.0 else np.linspace
        return [float(charge) for charge in even(low, high, count + 2)[1:-1]]

    def to_dict(
        self, charges: Mapping[str, Sequence[float]], contours: Mapping[str, Sequence[tuple[Contour, ...]]]
    ) -> dict[str, Any]:
        """For JSON, in mm, pC and N.

        Args:
            charges: Charges of each electrode, C.
            contours: The pieces of the contour of each of these charges, from `contours`; none if no press gives it.
        """
        names = self.forward_map.electrode_names
        return {
            "probe": self.forward_map.probe.notation,
            "force_N": self.force,
            "radius_mm": 1e3 * self.table.radius,
            "reached_pC": {name: [1e12 * charge for charge in self.reach(name)] for name in names},
            "contours": [
                {
                    "electrode": name,
                    "charge_pC": 1e12 * charge,
                    "pieces_mm": [(1e3 * piece.points).tolist() for piece in pieces],
                    "closed": [piece.closed for piece in pieces],
                }
                for name in charges
                for charge, pieces in zip(charges[name], contours[name], strict=True)
            ],
        }

    @cached_property
    def _squares(self) -> tuple[Array, Array, Array]:
        """Corners x and y of the squares, shape (n,), m, and charges there, shape (n, n, n_electrode), C.

        Outside the disk the charges are those of its edge, so that the squares on the edge are complete.
        """
        radius = self.table.radius
        line = np.linspace(-radius, radius, 2 * int(np.ceil(radius / GRID)) + 1)
        at = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        return line, line, self.table.first_order(at, self.force)[0].reshape(line.size, line.size, -1)

    def _inside(self, line: Array) -> Sequence[Array]:
        """The parts of a traced line that lie on the disk, each up to its edge."""
        radius = self.table.radius
        inside = np.hypot(line[:, 0], line[:, 1]) <= radius
        if inside.all():
            return [line]
        starts, ends = (np.flatnonzero(np.diff(np.pad(inside, 1).astype(int)) == change) for change in (1, -1))
        parts = []
        for start, end in zip(starts, ends, strict=True):
            before = [_onto_edge(line[start], line[start - 1], radius)] if start > 0 else []
            after = [_onto_edge(line[end - 1], line[end], radius)] if end < len(line) else []
            parts.append(np.array([*before, *line[start:end], *after]))
        if inside[0] and inside[-1] and np.array_equal(line[0], line[-1]):  # one part, cut where the trace began
            parts = [np.concatenate([parts[-1], parts[0][1:]]), *parts[1:-1]]
        return parts

    def _onto_contour(self, points: Array, index: int, charge: float) -> Array:
        """The points moved along the slope to where the forward map gives the charge; others are dropped."""
        at = points.copy()
        away = np.full(len(at), np.inf)
        for _ in range(STEPS):
            active = np.flatnonzero(np.abs(away) > ON_CONTOUR)
            if active.size == 0:
                break
            exact = self.forward_map.forward(at[active, 0], at[active, 1], np.full(active.size, self.force))
            slope = self.table.first_order(at[active], self.force)[1][:, index]
            squared = np.maximum(np.sum(slope**2, axis=1), 1e-300)
            step = (charge - exact[:, index])[:, None] * slope / squared[:, None]
            away[active] = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, GRID / np.maximum(away[active], 1e-300))[:, None]
            at[active] = np.where(
                (np.abs(away[active]) > ON_CONTOUR)[:, None],
                onto_disk(at[active] + step, self.table.radius),
                at[active],
            )
        if np.array_equal(points[0], points[-1]):
            at[-1] = at[0]
        on_contour: Array = at[np.abs(away) <= ON_CONTOUR]
        return on_contour


def _onto_edge(inner: Array, outer: Array, radius: float) -> Array:
    """Where the segment from a point inside to one outside leaves the disk."""
    segment = outer - inner
    a, b, c = segment @ segment, inner @ segment, inner @ inner - radius**2
    share = (-b + np.sqrt(b * b - a * c)) / a
    edge: Array = inner + share * segment * (1.0 - 1e-12)
    return edge
