"""Methods of Mirbagheri et al., 2007, as regressors: triangulation, the linear band and the lookup table.

Linear band: for forces F up to 0.5 N, each charge Q is assumed to be proportional to the force, Q = F s(x, y). Each
electrode has its own slope s. The slopes are interpolated between the presses by a polynomial in the position, and are
tabulated on a fine grid. For given charges, the method chooses the grid point at which the ratios of the slopes are
most similar to the ratios of the charges. Near this grid point, the equation Q = F (s + ds/dx dx + ds/dy dy) is linear
in F, F dx and F dy. The equations of all electrodes are solved for these three unknowns. The method is inaccurate on
slack films, because their charges are proportional to F^(2/3).

Lookup table: an entry consists of a contact, the mean features of the presses at this contact, and an affine map. The
affine map is fitted to the presses with the most similar features. With a larger number of such presses, the noise is
averaged better; with a smaller number, the affine map is a better approximation of the curved map. The number is
chosen by validation.
"""

import numpy as np
from numpy.polynomial import chebyshev
from scipy.spatial import cKDTree
from sklearn.base import BaseEstimator, RegressorMixin

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError
from isocharge.simulate import ChargeMap, Triangulation


class Triangulate(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Regressor that intersects the contours of the charges.

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
            inputs: Charges, shape (n, n_electrode), pC. If `given_force` is set, the true force, N, is an additional
                last column.
        """
        if not self.given_force:
            return self.contours_.locate_with_force(inputs).contact
        n_electrode = inputs.shape[1] - 1
        charge, force_column = np.split(inputs, [n_electrode], axis=1)
        true_force = force_column[:, 0]

        # `locate` raises an error for forces outside the range of the charge map.
        min_force, max_force = self.charge_map.domain.force_range
        force = np.clip(true_force, min_force, max_force)
        return self.contours_.locate(charge, force).contact


MAX_BAND_FORCE = 0.5
"""Largest force of the linear band in the paper, N."""

MIN_BAND_PRESSES = 200
"""Smallest number of presses in the band from which the slopes can be interpolated."""

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

    The charges are Q = F s(x, y), with one slope s for each electrode. The docstring of the module describes the
    method.

    Args:
        radius: Radius of the working area, mm.
        degree: Total degree of the polynomial in x and y that is fitted to the logarithm of each slope.
    """

    def __init__(self, radius: float, degree: int = 10) -> None:
        self.radius = radius
        self.degree = degree

    def fit(self, charge: Array, contact: Array) -> "LinearBand":
        """Fit polynomials of x and y to the logarithms of the slopes s = Q / F, and tabulate the slopes on a grid.

        For forces F up to `MAX_BAND_FORCE`, the charges Q are assumed to be proportional to F. The presses with forces
        up to this limit are called the band, and only these presses are used. The polynomials are fitted by least
        squares.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            This estimator.

        Raises:
            DatasetError: If the band has too few presses, or if a charge in the band is not positive.
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
            raise DatasetError(
                f"linear band: expected positive charges, got a charge of {band_charge.min():g} pC; the method "
                "interpolates the logarithms of the charges"
            )
        log_slope = np.log(band_charge / band_force)
        polynomials = self._polynomials(band_position / self.radius)
        coefficients, *_ = np.linalg.lstsq(polynomials, log_slope, rcond=LEAST_SQUARES_TOLERANCE)
        self._tabulate(np.asarray(coefficients))
        return self

    def _tabulate(self, coefficients: Array) -> None:
        """Tabulate the slopes on a grid, and compute a linear estimator of the contact near each grid point.

        Let s be the slope of an electrode at a grid point, which is its charge per force. At the shift (dx, dy) from
        the grid point, the charge of the electrode is

            Q = F (s + ds/dx dx + ds/dy dy),

        which is linear in the unknowns (F, F dx, F dy). The pseudoinverse of this linear map therefore estimates the
        unknowns from the charges of all electrodes.

        Args:
            coefficients: Coefficients of the polynomials for ln s, shape (n_term, n_electrode).
        """
        axis = np.linspace(-1.0, 1.0, GRID_POINTS)
        square_grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        is_in_disk = np.hypot(square_grid[:, 0], square_grid[:, 1]) <= 1.0
        grid = square_grid[is_in_disk]  # positions divided by the radius, shape (n_grid, 2)

        # The columns of the linear map are s, ds/dx and ds/dy. The derivative ds/dx is s d(ln s)/dx, and d(ln s)/dx is
        # computed by central differences. The steps are relative to the radius, so the differences are divided by it.
        slope = np.exp(self._polynomials(grid) @ coefficients)  # s, shape (n_grid, n_electrode)
        columns = [slope]
        for step in DIFFERENCE_STEP * np.eye(2):  # a step along x, and a step along y
            log_difference = (self._polynomials(grid + step) - self._polynomials(grid - step)) @ coefficients
            columns.append(slope * log_difference / (2.0 * DIFFERENCE_STEP * self.radius))
        linear_map = np.stack(columns, axis=2)  # shape (n_grid, n_electrode, 3)

        self.grid_position_ = grid * self.radius
        self.pseudoinverse_ = np.linalg.pinv(linear_map)  # shape (n_grid, 3, n_electrode)
        self.ratio_tree_ = cKDTree(unit_vectors(slope))

    def predict(self, charge: Array) -> Array:
        """Estimate contacts from charges.

        The ratios of the charges are compared with the ratios at all grid points, and the grid point with the most
        similar ratios is chosen. The linear estimator of this grid point gives the force F and the shift (dx, dy) from
        the grid point.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N.
        """
        _, grid_index = self.ratio_tree_.query(unit_vectors(charge))
        charge_column = charge[:, :, None]
        estimates = (self.pseudoinverse_[grid_index] @ charge_column)[:, :, 0]  # (F, F dx, F dy), shape (n, 3)
        force, force_times_shift = np.split(estimates, [1], axis=1)  # shapes (n, 1) and (n, 2)

        # The linear map is only valid near the grid point, so the shift is limited to twice the spacing of the grid.
        grid_spacing = 2.0 * self.radius / (GRID_POINTS - 1)
        max_shift = 2.0 * grid_spacing
        positive_force = np.maximum(force, MIN_DIVISOR)  # noise can make the estimated force zero or negative
        shift = np.clip(force_times_shift / positive_force, -max_shift, max_shift)
        position = self.grid_position_[grid_index] + shift
        return np.column_stack([position, np.maximum(force, MIN_FORCE)])

    def _polynomials(self, position: Array) -> Array:
        """Evaluate the products T_i(x) T_j(y) of Chebyshev polynomials for all i and j with i + j <= `degree`.

        Args:
            position: Positions (x, y) divided by the radius, shape (n, 2).

        Returns:
            Products, shape (n, n_term), sorted by i and then by j.
        """
        # NumPy computes the products of all i and j up to `degree`. Those with a larger sum i + j are removed.
        x, y = position.T
        all_products = chebyshev.chebvander2d(x, y, [self.degree, self.degree])
        x_degree, y_degree = np.indices((self.degree + 1, self.degree + 1))
        is_used = (x_degree + y_degree <= self.degree).ravel()
        products: Array = all_products.astype(float)[:, is_used]
        return products


def unit_vectors(charge: Array) -> Array:
    """Normalise each row of charges, shape (n, n_electrode), to the length one, so that only the ratios remain."""
    return np.asarray(charge / np.linalg.norm(charge, axis=1, keepdims=True))


CHUNK = 100_000
"""Largest number of neighbours whose features are in memory at once."""

RIDGE = 1e-6
"""Ridge in the fit of an affine map, relative to the trace of the normal matrix.

Without a ridge, neighbours whose features lie in a plane would not determine the map.
"""


class AffineTable(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """Lookup table in which each entry has an affine map from features to targets.

    Args:
        neighbours: Number of presses to which the affine map of an entry is fitted.
    """

    def __init__(self, neighbours: int = 64) -> None:
        self.neighbours = neighbours

    def fit(self, features: Array, target: Array) -> "AffineTable":
        """Compute the entries of the table and their affine maps.

        Presses with the same target form one entry, whose features are the mean of their features. The affine map of an
        entry is fitted to the `neighbours` presses with the most similar features.

        Args:
            features: Features of presses, shape (n, n_feature).
            target: Contacts in any coordinates, shape (n, n_target).

        Returns:
            This estimator.
        """
        # Mean features of the presses of each entry
        _, entry_of_press, presses_per_entry = np.unique(target, axis=0, return_inverse=True, return_counts=True)
        feature_sums = np.zeros((presses_per_entry.size, features.shape[1]))
        entry_of_press = entry_of_press.ravel()  # some versions of NumPy return an array with two axes
        np.add.at(feature_sums, entry_of_press, features)
        entry_features = feature_sums / presses_per_entry[:, None]

        # A query for the ranks 1 to k returns the indices of the k nearest presses, shape (n, k), also if k is 1.
        press_tree = cKDTree(features)
        n_neighbour = min(self.neighbours, len(features))
        ranks = range(1, n_neighbour + 1)

        # The maps are fitted in chunks of entries, which limits the memory. "+ 1" rounds the number of chunks up.
        entries_per_chunk = max(1, CHUNK // self.neighbours)
        n_chunk = len(entry_features) // entries_per_chunk + 1
        maps_of_chunks = []
        for chunk_features in np.array_split(entry_features, n_chunk):
            _, nearest_presses = press_tree.query(chunk_features, ranks)
            offset = features[nearest_presses] - chunk_features[:, None]  # from the entry, shape (n, k, n_feature)
            maps_of_chunks.append(affine_maps(offset, target[nearest_presses]))
        self.entry_tree_ = cKDTree(entry_features)
        self.maps_ = np.concatenate(maps_of_chunks)  # shape (n_entry, n_feature + 1, n_target)
        return self

    def predict(self, features: Array) -> Array:
        """Estimate each contact by the affine map of the entry with the most similar features.

        The estimate is (f - e) A + b, with the features f, the features e of the entry, and the slopes A and the
        constant b of its affine map.

        Args:
            features: Features, shape (n, n_feature).

        Returns:
            Contacts in the coordinates of the fit, shape (n, n_target).
        """
        _, nearest_entry = self.entry_tree_.query(features)
        offset = features - self.entry_tree_.data[nearest_entry]

        # The last row of a map is its constant, and the other rows are its slopes.
        n_feature = features.shape[1]
        slopes, constant = np.split(self.maps_[nearest_entry], [n_feature], axis=1)
        linear_part = (offset[:, None, :] @ slopes)[:, 0]
        return np.asarray(linear_part + constant[:, 0])


def affine_maps(offset: Array, target: Array) -> Array:
    """For each entry, fit an affine map to its neighbours by least squares, with a ridge on the slopes.

    The map M of an entry solves the normal equations (X' X + R) M = X' T. The rows of X are (offset, 1) of the
    neighbours, and the rows of T are their targets. R is a diagonal matrix, which is zero for the constant. The
    elements of R for the slopes are `RIDGE` times the sum of all squared offsets.

    Args:
        offset: Features of k neighbours relative to each of m entries, shape (m, k, p).
        target: Targets of the neighbours, shape (m, k, q).

    Returns:
        Maps, shape (m, p + 1, q). The row (offset, 1) times the map is the estimated target.
    """
    n_entry, n_neighbour, n_feature = offset.shape
    design = np.concatenate([offset, np.ones((n_entry, n_neighbour, 1))], axis=2)
    transposed = design.transpose(0, 2, 1)
    normal = transposed @ design  # shape (m, p + 1, p + 1)
    moment = transposed @ target  # shape (m, p + 1, q)

    slopes = slice(0, n_feature)
    square_sum = np.trace(normal[:, slopes, slopes], axis1=1, axis2=2)  # of all offsets, shape (m,)
    normal[:, slopes, slopes] += RIDGE * square_sum[:, None, None] * np.eye(n_feature)
    return np.asarray(np.linalg.solve(normal, moment))
