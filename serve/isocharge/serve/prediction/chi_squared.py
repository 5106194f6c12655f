"""The chi-squared distribution, without SciPy: how often noise alone gives a larger sum of squares."""

import math

TOLERANCE = 1e-15
"""Relative size of the last term of the series or fraction."""

MOST_TERMS = 1_000_000
"""Terms needed near the mean grow with the root of the degrees of freedom: this is far beyond 1e9 of them."""


def chi_squared_survival(statistic: float, degrees: int) -> float:
    """Probability that a chi-squared variable exceeds a value: the regularised upper incomplete gamma function.

    Q(a, x) with a = degrees / 2 and x = statistic / 2, by its series below a + 1 and by Lentz's continued fraction
    above (Press et al., Numerical Recipes, 3rd edition, section 6.2).

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
    a, x = 0.5 * degrees, 0.5 * statistic
    if x == 0.0 or math.isinf(x):
        return 0.0 if x else 1.0
    logarithm = a * math.log(x) - x - math.lgamma(a)
    if logarithm < -750.0:  # smaller than the smallest float, on the side where x lies
        return 0.0 if x > a else 1.0
    scale = math.exp(logarithm)
    return 1.0 - scale * _series(a, x) if x < a + 1.0 else scale * _fraction(a, x)


def _series(a: float, x: float) -> float:
    """Sum of x^n / (a (a + 1) ... (a + n)) over n from 0."""
    term = total = 1.0 / a
    for n in range(1, MOST_TERMS):
        term *= x / (a + n)
        total += term
        if term < TOLERANCE * total:
            break
    return total


def _fraction(a: float, x: float) -> float:
    """1 / (x + 1 - a - 1 (1 - a) / (x + 3 - a - 2 (2 - a) / (x + 5 - a - ...)))."""
    b = x + 1.0 - a
    c, d = math.inf, 1.0 / b
    value = d
    for n in range(1, MOST_TERMS):
        numerator, b = n * (a - n), b + 2.0
        d, c = 1.0 / (b + numerator * d), b + numerator / c
        value *= c * d
        if abs(c * d - 1.0) < TOLERANCE:
            break
    return value
