"""The posterior of a contact given charges with noise, by numerical integration.

The mean of the posterior has the smallest mean squared error of all estimators. The prior is uniform over a disk and
in the logarithm of the force. The charges are Gaussian about Q(c), with the standard deviation of the true charge, so
the likelihood includes its normalisation:

    p(Q | x, y, ln F) = prod_e exp(-(Q_e - q_e)^2 / (2 sigma_e^2)) / sigma_e,   q = Q(x, y, F),   sigma_e = sigma(q_e).

The integral over the positions is a sum over square cells. A cell is dropped only if no contact in it can explain the
charges. The method therefore works for posteriors of any shape, including those with several maxima. The other cells
are divided into four until they are small compared with the width of the posterior. In each cell, the logarithm of the
force is integrated by Gauss-Legendre quadrature over an interval around its best value. With cells of 1.25 standard
deviations, the midpoint rule has a relative error of 1e-5 on a Gaussian (Trefethen and Weideman 2014). Only cells at
the edge of the disk must be smaller.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import ChargeError, InputError
from isocharge.common.progress import track
from isocharge.simulate import ChargeSpline, NoiseModel
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import check_radius
from isocharge.simulate.identifiability.folds import singular_values
from isocharge.simulate.identifiability.force_profile import ForceProfile
from isocharge.simulate.numerics.disk import onto_disk

CHUNK = 64
"""Number of presses that are integrated at once. The arrays then need at most about 100 MB."""

CELLS_ACROSS = 32
"""Number of first cells across the disk."""

EDGE_POINTS = 8
"""Number of points across a cell at the edge of the disk; each point is either inside or outside."""

MAX_DIVISIONS = 10
"""Largest number of times that a cell is divided into four. The smallest side is a thirty-thousandth of the disk."""

MAX_SIDE_STD = 1.25
"""Largest side of a cell, in standard deviations of the position along its most certain direction."""

NEGLIGIBLE_CHI2 = 36.0
"""Excess of a cell's chi-squared over the smallest one of its press above which the cell is dropped.

The density of such a cell is smaller by a factor of exp(-18).
"""

EDGE_CHI2 = 9.0
"""Excess of chi-squared below which a cell at the edge of the disk matters.

If a press has such a cell, the cells of this press are refined once more."""

FORCE_HALF_WIDTH_STD = 5.0
"""Half width of the integral over the logarithm of the force, in standard deviations."""

N_FORCE_NODES = 12
"""Number of nodes of the integral over the force. Together with the half width the relative error is 1e-4."""


@dataclass(frozen=True)
class Cells:
    """Square cells of the plane of positions. Each cell belongs to one press.

    Attributes:
        press: Number of the press, ascending, shape (n,).
        root: Number of the first cell from which the cell was divided, shape (n,).
        centre: Centres (x, y), shape (n, 2), mm.
        side: Side of all cells, mm.
    """

    press: Integers
    root: Integers
    centre: Array
    side: float

    @classmethod
    def roots(cls, radius: float) -> "Cells":
        """Return the first cells of one press, which cover a disk with this radius, mm."""
        side = 2.0 * radius / CELLS_ACROSS
        centre = _grid(CELLS_ACROSS, side)
        centre = centre[_overlaps_disk(centre, side, radius)]
        return cls(np.zeros(len(centre), dtype=np.intp), np.arange(len(centre)), centre, side)

    def __len__(self) -> int:
        return self.press.size

    def __getitem__(self, rows: np.ndarray) -> "Cells":
        """Return some of the cells."""
        return Cells(self.press[rows], self.root[rows], self.centre[rows], self.side)

    def divided(self, radius: float) -> "Cells":
        """Divide each cell into four cells, and drop the cells outside the disk with this radius, mm."""
        quarters = self._quarters(0.25)  # the centres of four equal parts
        return quarters[_overlaps_disk(quarters.centre, quarters.side, radius)]

    def finer(self, radius: float) -> Iterator["Cells"]:
        """Yield finer cells for the last integration.

        A cell inside the disk is replaced by four cells, whose centres are the points of Gauss-Legendre quadrature. A
        cell on the edge of the disk is divided into sixteen cells.

        Args:
            radius: Radius of the disk, mm.
        """
        gauss_offset = 1.0 / np.sqrt(12.0)  # of the two points of Gauss-Legendre quadrature on an interval of length 1
        is_on_edge = self.on_edge(radius)
        yield self[~is_on_edge]._quarters(gauss_offset)
        yield self[is_on_edge].divided(radius).divided(radius)

    def _quarters(self, offset: float) -> "Cells":
        """Replace each cell by four cells whose sides are half as long.

        Args:
            offset: Distance of the new centres from the centre of the cell along x and y, in sides of the cell.
        """
        displacements = _grid(2, 2.0 * offset * self.side)  # shape (4, 2)
        centre = (self.centre[:, None] + displacements).reshape(-1, 2)
        return Cells(np.repeat(self.press, 4), np.repeat(self.root, 4), centre, 0.5 * self.side)

    def on_edge(self, radius: float) -> Booleans:
        """Return which cells can extend beyond the disk with this radius, mm, shape (n,)."""
        half_diagonal = np.sqrt(0.5) * self.side
        return np.asarray(np.hypot(self.centre[:, 0], self.centre[:, 1]) + half_diagonal > radius)

    def inside(self, radius: float) -> tuple[Array, Array]:
        """Compute the part of each cell that lies in the disk.

        Cells that the edge of the disk crosses are sampled by a grid of points. All other cells lie inside completely.

        Args:
            radius: Radius of the disk, mm.

        Returns:
            Area of the part relative to the cell, shape (n,), and its centroid, shape (n, 2), mm. A part without any of
            the points counts as half of a point.
        """
        fraction = np.ones(len(self))
        centroid = self.centre.copy()

        edge_cells = np.flatnonzero(self.on_edge(radius))
        points = centroid[edge_cells, None] + _grid(EDGE_POINTS, self.side / EDGE_POINTS)  # shape (n, n_point, 2)
        is_inside = np.hypot(points[..., 0], points[..., 1]) <= radius
        n_inside = is_inside.sum(axis=1)
        fraction[edge_cells] = np.maximum(n_inside, 0.5) / EDGE_POINTS**2  # of all points of the cell

        # The centroid is the mean of the points inside or, without such points, the nearest point of the disk.
        point_sum = (points * is_inside[..., None]).sum(axis=1)
        mean_point = point_sum / np.maximum(n_inside, 1)[:, None]
        nearest_point = onto_disk(centroid[edge_cells], radius)
        centroid[edge_cells] = np.where(n_inside[:, None] > 0, mean_point, nearest_point)
        return fraction, centroid


def _grid(count: int, step: float) -> Array:
    """Return a square grid of count x count points about the origin with the spacing `step`, shape (count^2, 2)."""
    line = step * (np.arange(count) - 0.5 * (count - 1))
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def _overlaps_disk(centre: Array, side: float, radius: float) -> Booleans:
    """Return which squares overlap the disk around the origin, shape (n,). Centres have the shape (n, 2), mm."""
    nearest_point = np.maximum(np.abs(centre) - 0.5 * side, 0.0)  # of each square to the origin, up to signs
    return np.asarray(np.hypot(nearest_point[:, 0], nearest_point[:, 1]) < radius)


class _RootCells(NamedTuple):
    """The first cells of a press.

    Attributes:
        cells: The n cells.
        terms: Terms of the charges at the centres of the cells, shape (n, n_term, n_electrode).
        largest_slope: Largest slope of each scaled charge in each cell, shape (n, n_electrode), 1/mm.
    """

    cells: Cells
    terms: Array
    largest_slope: Array


@dataclass(frozen=True)
class Posterior:
    """The posterior of contacts.

    Attributes:
        charges: Map from contacts to charges.
        noise: Noise of the charges.
        radius: Radius of the disk of the prior, mm.
    """

    charges: ChargeSpline
    noise: NoiseModel
    radius: float

    def __post_init__(self) -> None:
        if self.noise.white <= 0.0:
            raise InputError(f"noise: expected white noise above 0 pC, got {self.noise.name!r}: nothing to integrate")
        check_radius(self.radius, self.charges.domain.radius, "charge table")

    def mean_and_std(self, charge: Array, executor: Executor | None = None) -> tuple[Array, Array]:
        """Compute the mean and the standard deviation of the posterior.

        The mean of the force is E[1/F] / E[1/F^2], the estimate with the smallest mean squared relative error.

        Args:
            charge: Charges with noise, shape (n, n_electrode), pC.
            executor: Executor whose tasks integrate `CHUNK` presses each; None for this process.

        Returns:
            Mean and standard deviation of (x, y, F), shape (n, 3) each, mm and N.

        Raises:
            ChargeError: If there are no charges, if a charge is not finite, or if the number of electrodes is wrong.
        """
        charge = np.asarray(charge, dtype=float)
        n_electrode = len(self.charges.electrodes)
        has_electrodes = charge.ndim == 2 and charge.shape[1] == n_electrode
        is_valid = has_electrodes and len(charge) > 0 and bool(np.isfinite(charge).all())
        if not is_valid:
            raise ChargeError(
                f"expected finite charges of shape (n, {n_electrode}), n at least 1, got shape {charge.shape}"
            )
        chunks = [charge[start : start + CHUNK] for start in range(0, len(charge), CHUNK)]
        moments_by_chunk = in_order(executor, self._integrate, chunks)
        tracked_moments = list(track(moments_by_chunk, "integrating the posterior", len(chunks)))
        mean, std = np.concatenate(tracked_moments, axis=1)
        return mean, std

    @cached_property
    def _profile(self) -> ForceProfile:
        """Charges as a function of the force."""
        return ForceProfile.of(self.charges.force_weights, self.charges.domain.force_range)

    @cached_property
    def _roots(self) -> _RootCells:
        """Cells of the coarsest division, with the charges at their centres and the largest slopes within each cell."""
        cells = Cells.roots(self.radius)
        # The slopes are computed at 3 x 3 points of each cell: at its centre, its corners and the centres of its sides.
        points = (cells.centre[:, None] + _grid(3, 0.5 * cells.side)).reshape(-1, 2)
        gradients = self.charges.scaled_gradients(onto_disk(points, self.radius))
        # The largest slope among the terms of each point, and then among the points of each cell
        point_slope = np.linalg.norm(gradients, axis=-1).max(axis=1)
        largest_slope = point_slope.reshape(len(cells), 9, -1).max(axis=1)
        return _RootCells(cells, self._terms(cells), largest_slope)

    def _terms(self, cells: Cells) -> Array:
        """Compute the terms of the charges at the centres of cells, shape (n, n_term, n_electrode)."""
        return self.charges.scaled_charges(onto_disk(cells.centre, self.radius))

    def _integrate(self, charge: Array) -> Array:
        """Compute the mean and the standard deviation of the posterior of each press.

        The posterior is integrated over the position by cells of several sizes, and over the force by quadrature at the
        centroid of each cell.

        Args:
            charge: Charges with noise, shape (n, n_electrode), pC.

        Returns:
            Means and standard deviations of (x, y, F), shape (2, n, 3), mm and N.
        """
        # Concatenate the cells of all sizes.
        levels = list(self._integration_cells(charge))
        side = np.concatenate([np.full(len(cells), cells.side) for cells in levels])
        press_of_cell = np.concatenate([cells.press for cells in levels])
        fractions, centroids = zip(*(cells.inside(self.radius) for cells in levels), strict=True)

        # Sort the cells by press, as `_posterior_moments` needs them.
        order = np.argsort(press_of_cell, kind="stable")
        area = (np.concatenate(fractions) * side**2)[order]
        position = np.concatenate(centroids)[order]
        press = press_of_cell[order]

        log_force, log_weight = self._integrate_force(position, charge[press])
        log_weight += np.log(area)[:, None]
        return _posterior_moments(press, position, log_force, log_weight)

    def _integration_cells(self, charge: Array) -> Iterator[Cells]:
        """Yield cells that cover the posterior and are small compared with its width.

        All cells of a press have the same side. If the cells of a press are small enough, they are yielded. Otherwise,
        each of them is divided into four for the next round.

        Args:
            charge: Charges with noise, shape (n_press, n_electrode), pC.
        """
        n_press = len(charge)
        roots = self._roots
        press, root = np.indices((n_press, len(roots.cells))).reshape(2, -1)
        cells = Cells(press, root, roots.cells.centre[root], roots.cells.side)
        terms = roots.terms[root]
        for division in range(MAX_DIVISIONS + 1):
            cell_charge = charge[cells.press]
            log_force = self._profile.best(terms, cell_charge, self.noise)
            chi2, slope = self._chi2_and_slope(terms, log_force, cell_charge, roots.largest_slope[cells.root])
            smallest_chi2 = np.full(n_press, np.inf)
            np.minimum.at(smallest_chi2, cells.press, chi2)  # the smallest value among the cells of each press
            excess_chi2 = chi2 - smallest_chi2[cells.press]

            # A lower bound of chi-squared in the whole cell: no position is farther from the centre than the corners.
            half_diagonal = np.sqrt(0.5) * cells.side
            lower_bound = np.maximum(np.sqrt(chi2) - half_diagonal * slope, 0.0) ** 2
            possible = np.flatnonzero(lower_bound - smallest_chi2[cells.press] <= NEGLIGIBLE_CHI2)

            # The cells of a press are small enough if their side is small compared with the smallest standard deviation
            # of the position in any of them.
            largest_inverse_std = np.zeros(n_press)
            inverse_std = self._inverse_std(cells[possible], terms[possible], log_force[possible])
            np.maximum.at(largest_inverse_std, cells.press[possible], inverse_std)  # among the cells of each press
            press_is_fine = largest_inverse_std * cells.side <= MAX_SIDE_STD
            if division == MAX_DIVISIONS:
                press_is_fine[:] = True
            is_fine = press_is_fine[cells.press]

            # A posterior that reaches the edge of the disk needs finer cells.
            touches_edge = np.zeros(n_press, dtype=bool)
            is_near_edge = cells.on_edge(self.radius) & (excess_chi2 <= EDGE_CHI2)
            touches_edge[cells.press[is_near_edge]] = True
            finished = cells[is_fine & (excess_chi2 <= NEGLIGIBLE_CHI2)]
            yield finished[~touches_edge[finished.press]]
            yield from finished[touches_edge[finished.press]].finer(self.radius)

            cells = cells[possible][~is_fine[possible]].divided(self.radius)
            if not len(cells):
                return
            terms = self._terms(cells)

    def _chi2_and_slope(
        self, terms: Array, log_force: Array, charge: Array, largest_slope: Array
    ) -> tuple[Array, Array]:
        """Compute chi-squared at the centres of cells, and the largest slope of its square root in each cell.

        Args:
            terms: Terms of the charges, shape (n, n_term, n_electrode).
            log_force: Logarithms of the best forces, shape (n,).
            charge: Charges with noise, shape (n, n_electrode), pC.
            largest_slope: Largest slopes of the scaled charges in the cells, shape (n, n_electrode), 1/mm.

        Returns:
            Chi-squared, shape (n,), and the largest slope of its square root, shape (n,), 1/mm.
        """
        force_weights = self.charges.force_weights(log_force)
        expected = (force_weights[:, None, :] @ terms)[:, 0]  # shape (n, n_electrode)
        sigma = self.noise.sigma(expected)
        deviation = (charge - expected) / sigma
        slope = largest_slope * force_weights.sum(axis=1)[:, None] / sigma
        chi2 = (deviation**2).sum(axis=1)
        return chi2, np.linalg.norm(slope, axis=1)

    def _inverse_std(self, cells: Cells, terms: Array, log_force: Array) -> Array:
        """Compute the inverse of the smallest standard deviation of the position if the force is unknown.

        The result is the largest singular value of the matrix of derivatives of the charges, each divided by the noise
        of its charge.

        Args:
            cells: Cells at whose centres the contact is assumed.
            terms: Terms of the charges at the centres, shape (n, n_term, n_electrode).
            log_force: Logarithms of the forces, shape (n,).

        Returns:
            Inverse standard deviations, shape (n,), 1/mm.
        """
        force_weights = self.charges.force_weights(log_force)
        gradients = self.charges.scaled_gradients(onto_disk(cells.centre, self.radius))
        # Sums over the terms k of the dependence on the force, for each cell n, electrode e and coordinate i
        expected = np.einsum("nk,nke->ne", force_weights, terms)
        position_jacobian = np.einsum("nk,nkei->nei", force_weights, gradients)
        force_jacobian = self._profile.slope(log_force, expected)[..., None]
        jacobian = np.concatenate([position_jacobian, force_jacobian], axis=2)
        whitened_jacobian = jacobian / self.noise.sigma(expected)[..., None]
        largest_to_smallest = singular_values(whitened_jacobian)
        return np.asarray(largest_to_smallest[:, 0])

    def _integrate_force(self, position: Array, charge: Array) -> tuple[Array, Array]:
        """Return the nodes of the integral over the logarithm of the force, and their weights times the likelihood.

        The integral at each position is computed by Gauss-Legendre quadrature.

        Args:
            position: Positions, shape (n, 2), mm.
            charge: Charges with noise, shape (n, n_electrode), pC.

        Returns:
            Logarithms of the forces, and logarithms of weight times likelihood, shape (n, N_FORCE_NODES) each.
        """
        # The interval of integration lies about the best force and is several standard deviations wide.
        terms = self.charges.scaled_charges(position)
        best_log_force = self._profile.best(terms, charge, self.noise)
        best_charge = self._profile.charge(best_log_force, terms)
        relative_slope = self._profile.slope(best_log_force, best_charge) / self.noise.sigma(best_charge)
        half_width = FORCE_HALF_WIDTH_STD / np.linalg.norm(relative_slope, axis=1)
        min_log_force, max_log_force = self._profile.log_range
        lower = np.maximum(best_log_force - half_width, min_log_force)[:, None]
        upper = np.minimum(best_log_force + half_width, max_log_force)[:, None]

        nodes, weights = np.polynomial.legendre.leggauss(N_FORCE_NODES)  # for the interval from -1 to 1
        log_force = 0.5 * (lower + upper) + 0.5 * (upper - lower) * nodes

        # Expected charges of electrode e at position n and node m, as a sum over the terms k
        expected = np.einsum("nmk,nke->enm", self.charges.force_weights(log_force), terms)
        variance = self.noise.variance(expected)
        chi2 = ((charge.T[:, :, None] - expected) ** 2 / variance).sum(axis=0)
        log_likelihood = -0.5 * (chi2 + np.log(variance.prod(axis=0)))
        return log_force, np.log(weights * (upper - lower)) + log_likelihood


def _posterior_moments(press: Integers, position: Array, log_force: Array, log_weight: Array) -> Array:
    """Compute the mean and the standard deviation of (x, y, F) for every press.

    Both are computed from weighted sums over all positions of the press and over all forces at each position. The mean
    of the force is E[1/F] / E[1/F^2].

    Args:
        press: Number of the press of each position, ascending, shape (n_position,).
        position: Positions, shape (n_position, 2), mm.
        log_force: Logarithms of the forces at each position, shape (n_position, n_node).
        log_weight: Logarithms of the weights of these contacts, shape (n_position, n_node).

    Returns:
        Means and then standard deviations, shape (2, n_press, 3), mm and N.
    """
    # The rows of a press follow each other, so `reduceat` with the first row of each press gives values by press.
    first_row = np.flatnonzero(np.diff(press, prepend=-1))  # where the number of the press changes
    n_row = np.diff(first_row, append=press.size)

    # The largest weight of each press is scaled to 1, so that the exponentials do not underflow.
    largest_log_weight = np.maximum.reduceat(log_weight.max(axis=1), first_row)
    weight = np.exp(log_weight - np.repeat(largest_log_weight, n_row)[:, None])
    force = np.exp(log_force)
    position_weight = weight.sum(axis=1)
    total_weight = np.add.reduceat(position_weight, first_row)

    def expectation(weighted: Array) -> Array:
        """Return the weighted mean over the positions of each press, shape (n_press,).

        Args:
            weighted: Values at the positions times their weights, shape (n_position,).
        """
        return np.asarray(np.add.reduceat(weighted, first_row, axis=0) / total_weight)

    x, y = (expectation(position_weight * coordinate) for coordinate in position.T)
    x_square, y_square = (expectation(position_weight * coordinate**2) for coordinate in position.T)
    force_mean, force_square, inverse_force, inverse_square = (
        expectation((weight * force**power).sum(axis=1)) for power in (1, 2, -1, -2)
    )
    mean = np.stack([x, y, inverse_force / inverse_square], axis=1)
    variance = np.stack([x_square - x**2, y_square - y**2, force_square - force_mean**2], axis=1)
    return np.stack([mean, np.sqrt(np.maximum(variance, 0.0))])
