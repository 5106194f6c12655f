"""Discrepancy of a film: smooth differences between the real charges and the charges that the parameters imply.

A real film has properties that no parameter describes. For each electrode, a Gaussian process of finite rank models the
effects of such properties on the charges (Kennedy and O'Hagan 2001). The process is a sum of products of Chebyshev
polynomials T, which is added to the logarithm of the charge Q_e of the electrode e:

    ln Q_e = ln Q_e(map) + sum c_eijm T_i(x / r) T_j(y / r) T_m(l),    i + j + m <= DEGREE, m <= FORCE_DEGREE.

Here (x, y) is the position, r is the radius of the domain, and l is the logarithm of the force, scaled to [-1, 1]. The
coefficient c_eijm has the prior mean zero and the prior standard deviation s FADING^(i + j + m), where s is the size of
the discrepancy. The module `hypotheses` considers several sizes of the discrepancy, and computes their probabilities
from the presses.

A further part of the discrepancy is the same for all electrodes. This common part is needed, for example, because all
charges are smaller where a film is stiffer than its parameters imply. The standard deviation of the common part is
`COMMON` times the standard deviation of the part of each electrode.
"""

from functools import cache

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_map import Domain

DEGREE = 4
"""Largest total degree of a term in x, y and ln F."""

FORCE_DEGREE = 2
"""Largest degree of a term in ln F."""

FADING = 0.5
"""Factor by which the prior standard deviation of a coefficient decreases if its total degree increases by one.

The factor is below 1, because the discrepancy is smooth."""

COMMON = 1.0
"""Standard deviation of the common part of the discrepancy, relative to that of the part of each electrode.

Both parts have a similar size in full simulations of imperfect films. The common part causes errors of the force."""

TRACE_ANGLES = (-45.0, 0.0, 45.0)
"""Directions of the lines along which the trace of an electrode may lie, in degrees.

The direction 0 leads straight away from the centre of the film.

The effect of a trace between these lines is a weighted sum of the effects of the lines. For presses within the working
area, the error of this approximation is below the noise."""


def terms(contact: Array, domain: Domain) -> Array:
    """Compute the terms of the discrepancy. A weighted sum of these terms is added to the logarithm of a charge.

    Each term is the product T_i(x / r) T_j(y / r) T_m(l) FADING^(i + j + m). Here T is a Chebyshev polynomial, r is the
    radius of the domain, and l is the logarithm of the force, scaled to [-1, 1]. The factor FADING^(i + j + m) is the
    prior standard deviation of the coefficient of T_i T_j T_m for a discrepancy of the size 1. For a contact outside
    the domain, the values at the nearest contact of the domain are returned.

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        domain: Range of positions and forces to which the variables of the polynomials are scaled.

    Returns:
        Values of the terms, shape (n, n_term), dimensionless.
    """
    # Scale the contacts. A contact outside the domain is moved to the nearest contact of the domain, whose scaled
    # position lies in the unit disk and whose scaled ln F lies in [-1, 1].
    unit_contact = domain.to_unit(contact)
    distance = np.hypot(unit_contact[:, 0], unit_contact[:, 1])
    unit_contact[:, :2] /= np.maximum(distance, 1.0)[:, None]  # changes only positions outside the unit disk
    unit_contact[:, 2] = np.clip(unit_contact[:, 2], -1.0, 1.0)

    # Values of the polynomials T_0 to T_DEGREE in each coordinate, shape (n, DEGREE + 1). For each term, the columns
    # with its degrees are then selected and multiplied, shape (n, n_term).
    x_values, y_values, force_values = (chebyshev.chebvander(coordinate, DEGREE) for coordinate in unit_contact.T)
    degrees = _degrees()
    x_degree, y_degree, force_degree = degrees.T
    fading = FADING ** degrees.sum(axis=1)
    products = x_values[:, x_degree] * y_values[:, y_degree] * force_values[:, force_degree]
    return np.asarray(fading * products)


@cache
def _degrees() -> Integers:
    """Return the degrees in x, y and ln F of each term, shape (n_term, 3)."""
    # All combinations of degrees, of which those with a small total degree are selected
    all_degrees = np.indices((DEGREE + 1, DEGREE + 1, FORCE_DEGREE + 1)).reshape(3, -1).T
    total_degree = all_degrees.sum(axis=1)
    return np.asarray(all_degrees[total_degree <= DEGREE])


def term_count() -> int:
    """Return the number of terms in the discrepancy of each electrode."""
    return len(_degrees())
