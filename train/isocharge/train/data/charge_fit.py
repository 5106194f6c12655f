"""Fits of charge series to presses, by linear least squares.

The training uses a `ChargeSeries` in three searches: for the contact whose charges are nearest to given charges, for
folds of the map, and for distant contacts with the same charges. For a dataset with several probes, the series
describes the mean of the charges over the probes.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.polynomial import chebyshev
from scipy.linalg import cho_factor, cho_solve

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import TrainingError
from isocharge.serve.model.charge_series import CHUNK_SIZE, ChargeSeries, chebyshev_terms, position_degrees, series_size
from isocharge.simulate import noise_model
from isocharge.train.data.contact_errors import rms
from isocharge.train.data.presses import LOWEST_CHARGE, LabelledPresses

CANDIDATE_DEGREES: tuple[tuple[int, int], ...] = (
    (6, 1),
    (6, 4),
    (10, 2),
    (10, 4),
    (16, 2),
    (16, 4),
    (24, 2),
    (30, 2),
    (24, 4),
    (36, 2),
)
"""Degrees in the position and in the force that are tried, in this order, for positive charges.

On a slack film, the logarithm of a charge is nearly a linear function of the logarithm of the force. On taut films, the
charges are proportional to the force at small forces, and to its power 2/3 at large forces. This transition needs a
higher degree."""

SIGNED_CANDIDATE_DEGREES: tuple[tuple[int, int], ...] = (
    (6, 1),
    (6, 4),
    (12, 3),
    (16, 4),
    (16, 8),
    (20, 8),
    (24, 6),
    (24, 8),
)
"""Degrees in the position and in the force that are tried, in this order, for charges that are not all positive.

The degrees in the force are higher than for positive charges. Charges of both signs occur on taut films, where a charge
is a power of the force with an exponent that changes with the force. The first steps increase the degree in the
position, for two reasons: charges change more with the position than their logarithms do, and the few presses of a
calibration determine few terms."""

SIZE_DEGREE = 4
"""Degree of the polynomial in the logarithm of the force that approximates the logarithm of the size of the charges."""

REFERENCE_NOISE = noise_model("reference")
"""Noise with which the errors of a series are compared."""

MIN_PRESSES_PER_TERM = 8
"""Smallest number of presses per coefficient. Fewer presses would not determine the slopes near the edge."""

RIDGE = math.sqrt(np.finfo(float).eps)
"""Relative weight of the squared coefficients in the fit (ridge regression): the root of the machine precision.

The ridge is needed because the polynomials are defined on a square, whose corners lie outside the disk and contain no
presses.
"""

SUFFICIENT_ERROR = 1.5e-4
"""Relative rms error of the charges below which no higher degree is tried, about a tenth of the reference noise."""


def fit_charge_series(
    domain: Domain,
    electrodes: tuple[str, ...],
    presses: LabelledPresses,
    validation: LabelledPresses,
    white_pC: float = REFERENCE_NOISE.white,
) -> ChargeSeries:
    """Fit a charge series to presses by least squares, and choose its degrees by the error on other presses.

    Args:
        domain: Working area and range of forces of the contacts.
        electrodes: Names of the electrodes, in the order of the charges.
        presses: Presses to which the series is fitted.
        validation: Other presses, on which the error is measured.
        white_pC: White noise of the charges, pC. If not all charges are positive, it decides which charges count as
            small.

    Returns:
        The series with the smallest error among the degrees that were tried. Its `charge_std` is the root mean square
        of the relative errors on `validation`.

    Raises:
        TrainingError: If there are too few presses for the smallest degrees.
    """
    unit_contact = domain.to_unit(presses.contact)
    if presses.has_nonpositive_charges:
        # The series describes Q / S, where Q is a charge, and S is the typical size of charges at the same force. For
        # charges near zero, errors relative to Q would be too large. The unit of an error therefore does not decrease
        # below white_pC / gain. At this charge, the white noise equals the noise that is proportional to the charge.
        candidate_degrees = SIGNED_CANDIDATE_DEGREES
        size_coefficients = _fit_log_size(unit_contact[:, 2], presses.charge)  # of ln S as a polynomial
        charge_size, _ = series_size(size_coefficients, unit_contact[:, 2])  # S, shape (n, 1), pC
        target = presses.charge / charge_size
        error_unit = np.hypot(validation.charge, white_pC / REFERENCE_NOISE.gain)
    else:
        candidate_degrees = CANDIDATE_DEGREES
        size_coefficients = None
        target = np.log(presses.charge)  # the series describes ln Q
        error_unit = validation.charge

    # Try the degrees until the error is small enough, or the presses are too few for the next degrees.
    # The first degree is the total degree in x and y, and the second is the degree in the logarithm of the force.
    best_series: ChargeSeries | None = None
    for degree, largest_force_degree in candidate_degrees:
        force_degree = determined_degree(unit_contact[:, 2], largest_force_degree)
        min_press_count = MIN_PRESSES_PER_TERM * series_term_count(degree, force_degree)
        if min_press_count > len(presses):
            break
        # [None] adds the axis of the nodes, which are the pretensions of a series. This series has only one.
        coefficients = fit_series(unit_contact, target, degree, force_degree)[None]
        series = ChargeSeries(
            domain=domain, electrodes=electrodes, coefficients=coefficients, log_size=size_coefficients
        )
        error = rms((series.charges(validation.contact) - validation.charge) / error_unit)
        if best_series is None or error < best_series.charge_std:
            best_series = replace(series, charge_std=error)
        if error < SUFFICIENT_ERROR:
            break
    if best_series is None:  # the presses are too few for the first degrees
        raise TrainingError(f"expected at least {min_press_count} presses to fit the charges by, got {len(presses)}")
    return best_series


def fit_film_series(
    domain: Domain, electrodes: tuple[str, ...], contact: Array, node_charge: Array, node_MPa: Array
) -> ChargeSeries:
    """Fit a charge series to the charges of one film at several pretensions, which are the nodes of the series.

    The degrees of the series are the same at all nodes. They are chosen by the error at every tenth contact, which is
    left out of the fit.

    Args:
        domain: Working area and range of forces of the contacts.
        electrodes: Names of the electrodes, in the order of the charges.
        contact: Contacts (x, y, F), shape (n, 3), mm and N, in random order.
        node_charge: Charges of these contacts at each node, shape (n, n_node, n_electrode), pC.
        node_MPa: Changes of the mean pretension at the nodes, shape (n_node,), MPa, ascending and containing 0.

    Raises:
        TrainingError: If there are too few contacts for the smallest degrees.
    """
    # The fit treats the electrodes of all nodes as electrodes of one film.
    presses = LabelledPresses(contact, node_charge.reshape(len(contact), -1))
    names = electrodes * node_MPa.size  # all names are repeated for each node
    is_validation = np.arange(len(contact)) % 10 == 0
    all_nodes = fit_charge_series(domain, names, presses[~is_validation], presses[is_validation])

    # The coefficients have an axis for each of the three degrees, and one for the electrodes of all nodes. Divide the
    # last axis into nodes (axis 3) and electrodes, and make the nodes the first axis.
    (joined,) = all_nodes.coefficients
    *degrees, _ = joined.shape
    by_degree = joined.reshape(*degrees, node_MPa.size, len(electrodes))
    return replace(all_nodes, electrodes=electrodes, coefficients=np.moveaxis(by_degree, 3, 0), node_MPa=node_MPa)


def _fit_log_size(unit_log_force: Array, charge: Array) -> Array:
    """Fit a polynomial in l, the scaled logarithm of the force, to ln S, the logarithm of the size of the charges.

    For each press, the size S is the root of the sum of the squared charges, but at least `LOWEST_CHARGE`. Presses with
    few different forces determine only a polynomial of a lower degree.

    Args:
        unit_log_force: Logarithms l of the forces scaled to [-1, 1], shape (n,).
        charge: Charges, shape (n, n_electrode), pC.

    Returns:
        Coefficients of the Chebyshev polynomials, shape (n,) with n up to SIZE_DEGREE + 1.
    """
    size = np.maximum(np.linalg.norm(charge, axis=1), LOWEST_CHARGE)
    degree = determined_degree(unit_log_force, SIZE_DEGREE)
    return chebyshev.chebfit(unit_log_force, np.log(size), degree)


def determined_degree(coordinate: Array, largest: int) -> int:
    """Return the largest degree of a polynomial that is determined by its values at given coordinates.

    For example, values at or near three coordinates determine a polynomial of degree 2. These values do not determine a
    polynomial of a higher degree between the three coordinates.

    Args:
        coordinate: Coordinates, scaled to [-1, 1], shape (n,).
        largest: Upper bound of the result.
    """
    # A degree counts as determined if the smallest singular value of the matrix of the Chebyshev polynomials up to this
    # degree, divided by the root of n, is at least this number. For evenly distributed coordinates, it is above 0.3.
    min_singular_value = 0.1
    terms = chebyshev.chebvander(coordinate, largest)  # one column for each degree, shape (n, largest + 1)
    moments = terms.T @ terms / len(coordinate)  # its eigenvalues are the squared singular values divided by n
    for degree in range(largest, 0, -1):
        smallest_eigenvalue = np.linalg.eigvalsh(moments[: degree + 1, : degree + 1])[0]
        if smallest_eigenvalue >= min_singular_value**2:
            return degree
    return 0


def series_term_count(degree: int, force_degree: int) -> int:
    """Return the number of terms of a series with a given total degree in x and y, and a given degree in the force."""
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

    # The series also has entries for terms above the total degree, whose coefficients remain zero. The axes of the
    # solution become the term in the position, the degree in the force, and the value. `position_degrees` returns the
    # degree in x and the degree in y of each term in the position, which are its indices in the series.
    solution = cho_solve(cho_factor(normal_matrix), right_side)
    series = np.zeros((degree + 1, degree + 1, force_degree + 1, target.shape[1]))
    series[position_degrees(degree)] = solution.reshape(n_term // (force_degree + 1), force_degree + 1, -1)
    return series
