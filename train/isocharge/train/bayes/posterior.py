"""The posterior of a contact given noisy charges, by dense integration: what no estimator can beat on average.

The prior is uniform over the disk and in the logarithm of the force. Charges are Gaussian about Q(c) with the sigma of
the true charge, so the likelihood carries its normalisation,

    p(Q | x, y, ln F) = prod_e exp(-(Q_e - q_e)^2 / (2 sigma_e^2)) / sigma_e,   q = Q(x, y, F),   sigma_e = sigma(q_e).

Positions are integrated over square cells, cut in four where the posterior may have mass until they are small against
its width; wherever that mass lies, in one place or several, in an ellipse or a sickle, none of it is lost: a cell is
dropped only when no contact in it can explain the charges. In each cell the force is integrated about its best value by
Gauss and Legendre's rule, cut off at the ends of the range. The midpoint rule on a Gaussian is exact to 1e-5 with cells
of 1.25 standard deviations (Trefethen and Weideman 2014); only the edge of the disk wants more.
"""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property

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
"""Presses integrated at once: keeps the working arrays within some 100 MB."""

ACROSS = 32
"""Cells across the disk to begin with."""

EDGE = 8
"""Points across a cell on the edge of the disk; each counts as inside or outside."""

MOST_CUTS = 10
"""Cuts of a cell in four at most: down to a thirty-thousandth of the disk."""

STEP = 1.25
"""Largest side of a cell in standard deviations of the position, in the direction that the charges tell best."""

MARGIN = 36.0
"""Excess of a cell's chi-squared over the press's smallest above which it holds nothing: exp(-18)."""

NEAR = 9.0
"""The same below which a cell on the edge of the disk matters: the press is then integrated with more care."""

WIDTH, NODES = 5.0, 12
"""Half width of the force's integral in standard deviations, and its points: to 1e-4 together."""


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

    @classmethod
    def roots(cls, radius: float) -> "Cells":
        """The first cells of one press, all over the disk."""
        side = 2.0 * radius / ACROSS
        centre = _grid(ACROSS, side)
        centre = centre[_is_within(centre, side, radius)]
        return cls(np.zeros(len(centre), dtype=np.intp), np.arange(len(centre)), centre, side)

    def __len__(self) -> int:
        return self.press.size

    def __getitem__(self, rows: np.ndarray) -> "Cells":
        return Cells(self.press[rows], self.root[rows], self.centre[rows], self.side)

    def cut(self, radius: float) -> "Cells":
        """Each in four; those without a share in the disk are dropped."""
        parts = self._four(0.25)
        return parts[_is_within(parts.centre, parts.side, radius)]

    def finer(self, radius: float) -> Iterator["Cells"]:
        """Whole ones as Gauss and Legendre's four points, others in sixteen."""
        edge = self.on_edge(radius)
        yield self[~edge]._four(1.0 / np.sqrt(12.0))
        yield self[edge].cut(radius).cut(radius)

    def _four(self, offset: float) -> "Cells":
        """Four half as wide in place of each, their centres `offset` sides off its middle in both directions."""
        centre = (self.centre[:, None] + _grid(2, 2.0 * offset * self.side)).reshape(-1, 2)
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
        points = centre[edge, None] + _grid(EDGE, self.side / EDGE)
        counts = np.hypot(points[..., 0], points[..., 1]) <= radius
        total = counts.sum(axis=1, keepdims=True)
        share[edge] = np.maximum(total[:, 0], 0.5) / EDGE**2
        middle = np.einsum("np,npi->ni", counts, points) / np.maximum(total, 1)
        centre[edge] = np.where(total > 0, middle, onto_disk(centre[edge], radius))
        return share, centre


def _grid(count: int, step: float) -> Array:
    """`count` x `count` points about the origin, shape (count^2, 2)."""
    line = step * (np.arange(count) - 0.5 * (count - 1))
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def _is_within(centre: Array, side: float, radius: float) -> Booleans:
    """Which squares have a share in the disk."""
    return np.asarray(np.hypot(*np.maximum(np.abs(centre) - 0.5 * side, 0.0).T) < radius)


@dataclass(frozen=True)
class Posterior:
    """Integrates over the contacts that may have given some charges.

    Attributes:
        charges: Charges of a contact.
        noise: Of the readings.
        radius: Of the disk of the prior, mm.
    """

    charges: ChargeSpline
    noise: NoiseModel
    radius: float

    def __post_init__(self) -> None:
        if self.noise.white <= 0.0:
            raise InputError(f"noise: expected white noise above 0 pC, got {self.noise.name!r}: nothing to integrate")
        check_radius(self.radius, self.charges.domain.radius, "charge table")

    def mean_and_std(self, charge: Array, executor: Executor | None = None) -> tuple[Array, Array]:
        """Mean and standard deviation of (x, y, F), mm and N, each (n, 3), from noisy charges (n, n_electrode), pC.

        The mean of the force is E[1/F] / E[1/F^2], of all estimates the one with the least mean square relative error.

        Args:
            charge: Noisy charges, shape (n, n_electrode), pC.
            executor: Integrates `CHUNK` presses in a task; None for this process.
        """
        charge, electrodes = np.asarray(charge, dtype=float), len(self.charges.electrodes)
        if charge.ndim != 2 or charge.shape[1] != electrodes or not len(charge) or not np.isfinite(charge).all():
            raise ChargeError(
                f"expected finite charges of shape (n, {electrodes}), n at least 1, got shape {charge.shape}"
            )
        chunks = [charge[start : start + CHUNK] for start in range(0, len(charge), CHUNK)]
        moments = in_order(executor, self._integrate, chunks)
        mean, std = np.concatenate(list(track(moments, "integrating the posterior", len(chunks))), axis=1)
        return mean, std

    @cached_property
    def _curve(self) -> ForceProfile:
        return ForceProfile.of(self.charges.by_force, self.charges.domain.force_range)

    @cached_property
    def _roots(self) -> tuple[Cells, Array, Array]:
        """The first cells, their terms, and the steepest slope of each scaled charge in them, (n, n_electrode)."""
        cells = Cells.roots(self.radius)
        about = onto_disk((cells.centre[:, None] + _grid(3, 0.5 * cells.side)).reshape(-1, 2), self.radius)
        steepest = np.linalg.norm(self.charges.slopes(about), axis=-1).max(axis=1)
        terms = self.charges.terms(onto_disk(cells.centre, self.radius))
        return cells, terms, steepest.reshape(len(cells), 9, -1).max(axis=1)

    def _integrate(self, charge: Array) -> Array:
        """Means and standard deviations, shape (2, n, 3)."""
        levels = list(self._cells(charge))
        side = np.concatenate([np.full(len(cells), cells.side) for cells in levels])
        press = np.concatenate([cells.press for cells in levels])
        shares, centres = zip(*(cells.inside(self.radius) for cells in levels), strict=True)
        order = np.argsort(press, kind="stable")
        share, press, centre = np.concatenate(shares)[order], press[order], np.concatenate(centres)[order]
        logs, weight = self._over_force(centre, charge[press])
        weight += np.log(share * side[order] ** 2)[:, None]
        return _moments(press, centre, logs, weight)

    def _cells(self, charge: Array) -> Iterator[Cells]:
        """Cells that hold all of the mass, small against its width; every press in cells of one size."""
        roots, terms, steepest = self._roots
        press, root = (axis.ravel() for axis in np.indices((len(charge), len(roots))))
        cells, terms = Cells(press, root, roots.centre[root], roots.side), terms[root]
        for cut in range(MOST_CUTS + 1):
            logs = self._curve.best(terms, charge[cells.press], self.noise)
            chi2, reach = self._fit(terms, logs, charge[cells.press], steepest[cells.root])
            best = np.full(len(charge), np.inf)
            np.minimum.at(best, cells.press, chi2)
            excess = np.maximum(np.sqrt(chi2) - np.sqrt(0.5) * cells.side * reach, 0.0) ** 2 - best[cells.press]
            alive = np.flatnonzero(excess <= MARGIN)
            stiffest, stiffness = np.zeros(len(charge)), self._stiffness(cells[alive], terms[alive], logs[alive])
            np.maximum.at(stiffest, cells.press[alive], stiffness)
            cut_off = np.zeros(len(charge), dtype=bool)
            cut_off[cells.press[cells.on_edge(self.radius) & (chi2 <= best[cells.press] + NEAR)]] = True
            done = (stiffest * cells.side <= STEP)[cells.press] | (cut == MOST_CUTS)
            ready = cells[done & (chi2 <= best[cells.press] + MARGIN)]
            yield ready[~cut_off[ready.press]]
            yield from ready[cut_off[ready.press]].finer(self.radius)
            cells = cells[alive][~done[alive]].cut(self.radius)
            if not len(cells):
                return
            terms = self.charges.terms(onto_disk(cells.centre, self.radius))

    def _fit(self, terms: Array, logs: Array, charge: Array, steepest: Array) -> tuple[Array, Array]:
        """Chi-squared at each cell, and how fast its root can change with the place at most, 1/mm."""
        by_force = self.charges.by_force(logs)
        known = np.einsum("nk,nke->ne", by_force, terms)
        deviation = (charge - known) / self.noise.sigma(known)
        steep = steepest * by_force.sum(axis=1)[:, None] / self.noise.sigma(known)
        return np.einsum("ne,ne->n", deviation, deviation), np.sqrt(np.einsum("ne,ne->n", steep, steep))

    def _stiffness(self, cells: Cells, terms: Array, logs: Array) -> Array:
        """One over the smallest standard deviation of the position if it lay here, the force unknown; shape (n,)."""
        by_force, slopes = self.charges.by_force(logs), self.charges.slopes(onto_disk(cells.centre, self.radius))
        known = np.einsum("nk,nke->ne", by_force, terms)
        moved = np.einsum("nk,nkei->nei", by_force, slopes)
        jacobian = np.concatenate([moved, self._curve.slope(logs, known)[..., None]], axis=2)
        return singular_values(jacobian / self.noise.sigma(known)[..., None])[:, 0]

    def _over_force(self, position: Array, charge: Array) -> tuple[Array, Array]:
        """Points of the integral over the force's logarithm at each place, and the logarithms of their weights times
        the likelihood; both (n, NODES)."""
        terms = self.charges.terms(position)
        best = self._curve.best(terms, charge, self.noise)
        known = self._curve.charge(best, terms)
        reach = WIDTH / np.linalg.norm(self._curve.slope(best, known) / self.noise.sigma(known), axis=1)
        low, high = np.maximum(best - reach, self._curve.ends[0]), np.minimum(best + reach, self._curve.ends[1])
        nodes, weights = np.polynomial.legendre.leggauss(NODES)
        logs = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * nodes
        known = np.einsum("nmk,nke->enm", self.charges.by_force(logs), terms)
        variance = self.noise.variance(known)
        exponents = ((charge.T[:, :, None] - known) ** 2 / variance).sum(axis=0) + np.log(variance.prod(axis=0))
        return logs, np.log(weights * (high - low)[:, None]) - 0.5 * exponents


def _moments(press: Integers, place: Array, logs: Array, weight: Array) -> Array:
    """Mean and standard deviation of (x, y, F) of every press, from the points at its places, `press` ascending; shape
    (2, n, 3)."""
    first = np.flatnonzero(np.diff(press, prepend=-1))
    largest = np.maximum.reduceat(weight.max(axis=1), first)
    mass = np.exp(weight - np.repeat(largest, np.diff(first, append=press.size))[:, None])
    force, total = np.exp(logs), mass.sum(axis=1)
    columns = [total, *(total * place.T), *(total * place.T**2)]
    columns += [(mass * force**power).sum(axis=1) for power in (1, 2, -1, -2)]
    sums = np.add.reduceat(np.stack(columns, axis=1), first)
    x, y, x2, y2, f, f2, inverse, inverse2 = (sums[:, 1:] / sums[:, :1]).T
    mean = np.stack([x, y, inverse / inverse2], axis=1)
    variance = np.stack([x2 - x**2, y2 - y**2, f2 - f**2], axis=1)
    return np.stack([mean, np.sqrt(np.maximum(variance, 0.0))])
