"""Directions in which a calibrated film remains uncertain, for a service that follows the film.

The result is written as `film_directions.npz`; see `serve.model.film_directions`.

At a given pretension, the other unknowns of a film have the covariance C = R R'. Let M be the derivative of the misfit
vectors with respect to the unknowns, in units of the noise. The right singular vectors of M R are combinations of the
unknowns. These combinations are independent before any touch, and their effects on the misfits of touches are
orthogonal. The combinations are known as likelihood-informed directions (Cui et al., 2014). Touches hardly identify a
combination with a small singular value. Such a combination is left out.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.film_directions import FilmDirections
from isocharge.simulate import Domain
from isocharge.train.calibration.contact_error import spread_contacts
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.data.charge_field import fit_series

DEGREES = ((5, 3), (3, 1), (1, 1))
"""Degrees of the series in the position and in ln F. The first pair for which there are enough contacts is used."""

CONTACTS_PER_TERM = 2.0
"""Least number of contacts for each coefficient of a series."""

LEAST_MISFIT = 0.2
"""Effect of a direction on the misfit below which the direction is left out, in units of the noise.

The effect is the root mean square of the misfit that one standard deviation of the direction causes. More directions
hardly change the followed contacts."""

N_CHARGE_CONTACTS = 1200
"""Number of contacts to which the series of ln Q of the calibrated film is fitted."""

CHARGE_DEGREES = (12, 3)
"""Degrees of this series in the position and in ln F. The derivatives of the series are used as well."""

MAX_DIRECTIONS = 16
"""Largest number of directions. A larger number would increase the time that a touch takes."""

LEAST_VARIANCE = 1e-12
"""Variance of a combination of unknowns, relative to the largest one, below which it counts as known exactly."""


def film_directions(result: CalibrationResult) -> FilmDirections:
    """Compute the directions in which a calibrated film is uncertain when it is used.

    A direction is a combination of the unknowns of the film, with a standard deviation of 1. The directions are sorted
    by the misfit that they cause, and directions that cause only a small misfit are left out. The directions are
    uncorrelated with the pretension, because the service estimates the pretension separately.

    Args:
        result: The calibration of the film.
    """
    problem = result.problem
    sensitivity = result.sensitivity
    estimate = result.posterior.drifted(problem.prior)  # the film changes until it is used
    pretension = problem.prior.index("pretension")

    # Covariance C of the unknowns at a given pretension: that of all unknowns less the part due to the pretension. The
    # root R, with C = R R', expresses the unknowns by independent variables with a standard deviation of 1.
    covariance = estimate.unknown_covariance
    by_pretension = covariance[:, pretension] / covariance[pretension, pretension]  # regression on the pretension
    root = _covariance_root(covariance - np.outer(by_pretension, covariance[pretension]))

    # Each direction is a unit vector of these variables. The unknowns change by the root times this vector.
    unknowns = slice(0, len(covariance))
    directions = _visible_directions(sensitivity.misfit_jacobian[:, :, unknowns], root)
    unknown_changes = directions @ root.T  # shape (n_direction, n_unknown)

    # Sum over the unknowns u, for each contact n, direction k and electrode e
    log_changes = np.einsum("neu,ku->nke", sensitivity.log_charge_jacobian[:, :, unknowns], unknown_changes)
    # Mean of each direction after a change of the pretension, with which the unknowns are correlated
    mean_by_pretension = directions @ np.linalg.pinv(root) @ by_pretension
    return FilmDirections(
        coefficients=_fitted_series(problem.domain, sensitivity.contact, log_changes),
        radius_mm=problem.domain.radius,
        force_N=problem.domain.force_range,
        by_pretension=mean_by_pretension / problem.prior.std[pretension],
        log_charge_coefficients=_fitted_log_charge(result),
    )


def _fitted_log_charge(result: CalibrationResult) -> Array | None:
    """Fit a series to ln Q of the calibrated film.

    Args:
        result: The calibration of the film.

    Returns:
        Coefficients of the series, shape (degree + 1, degree + 1, force_degree + 1, n_electrode). None if the film has
        charges of both signs, which have no logarithm.
    """
    problem = result.problem
    contact = spread_contacts(problem.domain, N_CHARGE_CONTACTS)
    charge = problem.charges.charges(result.posterior.unknowns, contact)
    if charge.min() <= 0.0:
        return None
    degree, force_degree = CHARGE_DEGREES
    return fit_series(problem.domain.to_unit(contact), np.log(charge), degree, force_degree)


def _visible_directions(misfit_jacobian: Array, root: Array) -> Array:
    """Find the combinations of independent variables that change the misfits of touches most.

    The combinations are the right singular vectors of M R, where M is the misfit Jacobian and R is the root. Their
    effects on the misfits are orthogonal. Combinations with an effect below `LEAST_MISFIT` are left out.

    Args:
        misfit_jacobian: Derivatives of the misfits of each contact with respect to the unknowns, in units of the noise,
            shape (n, n_electrode, n_unknown).
        root: Derivatives of the unknowns with respect to the independent variables, shape (n_unknown, n_variable).

    Returns:
        Unit vectors, the largest misfit first, shape (n_direction, n_variable).
    """
    n_contact, _, n_unknown = misfit_jacobian.shape
    misfit_of_root = misfit_jacobian.reshape(-1, n_unknown) @ root  # one row for each misfit of each contact
    _, misfit_norms, combinations = np.linalg.svd(misfit_of_root, full_matrices=False)
    # A norm over all contacts is the root mean square misfit of a contact times the root of their number.
    is_visible = misfit_norms > LEAST_MISFIT * np.sqrt(n_contact)
    return np.asarray(combinations[is_visible][:MAX_DIRECTIONS])


def _covariance_root(covariance: Array) -> Array:
    """Return a matrix R, shape (n, m) with m <= n, whose product R R' is a covariance that may be singular."""
    variances, axes = np.linalg.eigh(covariance)
    is_uncertain = variances > LEAST_VARIANCE * variances[-1]
    return np.asarray(axes[:, is_uncertain] * np.sqrt(variances[is_uncertain]))


def _fitted_series(domain: Domain, contact: Array, log_changes: Array) -> Array:
    """Fit the series of `FilmDirections` to changes of ln Q.

    The series has the highest degrees of `DEGREES` for which there are enough contacts. If there are too few contacts
    for all of them, it has the last degrees.

    Args:
        domain: Domain of the series.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        log_changes: Changes of ln Q at the contacts, shape (n, n_direction, n_electrode).

    Returns:
        Coefficients of the series, shape (degree + 1, degree + 1, force_degree + 1, n_direction, n_electrode).
    """
    n_contact, n_direction, n_electrode = log_changes.shape
    for degree, force_degree in DEGREES:
        position_term_count = (degree + 1) * (degree + 2) // 2
        term_count = position_term_count * (force_degree + 1)
        if CONTACTS_PER_TERM * term_count <= n_contact:
            break
    columns = log_changes.reshape(n_contact, -1)  # `fit_series` expects one column for each fitted function
    series = fit_series(domain.to_unit(contact), columns, degree, force_degree)
    return series.reshape(*series.shape[:3], n_direction, n_electrode)
