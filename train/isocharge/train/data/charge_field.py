"""Chebyshev series of the map from contacts to charges, and the disk in which this map is invertible.

Without pretension, the charge of an electrode is nearly F^(2/3) g(x, y), with the force F and a smooth function g of
the position. The logarithm of each charge Q_e is therefore expanded in Chebyshev polynomials T_i:

    ln Q_e = sum c_ijm T_i(x / r) T_j(y / r) T_m(l),   i + j <= degree, m <= force_degree.

Here r is the radius of the working area. The variable l is the logarithm of the force, scaled to the interval [-1, 1].
Taut uniaxial films have charges of both signs. For such charges, the quotient Q_e / S(l) is expanded instead of the
logarithm of Q_e. The typical size S of the charges is a function of l. The coefficients are fitted to a dataset by
linear least squares.

The training uses the series in three searches: for the contact whose charges are nearest to given charges, for folds of
the map, and for distant contacts with the same charges. The trained model does not use the series. For a dataset with
several probes, the series describes the mean of the charges over the probes.
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
from isocharge.simulate import NoiseModel
from isocharge.simulate.forward.charge_map import ChargeMap, Domain, within
from isocharge.simulate.identifiability.ambiguous_pairs import find_ambiguous_pairs
from isocharge.simulate.identifiability.working_area import search_working_area
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses

CANDIDATE_DEGREES: tuple[tuple[int, int], ...] = ((6, 1), (10, 1), (16, 2), (24, 2), (30, 2), (36, 2))
"""Degrees in the position and in the force that are tried, in this order, for positive charges."""

TAUT_CANDIDATE_DEGREES: tuple[tuple[int, int], ...] = ((6, 4), (10, 4), (16, 4), (24, 4))
"""Degrees in the position and in the force that are tried, in this order, for positive charges on taut films.

On taut films, the charges are proportional to the force at small forces, and proportional to the power 2/3 of the force
at large forces. The logarithm of a charge is therefore not a polynomial of low degree in the logarithm of the force."""

TAUT_ERROR_RATIO = 0.8
"""Ratio of two errors of the fit below which a film counts as taut.

The ratio is the error with the first of `TAUT_CANDIDATE_DEGREES` divided by the error with the first of
`CANDIDATE_DEGREES`. On a slack film, a higher degree in the force hardly changes the error, so the ratio is nearly
one."""

SIGNED_CANDIDATE_DEGREES: tuple[tuple[int, int], ...] = (
    (6, 1),
    (6, 4),
    (8, 8),
    (12, 8),
    (16, 8),
    (20, 8),
    (24, 6),
    (24, 8),
)
"""Degrees in the position and in the force that are tried, in this order, for charges of both signs.

The degrees in the force are higher than for positive charges. Charges of both signs occur on taut films, on which the
exponent of the force changes with the force."""

SIZE_DEGREE = 4
"""Degree of the polynomial that approximates the logarithm of the size S of the charges as a function of l."""

NOISE_CORNER_pC = 500.0
"""Charge at which both parts of the `reference` noise, 1 pC and 0.2 % of the charge, are equal, pC.

For charges of both signs, the errors of a fit are divided by the root of the sum of the squares of the charge and of
this value. Charges near zero would otherwise have large relative errors.
"""

ROWS_PER_TERM = 40
"""Largest number of presses per coefficient. More presses would improve the fit mostly near the edge of the disk."""

FEWEST_PER_TERM = 8
"""Smallest number of presses per coefficient. Fewer presses would not determine the slopes near the edge."""

RIDGE = 1e-9
"""Relative weight of the squared coefficients in the fit (ridge regression).

The ridge is needed because the polynomials are defined on a square, whose corners lie outside the disk and contain no
presses.
"""

GOOD_ENOUGH = 1.5e-4
"""Relative rms error of the charges below which no higher degree is tried, about a tenth of the reference noise."""


@dataclass(frozen=True)
class ChargeField:
    """`ChargeMap` that evaluates a Chebyshev series, which was fitted to presses.

    Attributes:
        domain: Contacts for which the field holds.
        electrodes: Names of the electrodes, in the order of the charges.
        series: Coefficients of ln Q with Q in pC, or of Q / S if `log_size` is given, shape (degree + 1, degree + 1,
            force_degree + 1, n_electrode).
        error: Relative rms error of the charges of presses that were not used in the fit.
        log_size: Coefficients of ln S for charges of both signs, shape (SIZE_DEGREE + 1,); None for positive charges.
    """

    domain: Domain
    electrodes: tuple[str, ...]
    series: Array
    error: float
    log_size: Array | None = None

    @classmethod
    def fit(
        cls, domain: Domain, electrodes: tuple[str, ...], presses: LabelledPresses, validation: LabelledPresses
    ) -> "ChargeField":
        """Fit the series to presses by least squares, and choose its degrees by the error on other presses.

        Args:
            domain: Working area and range of forces of the contacts.
            electrodes: Names of the electrodes, in the order of the charges.
            presses: Presses to which the series is fitted.
            validation: Other presses, on which the error is measured.

        Returns:
            The field with the smallest error among the degrees that were tried.

        Raises:
            TrainingError: If there are too few presses for the smallest degrees.
        """
        fitter = _SeriesFitter.prepare(domain, electrodes, presses, validation)
        candidate_degrees = SIGNED_CANDIDATE_DEGREES if presses.signed else CANDIDATE_DEGREES
        first_degrees, *further_degrees = candidate_degrees
        best_field = fitter.fit(*first_degrees)
        if best_field is None:
            fewest = FEWEST_PER_TERM * series_term_count(*first_degrees)
            raise TrainingError(f"expected at least {fewest} presses to fit the charges by, got {len(presses)}")

        # A taut film, which has a pretension, needs higher degrees in the force. If the first degrees for taut films
        # have a clearly smaller error, the film is taut.
        if not presses.signed and best_field.error > GOOD_ENOUGH:
            first_taut_degrees, *further_taut_degrees = TAUT_CANDIDATE_DEGREES
            taut_field = fitter.fit(*first_taut_degrees)
            if taut_field is not None and taut_field.error < TAUT_ERROR_RATIO * best_field.error:
                best_field = taut_field
                further_degrees = further_taut_degrees

        # Try the further degrees until the error is small enough, or the presses are too few.
        for degree, force_degree in further_degrees:
            if best_field.error < GOOD_ENOUGH:
                break
            field = fitter.fit(degree, force_degree)
            if field is None:  # there are too few presses for this degree and all higher ones
                break
            if field.error < best_field.error:
                best_field = field
        return best_field

    def charges(self, contact: Array) -> Array:
        """Compute the charges of contacts; see `ChargeMap.charges`."""
        charge, _ = self.linearised(contact)
        return charge

    def derivatives(self, contact: Array) -> Array:
        """Compute the derivatives of the charges with respect to (x, y, ln F); see `ChargeMap.derivatives`."""
        _, derivatives = self.linearised(contact)
        return derivatives

    def linearised(self, contact: Array) -> tuple[Array, Array]:
        """Compute charges and their derivatives together, which is faster than computing them separately.

        The value of the series is ln Q for positive charges Q, and Q / S(l) for charges of both signs. S(l) is the
        typical size of the charges as a function of the scaled logarithm l of the force.

        Args:
            contact: Contacts (x, y, F), shape (n, 3), mm and N.

        Returns:
            Charges, shape (n, n_electrode), pC, and their derivatives with respect to (x, y, ln F), shape (n,
            n_electrode, 3).
        """
        unit_contact = self.domain.to_unit(contact)
        # The second axis has the value of the series, and then its derivatives with respect to the unit coordinates x,
        # y and l.
        values_and_slopes = self._series.values_and_derivatives(unit_contact)  # shape (n, 4, n_electrode)
        value = values_and_slopes[:, 0]
        slopes = values_and_slopes[:, 1:]  # shape (n, 3, n_electrode)

        # In both cases, the derivative of the charge is `charge_per_value` times `slopes`.
        if self.log_size is None:  # Q = exp(value), so the derivative is Q' = Q value'
            charge = np.exp(value)
            charge_per_value = charge  # dQ / d(value)
        else:  # Q = S(l) value, so the derivative is Q' = S (value' + (ln S)' value)
            size, log_size_slope = _size_and_slope(self.log_size, unit_contact[:, 2])
            charge = size * value
            slopes[:, 2] += log_size_slope * value  # S depends only on l, the third coordinate
            charge_per_value = size
        charge_slopes = charge_per_value[:, :, None] * slopes.swapaxes(1, 2)
        # The division by the scale converts derivatives in unit coordinates into derivatives in x, y and ln F.
        return charge, charge_slopes / self.domain.scale

    @cached_property
    def _series(self) -> Series:
        """Object that evaluates the series."""
        return Series(self.series)

    @property
    def positive_series(self) -> ChargeSeries | None:
        """Series with which contacts are tracked across folds. None if the charges have both signs."""
        if self.log_size is not None:
            return None
        return ChargeSeries(self._series, self.domain.radius, self.domain.force_range)


@dataclass(frozen=True)
class _SeriesFitter:
    """Data for fits of series: presses for the fits, and other presses on which the errors are measured.

    Attributes:
        domain: Working area and range of forces of the contacts.
        electrodes: Names of the electrodes, in the order of the charges.
        unit_contact: Contacts of the fit in unit coordinates, shape (n, 3).
        target: Values of the series at these contacts, ln Q or Q / S, shape (n, n_electrode).
        log_size: Coefficients of ln S for charges of both signs; None for positive charges.
        validation: Presses on which the errors are measured.
        error_unit: Charges by which the errors are divided, shape (n_validation, n_electrode), pC.
    """

    domain: Domain
    electrodes: tuple[str, ...]
    unit_contact: Array
    target: Array
    log_size: Array | None
    validation: LabelledPresses
    error_unit: Array

    @classmethod
    def prepare(
        cls, domain: Domain, electrodes: tuple[str, ...], presses: LabelledPresses, validation: LabelledPresses
    ) -> "_SeriesFitter":
        """Return a fitter with the target values of the series, and with the units in which its errors are measured.

        For positive charges Q, the targets are ln Q, and the errors are relative. For charges of both signs, the
        targets are Q / S. The typical size S of the charges is a fitted function of the force, and `log_size` contains
        its coefficients.

        Args:
            domain: Working area and range of forces of the contacts.
            electrodes: Names of the electrodes, in the order of the charges.
            presses: Presses to which series will be fitted.
            validation: Other presses, on which the errors will be measured.
        """
        unit_contact = domain.to_unit(presses.contact)
        if presses.signed:  # the presses have charges of both signs
            scaled_log_force = unit_contact[:, 2]
            log_size = _fit_log_size(scaled_log_force, presses.charge)
            size, _ = _size_and_slope(log_size, scaled_log_force)
            target = presses.charge / size
            smallest_error_unit = NOISE_CORNER_pC  # otherwise, charges near zero would have large relative errors
        else:
            log_size = None
            target = np.log(presses.charge)
            smallest_error_unit = 0.0
        error_unit = np.hypot(validation.charge, smallest_error_unit)  # |Q| if the smallest unit is zero
        return cls(domain, electrodes, unit_contact, target, log_size, validation, error_unit)

    def fit(self, degree: int, force_degree: int) -> ChargeField | None:
        """Fit a series with the given degrees, and measure its error on the validation presses.

        The fit uses the first presses, at most `ROWS_PER_TERM` for each term of the series.

        Args:
            degree: Largest total degree in x and y.
            force_degree: Largest degree in the logarithm of the force.

        Returns:
            The fitted field with its error; None if there are fewer than `FEWEST_PER_TERM` presses for each term.
        """
        n_term = series_term_count(degree, force_degree)
        if FEWEST_PER_TERM * n_term > len(self.unit_contact):
            return None
        used_rows = slice(0, ROWS_PER_TERM * n_term)
        series = fit_series(self.unit_contact[used_rows], self.target[used_rows], degree, force_degree)
        field = ChargeField(self.domain, self.electrodes, series, np.inf, self.log_size)  # the error is not known yet
        charge_error = field.charges(self.validation.contact) - self.validation.charge
        return replace(field, error=rms(charge_error / self.error_unit))


def _fit_log_size(unit_log_force: Array, charge: Array) -> Array:
    """Fit a polynomial in l, the scaled logarithm of the force, to ln S, the logarithm of the size of the charges.

    For each press, the size S is the root of the sum of the squared charges, but at least `LOWEST_CHARGE`.

    Args:
        unit_log_force: Logarithms l of the forces scaled to [-1, 1], shape (n,).
        charge: Charges, shape (n, n_electrode), pC.

    Returns:
        Coefficients of the Chebyshev polynomials, shape (SIZE_DEGREE + 1,).
    """
    size = np.maximum(np.linalg.norm(charge, axis=1), LOWEST_CHARGE)
    return np.asarray(chebyshev.chebfit(unit_log_force, np.log(size), SIZE_DEGREE))


def _size_and_slope(coefficients: Array, unit_log_force: Array) -> tuple[Array, Array]:
    """Compute the size S of the charges, and the derivative of ln S with respect to l.

    Args:
        coefficients: Coefficients of ln S, as `_fit_log_size` returns them.
        unit_log_force: Logarithms l of the forces scaled to [-1, 1], shape (n,). They are clipped to this interval.

    Returns:
        The size S, pC, and the derivative of ln S, dimensionless, each of shape (n, 1).
    """
    clipped = np.clip(unit_log_force, -1.0, 1.0)[:, None]
    slope = chebyshev.chebval(clipped, chebyshev.chebder(coefficients))
    return np.exp(chebyshev.chebval(clipped, coefficients)), np.asarray(slope)


def series_term_count(degree: int, force_degree: int) -> int:
    """Return the number of terms of a series, from its total degree in x and y and its degree in the force."""
    return (degree + 1) * (degree + 2) // 2 * (force_degree + 1)


def fit_series(unit_contact: Array, target: Array, degree: int, force_degree: int) -> Array:
    """Fit a Chebyshev series in position and force by least squares.

    Let the matrix A have one row for each of n contacts and one column for each term of the series. The coefficients c
    solve the normal equations (A' A + RIDGE n I) c = A' target. The ridge, RIDGE n I, makes the solution unique if the
    contacts do not determine all coefficients.

    Args:
        unit_contact: Contacts in unit coordinates, shape (n, 3).
        target: Values of the series at these contacts, shape (n, k).
        degree: Largest total degree in x and y.
        force_degree: Largest degree in the logarithm of the force.

    Returns:
        Coefficients, shape (degree + 1, degree + 1, force_degree + 1, k).
    """
    n_term = series_term_count(degree, force_degree)
    n_contact = len(unit_contact)
    normal_matrix = RIDGE * n_contact * np.eye(n_term)
    right_side = np.zeros((n_term, target.shape[1]))
    n_chunk = n_contact // CHUNK_SIZE + 1  # chunks limit the memory; "+ 1" rounds up
    for rows in np.array_split(np.arange(n_contact), n_chunk):
        position_terms, force_terms = chebyshev_terms(unit_contact[rows], degree, force_degree)
        # Each column of A is the product of a polynomial in the position and a polynomial in the force.
        chunk_of_a = (position_terms[:, :, None] * force_terms[:, None, :]).reshape(len(rows), -1)
        normal_matrix += chunk_of_a.T @ chunk_of_a
        right_side += chunk_of_a.T @ target[rows]

    # The series also has entries for terms above the total degree, whose coefficients remain zero.
    solution = cho_solve(cho_factor(normal_matrix), right_side)
    series = np.zeros((degree + 1, degree + 1, force_degree + 1, target.shape[1]))
    series[position_degrees(degree)] = solution.reshape(-1, force_degree + 1, target.shape[1])
    return series


MAX_ERROR_OF_CERTAIN_FOLD = 3e-4
"""Largest relative error of the fitted charges at which a fold counts as certain. A poor fit has spurious folds."""

MAX_ERROR_WITHOUT_NOISE = 2e-3
"""Relative error of a fit above which the charges probably have noise."""

CREDIBLE_FOLD_RATIO = 0.95
"""Largest ratio of the radius of a fold to the radius of the domain at which a fold of a poor fit counts as real.

Spurious folds lie near the edge of the domain, because there are presses on only one side of the edge."""

CREDIBLE_FOLD_RATIO_WITH_NOISE = 0.8
"""Ratio that replaces `CREDIBLE_FOLD_RATIO` if the charges have noise, because noise moves spurious folds inwards."""

SEARCHED_RADIUS_RATIO = 0.98
"""Ratio of the radius within which folds are searched for to the radius of the domain.

At the edge of the domain, the presses do not determine the derivatives of the charges accurately."""

N_PAIR_CONTACTS = 400
"""Number of contacts for each of which another contact with the same charges is searched for."""

SMALLEST_SHARE = 0.2
"""Smallest ratio of the radius without folds to the radius of the dataset at which a network can be trained."""


def invertible_domain(
    field: ChargeField, presses: LabelledPresses, noise: NoiseModel
) -> tuple[Domain, tuple[str, ...]]:
    """Return the disk on which a network is trained, and sentences for the user about ambiguous contacts.

    At a fold, the map from contacts to charges turns back, so that contacts on both sides of the fold have the same
    charges. There are three cases:

    - The fit is accurate and shows a fold: the disk is reduced to the radius of the fold, and a sentence states this.
    - The fit is inaccurate, because there are few presses or the charges have noise, and it shows a fold well inside
      the domain: the disk is not reduced, and a sentence states where the map seems to fold.
    - Otherwise, the disk is the domain of the field.

    If the charges have little noise and no uncertain fold was found, distant pairs of contacts with the same charges
    are searched for as well.

    Args:
        field: Charge field that was fitted to the presses.
        presses: Presses to which the field was fitted. A sentence states how many of them lie in the disk.
        noise: Noise of good presses. Charges that differ by less than the noise count as equal.

    Returns:
        The domain, which is the disk with the range of forces, and the sentences.

    Raises:
        DatasetError: If the radius of the disk is less than `SMALLEST_SHARE` of the radius of the field.
    """
    requested_domain = field.domain
    fold_radius = _fold_radius(field, noise)  # infinity without a fold
    has_little_noise = field.error < MAX_ERROR_WITHOUT_NOISE  # the error of the fit includes the noise of the charges

    # An inaccurate fit does not prove a fold, so the fold is only reported, and only if it lies well inside the domain.
    certain_fold_radius = fold_radius
    if field.error > MAX_ERROR_OF_CERTAIN_FOLD:
        credible_ratio = CREDIBLE_FOLD_RATIO if has_little_noise else CREDIBLE_FOLD_RATIO_WITH_NOISE
        if fold_radius < credible_ratio * requested_domain.radius:
            return requested_domain, (_uncertain_fold_caution(fold_radius, requested_domain.radius),)
        certain_fold_radius = np.inf  # a fold near the edge is probably not real

    if certain_fold_radius < SMALLEST_SHARE * requested_domain.radius:
        raise DatasetError(
            f"the map from contacts to charges folds {certain_fold_radius:g} mm from the centre, of "
            f"{requested_domain.radius:g} mm asked for: beyond, two contacts give the same charges; add an "
            "electrode, or take a biaxial film"
        )
    # Reduce the domain to a certain fold, and search for pairs of distant contacts with the same charges.
    domain = requested_domain
    cautions = []
    if certain_fold_radius < requested_domain.radius:
        domain = requested_domain.within(certain_fold_radius)
        cautions.append(_fold_caution(field, presses, certain_fold_radius))
    if has_little_noise:
        searched_field = within(field, SEARCHED_RADIUS_RATIO * domain.radius)  # the field is inaccurate at the edge
        cautions += _pair_cautions(searched_field, noise)
    return domain, tuple(cautions)


def _pair_cautions(searched_map: ChargeMap, noise: NoiseModel) -> list[str]:
    """Return a sentence about pairs of distant contacts with the same charges, if such pairs exist.

    Only contacts with the smallest force of the domain are compared.

    Args:
        searched_map: Map from contacts to charges, in whose domain pairs are searched for.
        noise: Noise of good presses. Charges that differ by less than the noise count as equal.

    Returns:
        A list of one sentence, or an empty list.
    """
    smallest_force, _ = searched_map.domain.force_range
    pairs = find_ambiguous_pairs(searched_map, noise, smallest_force, N_PAIR_CONTACTS)
    if not pairs.summary:
        return []
    # The sentence is continued, so it begins in lower case and has no full stop.
    sentence = pairs.summary[0].lower() + pairs.summary[1:].removesuffix(".")
    return [f"{sentence}; no model tells which of them it is; see 'isocharge simulate identify'"]


def _uncertain_fold_caution(fold_radius: float, requested_radius: float) -> str:
    """Return a sentence about a fold that the fit shows inside the domain but cannot prove.

    Args:
        fold_radius: Distance of the fold from the centre, mm.
        requested_radius: Radius of the domain, mm.
    """
    return (
        f"the map from contacts to charges seems to fold about {fold_radius:.2g} mm from the centre, where two "
        "contacts give the same charges; the presses cannot tell it for certain, and the model is trained "
        f"across it, up to {requested_radius:g} mm; see 'isocharge simulate identify', then ask for a smaller "
        "radius or add an electrode"
    )


def _fold_caution(field: ChargeField, presses: LabelledPresses, fold_radius: float) -> str:
    """Return a sentence that states the radius of a certain fold, to which the domain is reduced.

    For positive charges, the sentence also names the command that tracks contacts beyond the fold.

    Args:
        field: Charge field, whose domain is not reduced yet.
        presses: The presses, some of which lie beyond the fold.
        fold_radius: Distance of the fold from the centre, mm.
    """
    requested_radius = field.domain.radius
    remaining_count = len(presses.within(fold_radius))
    caution = (
        f"the map from contacts to charges folds beyond {fold_radius:g} mm: two contacts give the same charges there; "
        f"the model is trained for {fold_radius:g} mm, not {requested_radius:g} mm, on {remaining_count} of "
        f"{len(presses)} presses"
    )
    if field.positive_series is None:  # some charges are negative
        return caution
    return f"{caution}; 'serve stream --track' follows contacts to {requested_radius:g} mm"


def _fold_radius(field: ChargeField, noise: NoiseModel) -> float:
    """Return the rounded radius of the largest disk without folds, mm, or infinity if the domain has no fold.

    Args:
        field: Charge field in whose domain folds are searched for.
        noise: Noise of good presses.
    """
    area = search_working_area(within(field, SEARCHED_RADIUS_RATIO * field.domain.radius), noise, search_pairs=False)
    if not np.isfinite(area.fold_radius):
        return np.inf
    return float(f"{area.unambiguous_radius:.6g}")
