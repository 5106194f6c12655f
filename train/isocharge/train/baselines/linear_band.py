"""Interpolation in the linear band, the first remedy of Mirbagheri et al. (2007): up to 0.5 N the charges are taken as
linear in the force, so that a position has one slope per electrode, Q = F s(x, y).

The slopes are interpolated between the presses of the band by a polynomial of the position, and tabulated on a fine
grid. Ratios of the charges give the nearest grid point; about it Q = F (s + ds/dx dx + ds/dy dy) is linear in F, F dx
and F dy, and is solved. A slack film gives F^(2/3), not F: what that costs is what this method shows.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.train.baselines.estimator import Fitted, FittingTask, best_of
from isocharge.train.data.presses import LabelledPresses

NAME = "linear band"

BAND_N = 0.5
"""Largest force of the band, as the paper has it."""

FEWEST = 200
"""Presses in the band below which slopes cannot be interpolated."""

STEPS = 121
"""Points of the grid across the working area."""

NEAR, AXES = 1e-4, np.eye(2)
"""Step of the difference quotients over the radius, and their directions."""


@dataclass(frozen=True)
class LinearBand:
    """The method.

    Attributes:
        degrees: Candidates for the polynomial of the slopes.
    """

    degrees: tuple[int, ...] = (6, 10, 14)
    name: str = NAME

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Slopes from the presses of the band; the degree by the validation presses, which have any force."""
        band = task.train[np.flatnonzero(task.train.contact[:, 2] <= BAND_N)]
        if len(band) < FEWEST:
            raise DatasetError(
                f"linear band: expected at least {FEWEST} presses of at most {BAND_N} N, got {len(band)}; "
                "sweep smaller forces"
            )
        tables = {degree: tabulate(band, degree, task.domain.radius_mm) for degree in self.degrees}
        degree, comparison = best_of(
            task, self.degrees[:1] if task.quick else self.degrees, lambda d: tables[d].predict
        )
        choice = f"{len(band)} presses up to {BAND_N} N, slopes of degree {degree}{comparison}"
        return (replace(tables[degree], choice=choice),)


def tabulate(band: LabelledPresses, degree: int, radius_mm: float) -> "BandTable":
    """Slopes of the presses as a polynomial of the position, on a grid.

    ln(Q / F) is expanded in Chebyshev polynomials of x and y up to a total degree.
    """
    inside = np.array(np.triu(np.ones((degree + 1, degree + 1)))[:, ::-1], dtype=bool)

    def terms(at: Array) -> Array:
        every: Array = chebyshev.chebvander2d(at[:, 0], at[:, 1], [degree, degree]).astype(float)
        return every[:, inside.ravel()]

    slope = np.log(band.charge_pC / band.contact[:, 2:])
    series = np.linalg.lstsq(terms(band.contact[:, :2] / radius_mm), slope, rcond=1e-9)[0]
    grid = _grid()
    derivative = [(terms(grid + step) - terms(grid - step)) @ series / (2.0 * NEAR) for step in NEAR * AXES]
    return BandTable.of(grid * radius_mm, np.exp(terms(grid) @ series), np.stack(derivative, axis=1) / radius_mm)


def _grid() -> Array:
    """Square lattice over the unit disk, shape (m, 2)."""
    axis = np.linspace(-1.0, 1.0, STEPS)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    inside: Array = points[np.hypot(*points.T) <= 1.0]
    return inside


@dataclass(frozen=True)
class BandTable(Fitted):
    """Slopes on a grid.

    Attributes:
        position_mm: Grid, shape (m, 2).
        tree: Directions of the slopes, s / |s|, shape (m, n_electrode).
        inverse: From charges to (F, F dx, F dy) about each point, shape (m, 3, n_electrode).
        step_mm: Farthest that a position may lie from its grid point along an axis.
    """

    position_mm: Array
    tree: cKDTree
    inverse: Array
    step_mm: float
    choice: str = ""
    name: str = NAME
    form: str = "SciPy KD-tree"

    @classmethod
    def of(cls, position_mm: Array, slope: Array, log_gradient: Array) -> "BandTable":
        """From slopes (m, n_electrode), pC/N, and the derivatives of their logarithms (m, 2, n_electrode), 1/mm."""
        rows = np.concatenate([slope[:, None], log_gradient * slope[:, None]], axis=1)
        tree = cKDTree(slope / np.linalg.norm(slope, axis=1, keepdims=True))
        step = 2.0 * float(np.ptp(position_mm[:, 0])) / (STEPS - 1)
        return cls(position_mm, tree, np.linalg.pinv(rows.transpose(0, 2, 1)), step)

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        rows = self.tree.query(charge_pC / np.linalg.norm(charge_pC, axis=1, keepdims=True))[1]
        parts = np.einsum("nke,ne->nk", self.inverse[rows], charge_pC)
        shift = np.clip(parts[:, 1:] / np.maximum(parts[:, :1], 1e-9), -self.step_mm, self.step_mm)
        return np.column_stack([self.position_mm[rows] + shift, np.maximum(parts[:, 0], 1e-6)])
