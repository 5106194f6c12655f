"""The forward map as a series, against the simulator's own charges."""

import numpy as np
import pytest

from isocharge.common.errors import TrainingError
from isocharge.train.data.charge_field import ChargeField
from isocharge.train.data.domain import ContactDomain

FORCES = (0.05, 2.0)


@pytest.fixture(scope="module")
def field(fit):
    return fit.field


def presses(count, seed):
    rng = np.random.default_rng(seed)
    radius, angle = 8.0 * np.sqrt(rng.uniform(size=count)), rng.uniform(-np.pi, np.pi, count)
    force = np.exp(rng.uniform(*np.log(FORCES), count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), force], axis=1)


def simulated(film, contact):
    return 1e12 * film.forward(1e-3 * contact[:, 0], 1e-3 * contact[:, 1], contact[:, 2])


def test_charges_agree_with_the_simulator(field, film):
    contact = presses(500, seed=8)
    error = np.abs(field.charge_pC(contact) / simulated(film, contact) - 1.0)
    assert np.median(error) < 2e-4
    assert np.sqrt(np.mean(error**2)) < 2.0 * field.error


def test_the_derivatives_are_those_of_the_charges(field):
    unit = np.random.default_rng(3).uniform(-0.6, 0.6, (200, 3))
    derivatives, step = field.log_charge(unit)[:, 1:], 1e-5
    for axis in range(3):
        moved = [field.log_charge(unit + sign * step * np.eye(3)[axis])[:, 0] for sign in (1.0, -1.0)]
        assert np.allclose((moved[0] - moved[1]) / (2.0 * step), derivatives[:, axis], rtol=1e-6, atol=1e-7)


def test_the_series_is_what_numpy_evaluates(field):
    unit = np.random.default_rng(4).uniform(-0.7, 0.7, (50, 3))
    for electrode in range(3):
        wanted = np.polynomial.chebyshev.chebval3d(*unit.T, field.series[..., electrode])
        assert np.allclose(field.log_charge(unit)[:, 0, electrode], wanted, rtol=1e-12)


def test_a_known_series_is_recovered():
    """Charges made from a polynomial of low degree come back, but for the ridge."""
    domain, rng = ContactDomain(5.0, (0.1, 1.0)), np.random.default_rng(0)

    def charges(contact):
        x, y, force = contact.T
        return (
            np.exp(np.stack([5 + 0.1 * x + 0.02 * x * y, 6 - 0.1 * y + 0.01 * y**3, 5 + 0.05 * x], 1)) * force[:, None]
        )

    def contacts(count):
        return np.stack([rng.uniform(-3.5, 3.5, count), rng.uniform(-3.5, 3.5, count), rng.uniform(0.1, 1, count)], 1)

    train, held = contacts(2000), contacts(100)
    field = ChargeField.fit(domain, train, charges(train), (held, charges(held)))
    assert field.error < 1e-5
    assert np.allclose(field.charge_pC(held), charges(held), rtol=1e-4)


def test_too_few_presses():
    contact, charge = presses(50, seed=0), np.ones((50, 3))
    with pytest.raises(TrainingError, match="expected at least 448 presses"):
        ChargeField.fit(ContactDomain(8.0, FORCES), contact, charge, (contact, charge))
