"""The nearest known contact, against brute force with scipy's constrained minimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize

from isocharge.simulate import noise_model
from isocharge.simulate.numerics.disk_least_squares import into_domain
from isocharge.train.data.nearest_contact import nearest_in_field, search_field

NOISE = noise_model("reference")
FAULTS = {
    "noisy": lambda charge, rng: 1e12 * NOISE.add(1e-12 * charge, rng),
    "wrong gain": lambda charge, _: charge * [1.0, 1.3, 1.0],
    "far too hard": lambda charge, _: 4.0 * charge,
    "dead electrode": lambda charge, _: np.maximum(charge * [1.0, 0.0, 1.0], 1.0),
    "anything": lambda charge, rng: 10.0 ** rng.uniform(0.0, 4.0, charge.shape),
}


def by_scipy(field, charge, start):
    """min over the domain of |(Q - Q(c)) / sigma|, the disk and the range of forces as constraints."""
    sigma = np.hypot(1.0, 0.002 * charge)

    def square(unit):
        return float((((charge - np.exp(field.log_charge(unit[None])[0, 0])) / sigma) ** 2).sum())

    inside = {"type": "ineq", "fun": lambda unit: 1.0 - unit[0] ** 2 - unit[1] ** 2}
    bounds = [(-1, 1), (-1, 1), (-1, 1)]
    found = minimize(square, start, bounds=bounds, constraints=inside, options={"ftol": 1e-12})
    return np.sqrt(square(into_domain(found.x[None])[0]))  # it may end a little outside


@pytest.mark.parametrize("fault", FAULTS)
def test_nobody_finds_a_nearer_one(fit, fault):
    rng = np.random.default_rng(1)
    charge = FAULTS[fault](fit.held.charge_pC[:12], rng)
    unit, miss = search_field(fit.field, charge, NOISE, starts=3)
    found = np.linalg.norm(miss, axis=1)
    for row in range(len(charge)):
        starts = [unit[row], *into_domain(rng.uniform(-0.7, 0.7, (3, 3)))]
        best = min(by_scipy(fit.field, charge[row], start) for start in starts)
        assert found[row] <= best + 0.01 + 1e-3 * best


def test_the_miss_is_that_of_the_contact(fit):
    charge = 1.1 * fit.held.charge_pC[:50]
    unit, miss = search_field(fit.field, charge, NOISE)
    known = np.exp(fit.field.log_charge(unit)[:, 0])
    assert np.allclose(miss, (charge - known) / np.hypot(1.0, 0.002 * charge), rtol=1e-9, atol=1e-9)
    assert np.all(np.hypot(unit[:, 0], unit[:, 1]) <= 1.0 + 1e-12)
    assert np.all(np.abs(unit[:, 2]) <= 1.0)


def test_a_clean_press_is_found_where_it_was(fit):
    start = fit.network.domain.to_unit(fit.held.contact)
    charge = np.exp(fit.field.log_charge(start)[:, 0])
    moved = start + np.random.default_rng(0).uniform(-0.1, 0.1, start.shape)
    unit, miss = nearest_in_field(fit.field, charge, NOISE, moved)
    assert np.abs(unit - start).max() < 1e-3
    assert np.abs(miss).max() < 0.01


def test_a_shift_makes_a_press_its_own_nearest(fit):
    """Charges that the field does not give exactly count as known once the field is shifted to them."""
    start = fit.network.domain.to_unit(fit.held.contact[:40])
    shift = np.full((40, 3), 0.02) * [1.0, -1.0, 1.0]
    charge = np.exp(fit.field.log_charge(start)[:, 0] + shift)
    assert np.abs(nearest_in_field(fit.field, charge, NOISE, start, shift)[1]).max() < 1e-9
