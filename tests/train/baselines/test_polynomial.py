"""The NumPy polynomial, term by term."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.preprocessing import PolynomialFeatures
from tests.train.baselines.conftest import KnownMap

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


@pytest.mark.parametrize(("electrodes", "degrees"), [(3, {8, 10}), (5, {6}), (7, {4}), (8, {4}), (40, {1})])
def test_many_electrodes_lower_the_degree(task, electrodes, degrees):
    """Eight electrodes without one left no candidate, and the report of the model ended in a traceback."""
    known = KnownMap(electrodes)
    wide = replace(task, train=known.presses(1_000, 1), validation=known.presses(100, 2))
    form = PolynomialRidge(degrees=(8, 10), alphas=(1e-11,)).fit(replace(wide, quick=False))[-1]
    assert form.degree in degrees
    assert f"degree {form.degree} (" in form.choice
    assert np.isfinite(form.predict(wide.validation.charge_pC)).all()
