"""Tests of the layout of the unknowns, and of the derivatives with respect to nuisances by finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from tests.train.calibration.conftest import rig

from isocharge.train.calibration.discrepancy import COMMON, term_count
from isocharge.train.calibration.hypotheses import Hypothesis, hypotheses
from isocharge.train.calibration.nuisances import NUISANCES, nuisance_derivatives, without_nuisances
from isocharge.train.calibration.press_data import PressData


def test_the_slices_of_the_layout_hold_every_unknown_once(problem):
    layout = problem.charges.layout
    parts = (layout.parameters, layout.modes, layout.traces, layout.terms, layout.nuisances)
    places = [place for part in parts for place in range(layout.count)[part]]
    assert places == list(range(layout.count))
    assert [layout.parameter(name) for name in problem.prior.names] == places[layout.parameters]
    assert [layout.nuisance(nuisance.name) for nuisance in NUISANCES] == places[layout.nuisances]


def test_a_hypothesis_gives_each_kind_of_unknown_its_variance(problem):
    layout = problem.charges.layout
    stds = tuple(float(number) for number in range(1, len(NUISANCES) + 1))
    covariance = Hypothesis(modes=2.0, discrepancy=0.1, traces=3.0, nuisance_stds=stds).covariance(layout)
    variance = np.diag(covariance)
    assert (variance[layout.parameters] == 0.0).all()
    assert (variance[layout.modes] == 4.0).all()
    assert (variance[layout.traces] == 9.0).all()
    np.testing.assert_allclose(variance[layout.terms], 0.01 * (1.0 + COMMON**2))
    np.testing.assert_array_equal(variance[layout.nuisances], np.square(stds))
    shared = covariance[layout.terms, layout.terms].reshape(term_count(), 4, term_count(), 4)[0, 0, 0, 1:]
    np.testing.assert_allclose(shared, 0.01 * COMMON**2)


def test_the_probabilities_of_all_hypotheses_add_up():
    """The sum is not exactly 1, because modes without a discrepancy are left out and traces are added."""
    assert 0.7 < sum(hypothesis.prior_probability for hypothesis in hypotheses()) < 1.01


@pytest.mark.parametrize("nuisance", NUISANCES, ids=lambda nuisance: nuisance.name)
def test_derivatives_with_respect_to_a_nuisance_are_finite_differences(problem, nuisance):
    parameters, presses = rig(problem, 6, seed=7)
    data = PressData.from_presses(presses, problem.noise, problem.charges.domain)
    friction_charge = np.linspace(-9.0, 9.0, data.charge.size).reshape(data.charge.shape)
    data = replace(data, warming_K=np.linspace(-1.0, 1.0, 6), friction_charge=friction_charge)
    pretension = problem.charges.layout.parameter("pretension")

    def residual(value):
        """Return the residuals at the measured contacts for one value of the nuisance.

        The nuisance may give the film a different pretension during each press.
        """
        values = [value if each is nuisance else 0.0 for each in NUISANCES]
        corrected = without_nuisances(data, values)
        charge = []
        for change, contact in zip(corrected.tension_change, presses.contact, strict=True):
            film = parameters.copy()
            film[pretension] += change
            charge.append(problem.charges.charges(film, contact[None])[0])
        return corrected.residual(np.array(charge), corrected.contact)

    step = 1e-3
    lower = parameters.copy()
    lower[pretension] -= step
    upper = parameters.copy()
    upper[pretension] += step
    charge_change = problem.charges.charges(upper, presses.contact) - problem.charges.charges(lower, presses.contact)
    charge_derivative = data.weight * charge_change / (2.0 * step)
    pretension_derivative = np.column_stack([charge_derivative, np.zeros((6, 3))])

    column = NUISANCES.index(nuisance)
    derivative = nuisance_derivatives(data, pretension_derivative)[:, :, column]
    expected = (residual(step) - residual(-step)) / (2.0 * step)
    np.testing.assert_allclose(derivative, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
