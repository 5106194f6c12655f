"""The chi-squared distribution beside SciPy's."""

import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import gammaincc

from isocharge.serve.prediction.chi_squared import chi_squared_survival


@given(degrees=st.integers(1, 2000), sigmas=st.floats(-4.0, 20.0))
@example(degrees=1, sigmas=-0.7)
@example(degrees=2, sigmas=0.0)
@example(degrees=3_000_000, sigmas=2.0)
@settings(derandomize=True, deadline=None)
def test_as_scipy_has_it(degrees, sigmas):
    statistic = max(0.0, degrees + sigmas * math.sqrt(2.0 * degrees))
    expected = gammaincc(0.5 * degrees, 0.5 * statistic)
    assert chi_squared_survival(statistic, degrees) == pytest.approx(expected, rel=1e-6 if degrees > 2000 else 1e-11)


@pytest.mark.parametrize(("statistic", "expected"), [(0.0, 1.0), (math.inf, 0.0), (1e300, 0.0), (1e-320, 1.0)])
def test_ends(statistic, expected):
    assert chi_squared_survival(statistic, 3) == expected


@pytest.mark.parametrize(("statistic", "degrees"), [(-1.0, 3), (math.nan, 3), (1.0, 0)])
def test_arguments_out_of_range(statistic, degrees):
    with pytest.raises(ValueError, match="expected a sum of squares from 0 and 1 degree of freedom or more"):
        chi_squared_survival(statistic, degrees)
