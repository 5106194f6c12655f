"""Discrepancy of a film: a smooth factor on the charges of each electrode that no parameter describes.

No list of parameters has everything that a real film has. The rest is a Gaussian process for each electrode (Kennedy
and O'Hagan 2001), of finite rank: products of Chebyshev polynomials in the place and the logarithm of the force,

    ln Q_e = ln Q_e(map) + sum c_eijm T_i(x / r) T_j(y / r) T_m(l),    i + j + m <= degree, m <= 2.

The coefficients have the mean zero and the standard deviation s FADING^(i + j + m). All electrodes share a further part
that is COMMON times as large: where a film is stiffer than its parameters say, all charges are smaller. The size s is
unknown; `hypotheses` weighs several sizes by the presses.
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
"""Ratio of the standard deviations of terms of successive degrees: what is unexplained is smooth."""

COMMON = 1.0
"""Ratio of the standard deviation of what electrodes share to that of what each has alone. Of imperfect films, solved
in full, modes leave 0.05 to 0.25 % in common and 0.1 to 0.35 % of the electrodes' own; coats and load cells that are
not straight add to the first. Forces are wrong by what is in common."""

TRACE_ANGLES = (-45.0, 0.0, 45.0)
"""Directions of the lines along which the trace of an electrode may lie, degrees from the outward one: for presses
within the working area a trace in between is a sum of these, to half of the noise."""


def terms(contact: Array, domain: Domain) -> Array:
    """Return the polynomials with their fading at contacts (x, y, F), shape (n, 3): (n, n_term), dimensionless.

    A contact beyond the domain has the values of the nearest contact of the domain.
    """
    unit = domain.to_unit(contact)
    unit[:, :2] /= np.maximum(np.hypot(unit[:, 0], unit[:, 1]), 1.0)[:, None]
    unit[:, 2] = np.clip(unit[:, 2], -1.0, 1.0)
    x_polynomials, y_polynomials, force_polynomials = (chebyshev.chebvander(axis, DEGREE) for axis in unit.T)
    degrees = _degrees()
    x_degree, y_degree, force_degree = degrees.T
    fading = FADING ** degrees.sum(axis=1)
    return np.asarray(
        fading * x_polynomials[:, x_degree] * y_polynomials[:, y_degree] * force_polynomials[:, force_degree]
    )


@cache
def _degrees() -> Integers:
    """Return the degrees in x, y and ln F, shape (n_term, 3)."""
    grid = np.indices((DEGREE + 1, DEGREE + 1, FORCE_DEGREE + 1)).reshape(3, -1).T
    return np.asarray(grid[grid.sum(axis=1) <= DEGREE])


def term_count() -> int:
    """Return the number of polynomials of each electrode."""
    return len(_degrees())
