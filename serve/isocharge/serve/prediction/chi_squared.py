"""The chi-squared distribution, without SciPy: how often noise alone gives a larger sum of squares."""

import math

import numpy as np


def chi_squared_survival(statistic: float, degrees: int) -> float:
    """Probability that a chi-squared variable exceeds a value.

    The tail is a finite sum (Abramowitz and Stegun 1964, 26.4.4 and 26.4.5): with x = statistic / 2, and erfc(sqrt(x))
    added for odd degrees,

        sum of x^s exp(-x) / Gamma(s + 1) over s = degrees / 2 - 1, degrees / 2 - 2, ... down to 0 or 1/2.

    Args:
        statistic: Sum of squares, not negative; infinity gives 0.
        degrees: Degrees of freedom, 1 or more.

    Raises:
        ValueError: If an argument is out of its range.
    """
    if degrees < 1 or not statistic >= 0.0:
        raise ValueError(
            f"expected a sum of squares from 0 and 1 degree of freedom or more, got {statistic}, {degrees}"
        )
    x, odd = 0.5 * statistic, degrees % 2
    if x == 0.0 or math.isinf(x):
        return 0.0 if x else 1.0
    first = 0.5 * odd * math.log(4.0 * x / math.pi) - x  # the term of s = 0 or 1/2, of which the others are multiples
    ratios = np.log(x / (np.arange(1, degrees // 2) + 0.5 * odd))
    logarithms = first + np.concatenate([[0.0], np.cumsum(ratios)])[: degrees // 2]
    return min(1.0, odd * math.erfc(math.sqrt(x)) + float(np.exp(logarithms).sum()))
