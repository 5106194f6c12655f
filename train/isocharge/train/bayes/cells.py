"""Square cells that cover the mass of a posterior."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.simulate.numerics.disk import onto_disk

EDGE = 8
"""Points across a cell on the edge of the disk; each counts as inside or outside."""


@dataclass(frozen=True)
class Cells:
    """Squares in the plane of positions, each for one press.

    Attributes:
        press: Number of the press, ascending, shape (n,).
        root: Number of the first cell that it was cut from, shape (n,).
        centre: Shape (n, 2), mm.
        side: Of every cell, mm.
    """

    press: Integers
    root: Integers
    centre: Array
    side: float

    def __len__(self) -> int:
        return self.press.size

    def __getitem__(self, rows: np.ndarray) -> "Cells":
        return Cells(self.press[rows], self.root[rows], self.centre[rows], self.side)

    def cut(self, radius: float) -> "Cells":
        """Each in four; those without a share in the disk are dropped."""
        parts = self._four(0.25)
        return parts[np.hypot(*np.maximum(np.abs(parts.centre) - 0.5 * parts.side, 0.0).T) < radius]

    def finer(self, radius: float) -> Iterator["Cells"]:
        """Whole ones as Gauss and Legendre's four points, others in sixteen."""
        edge = self.on_edge(radius)
        yield self[~edge]._four(1.0 / np.sqrt(12.0))
        yield self[edge].cut(radius).cut(radius)

    def _four(self, offset: float) -> "Cells":
        """Four half as wide in place of each, their centres `offset` sides off its middle in both directions."""
        corner = offset * self.side * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
        centre = (self.centre[:, None] + corner).reshape(-1, 2)
        return Cells(np.repeat(self.press, 4), np.repeat(self.root, 4), centre, 0.5 * self.side)

    def on_edge(self, radius: float) -> Booleans:
        """Which may stick out of the disk, shape (n,)."""
        return np.asarray(np.hypot(*self.centre.T) + np.sqrt(0.5) * self.side > radius)

    def inside(self, radius: float) -> tuple[Array, Array]:
        """Share of each cell that lies in the disk, shape (n,), and that share's centre, shape (n, 2).

        A corner without any of the counted points has half of one point's share.
        """
        share, centre = np.ones(len(self)), self.centre.copy()
        edge = np.flatnonzero(self.on_edge(radius))
        line = self.side * ((np.arange(EDGE) + 0.5) / EDGE - 0.5)
        points = self.centre[edge, None] + np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        counts = np.hypot(points[..., 0], points[..., 1]) <= radius
        total = counts.sum(axis=1, keepdims=True)
        share[edge] = np.maximum(total[:, 0], 0.5) / EDGE**2
        middle = np.einsum("np,npi->ni", counts, points) / np.maximum(total, 1)
        centre[edge] = np.where(total > 0, middle, onto_disk(centre[edge], radius))
        return share, centre
