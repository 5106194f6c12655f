"""The chi-squared distribution beside SciPy's."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.special import gammaincc

from isocharge.serve.prediction.chi_squared import chi_squared_survival


@given(degrees=st.integers(1, 3_000_000), ratio=st.floats(0.0, 5.0))
@example(degrees=1, ratio=1e-12)
@example(degrees=3_000_000, ratio=1.0)
@example(degrees=3_000_000, ratio=1.0 + 2e-6)
@example(degrees=2, ratio=1.0)
@settings(derandomize=True, max_examples=300, deadline=None)
def test_as_scipy_has_it(degrees, ratio):
    ours, theirs = chi_squared_survival(ratio * degrees, degrees), gammaincc(0.5 * degrees, 0.5 * ratio * degrees)
    tolerance = 1e-12 if degrees < 1000 else 1e-8  # of the exponential of numbers of the size of the degrees
    assert ours == pytest.approx(theirs, rel=tolerance, abs=1e-300)


@given(degrees=st.integers(1, 2000), sigmas=st.floats(-4.0, 8.0))
@settings(derandomize=True, deadline=None)
def test_as_scipy_has_it_about_the_mean(degrees, sigmas):
    statistic = max(0.0, degrees + sigmas * math.sqrt(2.0 * degrees))
    expected = gammaincc(0.5 * degrees, 0.5 * statistic)
    assert chi_squared_survival(statistic, degrees) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize(("statistic", "expected"), [(0.0, 1.0), (math.inf, 0.0), (1e300, 0.0), (1e-320, 1.0)])
def test_ends(statistic, expected):
    assert chi_squared_survival(statistic, 3) == expected


def test_two_degrees_are_an_exponential():
    for statistic in np.geomspace(1e-6, 1400.0, 50):
        assert chi_squared_survival(statistic, 2) == pytest.approx(math.exp(-0.5 * statistic), rel=1e-12)


@pytest.mark.parametrize(("statistic", "degrees"), [(-1.0, 3), (math.nan, 3), (1.0, 0)])
def test_arguments_out_of_range(statistic, degrees):
    with pytest.raises(ValueError, match="expected a sum of squares from 0 and 1 degree of freedom or more"):
        chi_squared_survival(statistic, degrees)
