"""Directions in which a calibrated film is uncertain. A service uses these directions to follow changes of the film.

The directions are written to the file `film_directions.npz`; see `serve.model.film_directions`.

A direction is a linear combination of the unknowns of the film. Let C = R R' be the covariance of the unknowns at a
given pretension. Let M be the derivative of the misfits of touches with respect to the unknowns, in units of the noise.
Each right singular vector of the matrix M R defines one direction. The directions are uncorrelated before any touch,
and their effects on the misfits of touches are orthogonal. Such directions are known as likelihood-informed directions
(Cui et al., 2014). Directions with small singular values are left out, because touches hardly determine them.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.film_directions import FilmDirections
from isocharge.simulate import Domain
from isocharge.train.calibration.result import CalibrationResult
from isocharge.train.data.charge_field import fit_series

DEGREES = ((5, 3), (3, 1), (1, 1))
"""Possible degrees of a series in the position and in ln F.

The first pair for which there are enough contacts is used."""

CONTACTS_PER_TERM = 2.0
"""Smallest ratio of the number of contacts to the number of coefficients of a series."""

LEAST_MISFIT = 0.2
"""Effect of a direction on the misfit below which the direction is left out, in units of the noise.

The effect is the root mean square of the misfit that one standard deviation of the direction causes. Directions with
smaller effects hardly change the contacts that the service estimates."""

MAX_DIRECTIONS = 16
"""Largest number of directions. With more directions, the computation for each touch would take longer."""

LEAST_VARIANCE = 1e-12
"""Largest variance of a combination of unknowns that is treated as zero, relative to the largest variance."""


def film_directions(result: CalibrationResult) -> FilmDirections:
    """Compute the directions in which a calibrated film will be uncertain when it is used.

    A direction is a linear combination of the unknowns of the film, scaled to the standard deviation 1. A misfit is the
    part of measured charges that no contact explains. The direction that causes the largest misfits comes first.
    Directions that cause only small misfits are left out. The directions describe the uncertainty at a given
    pretension, because the service estimates the pretension separately.

    Args:
        result: Result of the calibration of the film.
    """
    problem = result.problem
    sensitivity = result.sensitivity
    estimate = result.posterior.drifted(problem.prior)  # the film may change before it is used
    pretension_index = problem.prior.index("pretension")

    # Covariance C of the unknowns at a given pretension: the covariance of all unknowns minus the part that is due to
    # the pretension. The regression is the change of each unknown per unit change of the pretension.
    covariance = estimate.unknown_covariance
    pretension_variance = covariance[pretension_index, pretension_index]
    pretension_regression = covariance[:, pretension_index] / pretension_variance
    conditional_covariance = covariance - np.outer(pretension_regression, covariance[pretension_index])

    # With a root R of the covariance, C = R R', the unknowns are R times independent variables with the standard
    # deviation 1. Each direction is a unit vector v of these variables, and changes the unknowns by R v.
    root = _covariance_root(conditional_covariance)
    film_unknowns = slice(0, len(covariance))  # the estimate may contain the parameters without the coefficients
    directions = _visible_directions(sensitivity.misfit_jacobian[:, :, film_unknowns], root)
    unknown_changes = directions @ root.T  # shape (n_direction, n_unknown)

    # Change of ln Q by each direction: sum over the unknowns u, for each contact n, direction k and electrode e
    log_charge_jacobian = sensitivity.log_charge_jacobian[:, :, film_unknowns]
    log_changes = np.einsum("neu,ku->nke", log_charge_jacobian, unknown_changes)
    # If the pretension increases by one prior standard deviation, the mean of the unknowns changes by the regression.
    # The pseudoinverse of R converts this change to the independent variables. Its scalar product with a direction is
    # the change of the mean along this direction, shape (n_direction,).
    mean_by_pretension = directions @ np.linalg.pinv(root) @ pretension_regression
    return FilmDirections(
        coefficients=_fitted_series(problem.domain, sensitivity.contact, log_changes),
        radius_mm=problem.domain.radius,
        force_N=problem.domain.force_range,
        by_pretension=mean_by_pretension / problem.prior.std[pretension_index],  # per MPa
    )


def _visible_directions(misfit_jacobian: Array, root: Array) -> Array:
    """Find the combinations of independent variables with the largest effects on the misfits of touches.

    The combinations are the right singular vectors of M R, where M is the misfit Jacobian and R is the root. Their
    effects on the misfits are orthogonal. A combination is left out if its effect on the misfits is below
    `LEAST_MISFIT`.

    Args:
        misfit_jacobian: Derivatives of the misfits of each contact with respect to the unknowns, in units of the noise,
            shape (n, n_electrode, n_unknown).
        root: Derivatives of the unknowns with respect to the independent variables, shape (n_unknown, n_variable).

    Returns:
        The combinations as unit vectors, shape (n_direction, n_variable). The combination with the largest effect comes
        first.
    """
    n_contact, _, n_unknown = misfit_jacobian.shape
    # Derivatives of the misfits with respect to the independent variables, shape (n * n_electrode, n_variable)
    variable_jacobian = misfit_jacobian.reshape(-1, n_unknown) @ root
    _, misfit_norms, combinations = np.linalg.svd(variable_jacobian, full_matrices=False)
    # A singular value is a norm over all contacts: the root mean square misfit of a contact times the square root of
    # the number of contacts.
    is_visible = misfit_norms > LEAST_MISFIT * np.sqrt(n_contact)
    return np.asarray(combinations[is_visible][:MAX_DIRECTIONS])


def _covariance_root(covariance: Array) -> Array:
    """Return a matrix R for which R R' is a given covariance matrix.

    The covariance matrix may be singular. The matrix R has no column for an eigenvector with negligible variance.

    Args:
        covariance: Covariance matrix, shape (n, n).

    Returns:
        Matrix R, shape (n, m) with m <= n.
    """
    variances, eigenvectors = np.linalg.eigh(covariance)  # in ascending order of the variance
    largest_variance = variances[-1]
    is_uncertain = variances > LEAST_VARIANCE * largest_variance
    return np.asarray(eigenvectors[:, is_uncertain] * np.sqrt(variances[is_uncertain]))


def _fitted_series(domain: Domain, contact: Array, log_changes: Array) -> Array:
    """Fit polynomial series in the contact to given changes of the logarithm of the charge Q.

    The number of contacts determines the degrees of the series; see `_series_degrees`.

    Args:
        domain: Range of positions and forces to which the variables of the series are scaled.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        log_changes: Changes of ln Q at the contacts, shape (n, n_direction, n_electrode).

    Returns:
        Coefficients of the series, shape (degree + 1, degree + 1, force_degree + 1, n_direction, n_electrode).
    """
    n_contact, n_direction, n_electrode = log_changes.shape
    degree, force_degree = _series_degrees(n_contact)
    columns = log_changes.reshape(n_contact, -1)  # `fit_series` expects one column for each fitted function
    series = fit_series(domain.to_unit(contact), columns, degree, force_degree)
    return series.reshape(*series.shape[:3], n_direction, n_electrode)


def _series_degrees(n_contact: int) -> tuple[int, int]:
    """Return the first pair of `DEGREES` for which the number of contacts suffices, or the last pair if there is none.

    The number of contacts suffices if it is at least `CONTACTS_PER_TERM` times the number of coefficients.

    Args:
        n_contact: Number of contacts to which the series is fitted.
    """
    for degree, force_degree in DEGREES:
        position_term_count = (degree + 1) * (degree + 2) // 2  # terms in x and y up to this total degree
        term_count = position_term_count * (force_degree + 1)
        if CONTACTS_PER_TERM * term_count <= n_contact:
            return degree, force_degree
    return DEGREES[-1]
