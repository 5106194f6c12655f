"""The NumPy polynomial, term by term."""

import numpy as np
import pytest
from sklearn.preprocessing import PolynomialFeatures

from isocharge.train.baselines import PolynomialRidge
from isocharge.train.baselines.polynomial import lower_monomials, monomials


@pytest.mark.parametrize(("variables", "degree"), [(3, 5), (4, 3), (2, 7)])
def test_the_recipe_makes_scikit_learns_monomials(variables, degree):
    values = np.random.default_rng(0).normal(size=(10, variables))
    expected = PolynomialFeatures(degree).fit_transform(values)
    terms = np.ones((expected.shape[1], 10))
    for number, parent, factor in lower_monomials(variables, degree):
        assert parent < number
        terms[number] = terms[parent] * values[:, factor]
    np.testing.assert_allclose(terms.T, expected)
    np.testing.assert_array_equal(monomials(variables, degree).sum(axis=1) <= degree, True)


def test_nothing_explodes_outside_of_the_features(task):
    form = PolynomialRidge().fit(task)[-1]
    n_electrode = task.train.charge_pC.shape[1]
    for charge in (np.zeros((1, n_electrode)), np.full((1, n_electrode), -5.0), np.full((1, n_electrode), 1e9)):
        assert np.isfinite(form.predict(charge)).all()
