"""The chi-square distribution of the calibration agrees with that of scipy.stats."""

import numpy as np
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from isocharge.train.calibration.chi_square import probability_above, value_exceeded_with


@given(st.floats(0.0, 1e4), st.floats(0.01, 1e3))
def test_probability_above_a_value_is_that_of_scipy_stats(chi2, degrees_of_freedom):
    expected = scipy.stats.chi2.sf(chi2, degrees_of_freedom)
    np.testing.assert_allclose(probability_above(chi2, degrees_of_freedom), expected, rtol=1e-12)


@given(st.floats(1e-12, 0.999), st.floats(1.0, 1e3))
def test_value_that_is_exceeded_with_a_probability_is_that_of_scipy_stats(probability, degrees_of_freedom):
    expected = scipy.stats.chi2.isf(probability, degrees_of_freedom)
    np.testing.assert_allclose(value_exceeded_with(probability, np.array([degrees_of_freedom])), expected, rtol=1e-9)
