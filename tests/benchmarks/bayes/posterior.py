"""Posterior distribution of a contact for given noisy charges, computed by numerical integration.

The mean of the posterior has the smallest mean squared error of all estimators. The prior is uniform over a disk and in
the logarithm of the force. Given a contact (x, y, F), the charge Q_e of each electrode e has a normal distribution
about its expected value q_e. The standard deviation sigma_e depends on the expected value, so the likelihood includes
the normalisation of the distribution:

    p(Q | x, y, ln F) = prod_e exp(-(Q_e - q_e)^2 / (2 sigma_e^2)) / sigma_e,   sigma_e = sigma(q_e).

The integral over the positions is a sum over square cells. A cell is dropped only if no contact in the cell can explain
the charges. The method therefore works for posteriors of any shape, including posteriors with several maxima. Every
remaining cell is divided into four cells until the cells are small compared with the width of the posterior. In each
cell, the integral over the logarithm of the force is computed by Gauss-Legendre quadrature over an interval around the
most likely force. With cells of 1.25 standard deviations, the midpoint rule has a relative error of 1e-5 for a normal
distribution (Trefethen and Weideman 2014). Only posteriors that reach the edge of the disk need smaller cells.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from bayes.force_profile import ForceProfile

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.common.errors import ChargeError, InputError
from isocharge.common.progress import track
from isocharge.simulate import ChargeSpline, NoiseModel
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.charge_map import check_radius
from isocharge.simulate.numerics.disk import onto_disk

CHUNK = 64
"""Number of presses whose posteriors are integrated at once, which limits the memory."""

CELLS_ACROSS = 32
"""Number of cells across the disk before the first division."""

EDGE_POINTS = 8
"""Number of points across a cell at the edge of the disk. The points show which part of the cell is inside."""

MAX_DIVISIONS = 10
"""Largest number of times that a cell is divided into four cells."""

MAX_SIDE_STD = 1.25
"""Largest side of a cell, in standard deviations of the position along its most certain direction."""

NEGLIGIBLE_CHI2 = 36.0
"""Difference between the chi-squared of a cell and the smallest one of its press above which the cell is dropped.

The density in such a cell is smaller than the largest density by a factor of at least exp(18).
"""

EDGE_CHI2 = 9.0
"""Difference of chi-squared, as in `NEGLIGIBLE_CHI2`, up to which a cell at the edge of the disk is important.

If a press has such a cell, all cells of this press are refined once more."""

FORCE_HALF_WIDTH_STD = 5.0
"""Half width of the interval of the integral over the logarithm of the force, in standard deviations."""

N_FORCE_NODES = 12
"""Number of nodes of the integral over the logarithm of the force.

With this number of nodes and `FORCE_HALF_WIDTH_STD`, the relative error of the integral is about 1e-4."""


@dataclass(frozen=True)
class Cells:
    """Square cells that cover positions (x, y) of contacts. Each cell belongs to one press.

    Attributes:
        press: Number of the press of each cell, in ascending order, shape (n,).
        root: Number of the first cell of which each cell is a part, shape (n,).
        centre: Centres (x, y) of the cells, shape (n, 2), mm.
        side: Side of all cells, mm.
    """

    press: Integers
    root: Integers
    centre: Array
    side: float

    @classmethod
    def roots(cls, radius: float) -> "Cells":
        """Return undivided cells for one press, which together cover a disk with the given radius in mm."""
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
        """Divide each cell into four cells, and drop the new cells outside the disk with the given radius in mm."""
        quarters = self._quarters(0.25)  # the centres of four equal parts
        return quarters[_overlaps_disk(quarters.centre, quarters.side, radius)]

    def finer(self, radius: float) -> Iterator["Cells"]:
        """Yield smaller cells for the integration: first the cells inside the disk, and then the cells at its edge.

        A cell inside the disk is replaced by four cells, whose centres are points of a Gauss-Legendre quadrature. A
        cell on the edge of the disk is divided into sixteen cells.

        Args:
            radius: Radius of the disk, mm.
        """
        gauss_offset = 1.0 / np.sqrt(12.0)  # of the two points of Gauss-Legendre quadrature on an interval of length 1
        is_on_edge = self.on_edge(radius)
        yield self[~is_on_edge]._quarters(gauss_offset)
        yield self[is_on_edge].divided(radius).divided(radius)

    def _quarters(self, offset: float) -> "Cells":
        """Replace each cell by four cells with sides of half the length.

        Args:
            offset: Distance of the new centres from the centre of the cell along x and y, in sides of the cell.
        """
        displacements = _grid(2, 2.0 * offset * self.side)  # shape (4, 2)
        centre = (self.centre[:, None] + displacements).reshape(-1, 2)
        return Cells(np.repeat(self.press, 4), np.repeat(self.root, 4), centre, 0.5 * self.side)

    def on_edge(self, radius: float) -> Booleans:
        """Return whether each cell may extend beyond the disk with the given radius in mm, shape (n,)."""
        half_diagonal = np.sqrt(0.5) * self.side
        return np.asarray(np.hypot(self.centre[:, 0], self.centre[:, 1]) + half_diagonal > radius)

    def fraction_and_centroid_inside(self, radius: float) -> tuple[Array, Array]:
        """Compute how much of each cell lies in the disk, and the centroid of this part.

        Cells that may extend beyond the disk are sampled by a grid of points. All other cells lie inside completely.

        Args:
            radius: Radius of the disk, mm.

        Returns:
            Area of the part divided by the area of the cell, shape (n,). Centroid of the part, shape (n, 2), mm.
        """
        # Values of the cells that lie inside completely. Those of the other cells are replaced below.
        fraction = np.ones(len(self))
        centroid = self.centre.copy()

        edge_cells = np.flatnonzero(self.on_edge(radius))
        edge_centre = self.centre[edge_cells]
        points = edge_centre[:, None] + _grid(EDGE_POINTS, self.side / EDGE_POINTS)  # shape (n, n_point, 2)
        is_inside = np.hypot(points[..., 0], points[..., 1]) <= radius
        n_inside = is_inside.sum(axis=1)
        n_point = EDGE_POINTS**2
        # Without points inside, half a point is counted, because the logarithm of the area must be finite.
        fraction[edge_cells] = np.maximum(n_inside, 0.5) / n_point

        # The centroid is the mean of the points inside or, without such points, the nearest point of the disk.
        point_sum = (points * is_inside[..., None]).sum(axis=1)
        mean_point = point_sum / np.maximum(n_inside, 1)[:, None]  # avoids a division by zero
        nearest_point = onto_disk(edge_centre, radius)
        centroid[edge_cells] = np.where(n_inside[:, None] > 0, mean_point, nearest_point)
        return fraction, centroid


def _grid(count: int, step: float) -> Array:
    """Return a square grid of count x count points around the origin with the spacing `step`, shape (count^2, 2)."""
    line = step * (np.arange(count) - 0.5 * (count - 1))
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def _overlaps_disk(centre: Array, side: float, radius: float) -> Booleans:
    """Return whether each square overlaps a disk around the origin, shape (n,).

    Args:
        centre: Centres of the squares, shape (n, 2), mm.
        side: Side of all squares, mm.
        radius: Radius of the disk, mm.
    """
    nearest_point = np.maximum(np.abs(centre) - 0.5 * side, 0.0)  # of each square to the origin, up to signs
    return np.asarray(np.hypot(nearest_point[:, 0], nearest_point[:, 1]) < radius)


class _RootCells(NamedTuple):
    """Undivided cells of a press, with properties of the charges in these cells.

    Attributes:
        cells: The n cells.
        terms: Terms at the centres of the cells whose sums, weighted by functions of the force, are the charges, shape
            (n, n_term, n_electrode).
        largest_slope: Largest slope of each scaled charge in each cell, shape (n, n_electrode), 1/mm.
    """

    cells: Cells
    terms: Array
    largest_slope: Array


@dataclass(frozen=True)
class Posterior:
    """Posterior distribution of the contact of a press for given charges.

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

        Instead of the mean of the force, E[1/F] / E[1/F^2] is returned. This estimate has the smallest mean squared
        relative error.

        Args:
            charge: Charges with noise, shape (n, n_electrode), pC.
            executor: Executor, each of whose tasks integrates the posteriors of `CHUNK` presses; None for this process.

        Returns:
            Mean and standard deviation of (x, y, F), shape (n, 3) each, mm and N.

        Raises:
            ChargeError: If there are no charges, if a charge is not finite, or if the number of electrodes is wrong.
        """
        charge = np.asarray(charge, dtype=float)
        n_electrode = len(self.charges.electrodes)
        has_right_shape = charge.ndim == 2 and charge.shape[1] == n_electrode and len(charge) > 0
        if not (has_right_shape and np.isfinite(charge).all()):
            raise ChargeError(
                f"expected finite charges of shape (n, {n_electrode}), n at least 1, got shape {charge.shape}"
            )
        chunks = [charge[start : start + CHUNK] for start in range(0, len(charge), CHUNK)]
        moments_by_chunk = in_order(executor, self._integrate, chunks)  # iterator over arrays of shape (2, n, 3)
        tracked_moments = list(track(moments_by_chunk, "integrating the posterior", len(chunks)))  # reports progress
        mean, std = np.concatenate(tracked_moments, axis=1)
        return mean, std

    @cached_property
    def _profile(self) -> ForceProfile:
        """Charges as a function of the force."""
        return ForceProfile.of(self.charges.force_weights, self.charges.domain.force_range)

    @cached_property
    def _root_cells(self) -> _RootCells:
        """Undivided cells of a press, with the charges at their centres and the largest slopes of the charges in them.

        Each charge is a sum of terms, which depend on the position and are weighted by functions of the force.
        """
        cells = Cells.roots(self.radius)

        # The slopes are computed at 3 x 3 points of each cell: at its centre, its corners and the centres of its sides.
        # Points outside the disk are moved to its edge.
        n_point = 9
        points = cells.centre[:, None] + _grid(3, 0.5 * cells.side)  # shape (n_cell, n_point, 2)
        gradients = self.charges.scaled_gradients(onto_disk(points.reshape(-1, 2), self.radius))

        # A slope is the length of a gradient, shape (n_cell * n_point, n_term, n_electrode). The largest slope is
        # determined first among the terms of each point, and then among the points of each cell.
        slope = np.linalg.norm(gradients, axis=-1)
        largest_slope_of_point = slope.max(axis=1)
        largest_slope = largest_slope_of_point.reshape(len(cells), n_point, -1).max(axis=1)  # (n_cell, n_electrode)
        return _RootCells(cells, self._terms(cells), largest_slope)

    def _terms(self, cells: Cells) -> Array:
        """Compute the terms of the charges at the centre of each cell, shape (n, n_term, n_electrode)."""
        return self.charges.scaled_charges(onto_disk(cells.centre, self.radius))

    def _integrate(self, charge: Array) -> Array:
        """Compute the mean and the standard deviation of the posterior of each press.

        The integral over the position is a sum over square cells. The weight of each cell is the area of the part that
        lies in the disk of the prior. The integral over the force is computed by quadrature at the centroid of this
        part.

        Args:
            charge: Charges with noise, shape (n, n_electrode), pC.

        Returns:
            Means and standard deviations of (x, y, F), shape (2, n, 3), mm and N.
        """
        # Each group contains cells of one size, with the press to which each cell belongs.
        press_groups = []
        area_groups = []
        centroid_groups = []
        for cells in self._integration_cells(charge):
            fraction, centroid = cells.fraction_and_centroid_inside(self.radius)
            press_groups.append(cells.press)
            area_groups.append(fraction * np.square(cells.side))
            centroid_groups.append(centroid)

        # Sort the cells by press, because `_posterior_moments` needs all cells of a press together.
        unsorted_press = np.concatenate(press_groups)
        order = np.argsort(unsorted_press, kind="stable")
        press = unsorted_press[order]
        area = np.concatenate(area_groups)[order]
        position = np.concatenate(centroid_groups)[order]

        log_force, log_weight = self._integrate_force(position, charge[press])
        log_weight += np.log(area)[:, None]
        return _posterior_moments(press, position, log_force, log_weight)

    def _integration_cells(self, charge: Array) -> Iterator[Cells]:
        """Yield groups of cells that cover the posterior of each press and are small compared with its width.

        In each round, all cells have the same side. Chi-squared, which is the sum of the squared deviations of the
        charges in units of the noise, is computed at the centre of each cell. A cell is possible if chi-squared may be
        small at some contact in the cell. If the possible cells of a press are small enough, the cells of this press
        are finished: those with a small chi-squared are yielded. Otherwise, each possible cell is divided into four
        cells for the next round. In the last round, all cells are accepted.

        Args:
            charge: Charges with noise, shape (n_press, n_electrode), pC.
        """
        # In the first round, each press has all root cells.
        n_press = len(charge)
        roots = self._root_cells
        press, root = np.indices((n_press, len(roots.cells))).reshape(2, -1)
        cells = Cells(press, root, roots.cells.centre[root], roots.cells.side)
        terms = roots.terms[root]
        for division in range(MAX_DIVISIONS + 1):
            # Chi-squared at the centre of each cell, for the force that fits best there, and how much larger it is than
            # the smallest value among the cells of the same press
            cell_charge = charge[cells.press]
            log_force = self._profile.best_log_force(terms, cell_charge, self.noise)
            chi2, root_slope = self._chi2_and_slope(terms, log_force, cell_charge, roots.largest_slope[cells.root])
            smallest_chi2 = np.full(n_press, np.inf)
            np.minimum.at(smallest_chi2, cells.press, chi2)  # minimum by press, shape (n_press,)
            excess_chi2 = chi2 - smallest_chi2[cells.press]

            # Lower bound of chi-squared in the whole cell: between the centre and any position in the cell, the root of
            # chi-squared decreases by at most the half diagonal times the largest slope of the root.
            half_diagonal = np.sqrt(0.5) * cells.side
            lower_bound = np.maximum(np.sqrt(chi2) - half_diagonal * root_slope, 0.0) ** 2
            is_possible = lower_bound - smallest_chi2[cells.press] <= NEGLIGIBLE_CHI2

            # Yield the cells of the presses whose possible cells are small enough.
            press_has_fine_cells = self._has_fine_cells(
                cells[is_possible], terms[is_possible], log_force[is_possible], n_press
            )
            if division == MAX_DIVISIONS:
                press_has_fine_cells[:] = True  # the cells are not divided again, so they are accepted as they are
            is_finished = press_has_fine_cells[cells.press]
            yield from self._finished_cells(cells[is_finished], excess_chi2[is_finished], n_press)

            # Divide the possible cells of the other presses.
            cells = cells[is_possible & ~is_finished].divided(self.radius)
            if not len(cells):
                return
            terms = self._terms(cells)

    def _has_fine_cells(self, cells: Cells, terms: Array, log_force: Array, n_press: int) -> Booleans:
        """Return whether the cells of each press are small enough for the integration.

        The cells of a press are small enough if their side is at most `MAX_SIDE_STD` times the smallest standard
        deviation of the position in these cells.

        Args:
            cells: Cells that may contain the contacts of their presses.
            terms: Terms of the charges at the centres, shape (n, n_term, n_electrode).
            log_force: Logarithms of the best forces at the centres, shape (n,).
            n_press: Number of presses.

        Returns:
            Whether the cells of each press are small enough, shape (n_press,).
        """
        inverse_std = self._inverse_std(cells, terms, log_force)
        largest_inverse_std = np.zeros(n_press)
        np.maximum.at(largest_inverse_std, cells.press, inverse_std)  # the largest value among the cells of each press
        return np.asarray(largest_inverse_std * cells.side <= MAX_SIDE_STD)

    def _finished_cells(self, cells: Cells, excess_chi2: Array, n_press: int) -> Iterator[Cells]:
        """For presses with small enough cells, yield the cells over which the integral is computed.

        Improbable cells are dropped. The cells of a press are refined once more if its posterior reaches the edge of
        the disk, where the prior ends.

        Args:
            cells: All cells of the presses whose cells are small enough, including cells that must be dropped.
            excess_chi2: Chi-squared of each cell minus the smallest chi-squared of its press, shape (n,).
            n_press: Number of all presses.
        """
        is_probable_on_edge = cells.on_edge(self.radius) & (excess_chi2 <= EDGE_CHI2)
        press_reaches_edge = np.zeros(n_press, dtype=bool)
        press_reaches_edge[cells.press[is_probable_on_edge]] = True

        probable_cells = cells[excess_chi2 <= NEGLIGIBLE_CHI2]
        must_be_finer = press_reaches_edge[probable_cells.press]
        yield probable_cells[~must_be_finer]
        yield from probable_cells[must_be_finer].finer(self.radius)

    def _chi2_and_slope(
        self, terms: Array, log_force: Array, charge: Array, largest_slope: Array
    ) -> tuple[Array, Array]:
        """Compute chi-squared at the centres of cells, and the largest slope of its square root in each cell.

        Chi-squared is the sum over the electrodes of ((Q - q) / sigma)^2. Here Q are the measured charges, q are the
        expected charges at the centre of the cell, and sigma are the standard deviations of their noise. Each expected
        charge is a sum of terms, which depend on the position and are weighted by functions of the force.

        Args:
            terms: Terms of the charges at the centres, shape (n, n_term, n_electrode).
            log_force: Logarithms of the best forces, shape (n,).
            charge: Charges with noise, shape (n, n_electrode), pC.
            largest_slope: Largest slope of any term in each cell, shape (n, n_electrode), 1/mm.

        Returns:
            Chi-squared, shape (n,), and the largest slope of its square root, shape (n,), 1/mm.
        """
        force_weights = self.charges.force_weights(log_force)  # shape (n, n_term)
        expected = (force_weights[:, None, :] @ terms)[:, 0]  # shape (n, n_electrode)
        sigma = self.noise.sigma(expected)
        deviation = (charge - expected) / sigma
        chi2 = (deviation**2).sum(axis=1)

        # No term is steeper than the largest slope. The slope of an expected charge is therefore at most the largest
        # slope times the sum of the magnitudes of the weights, some of which are negative. The square root of
        # chi-squared is the norm of the deviations of all electrodes, so its slope is at most the norm of their slopes.
        weight_sum = np.abs(force_weights).sum(axis=1)
        deviation_slope = largest_slope * weight_sum[:, None] / sigma
        return chi2, np.linalg.norm(deviation_slope, axis=1)

    def _inverse_std(self, cells: Cells, terms: Array, log_force: Array) -> Array:
        """Compute the inverse of the standard deviation of the position along its most certain direction.

        The force is assumed to be unknown. The computation begins with the derivatives of the charges with respect to
        the position, in units of the noise. The part of these derivatives that a change of the force can also cause is
        removed. The largest singular value of the remaining matrix is the result.

        Args:
            cells: Cells at whose centres the contact is assumed.
            terms: Terms of the charges at the centres, shape (n, n_term, n_electrode).
            log_force: Logarithms of the forces, shape (n,).

        Returns:
            Inverse standard deviations, shape (n,), 1/mm.
        """
        # Expected charges, shape (n, n_electrode), and their derivatives with respect to x and y, shape
        # (n, n_electrode, 2). Both are sums over the terms k, whose weights depend on the force, for each cell n,
        # electrode e and coordinate i.
        force_weights = self.charges.force_weights(log_force)
        gradients = self.charges.scaled_gradients(onto_disk(cells.centre, self.radius))
        expected = np.einsum("nk,nke->ne", force_weights, terms)
        position_jacobian = np.einsum("nk,nkei->nei", force_weights, gradients)

        # Derivatives with respect to (x, y, ln F), in units of the noise, shape (n, n_electrode, 3)
        force_jacobian = self._profile.slope(log_force, expected)[..., None]
        jacobian = np.concatenate([position_jacobian, force_jacobian], axis=2)
        whitened_jacobian = jacobian / self.noise.sigma(expected)[..., None]
        # Remove the component along the derivative with respect to the force, because the force is not known.
        along_force = whitened_jacobian[..., 2:]
        force_direction = along_force / np.maximum(np.linalg.norm(along_force, axis=1, keepdims=True), 1e-300)
        position_jacobian = whitened_jacobian[..., :2]
        component = np.einsum("nej,nei->nji", force_direction, position_jacobian)
        inverse_stds = np.linalg.svd(position_jacobian - force_direction @ component, compute_uv=False)
        return np.asarray(inverse_stds[:, 0])

    def _integrate_force(self, position: Array, charge: Array) -> tuple[Array, Array]:
        """Return the nodes of the integral over the logarithm of the force, and their weights times the likelihood.

        The integral at each position is computed by Gauss-Legendre quadrature. The likelihood of the charges Q is the
        product of exp(-(Q - q)^2 / (2 sigma^2)) / sigma over the electrodes, with the expected charge q and the
        standard deviation sigma of its noise.

        Args:
            position: Positions, shape (n, 2), mm.
            charge: Charges with noise, shape (n, n_electrode), pC.

        Returns:
            Logarithms of the forces, and logarithms of weight times likelihood up to a constant, shape (n,
            N_FORCE_NODES) each.
        """
        # The interval of integration lies about the best force, within the forces of the prior. Its half width is a
        # multiple of the standard deviation of ln F, which is the inverse of the norm of d(Q / sigma) / d ln F.
        terms = self.charges.scaled_charges(position)
        best_log_force = self._profile.best_log_force(terms, charge, self.noise)
        best_charge = self._profile.charge(best_log_force, terms)
        whitened_slope = self._profile.slope(best_log_force, best_charge) / self.noise.sigma(best_charge)
        half_width = FORCE_HALF_WIDTH_STD / np.linalg.norm(whitened_slope, axis=1)
        min_log_force, max_log_force = self._profile.log_range
        lower = np.maximum(best_log_force - half_width, min_log_force)[:, None]
        upper = np.minimum(best_log_force + half_width, max_log_force)[:, None]

        # Move the nodes from the interval [-1, 1] to [lower, upper]. The weights are proportional to its width.
        nodes, weights = np.polynomial.legendre.leggauss(N_FORCE_NODES)
        log_force = 0.5 * (lower + upper) + 0.5 * (upper - lower) * nodes
        log_weight = np.log(weights * (upper - lower))

        # Expected charges of electrode e at position n and node m, as a sum over the terms k
        expected = np.einsum("nmk,nke->enm", self.charges.force_weights(log_force), terms)
        variance = self.noise.variance(expected)
        measured = charge.T[:, :, None]  # shape (n_electrode, n, 1)
        chi2 = ((measured - expected) ** 2 / variance).sum(axis=0)
        log_likelihood = -0.5 * (chi2 + np.log(variance.prod(axis=0)))
        return log_force, log_weight + log_likelihood


def _posterior_moments(press: Integers, position: Array, log_force: Array, log_weight: Array) -> Array:
    """Compute the mean and the standard deviation of (x, y, F) for every press.

    Each expectation is a weighted mean over all positions of the press and over all forces at each position. Instead of
    the mean of the force, E[1/F] / E[1/F^2] is returned. This estimate has the smallest mean squared relative error.

    Args:
        press: Number of the press of each position, ascending, shape (n_position,).
        position: Positions, shape (n_position, 2), mm.
        log_force: Logarithms of the forces at each position, shape (n_position, n_node).
        log_weight: Logarithms of the weights of these contacts, up to a constant, shape (n_position, n_node).

    Returns:
        Means and then standard deviations, shape (2, n_press, 3), mm and N.
    """
    # The rows of a press follow each other, so `reduceat` with the first row of each press gives values by press.
    first_row = np.flatnonzero(np.diff(press, prepend=-1))  # where the number of the press changes
    n_row = np.diff(first_row, append=press.size)

    # The largest weight of each press is scaled to 1, so that the exponentials do not underflow.
    largest_log_weight = np.maximum.reduceat(log_weight.max(axis=1), first_row)
    weight = np.exp(log_weight - np.repeat(largest_log_weight, n_row)[:, None])
    position_weight = weight.sum(axis=1)  # over all forces, shape (n_position,)
    total_weight = np.add.reduceat(position_weight, first_row)  # shape (n_press,)

    def expectation(weighted: Array) -> Array:
        """Return the weighted mean over the positions of each press, shape (n_press,).

        Args:
            weighted: Values at the positions times their weights, shape (n_position,).
        """
        return np.asarray(np.add.reduceat(weighted, first_row, axis=0) / total_weight)

    x, y = position.T
    x_mean = expectation(position_weight * x)
    y_mean = expectation(position_weight * y)
    x_variance = expectation(position_weight * x**2) - x_mean**2
    y_variance = expectation(position_weight * y**2) - y_mean**2

    force = np.exp(log_force)
    force_mean = expectation((weight * force).sum(axis=1))
    force_variance = expectation((weight * force**2).sum(axis=1)) - force_mean**2
    inverse_force_mean = expectation((weight * force**-1).sum(axis=1))
    inverse_square_mean = expectation((weight * force**-2).sum(axis=1))
    force_estimate = inverse_force_mean / inverse_square_mean

    mean = np.stack([x_mean, y_mean, force_estimate], axis=1)
    variance = np.stack([x_variance, y_variance, force_variance], axis=1)
    std = np.sqrt(np.maximum(variance, 0.0))  # a small variance can be negative by rounding errors
    return np.stack([mean, std])
