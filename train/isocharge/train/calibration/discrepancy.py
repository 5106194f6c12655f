"""Discrepancy of a film: a smooth factor on the charges of each electrode that no parameter describes.

A real film has properties that no parameter describes. The effects of these properties are modelled as a Gaussian
process of finite rank for each electrode (Kennedy and O'Hagan 2001). The process is a sum of products of Chebyshev
polynomials in the place and in the logarithm l of the force:

    ln Q_e = ln Q_e(map) + sum c_eijm T_i(x / r) T_j(y / r) T_m(l),    i + j + m <= degree, m <= 2.

The coefficients have the mean zero and the standard deviation s FADING^(i + j + m). Another part of the discrepancy is
the same for all electrodes. This common part is needed because all charges are smaller where a film is stiffer than its
parameters imply. The standard deviation of this part is COMMON times as large. The size s is unknown. The module
`hypotheses` computes the probabilities of several sizes from the presses.
"""

from functools import cache

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_map import Domain

DEGREE = 4
"""Largest total degree of the polynomials."""

FORCE_DEGREE = 2
"""Largest degree of the polynomials in ln F."""

FADING = 0.5
"""Ratio of the standard deviations of terms of successive degrees. It is below 1 because the discrepancy is smooth."""

COMMON = 1.0
"""Standard deviation of the part that all electrodes share, relative to that of the part of each electrode.

Both parts are of similar size in full simulations of imperfect films. The shared part causes errors of the force."""

TRACE_ANGLES = (-45.0, 0.0, 45.0)
"""Directions of the lines along which the trace of an electrode may lie, degrees from the outward direction.

The effect of a trace between these lines is a weighted sum of the effects of the lines. For presses within the working
area, the error of this approximation is below the noise."""


def terms(contact: Array, domain: Domain) -> Array:
    """Compute the polynomials of the discrepancy, each times the standard deviation of its coefficient.

    The discrepancy of a film is a smooth function of the contact that is added to the logarithms of its charges. Its
    terms are the products T_i(x / r) T_j(y / r) T_m(l) of Chebyshev polynomials, where r is the radius of the domain
    and l is the logarithm of the force, scaled to [-1, 1]. The standard deviation of a coefficient is
    FADING^(i + j + m) for a discrepancy of the size 1. For a contact outside the domain, the values at the nearest
    contact of the domain are returned.

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        domain: Domain of the polynomials.

    Returns:
        T_i(x / r) T_j(y / r) T_m(l) FADING^(i + j + m), shape (n, n_term), dimensionless.
    """
    # Scaled contacts in the unit disk times [-1, 1], to which contacts outside the domain are moved.
    unit_contact = domain.to_unit(contact)
    distance = np.hypot(unit_contact[:, 0], unit_contact[:, 1])
    unit_contact[:, :2] /= np.maximum(distance, 1.0)[:, None]  # changes only positions outside the unit disk
    unit_contact[:, 2] = np.clip(unit_contact[:, 2], -1.0, 1.0)

    # Polynomials of all degrees in each coordinate, shape (n, DEGREE + 1), from which those of each term are selected
    x_values, y_values, force_values = (chebyshev.chebvander(column, DEGREE) for column in unit_contact.T)
    degrees = _degrees()
    x_degree, y_degree, force_degree = degrees.T
    fading = FADING ** degrees.sum(axis=1)
    products = x_values[:, x_degree] * y_values[:, y_degree] * force_values[:, force_degree]
    return np.asarray(fading * products)


@cache
def _degrees() -> Integers:
    """Return the degrees of each polynomial in x, y and ln F, shape (n_term, 3)."""
    all_degrees = np.indices((DEGREE + 1, DEGREE + 1, FORCE_DEGREE + 1)).reshape(3, -1).T
    total_degree = all_degrees.sum(axis=1)
    return np.asarray(all_degrees[total_degree <= DEGREE])


def term_count() -> int:
    """Return the number of polynomials of each electrode."""
    return len(_degrees())
