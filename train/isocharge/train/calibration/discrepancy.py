"""Discrepancy of a film: smooth differences between the real charges and those of the film with its best properties.

A real film has features that no property describes. For each electrode, a Gaussian process of finite rank models their
effects (Kennedy and O'Hagan 2001). The relative change of the charge of the electrode e is

    sum c_eijm T_i(x / r) T_j(y / r) T_m(l),    i + j + m <= DEGREE, m <= FORCE_DEGREE,

with Chebyshev polynomials T, the radius r of the domain, and the logarithm l of the force, scaled to [-1, 1]. The prior
standard deviation of c_eijm is s FADING^(i + j + m), where s is the size of the discrepancy. A part of the coefficients
is the same for all electrodes, because all charges are smaller where a film is stiffer than its properties imply.
"""

from functools import cache

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers
from isocharge.simulate import Domain

DEGREE = 4
"""Largest total degree of a term in x, y and ln F."""

FORCE_DEGREE = 2
"""Largest degree of a term in ln F."""

FADING = 0.5
"""Factor by which the standard deviation of a coefficient decreases if its total degree increases by one."""


def terms(contact: Array, domain: Domain) -> Array:
    """Compute the terms of the discrepancy, each multiplied by FADING^(i + j + m).

    For a contact outside the domain, the values at the nearest contact of the domain are returned.

    Args:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        domain: Range of positions and forces to which the variables of the polynomials are scaled.

    Returns:
        Values of the terms, shape (n, n_term), dimensionless.
    """
    unit_contact = domain.to_unit(contact)
    distance = np.hypot(unit_contact[:, 0], unit_contact[:, 1])
    unit_contact[:, :2] /= np.maximum(distance, 1.0)[:, None]  # changes only positions outside the unit disk
    unit_contact[:, 2] = np.clip(unit_contact[:, 2], -1.0, 1.0)
    x_values, y_values, force_values = (chebyshev.chebvander(coordinate, DEGREE) for coordinate in unit_contact.T)
    degrees = _degrees()
    x_degree, y_degree, force_degree = degrees.T
    products = x_values[:, x_degree] * y_values[:, y_degree] * force_values[:, force_degree]
    return np.asarray(FADING ** degrees.sum(axis=1) * products)


@cache
def _degrees() -> Integers:
    """Return the degrees in x, y and ln F of each term, shape (n_term, 3)."""
    all_degrees = np.indices((DEGREE + 1, DEGREE + 1, FORCE_DEGREE + 1)).reshape(3, -1).T
    return np.asarray(all_degrees[all_degrees.sum(axis=1) <= DEGREE])


def term_names() -> list[str]:
    """Return the name of each term, which consists of its degrees in x, y and ln F."""
    return ["".join(map(str, degrees)) for degrees in _degrees().tolist()]


def unit_covariance(n_electrode: int) -> Array:
    """Return the prior covariance of the coefficients for a discrepancy of the size 1.

    The factors FADING^(i + j + m) belong to `terms`. The coefficients of a term are correlated between electrodes.

    Returns:
        Covariance, shape (n_term * n_electrode, n_term * n_electrode). The index of the electrode changes fastest.
    """
    between_electrodes = np.eye(n_electrode) + np.ones((n_electrode, n_electrode))
    return np.asarray(np.kron(np.eye(len(_degrees())), between_electrodes), dtype=float)
