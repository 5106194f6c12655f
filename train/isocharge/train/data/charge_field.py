"""A series for the map from contacts to charges that is fitted to a dataset, and the disk in which it is invertible.

Without pretension Q = F^(2/3) g(x, y) nearly, with g smooth, so ln Q is expanded in Chebyshev polynomials

    ln Q_e = sum c_ijm T_i(x / r) T_j(y / r) T_m(l),   i + j <= degree, m <= force_degree,

with r the radius of the working area and l the logarithm of the force scaled to [-1, 1]. For charges of both signs,
which taut uniaxial films give, Q_e / S(l) is expanded instead of the logarithm, where S is the usual size of the
charges under this force. The coefficients follow from linear least squares. The training uses the series to find the
contact that is nearest to given charges, and to find folds and distant contacts with the same charges with the searches
of the simulator. The model itself does not use the series. For a dataset of several probes, the series is their mean.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from scipy.linalg import cho_factor, cho_solve

from isocharge.common.arrays import Array
from isocharge.common.chebyshev_series import CHUNK_SIZE, Series, chebyshev_terms, position_degrees
from isocharge.common.errors import DatasetError, TrainingError
from isocharge.common.statistics import rms
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import NoiseModel, working_area
from isocharge.simulate.forward.charge_map import Domain, within
from isocharge.simulate.identifiability.ambiguous_pairs import find_ambiguous_pairs
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses

CANDIDATES = ((6, 1), (10, 1), (16, 2), (24, 2), (30, 2), (36, 2))
"""Degrees in position and in force that are tried one after the other."""

TAUT_CANDIDATES = ((6, 4), (10, 4), (16, 4), (24, 4))
"""The same for positive charges on taut films. The charges grow with the force at small forces, and with its power 2/3
at large ones, so that the logarithm of a charge is not a polynomial of low degree in the logarithm of the force."""

TAUT_RATIO = 0.8
"""Ratio of the errors with the first of `TAUT_CANDIDATES` and the first of `CANDIDATES` below which the film counts as
taut. On a slack film the force degree hardly changes the error, and the ratio is nearly one."""

SIGNED_CANDIDATES = ((6, 1), (6, 4), (8, 8), (12, 8), (16, 8), (20, 8), (24, 6), (24, 8))
"""The same for charges of both signs: on taut films, the exponent of the force changes with the force."""

SIZE_DEGREE = 4
"""Degree of ln S in l."""

NOISY = 500.0
"""Charge at which both parts of the `reference` noise are equal, 1 pC and 0.2 %, pC.

Errors of charges of both signs are relative to at least about this charge.
"""

ROWS_PER_TERM = 40
"""Largest number of presses for each coefficient. More presses help most near the edge of the disk."""

FEWEST_PER_TERM = 8
"""Smallest number of presses for each coefficient. With fewer, the slopes at the rim are not determined."""

RIDGE = 1e-9
"""Relative weight of the squared coefficients in the fit (ridge regression).

The polynomials are defined on a square, whose corners lie outside of the disk and contain no presses.
"""

GOOD_ENOUGH = 1.5e-4
"""Relative rms error of the charges below which no higher degree is tried: about a tenth of the reference noise."""


@dataclass(frozen=True)
class ChargeField:
    """A `ChargeMap` fitted to presses.

    Attributes:
        domain: Contacts for which the field holds.
        electrodes: Names of the electrodes, in the order of the charges.
        series: Coefficients of ln Q (Q in pC), shape (degree + 1, degree + 1, force_degree + 1, n_electrode).
        error: Relative rms error of the charges of presses that were not used in the fit.
        log_size: Coefficients of ln S for charges of both signs, shape (SIZE_DEGREE + 1,); the series then has the
            coefficients of Q / S. None for positive charges.
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
        """Fit the series to presses by least squares, and choose its degree by the error on other presses.

        Args:
            domain: Domain of the contacts.
            electrodes: Names of the electrodes.
            presses: Presses without noise.
            held: Presses on which the error is measured.

        Raises:
            TrainingError: If there are too few presses for the smallest degree.
        """
        unit = domain.to_unit(presses.contact)
        signed = presses.signed
        log_size = _log_size(unit[:, 2], presses.charge) if signed else None
        target = np.log(presses.charge) if log_size is None else presses.charge / _size(log_size, unit[:, 2])[0]

        def fit_degrees(degree: int, force_degree: int) -> ChargeField | None:
            """Fit a series of these degrees; return None if there are too few presses for it."""
            count = (degree + 1) * (degree + 2) // 2 * (force_degree + 1)
            if FEWEST_PER_TERM * count > len(unit):
                return None
            rows = slice(0, ROWS_PER_TERM * count)
            series = fit_series(unit[rows], target[rows], degree, force_degree)
            field = cls(domain, electrodes, series, np.inf, log_size)
            error = rms((field.charges(held.contact) - held.charge) / np.hypot(held.charge, NOISY if signed else 0.0))
            return replace(field, error=error)

        first_degrees, *further_degrees = SIGNED_CANDIDATES if signed else CANDIDATES
        best = fit_degrees(*first_degrees)
        if best is None:
            raise TrainingError(
                f"expected at least {FEWEST_PER_TERM * 56} presses to fit the charges by, got {len(unit)}"
            )
        if not signed and best.error > GOOD_ENOUGH:
            taut = fit_degrees(*TAUT_CANDIDATES[0])
            if taut is not None and taut.error < TAUT_RATIO * best.error:
                best = taut
                further_degrees = list(TAUT_CANDIDATES[1:])
        for degree, force_degree in further_degrees:
            if best.error < GOOD_ENOUGH:
                break
            field = fit_degrees(degree, force_degree)
            if field is None:
                break
            if field.error < best.error:
                best = field
        return best

    def charges(self, contact: Array) -> Array:
        """Return the charges of contacts; see `ChargeMap`."""
        return self.linearised(contact)[0]

    def derivatives(self, contact: Array) -> Array:
        """Return the derivatives of the charges; see `ChargeMap`."""
        return self.linearised(contact)[1]

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Return charges and derivatives together, which takes half the time; see `ChargeMap`."""
        unit = self.domain.to_unit(contact)
        # value of the series, then its derivatives with respect to x, y and l, shape (n, 4, n_electrode)
        values_and_slopes = self._series.values(unit)
        value = values_and_slopes[:, 0]
        slopes = values_and_slopes[:, 1:]
        if self.log_size is None:  # ln Q = value
            charge = np.exp(value)
            factor = charge
        else:  # Q = S(l) * value
            size, log_size_slope = _size(self.log_size, unit[:, 2])
            charge = size * value
            slopes[:, 2] += log_size_slope * value
            factor = size
        return charge, factor[:, :, None] * slopes.swapaxes(1, 2) / self.domain.scale

    @cached_property
    def _series(self) -> Series:
        return Series(self.series)

    @property
    def of_positive(self) -> ChargeSeries | None:
        """The series with which contacts are tracked across folds; None for charges of both signs."""
        if self.log_size is not None:
            return None
        return ChargeSeries(self._series, self.domain.radius, self.domain.force_range)


def _log_size(logs: Array, charge: Array) -> Array:
    """Fit the coefficients of ln S to scaled logarithms of forces, shape (n,), and charges, shape (n, n_electrode)."""
    total = np.maximum(np.linalg.norm(charge, axis=1), LOWEST_CHARGE)
    return np.asarray(chebyshev.chebfit(logs, np.log(total), SIZE_DEGREE))


def _size(coefficients: Array, logs: Array) -> tuple[Array, Array]:
    """Return S and the derivative of ln S with respect to l, each of shape (n, 1)."""
    inside = np.clip(logs, -1.0, 1.0)[:, None]
    slope = chebyshev.chebval(inside, chebyshev.chebder(coefficients))
    return np.exp(chebyshev.chebval(inside, coefficients)), np.asarray(slope)


def fit_series(unit: Array, target: Array, degree: int, force_degree: int) -> Array:
    """Fit a Chebyshev series in position and force by the normal equations, which are well conditioned here.

    Args:
        unit: Scaled contacts, shape (n, 3).
        target: Values of the series at these contacts, shape (n, k).
        degree: Largest total degree in x and y.
        force_degree: Largest degree in the logarithm of the force.

    Returns:
        Coefficients, shape (degree + 1, degree + 1, force_degree + 1, k).
    """
    count = (degree + 1) * (degree + 2) // 2 * (force_degree + 1)
    normal = RIDGE * len(unit) * np.eye(count)
    moment = np.zeros((count, target.shape[1]))
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
"""Largest relative error of the fitted charges for which a fold is certain. A poor fit has spurious folds."""

SMOOTH = 2e-3
"""Largest relative error of a poor fit to charges without noise."""

CREDIBLE_SMOOTH = 0.95
CREDIBLE_NOISY = 0.8
"""Share of the radius within which a fold of a poor fit is taken to be real, without and with noise.

Spurious folds lie at the rim, where presses determine the fit from one side only. Noise moves them inwards.
"""

RIM = 0.98
"""Ratio of the searched radius to that of the domain. At the rim, presses do not determine the slopes."""

PAIR_PLACES = 400
"""Number of contacts for which another contact with the same charges is searched. 400 contacts take half a second."""

SMALLEST_SHARE = 0.2
"""Smallest ratio of the fold-free radius to the radius of the dataset for which a training makes sense."""


def invertible_domain(
    field: ChargeField, presses: LabelledPresses, noise: NoiseModel
) -> tuple[Domain, tuple[str, ...]]:
    """Return the largest disk without a certain fold, and sentences about folds and ambiguous pairs.

    A fit to a few presses, or to measured charges with more noise than `SURE`, is too poor for a certain fold. The
    domain is then not reduced, and a sentence says where the map seems to fold. Ambiguous pairs are searched only if
    the fit is smooth.

    Args:
        field: Charge field that was fitted to the presses.
        presses: The presses, whose remaining number a sentence states.
        noise: Noise of good presses. Charges that differ by less count as the same.

    Raises:
        DatasetError: If hardly anything is left of the domain.
    """
    asked = field.domain
    fold_radius = _fold_radius(field, noise)
    if field.error > SURE:
        credible_share = CREDIBLE_SMOOTH if field.error < SMOOTH else CREDIBLE_NOISY
        if fold_radius < credible_share * asked.radius:
            return asked, (_uncertain_fold_caution(fold_radius, asked.radius),)
        fold_radius = np.inf
    if fold_radius < SMALLEST_SHARE * asked.radius:
        raise DatasetError(
            f"the map from contacts to charges folds {fold_radius:g} mm from the centre, of {asked.radius:g} mm asked "
            "for: beyond, two contacts give the same charges; add an electrode, or take a biaxial film"
        )
    domain = asked
    cautions = []
    if fold_radius < asked.radius:
        domain = asked.within(fold_radius)
        cautions.append(_fold_caution(field, presses, fold_radius))
    if field.error < SMOOTH:
        inner = within(field, RIM * domain.radius)
        pairs = find_ambiguous_pairs(inner, noise, asked.force_range[0], PAIR_PLACES)
        if pairs.summary:
            sentence = pairs.summary[0].lower() + pairs.summary[1:-1]  # continued below, so without its full stop
            cautions.append(f"{sentence}; no model tells which of them it is; see 'isocharge simulate identify'")
    return domain, tuple(cautions)


def _uncertain_fold_caution(fold_radius: float, asked_radius: float) -> str:
    """Return the sentence about a fold that a poor fit shows inside the domain, which is not reduced.

    Args:
        fold_radius: Distance of the fold from the centre, mm.
        asked_radius: Radius of the domain, mm.
    """
    return (
        f"the map from contacts to charges seems to fold about {fold_radius:.2g} mm from the centre, where two "
        "contacts give the same charges; the presses cannot tell it for certain, and the model is trained "
        f"across it, up to {asked_radius:g} mm; see 'isocharge simulate identify', then ask for a smaller "
        "radius or add an electrode"
    )


def _fold_caution(field: ChargeField, presses: LabelledPresses, fold_radius: float) -> str:
    """Return the sentence about a certain fold, to which the domain is reduced.

    Args:
        field: Charge field with the domain before the reduction.
        presses: The presses, some of which lie beyond the fold.
        fold_radius: Distance of the fold from the centre, mm.
    """
    asked_radius = field.domain.radius
    caution = (
        f"the map from contacts to charges folds beyond {fold_radius:g} mm: two contacts give the same charges there; "
        f"the model is trained for {fold_radius:g} mm, not {asked_radius:g} mm, on {len(presses.within(fold_radius))} "
        f"of {len(presses)} presses"
    )
    if field.of_positive is None:
        return caution
    return f"{caution}; 'serve stream --track' follows contacts to {asked_radius:g} mm"


def _fold_radius(field: ChargeField, noise: NoiseModel) -> float:
    """Return the distance of the nearest fold from the centre, mm, rounded; infinity if there is no fold."""
    area = working_area(within(field, RIM * field.domain.radius), noise, search_pairs=False)
    if not np.isfinite(area.fold_radius):
        return np.inf
    return float(f"{area.unambiguous_radius:.6g}")
