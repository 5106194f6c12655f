"""The forward map as a short series: what charges a contact gives, cheap enough to live inside the model.

Without pretension Q = F^(2/3) g(x, y) nearly, with g smooth, so ln Q is expanded in Chebyshev polynomials

    ln Q_e = sum c_ijm T_i(x / r) T_j(y / r) T_m(l),   i + j <= degree, m <= force_degree,

with r the radius of the working area and l the logarithm of the force scaled to [-1, 1]. The coefficients follow from
linear least squares. A second series of the same polynomials gives the Gauss-Newton inverse of the map,

    P = (J' W J + damping)^-1 J' W,   J = d(ln Q)/d(unit contact),   W = (Q / sigma)^2,

so that P (ln Q_measured - ln Q(c)) is the step from c to the contact that fits measured charges best.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.linalg import solve_triangular

from isocharge.errors import TrainingError
from isocharge.simulate.arrays import Array
from isocharge.simulate.noise import NoiseModel

CANDIDATES = ((6, 1), (10, 1), (14, 1), (18, 1), (22, 1), (22, 2), (22, 3))
"""Degrees tried in turn, in position and in force."""

DAMPING = 1e-4
"""Levenberg damping of the inverse, relative to the mean diagonal: bounds it where the map nearly folds."""

ROWS_PER_TERM = 40
"""Presses used for each coefficient at most. Near the edge of the disk, where the series is worst, more help most."""

RIDGE = 1e-4
"""Weight of the coefficients' own size in the fit, relative: the square's corners lie outside the disk, where nothing
holds the polynomials, and large coefficients that cancel would cost the digits of float32."""

GOOD_ENOUGH = 2e-4
"""Root-mean-square relative error of the charges at which no higher degree is tried: a tenth of the reference noise."""


@dataclass(frozen=True)
class Domain:
    """The contacts that a model knows: a disk and a range of forces.

    Attributes:
        radius_mm: Radius of the working area.
        force_range_N: Smallest and largest force.
    """

    radius_mm: float
    force_range_N: tuple[float, float]

    @property
    def centre(self) -> Array:
        """Middle of (x_mm, y_mm, ln force), shape (3,)."""
        low, high = np.log(self.force_range_N)
        return np.array([0.0, 0.0, 0.5 * (low + high)])

    @property
    def scale(self) -> Array:
        """Half width of (x_mm, y_mm, ln force), shape (3,)."""
        low, high = np.log(self.force_range_N)
        return np.array([self.radius_mm, self.radius_mm, max(0.5 * (high - low), 0.05)])

    def to_unit(self, contact: Array) -> Array:
        """(x_mm, y_mm, force_N), shape (n, 3), to [-1, 1]^3."""
        logs = np.stack([contact[:, 0], contact[:, 1], np.log(contact[:, 2])], axis=1)
        unit: Array = (logs - self.centre) / self.scale
        return unit

    def to_contact(self, unit: Array) -> Array:
        """The inverse of `to_unit`: shape (n, 3) to (x_mm, y_mm, force_N), shape (n, 3)."""
        contact: Array = unit * self.scale + self.centre
        contact[..., 2] = np.exp(contact[..., 2])
        return contact


@dataclass(frozen=True)
class ChargeField:
    """Charges as a function of the contact.

    Attributes:
        domain: Where it holds.
        coefficients: Of ln Q (Q in pC) and of the three rows of P, shape
            (4, degree + 1, degree + 1, force_degree + 1, n_electrode).
        error: Root-mean-square relative error on samples that the fit did not see.
    """

    domain: Domain
    coefficients: Array
    error: float

    @classmethod
    def fit(
        cls, domain: Domain, contact: Array, charge_pC: Array, held: tuple[Array, Array], noise: NoiseModel
    ) -> "ChargeField":
        """Least squares on (contact, charge), the degree chosen on `held`.

        Args:
            domain: Where the contacts lie.
            contact: (x_mm, y_mm, force_N), shape (n, 3).
            charge_pC: Clean charges, shape (n, n_electrode), all positive.
            held: Contacts and charges to measure the error on.
            noise: Weights of the inverse.

        Raises:
            TrainingError: If there are too few samples for the smallest degree.
        """
        best: tuple[float, Array] | None = None
        target, unit, held_unit = np.log(charge_pC), domain.to_unit(contact), domain.to_unit(held[0])
        for degree, force_degree in CANDIDATES:
            count = (degree + 1) * (degree + 2) // 2 * (force_degree + 1)
            if 4 * count > len(unit):
                break
            rows = slice(0, ROWS_PER_TERM * count)
            solve = _LeastSquares(unit[rows], degree, force_degree)
            series = solve(target[rows])
            relative = np.exp(_evaluate(series, held_unit)) / held[1] - 1.0
            error = float(np.sqrt(np.mean(relative**2)))
            if best is None or error < best[0]:
                inverse = np.split(solve(_inverse(series, unit[rows], noise)), 3, axis=-1)
                best = error, np.stack([series, *inverse])
            if error < GOOD_ENOUGH:
                break
        if best is None:
            raise TrainingError(f"expected at least 224 presses to fit the charges by, got {len(unit)}")
        return cls(domain, best[1], best[0])

    def charge_pC(self, contact: Array) -> Array:
        """Charges of contacts (x_mm, y_mm, force_N): shape (n, 3) to (n, n_electrode)."""
        charge: Array = np.exp(_evaluate(self.coefficients[0], self.domain.to_unit(contact)))
        return charge

    def with_slopes(self) -> Array:
        """Series of ln Q and of its derivatives by the unit coordinates, side by side.

        Returns:
            Shape (degree + 1, degree + 1, force_degree + 1, 4, n_electrode).
        """
        series = self.coefficients[0]
        return np.stack([series, *(_derivative(series, axis) for axis in range(3))], axis=3)


def _polynomials(unit: Array, degree: int, force_degree: int) -> tuple[Array, Array, Array]:
    degrees = (degree, degree, force_degree)
    x, y, force = (chebyshev.chebvander(np.clip(unit[:, i], -1.0, 1.0), degrees[i]).astype(float) for i in range(3))
    return x, y, force


class _LeastSquares:
    """Least squares for one set of terms at one set of contacts: factorised once, solved for several targets."""

    def __init__(self, unit: Array, degree: int, force_degree: int) -> None:
        in_x, in_y, in_force = _polynomials(unit, degree, force_degree)
        self.shape = (degree + 1, degree + 1, force_degree + 1)
        self.terms = np.nonzero(np.add.outer(np.arange(degree + 1), np.arange(degree + 1)) <= degree)
        plane = in_x[:, self.terms[0]] * in_y[:, self.terms[1]]
        columns = (plane[:, :, None] * in_force[:, None, :]).reshape(len(unit), -1)
        ridge = RIDGE * np.sqrt(len(unit)) * np.eye(columns.shape[1])
        self.factor = np.linalg.qr(np.vstack([columns, ridge]))

    def __call__(self, target: Array) -> Array:
        """Series of shape (degree + 1, degree + 1, force_degree + 1, k) for targets of shape (n, k)."""
        orthogonal, triangle = self.factor
        solution = solve_triangular(triangle, orthogonal[: len(target)].T @ target)
        series = np.zeros((*self.shape, target.shape[1]))
        series[self.terms] = solution.reshape(self.terms[0].size, self.shape[2], -1)
        return series


def _evaluate(series: Array, unit: Array) -> Array:
    parts = _polynomials(unit, series.shape[0] - 1, series.shape[2] - 1)
    values: Array = np.einsum("ni,nj,nm,ijme->ne", *parts, series, optimize=True)
    return values


def _inverse(series: Array, unit: Array, noise: NoiseModel) -> Array:
    """P at contacts in unit coordinates, its three rows side by side: (n, 3) to (n, 3 n_electrode)."""
    jacobian = np.stack([_evaluate(_derivative(series, axis), unit) for axis in range(3)], axis=1)
    charge = np.exp(_evaluate(series, unit)) * 1e-12
    weighted = jacobian * ((charge / noise.sigma(charge)) ** 2)[:, None, :]
    normal = weighted @ jacobian.transpose(0, 2, 1)
    damping = DAMPING / 3.0 * np.trace(normal, axis1=1, axis2=2)
    inverse: Array = np.linalg.solve(normal + damping[:, None, None] * np.eye(3), weighted)
    return inverse.reshape(len(unit), -1)


def _derivative(series: Array, axis: int) -> Array:
    """Series of the derivative by one unit coordinate, padded to the same shape."""
    return np.pad(chebyshev.chebder(series, axis=axis), [(0, int(k == axis)) for k in range(4)])
