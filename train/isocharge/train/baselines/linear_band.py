"""Interpolation in the linear band, the first remedy of Mirbagheri et al. (2007): up to 0.5 N the charges are taken as
linear in the force, so that a position has one slope per electrode, Q = F s(x, y).

The slopes are interpolated between the presses of the band by a polynomial of the position, and tabulated on a fine
grid. Ratios of the charges give the nearest grid point; about it Q = F (s + ds/dx dx + ds/dy dy) is linear in F, F dx
and F dy, and is solved. A slack film gives F^(2/3), not F: what that costs is what this method shows.
"""

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, RegressorMixin

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError

BAND = 0.5
"""Largest force of the band, N, as the paper has it."""

FEWEST = 200
"""Presses in the band below which slopes cannot be interpolated."""

STEPS = 121
"""Points of the grid across the working area."""

NEAR = 1e-4
"""Step of the difference quotients over the radius."""


class LinearBand(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Slopes on a grid.

    Attributes:
        radius: Of the working area, mm.
        degree: Of the polynomial of the slopes.
    """

    def __init__(self, radius: float, degree: int = 10) -> None:
        self.radius, self.degree = radius, degree

    def fit(self, charge: Array, contact: Array) -> "LinearBand":
        """Slopes from the presses of the band: ln(Q / F) as Chebyshev polynomials of x and y up to a total degree.

        Raises:
            DatasetError: If there are too few presses of small force.
        """
        band = contact[:, 2] <= BAND
        if np.count_nonzero(band) < FEWEST:
            raise DatasetError(
                f"linear band: expected at least {FEWEST} presses of at most {BAND} N, got {np.count_nonzero(band)}; "
                "sweep smaller forces"
            )
        slope = np.log(charge[band] / contact[band, 2:])
        series = np.linalg.lstsq(self._terms(contact[band, :2] / self.radius), slope, rcond=1e-9)[0]
        axis = np.linspace(-1.0, 1.0, STEPS)
        square = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        grid = square[np.hypot(*square.T) <= 1.0]
        slopes = [np.exp(self._terms(grid) @ series)]
        for step in NEAR * np.eye(2):
            change = (self._terms(grid + step) - self._terms(grid - step)) @ series
            slopes.append(slopes[0] * change / (2.0 * NEAR * self.radius))
        self.position_, self.inverse_ = grid * self.radius, np.linalg.pinv(np.stack(slopes, axis=2))
        self.tree_ = cKDTree(directions(slopes[0]))
        return self

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3)."""
        rows = self.tree_.query(directions(charge))[1]
        parts = np.einsum("nke,ne->nk", self.inverse_[rows], charge)
        most = 4.0 * self.radius / (STEPS - 1)  # a linear map holds no farther than to the next grid points
        shift = np.clip(parts[:, 1:] / np.maximum(parts[:, :1], 1e-9), -most, most)
        return np.column_stack([self.position_[rows] + shift, np.maximum(parts[:, 0], 1e-6)])

    def _terms(self, at: Array) -> Array:
        """Products of the polynomials at positions over the radius, shape (n, n_term)."""
        count = self.degree + 1
        inside = np.triu(np.ones((count, count), dtype=bool))[:, ::-1].ravel()
        terms: Array = chebyshev.chebvander2d(at[:, 0], at[:, 1], [self.degree, self.degree]).astype(float)
        return terms[:, inside]


def directions(charge: Array) -> Array:
    """Ratios of charges, shape (n, n_electrode): each row of length one."""
    unit: Array = charge / np.linalg.norm(charge, axis=1, keepdims=True)
    return unit
