"""The forward map as a series, against the simulator's own charges."""

import numpy as np
import pytest

from isocharge.common.errors import TrainingError
from isocharge.simulate import Domain
from isocharge.simulate.forward.charge_map import differences
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.presses import LabelledPresses, draw_contacts

DOMAIN = Domain(8.0, (0.05, 2.0))


def test_charges_agree_with_the_simulator(trained, film):
    field, contact = trained.split.field, draw_contacts(np.random.default_rng(8), DOMAIN, 500)
    error = np.abs(field.charges(contact) / film.charges(contact) - 1.0)
    assert np.median(error) < 2e-4
    assert np.sqrt(np.mean(error**2)) < 2.0 * field.error


def test_the_derivatives_are_those_of_the_charges(trained):
    field, inner = trained.split.field, Domain(7.0, (0.06, 1.9))  # the series ends at its domain's ends
    contact = draw_contacts(np.random.default_rng(3), inner, 200)
    expected = differences(field.charges, contact, steps=(1e-3, 1e-3, 1e-4))
    assert np.allclose(field.derivatives(contact), expected, rtol=1e-4, atol=1e-2)


def test_the_series_is_what_numpy_evaluates(trained):
    unit = np.random.default_rng(4).uniform(-0.7, 0.7, (50, 3))
    for electrode in range(3):
        expected = np.polynomial.chebyshev.chebval3d(*unit.T, trained.split.field.series[..., electrode])
        assert np.allclose(trained.split.field.log_charge(unit)[:, 0, electrode], expected, rtol=1e-12)


def test_a_known_series_is_recovered():
    """Charges made from a polynomial of low degree come back, but for the ridge."""
    rng = np.random.default_rng(0)

    def presses(count):
        x, y, force = rng.uniform(-3.5, 3.5, count), rng.uniform(-3.5, 3.5, count), rng.uniform(0.1, 1, count)
        logs = np.stack([5 + 0.1 * x + 0.02 * x * y, 6 - 0.1 * y + 0.01 * y**3, 5 + 0.05 * x], 1)
        return LabelledPresses(np.stack([x, y, force], 1), np.exp(logs) * force[:, None])

    held = presses(100)
    field = ChargeField.fit(Domain(5.0, (0.1, 1.0)), ("A", "B", "C"), presses(2000), held)
    assert field.error < 1e-5
    assert np.allclose(field.charges(held.contact), held.charge, rtol=1e-4)


def test_too_few_presses():
    few = LabelledPresses(draw_contacts(np.random.default_rng(0), DOMAIN, 50), np.ones((50, 3)))
    with pytest.raises(TrainingError, match="expected at least 448 presses"):
        ChargeField.fit(DOMAIN, ("A", "B", "C"), few, few)
