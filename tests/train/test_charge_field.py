"""The forward map as a series, against the simulator's own charges."""

import numpy as np
import pytest

from isocharge.errors import TrainingError
from isocharge.simulate import noise_model
from isocharge.train.charge_field import ChargeField, Domain

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


def test_the_inverse_steps_to_the_contact(field, film):
    """P (ln Q(c + d) - ln Q(c)) = d for small d, with Q from the simulator, not from the series."""
    contact = presses(200, seed=9) * np.array([0.9, 0.9, 1.0])
    contact[:, 2] = np.clip(contact[:, 2], 0.06, 1.8)
    moved = contact + np.random.default_rng(1).uniform(-1, 1, contact.shape) * np.array([0.02, 0.02, 0.0])
    moved[:, 2] *= 1.002
    difference = np.log(simulated(film, moved) / simulated(film, contact))
    unit = field.domain.to_unit(contact)
    rows = np.stack([chebyshev_value(row, unit) for row in field.coefficients[1:]], axis=1)
    step = np.einsum("nke,ne->nk", rows, difference)
    wanted = field.domain.to_unit(moved) - unit
    assert np.median(np.abs(step - wanted).max(axis=1)) < 0.02 * np.median(np.abs(wanted).max(axis=1))


def chebyshev_value(series, unit):
    """Evaluated by numpy, term by term."""
    return np.stack(
        [np.polynomial.chebyshev.chebval3d(*unit.T, series[..., e]) for e in range(series.shape[-1])], axis=1
    )


def test_a_known_series_is_recovered():
    """Charges made from a polynomial of low degree come back, but for the ridge."""
    domain, rng = Domain(5.0, (0.1, 1.0)), np.random.default_rng(0)

    def charges(contact):
        x, y, force = contact.T
        return (
            np.exp(np.stack([5 + 0.1 * x + 0.02 * x * y, 6 - 0.1 * y + 0.01 * y**3, 5 + 0.05 * x], 1)) * force[:, None]
        )

    def contacts(count):
        return np.stack([rng.uniform(-3.5, 3.5, count), rng.uniform(-3.5, 3.5, count), rng.uniform(0.1, 1, count)], 1)

    train, held = contacts(2000), contacts(100)
    field = ChargeField.fit(domain, train, charges(train), (held, charges(held)), noise_model("reference"))
    assert field.error < 1e-5
    assert np.allclose(field.charge_pC(held), charges(held), rtol=1e-4)


def test_too_few_presses():
    contact, charge = presses(50, seed=0), np.ones((50, 3))
    with pytest.raises(TrainingError, match="expected at least 224 presses"):
        ChargeField.fit(Domain(8.0, FORCES), contact, charge, (contact, charge), noise_model("reference"))
