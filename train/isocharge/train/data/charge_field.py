"""The map from contacts to charges as a short series fitted to a dataset, and how far from the centre it is invertible.

Without pretension Q = F^(2/3) g(x, y) nearly, with g smooth, so ln Q is expanded in Chebyshev polynomials

    ln Q_e = sum c_ijm T_i(x / r) T_j(y / r) T_m(l),   i + j <= degree, m <= force_degree,

with r the radius of the working area and l the logarithm of the force scaled to [-1, 1]. Charges of both signs, as taut
uniaxial films give, have Q_e / S(l) in the logarithm's place, with S their usual size under that force. The
coefficients follow from linear least squares. Training needs the series to find the contact nearest to any charges, and
to see folds, by the simulator's search for folds and for contacts far apart with the same charges; the model itself
does without. A dataset of several probes gives their mean.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from scipy.linalg import cho_factor, cho_solve

from isocharge.common.arrays import Array
from isocharge.common.chebyshev_series import CHUNK_SIZE, Series, chebyshev_terms, position_degrees
from isocharge.common.errors import DatasetError, TrainingError
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import NoiseModel, working_area
from isocharge.simulate.forward.charge_map import Domain, within
from isocharge.simulate.identifiability.ambiguous_pairs import find_ambiguous_pairs
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses

CANDIDATES = ((6, 1), (10, 1), (16, 2), (24, 2), (30, 2), (36, 2))
"""Degrees tried in turn, in position and in force."""

SIGNED_CANDIDATES = ((6, 1), (6, 4), (8, 8), (12, 8), (16, 8), (20, 8), (24, 6), (24, 8))
"""The same for charges of both signs: taut films, on which the force's power changes with the force."""

SIZE_DEGREE = 4
"""Degree of ln S in l."""

NOISY = 500.0
"""Charge below which errors of charges of both signs are relative to this, pC: it has as much of either noise of
`reference`, 1 pC and 0.2 %."""

ROWS_PER_TERM = 40
"""Presses used for each coefficient at most. Near the edge of the disk, where the series is worst, more help most."""

FEWEST_PER_TERM = 8
"""Fewer presses for a coefficient than this leave the slopes at the rim to chance."""

RIDGE = 1e-9
"""Weight of the coefficients' own size in the fit, relative: the square's corners lie outside the disk, where nothing
holds the polynomials."""

GOOD_ENOUGH = 1.5e-4
"""Root-mean-square relative error of the charges at which no higher degree is tried: a tenth of the reference noise."""


@dataclass(frozen=True)
class ChargeField:
    """A `ChargeMap` fitted to presses.

    Attributes:
        domain: Where it holds.
        electrodes: Names, in the order of the charges.
        series: Coefficients of ln Q (Q in pC), shape (degree + 1, degree + 1, force_degree + 1, n_electrode).
        error: Root-mean-square relative error on presses that the fit did not see.
        log_size: For charges of both signs the coefficients of ln S, shape (SIZE_DEGREE + 1,); `series` is then of
            Q / S.
    """

    domain: Domain
    electrodes: tuple[str, ...]
    series: Array
    error: float
    log_size: Array | None = None

    @classmethod
    def fit(
        cls, domain: Domain, electrodes: tuple[str, ...], presses: LabelledPresses, held: LabelledPresses
    ) -> "ChargeField":
        """Least squares on presses, the degree chosen on others.

        Args:
            domain: Where the contacts lie.
            electrodes: Names.
            presses: Clean.
            held: Presses to measure the error on.

        Raises:
            TrainingError: If there are too few presses for the smallest degree.
        """
        best: ChargeField | None = None
        unit, signed = domain.to_unit(presses.contact), presses.signed
        log_size = _log_size(unit[:, 2], presses.charge) if signed else None
        target = np.log(presses.charge) if log_size is None else presses.charge / _size(log_size, unit[:, 2])[0]
        for degree, force_degree in SIGNED_CANDIDATES if signed else CANDIDATES:
            count = (degree + 1) * (degree + 2) // 2 * (force_degree + 1)
            if FEWEST_PER_TERM * count > len(unit):
                break
            rows = slice(0, ROWS_PER_TERM * count)
            series = _least_squares(unit[rows], target[rows], degree, force_degree)
            field = cls(domain, electrodes, series, np.inf, log_size)
            error = rms((field.charges(held.contact) - held.charge) / np.hypot(held.charge, NOISY if signed else 0.0))
            if best is None or error < best.error:
                best = replace(field, error=error)
            if error < GOOD_ENOUGH:
                break
        if best is None:
            raise TrainingError(
                f"expected at least {FEWEST_PER_TERM * 56} presses to fit the charges by, got {len(unit)}"
            )
        return best

    def charges(self, contact: Array) -> Array:
        """See `ChargeMap`."""
        return self.linearised(contact)[0]

    def derivatives(self, contact: Array) -> Array:
        """See `ChargeMap`."""
        return self.linearised(contact)[1]

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Charges and derivatives at once, in half the time; see `ChargeMap`."""
        unit = self.domain.to_unit(contact)
        values = self._series.values(unit)
        if self.log_size is None:
            charge = np.exp(values[:, 0])
            return charge, charge[:, :, None] * values[:, 1:].swapaxes(1, 2) / self.domain.scale
        size, growth = _size(self.log_size, unit[:, 2])
        slopes = values[:, 1:]
        slopes[:, 2] += growth * values[:, 0]
        return size * values[:, 0], size[:, :, None] * slopes.swapaxes(1, 2) / self.domain.scale

    @cached_property
    def _series(self) -> Series:
        return Series(self.series)

    @property
    def of_positive(self) -> ChargeSeries | None:
        """The series that follows contacts across folds; None for charges of both signs."""
        if self.log_size is not None:
            return None
        return ChargeSeries(self._series, self.domain.radius, self.domain.force_range)


def _log_size(logs: Array, charge: Array) -> Array:
    """Coefficients of ln S, from logarithms of forces in [-1, 1], shape (n,), and charges (n, n_electrode)."""
    total = np.maximum(np.linalg.norm(charge, axis=1), LOWEST_CHARGE)
    return np.asarray(chebyshev.chebfit(logs, np.log(total), SIZE_DEGREE))


def _size(coefficients: Array, logs: Array) -> tuple[Array, Array]:
    """S and the derivative of ln S by l, each of shape (n, 1)."""
    inside = np.clip(logs, -1.0, 1.0)[:, None]
    slope = chebyshev.chebval(inside, chebyshev.chebder(coefficients))
    return np.exp(chebyshev.chebval(inside, coefficients)), np.asarray(slope)


def _least_squares(unit: Array, target: Array, degree: int, force_degree: int) -> Array:
    """Series for targets of shape (n, k), by the normal equations: double precision is plenty for these polynomials."""
    count = (degree + 1) * (degree + 2) // 2 * (force_degree + 1)
    normal, moment = RIDGE * len(unit) * np.eye(count), np.zeros((count, target.shape[1]))
    for some in np.array_split(np.arange(len(unit)), len(unit) // CHUNK_SIZE + 1):
        plane, in_force = chebyshev_terms(unit[some], degree, force_degree)
        columns = (plane[:, :, None] * in_force[:, None, :]).reshape(len(some), -1)
        normal += columns.T @ columns
        moment += columns.T @ target[some]
    series = np.zeros((degree + 1, degree + 1, force_degree + 1, target.shape[1]))
    solution = cho_solve(cho_factor(normal), moment)
    series[position_degrees(degree)] = solution.reshape(-1, force_degree + 1, target.shape[1])
    return series


SURE = 3e-4
"""Largest error of the fitted charges, relative, for which a fold is certain: a poor fit has folds of its own."""

SMOOTH = 2e-3
"""Largest error of a poor fit to charges without noise, relative."""

CREDIBLE_SMOOTH, CREDIBLE_NOISY = 0.95, 0.8
"""Share of the radius within which a fold of a poor fit is believed: its spurious folds lie at the rim, where presses
hold it from one side only, and noise moves them inwards."""

RIM = 0.98
"""Searched radius over the domain's, dimensionless: at the very rim no press holds the slopes from outside."""

PAIR_PLACES = 400
"""Places from which contacts with the same charges are looked for; 400 take half a second."""

SMALLEST_SHARE = 0.2
"""Smallest fold-free radius over the dataset's, dimensionless, for which a training makes sense."""


def invertible_domain(
    field: ChargeField, presses: LabelledPresses, noise: NoiseModel
) -> tuple[Domain, tuple[str, ...]]:
    """The largest disk in which the map certainly does not fold, and sentences on folds and ambiguous pairs.

    A fit to measured charges, which have more noise than `SURE`, or to few presses is too poor for a certain fold: the
    domain then stays, and the sentence says where the map seems to fold. Pairs are searched for where it is smooth.

    Args:
        field: Fitted to the presses.
        presses: For the sentence: how many of them are left.
        noise: Of good presses: what it hides is the same charge.

    Raises:
        DatasetError: If hardly anything is left of the domain.
    """
    asked, fold = field.domain, _fold_radius(field, noise)
    if field.error > SURE:
        if fold < (CREDIBLE_SMOOTH if field.error < SMOOTH else CREDIBLE_NOISY) * asked.radius:
            return asked, (
                f"the map from contacts to charges seems to fold about {fold:.2g} mm from the centre, where two "
                "contacts give the same charges; the presses cannot tell it for certain, and the model is trained "
                f"across it, up to {asked.radius:g} mm; see 'isocharge simulate identify', then ask for a smaller "
                "radius or add an electrode",
            )
        fold = np.inf
    if fold < SMALLEST_SHARE * asked.radius:
        raise DatasetError(
            f"the map from contacts to charges folds {fold:g} mm from the centre, of {asked.radius:g} mm asked for: "
            "beyond, two contacts give the same charges; add an electrode, or take a biaxial film"
        )
    domain, cautions = asked, []
    if fold < asked.radius:
        domain = asked.within(fold)
        cautions.append(
            f"the map from contacts to charges folds beyond {fold:g} mm: two contacts give the same charges there; the "
            f"model is trained for {fold:g} mm, not {asked.radius:g} mm, on {len(presses.within(fold))} of "
            f"{len(presses)} presses"
            + ("" if field.of_positive is None else f"; 'serve stream --track' follows contacts to {asked.radius:g} mm")
        )
    if field.error < SMOOTH:
        inner = within(field, RIM * domain.radius)
        if pairs := find_ambiguous_pairs(inner, noise, asked.force_range[0], PAIR_PLACES).summary:
            which = "no model tells which of them it is; see 'isocharge simulate identify'"
            cautions.append(f"{pairs[0].lower()}{pairs[1:-1]}; {which}")
    return domain, tuple(cautions)


def _fold_radius(field: ChargeField, noise: NoiseModel) -> float:
    """Distance of the nearest fold from the centre, mm; infinite if there is none."""
    area = working_area(within(field, RIM * field.domain.radius), noise, search_pairs=False)
    return float(f"{area.unambiguous_radius:.6g}") if np.isfinite(area.fold_radius) else np.inf
