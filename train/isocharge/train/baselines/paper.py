"""The method of Mirbagheri et al. (2007), triangulation, and their two remedies, as regressors.

Linear band: up to 0.5 N the charges are taken as linear in the force, so that a position has one slope per electrode,
Q = F s(x, y). The slopes are interpolated between the presses of the band by a polynomial of the position, and
tabulated on a fine grid. Ratios of the charges give the nearest grid point; about it Q = F (s + ds/dx dx + ds/dy dy) is
linear in F, F dx and F dy, and is solved. A slack film gives F^(2/3), not F: what that costs is what this method shows.

Lookup table over forces and positions, interpolated: an entry is a contact with the mean of its presses; with it goes
the affine map that fits its neighbourhood best. Large neighbourhoods of noisy presses average the noise, small ones of
clean presses follow the map: validation decides. (Without interpolation a table is a nearest neighbour.)
"""

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, RegressorMixin

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.simulate import ChargeMap, Triangulation


class Triangulate(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Where the contours meet; NaN where they do not, or twice.

    Attributes:
        charge_map: Where the contours come from.
        given_force: Whether the true force, N, stands behind the charges of each press.
    """

    def __init__(self, charge_map: ChargeMap, *, given_force: bool = False) -> None:
        self.charge_map, self.given_force = charge_map, given_force

    def fit(self, charge: Array, contact: Array) -> "Triangulate":
        """Nothing is learned from presses."""
        del charge, contact
        self.contours_ = Triangulation(self.charge_map)
        return self

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3)."""
        if not self.given_force:
            return self.contours_.locate_with_force(charge).contact
        force = np.clip(charge[:, -1], *self.charge_map.domain.force_range)
        return self.contours_.locate(charge[:, :-1], force).contact


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
            DatasetError: If there are too few presses of small force, or charges that are not positive.
        """
        band = contact[:, 2] <= BAND
        if np.count_nonzero(band) < FEWEST:
            raise DatasetError(
                f"linear band: expected at least {FEWEST} presses of at most {BAND} N, got {np.count_nonzero(band)}; "
                "sweep smaller forces"
            )
        if (charge[band] <= 0.0).any():
            raise DatasetError("linear band: expected positive charges, for it interpolates their logarithms")
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
    return np.asarray(charge / np.linalg.norm(charge, axis=1, keepdims=True))


CHUNK = 100_000
"""Neighbours gathered at once."""

RIDGE = 1e-6
"""Relative ridge of an affine map: neighbours may lie in a plane."""


class AffineTable(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Nearest entry and its affine map.

    Attributes:
        neighbours: Presses that a map is fitted to.
    """

    def __init__(self, neighbours: int = 64) -> None:
        self.neighbours = neighbours

    def fit(self, values: Array, target: Array) -> "AffineTable":
        """Entries and maps; rows with the same target are one entry."""
        _, entry, count = np.unique(target, axis=0, return_inverse=True, return_counts=True)
        sums = np.zeros((count.size, values.shape[1]))
        np.add.at(sums, entry.ravel(), values)
        entries, presses = sums / count[:, None], cKDTree(values)
        chunk = max(1, CHUNK // self.neighbours)
        parts = []
        for at in np.array_split(entries, len(entries) // chunk + 1):
            rows = presses.query(at, range(1, min(self.neighbours, len(values)) + 1))[1]
            parts.append(affine_maps(values[rows] - at[:, None], target[rows]))
        self.tree_, self.maps_ = cKDTree(entries), np.concatenate(parts)
        return self

    def predict(self, values: Array) -> Array:
        """The nearest entries' maps."""
        rows = self.tree_.query(values)[1]
        linear = np.einsum("ne,nek->nk", values - self.tree_.data[rows], self.maps_[rows, :-1])
        return np.asarray(linear + self.maps_[rows, -1])


def affine_maps(offset: Array, target: Array) -> Array:
    """Least squares with a ridge on the slopes.

    Args:
        offset: Presses about each entry, shape (m, k, p).
        target: Theirs, shape (m, k, q).

    Returns:
        Shape (m, p + 1, q): (offset, 1) times the map is the target.
    """
    columns = np.concatenate([offset, np.ones((*offset.shape[:2], 1))], axis=2)
    normal = columns.transpose(0, 2, 1) @ columns
    size = np.trace(normal[:, :-1, :-1], axis1=1, axis2=2)
    normal[:, :-1, :-1] += RIDGE * size[:, None, None] * np.eye(offset.shape[2])
    return np.asarray(np.linalg.solve(normal, columns.transpose(0, 2, 1) @ target))
