"""Rows of a square anywhere on the film under a fixed set of presses, by interpolation: microseconds for each.

For every press the rows are tabulated on a grid of places that is fine beside the press and coarse far from it,

    place - press = SCALE * sinh(STEP * (i, j)),

and interpolated by local cubics, which also give the derivatives by the place. Presses that a mirroring of the film in
its axes carries onto each other share a table; in a film that is the same in all directions also those that are
mirrored in its diagonals.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.progress import Progress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.solve_family import report_each
from isocharge.simulate.layout.square_charges import COLUMNS, SquareCharges
from isocharge.simulate.numerics.cubic import cubic_weights
from isocharge.simulate.numerics.interpolation import barycentric_weights, chebyshev_nodes, lagrange_values

SCALE, STEP = 1.5e-3, 0.16
"""The grid of places: up to SCALE, m, its steps are even, SCALE * STEP; beyond they grow by the share STEP of the
distance."""

BEYOND = 4e-3
"""Places as far outside the film are not tabulated, m: no square lies there."""

BATCH = 8
"""Presses that one job tabulates."""

SIZES = 3
"""Number of sides that are tabulated where the size may vary."""

SIDE_STEP = 1e-6
"""Step of the derivative of the interpolation by the side, m."""


@dataclass(frozen=True)
class TableJob:
    """Some presses (x, y), shape (n_press, 2), the sides, and the grid of places about a press along x and y; m."""

    charges: SquareCharges
    presses: Array
    sides: Array
    axis: Array


def tabulate(job: TableJob) -> np.ndarray:
    """Rows, shape (n_press, n, n, n_side, 7), single precision, of squares at press + (axis[i], axis[j])."""
    return np.stack([_tabulate_press(job, press) for press in job.presses])


def _tabulate_press(job: TableJob, press: Array) -> np.ndarray:
    x, y = np.meshgrid(press[0] + job.axis, press[1] + job.axis, indexing="ij")
    rows = np.zeros((*x.shape, len(job.sides), len(COLUMNS)), dtype=np.float32)
    on_film = np.hypot(x, y) < job.charges.scene.film.radius + BEYOND
    centres = np.stack([x[on_film], y[on_film]], axis=1)
    pressed, first = job.charges.under(press[None]), np.zeros(len(centres), dtype=np.intp)
    for number, side in enumerate(job.sides):
        rows[on_film, number] = pressed.rows(first, centres, np.full(len(centres), side))
    return rows


@dataclass(frozen=True)
class PlaceTable:
    """Rows of squares under presses.

    Attributes:
        presses: (x, y), shape (n_press, 2), m.
        table: Number of each press's table, shape (n_press,).
        sign: Signs of x and y that carry a press into the sector of its table, shape (n_press, 2).
        swapped: Whether x and y change places after that, shape (n_press,).
        origin: Press of each table, shape (n_table, 2), m.
        sides: Sides that are tabulated, shape (n_side,), m.
        values: Shape (n_table, n, n, n_side, 7).
    """

    presses: Array
    table: Integers
    sign: Array
    swapped: Booleans
    origin: Array
    sides: Array
    values: np.ndarray

    @classmethod
    def build(
        cls,
        charges: SquareCharges,
        presses: Array,
        side: tuple[float, float],
        *,
        map_jobs: JobMap = map,
        progress: Progress | None = None,
    ) -> "PlaceTable":
        """Tabulate presses, shape (n, 2), m, for sides from the first to the second of `side`, m."""
        isotropic = charges.piezo.d31 == charges.piezo.d32
        sign = np.where(presses < 0.0, -1.0, 1.0)
        folded = presses * sign
        swapped = (folded[:, 1] > folded[:, 0]) & isotropic
        folded = np.where(swapped[:, None], folded[:, ::-1], folded)
        origin, table = np.unique(np.round(folded, 12), axis=0, return_inverse=True)
        sides = np.array([side[0]]) if side[0] == side[1] else chebyshev_nodes(SIZES, *side)
        reach = charges.scene.film.radius + charges.scene.radius
        count = int(np.ceil(np.arcsinh(reach / SCALE) / STEP)) + 1
        axis = SCALE * np.sinh(STEP * np.arange(-count, count + 1))
        jobs = [TableJob(charges, origin[i : i + BATCH], sides, axis) for i in range(0, len(origin), BATCH)]
        values = np.concatenate(list(report_each(map_jobs(tabulate, jobs), len(jobs), progress)))
        return cls(presses, table.ravel(), sign, swapped, origin, sides, values)

    def rows(self, centre: Array, side: float) -> tuple[Array, Array]:
        """Rows of one square and their derivatives by its x, y and side.

        Args:
            centre: (x, y), shape (2,), m.
            side: m.

        Returns:
            Shapes (n_press, 7) and (n_press, 7, 3), the columns of `square_charges.COLUMNS`.
        """
        moved = centre * self.sign
        moved = np.where(self.swapped[:, None], moved[:, ::-1], moved) - self.origin[self.table]
        count = self.values.shape[1]
        at = np.arcsinh(moved / SCALE) / STEP + (count - 1) / 2
        chain = 1.0 / (STEP * np.hypot(moved, SCALE))
        (i, *by_i), (j, *by_j) = (cubic_weights(at[:, axis], count) for axis in (0, 1))
        node = (self.table[:, None, None] * count + i[:, :, None]) * count + j[:, None, :]
        block = self.values.reshape(-1, len(self.sides) * len(COLUMNS))[node.reshape(len(node), 16)]
        weights = np.stack(
            [(a[:, :, None] * b[:, None, :]).reshape(-1, 16) for a, b in
             ((by_i[0], by_j[0]), (by_i[1] * chain[:, :1], by_j[0]), (by_i[0], by_j[1] * chain[:, 1:]))],
            axis=1,
        )  # fmt: skip
        taken = np.matmul(weights.astype(np.float32), block).astype(float)
        sized = taken.reshape(len(node), 3, len(self.sides), len(COLUMNS))
        by_side = self._by_side(side)
        first = np.einsum("kdsc,s->kdc", sized, by_side[0])
        grown = np.einsum("ksc,s->kc", sized[:, 0], by_side[1])
        return self._unfold(first[:, 0], first[:, 1:], grown)

    def _by_side(self, side: float) -> tuple[Array, Array]:
        """Weights of the tabulated sides, and their derivatives by the side."""
        if len(self.sides) == 1:
            return np.ones(1), np.zeros(1)
        weights = lagrange_values(
            self.sides, barycentric_weights(self.sides), side + SIDE_STEP * np.array([0.0, 1.0, -1.0])
        )
        return weights[0], (weights[1] - weights[2]) / (2.0 * SIDE_STEP)

    def _unfold(self, rows: Array, by_place: Array, by_side: Array) -> tuple[Array, Array]:
        """From the sector of the table back to each press: x and y of press and square change signs and places."""
        derivatives = np.concatenate([by_place, by_side[:, None]], axis=1)
        swap = self.swapped[:, None]
        derivatives[:, :2] = np.where(swap[:, None], derivatives[:, 1::-1], derivatives[:, :2])
        for block in (rows[:, None], derivatives):
            block[..., 1:3] = np.where(swap[:, None], block[..., 2:0:-1], block[..., 1:3])
            block[..., 1:3] *= self.sign[:, None]
        derivatives[:, :2] *= self.sign[:, :, None]
        return rows, np.moveaxis(derivatives, 1, 2)
