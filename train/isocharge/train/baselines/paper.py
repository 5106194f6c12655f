"""The methods of Mirbagheri et al., 2007, as regressors: triangulation, the linear band and the lookup table.

Linear band: up to 0.5 N, the charges are assumed to be proportional to the force, Q = F s(x, y). There is one slope s
for each electrode. The slopes are interpolated between the presses by a polynomial of the position and tabulated on a
fine grid. The ratios of the charges give the nearest grid point. Near this point, the equation Q = F (s + ds/dx dx +
ds/dy dy) is linear in F, F dx and F dy. It is solved for these three unknowns. On a slack film, the charges are
proportional to F^(2/3) instead, which causes errors of this method.

Lookup table: an entry consists of a contact, the mean features of its presses, and an affine map. The affine map is
fitted to the presses in the neighbourhood of the contact. Large neighbourhoods average the noise, and small
neighbourhoods follow the curvature of the map. The size is chosen by validation.
"""

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, RegressorMixin

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.simulate import ChargeMap, Triangulation


class Triangulate(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Regressor that intersects the charge contours.

    The result is NaN if the contours do not meet at exactly one point.

    Args:
        charge_map: Map from which the contours are computed.
        given_force: Whether the inputs have a last column with the true force, N.
    """

    def __init__(self, charge_map: ChargeMap, *, given_force: bool = False) -> None:
        self.charge_map = charge_map
        self.given_force = given_force

    def fit(self, charge: Array, contact: Array) -> "Triangulate":
        """Compute the contours of the charge map; the presses are not used."""
        del charge, contact
        self.contours_ = Triangulation(self.charge_map)
        return self

    def predict(self, inputs: Array) -> Array:
        """Estimate contacts, shape (n, 3), mm and N.

        Args:
            inputs: Charges, shape (n, n_electrode), pC; with the true force, N, as an additional last column if
                `given_force` is set.
        """
        if not self.given_force:
            return self.contours_.locate_with_force(inputs).contact
        n_electrode = inputs.shape[1] - 1
        charge, force_column = np.split(inputs, [n_electrode], axis=1)
        min_force, max_force = self.charge_map.domain.force_range
        force = np.clip(force_column[:, 0], min_force, max_force)
        return self.contours_.locate(charge, force).contact


MAX_BAND_FORCE = 0.5
"""Largest force of the linear band in the paper, N."""

MIN_BAND_PRESSES = 200
"""Number of presses in the band below which the slopes cannot be interpolated."""

GRID_POINTS = 121
"""Number of grid points across the working area."""

DIFFERENCE_STEP = 1e-4
"""Step of the central differences, relative to the radius of the working area."""

LEAST_SQUARES_TOLERANCE = 1e-9
"""Relative singular value below which the fit of the polynomial ignores a direction."""

MIN_FORCE = 1e-6
"""Smallest force of an answer, N."""

MIN_DIVISOR = 1e-9
"""Smallest force by which F dx and F dy are divided, N."""


class LinearBand(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Regressor that assumes that the charges are proportional to the force.

    Args:
        radius: Radius of the working area, mm.
        degree: Total degree of the polynomial of the slopes.
    """

    def __init__(self, radius: float, degree: int = 10) -> None:
        self.radius = radius
        self.degree = degree

    def fit(self, charge: Array, contact: Array) -> "LinearBand":
        """Fit ln(Q / F) of the presses with small forces by Chebyshev polynomials of x and y, and tabulate the slopes.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            This estimator.

        Raises:
            DatasetError: If there are too few presses in the band, or charges that are not positive.
        """
        is_in_band = contact[:, 2] <= MAX_BAND_FORCE
        n_band = np.count_nonzero(is_in_band)
        if n_band < MIN_BAND_PRESSES:
            raise DatasetError(
                f"linear band: expected at least {MIN_BAND_PRESSES} presses of at most {MAX_BAND_FORCE} N, got "
                f"{n_band}; sweep smaller forces"
            )
        band_charge = charge[is_in_band]
        band_position = contact[is_in_band, :2]
        band_force = contact[is_in_band, 2:]  # shape (n_band, 1)
        if (band_charge <= 0.0).any():
            raise DatasetError("linear band: expected positive charges, for it interpolates their logarithms")
        log_charge_per_force = np.log(band_charge / band_force)
        polynomials = self._terms(band_position / self.radius)
        coefficients, *_ = np.linalg.lstsq(polynomials, log_charge_per_force, rcond=LEAST_SQUARES_TOLERANCE)
        self._tabulate(np.asarray(coefficients))
        return self

    def _tabulate(self, coefficients: Array) -> None:
        """Tabulate Q / F and its derivatives with respect to x and y on a grid of the disk.

        Near a grid point, Q is linear in (F, F dx, F dy), so that a pseudoinverse estimates these three values from the
        charges.

        Args:
            coefficients: Coefficients of the polynomials for ln(Q / F), shape (n_term, n_electrode).
        """
        axis = np.linspace(-1.0, 1.0, GRID_POINTS)
        square_grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        is_in_disk = np.hypot(square_grid[:, 0], square_grid[:, 1]) <= 1.0
        grid = square_grid[is_in_disk]  # positions divided by the radius, shape (n_grid, 2)

        charge_per_force = np.exp(self._terms(grid) @ coefficients)
        value_and_slopes = [charge_per_force]
        for step in DIFFERENCE_STEP * np.eye(2):  # a step along x, and a step along y
            log_difference = (self._terms(grid + step) - self._terms(grid - step)) @ coefficients
            value_and_slopes.append(charge_per_force * log_difference / (2.0 * DIFFERENCE_STEP * self.radius))

        self.position_ = grid * self.radius
        linear_map = np.stack(
            value_and_slopes, axis=2
        )  # from (F, F dx, F dy) to charges, shape (n_grid, n_electrode, 3)
        self.inverse_ = np.linalg.pinv(linear_map)
        self.tree_ = cKDTree(unit_vectors(charge_per_force))

    def predict(self, charge: Array) -> Array:
        """Estimate contacts from charges.

        The ratios of the charges are compared with those at all grid points, and the most similar grid point is chosen.
        The linear map of this grid point then estimates the force and the shift from the grid point.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N.
        """
        _, grid_rows = self.tree_.query(unit_vectors(charge))
        estimates = (self.inverse_[grid_rows] @ charge[:, :, None])[:, :, 0]  # (F, F dx, F dy), shape (n, 3)
        force, force_times_shift = np.split(estimates, [1], axis=1)
        max_shift = 4.0 * self.radius / (GRID_POINTS - 1)  # the linear map is valid up to the next grid points
        shift = np.clip(force_times_shift / np.maximum(force, MIN_DIVISOR), -max_shift, max_shift)
        return np.column_stack([self.position_[grid_rows] + shift, np.maximum(force, MIN_FORCE)])

    def _terms(self, position: Array) -> Array:
        """Evaluate the products of Chebyshev polynomials up to the total degree.

        Args:
            position: Positions relative to the radius, shape (n, 2).

        Returns:
            Products, shape (n, n_term).
        """
        # All products, in the order of their degrees in x and then in y; those above the total degree are removed.
        products = chebyshev.chebvander2d(position[:, 0], position[:, 1], [self.degree, self.degree])
        x_degree, y_degree = np.indices((self.degree + 1, self.degree + 1))
        in_total_degree = (x_degree + y_degree <= self.degree).ravel()
        terms: Array = products.astype(float)[:, in_total_degree]
        return terms


def unit_vectors(charge: Array) -> Array:
    """Normalise each row of charges, shape (n, n_electrode), to length one, so that only ratios remain."""
    return np.asarray(charge / np.linalg.norm(charge, axis=1, keepdims=True))


CHUNK = 100_000
"""Number of neighbours that are gathered at once."""

RIDGE = 1e-6
"""Ridge of an affine map, relative to the trace of the normal matrix.

Without a ridge, neighbours that lie in a plane would not determine the map.
"""


class AffineTable(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Lookup table whose entries have affine maps.

    Args:
        neighbours: Number of presses to which the affine map of an entry is fitted.
    """

    def __init__(self, neighbours: int = 64) -> None:
        self.neighbours = neighbours

    def fit(self, values: Array, target: Array) -> "AffineTable":
        """Compute the entries of the table and their affine maps.

        Presses with the same target form one entry, whose features are the mean of their features. The affine map of an
        entry is fitted to the presses with the most similar features.

        Args:
            values: Features of presses, shape (n, n_feature).
            target: Contacts in any coordinates, shape (n, n_target).

        Returns:
            This estimator.
        """
        # Mean features of the presses of each entry
        _, entry_of_press, presses_per_entry = np.unique(target, axis=0, return_inverse=True, return_counts=True)
        feature_sums = np.zeros((presses_per_entry.size, values.shape[1]))
        np.add.at(feature_sums, entry_of_press.ravel(), values)
        entries = feature_sums / presses_per_entry[:, None]

        # The maps are fitted in chunks of entries, which limits the memory. A query for ranks 1 to k returns the k
        # nearest presses, also as an array of shape (n, 1) if k is 1.
        press_tree = cKDTree(values)
        neighbour_ranks = range(1, min(self.neighbours, len(values)) + 1)
        entries_per_chunk = max(1, CHUNK // self.neighbours)
        chunk_count = len(entries) // entries_per_chunk + 1
        maps = []
        for chunk in np.array_split(entries, chunk_count):
            _, neighbours = press_tree.query(chunk, neighbour_ranks)
            offset = values[neighbours] - chunk[:, None]
            maps.append(affine_maps(offset, target[neighbours]))
        self.tree_ = cKDTree(entries)
        self.maps_ = np.concatenate(maps)
        return self

    def predict(self, values: Array) -> Array:
        """Estimate each contact by the affine map of the entry with the most similar features.

        Args:
            values: Features, shape (n, n_feature).

        Returns:
            Contacts in the coordinates of the fit, shape (n, n_target).
        """
        _, nearest_entry = self.tree_.query(values)
        n_feature = values.shape[1]
        slope, constant = np.split(self.maps_[nearest_entry], [n_feature], axis=1)
        difference = values - self.tree_.data[nearest_entry]
        linear_part = (difference[:, None, :] @ slope)[:, 0]
        return np.asarray(linear_part + constant[:, 0])


def affine_maps(offset: Array, target: Array) -> Array:
    """Fit an affine map to the neighbours of each entry by least squares, with a ridge on the slopes.

    The ridge is `RIDGE` times the sum of the squared features of the neighbours.

    Args:
        offset: Features of the neighbours relative to each of m entries, shape (m, k, p).
        target: Targets of the neighbours, shape (m, k, q).

    Returns:
        Maps, shape (m, p + 1, q). The row (offset, 1) times the map is the target.
    """
    n_entry, n_neighbour, n_feature = offset.shape
    columns = np.concatenate([offset, np.ones((n_entry, n_neighbour, 1))], axis=2)
    transposed = columns.transpose(0, 2, 1)
    normal = transposed @ columns  # shape (m, p + 1, p + 1)
    moment = transposed @ target

    slopes = slice(0, n_feature)
    trace = np.trace(normal[:, slopes, slopes], axis1=1, axis2=2)
    normal[:, slopes, slopes] += RIDGE * trace[:, None, None] * np.eye(n_feature)
    return np.asarray(np.linalg.solve(normal, moment))
