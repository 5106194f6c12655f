"""What a film's parameters leave unexplained of its charges: smooth over the film, as large as the presses say.

No list of parameters has all that a real film has. The rest is a Gaussian process for each electrode (Kennedy and
O'Hagan 2001), of finite rank: products of Chebyshev polynomials in place and logarithm of the force,

    ln Q_e = ln Q_e(map) + sum c_eijm T_i(x / r) T_j(y / r) T_m(l),    i + j + m <= degree, m <= 2,

whose coefficients have mean zero and the standard deviation s FADING^(i + j + m), and besides a part that all
electrodes share, COMMON times as large: where a film is stiffer than its parameters say, all charges are smaller. The
size s is not known. Neither is whether the whole session had a common offset of the charges (a bad tare), charges that
drifted, or charges and forces that were not read together (a leak between them, a load cell that lags). Every
combination is a hypothesis, and so are traces that are not described, in a session without any of these; the presses
weigh them by how well each predicts them (the evidence of a linear Gaussian model, MacKay 1992), and what is known is
the mixture.
"""

from functools import cache

import numpy as np
from numpy.polynomial import chebyshev

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.forward.charge_map import Domain

DEGREE, FORCE_DEGREE = 4, 2
"""Largest degree of the polynomials in all, and in ln F."""

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
    """Values of the polynomials with their fading at contacts (x, y, F), shape (n, 3): (n, n_term), dimensionless.

    Beyond the domain they are those of its nearest contact.
    """
    unit = domain.to_unit(contact)
    unit[:, :2] /= np.maximum(np.hypot(unit[:, 0], unit[:, 1]), 1.0)[:, None]
    unit[:, 2] = np.clip(unit[:, 2], -1.0, 1.0)
    values = [chebyshev.chebvander(unit[:, axis], DEGREE) for axis in range(3)]
    of = _degrees()
    faded = FADING ** of.sum(axis=1)
    return np.asarray(faded * values[0][:, of[:, 0]] * values[1][:, of[:, 1]] * values[2][:, of[:, 2]])


@cache
def _degrees() -> Integers:
    """Degrees in x, y and ln F, shape (n_term, 3)."""
    grid = np.indices((DEGREE + 1, DEGREE + 1, FORCE_DEGREE + 1)).reshape(3, -1).T
    return np.asarray(grid[grid.sum(axis=1) <= DEGREE])


def term_count() -> int:
    """Number of polynomials of each electrode."""
    return len(_degrees())
