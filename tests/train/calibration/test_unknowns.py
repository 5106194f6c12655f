"""The layout of the unknowns, and what nuisances do to presses, against differences of the residuals."""

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
    """The modes alone, without a discrepancy, are left out, and traces come on top."""
    assert 0.7 < sum(hypothesis.prior_probability for hypothesis in hypotheses()) < 1.01


@pytest.mark.parametrize("nuisance", NUISANCES, ids=lambda nuisance: nuisance.name)
def test_derivatives_of_the_residual_by_a_nuisance_are_its_differences(problem, nuisance):
    """On one film, whose pretension changes the residual by known slopes."""
    parameters, presses = rig(problem, 6, seed=7)
    data = PressData.of(presses, problem.noise, problem.charges.domain)
    data = data[np.arange(6)]
    data.warming_K[:] = np.linspace(-1.0, 1.0, 6)
    pretension = problem.charges.layout.parameter("pretension")

    def residual(value):
        """The residual at the stated contacts, each press on a film of its own pretension."""
        values = [value if each is nuisance else 0.0 for each in NUISANCES]
        corrected = without_nuisances(data, values)
        charge = []
        for change, contact in zip(corrected.tension_change, presses.contact, strict=True):
            film = parameters.copy()
            film[pretension] += change
            charge.append(problem.charges.charges(film, contact[None])[0])
        return corrected.residual(np.array(charge), corrected.contact)

    def by_pretension(step=1e-3):
        films = parameters + np.zeros((2, 1))
        films[:, pretension] += [-step, step]
        charge = [problem.charges.charges(film, presses.contact) for film in films]
        rows = data.weight * (charge[1] - charge[0]) / (2.0 * step)
        return np.column_stack([rows, np.zeros((6, 3))])

    step = 1e-3
    expected = (residual(step) - residual(-step)) / (2.0 * step)
    column = [each is nuisance for each in NUISANCES].index(True)
    derivative = nuisance_derivatives(data, by_pretension())[:, :, column]
    np.testing.assert_allclose(derivative, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
