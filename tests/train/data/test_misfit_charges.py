"""The nearest known contact, against brute force with scipy's constrained minimiser, and the examples made with it."""

import numpy as np
import pytest
from scipy.optimize import minimize

from isocharge.simulate import noise_model
from isocharge.simulate.identifiability.nearest_contact import explain, search
from isocharge.simulate.numerics.disk_least_squares import into_domain
from isocharge.train.data.misfit_charges import draw_misfit_examples

NOISE = noise_model("reference")
FAULTS = {
    "noisy": lambda charge, rng: NOISE.add(charge, rng),
    "wrong gain": lambda charge, _: charge * [1.0, 1.3, 1.0],
    "far too hard": lambda charge, _: 4.0 * charge,
    "dead electrode": lambda charge, _: np.maximum(charge * [1.0, 0.0, 1.0], 1.0),
    "anything": lambda charge, rng: 10.0 ** rng.uniform(0.0, 4.0, charge.shape),
}


@pytest.fixture(scope="module")
def field(trained):
    return trained.split.field


@pytest.fixture(scope="module")
def held(trained):
    return trained.split.held


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
def test_nobody_finds_a_nearer_one(field, held, fault):
    rng = np.random.default_rng(1)
    charge = FAULTS[fault](held.charge[:12], rng)
    contact, residual = search(field, charge, NOISE.sigma(charge), starts=3)
    assert np.allclose(residual, (charge - field.charges(contact)) / np.hypot(1.0, 0.002 * charge), atol=1e-8)
    assert (np.hypot(contact[:, 0], contact[:, 1]) <= 8.0).all()
    assert ((contact[:, 2] >= 0.05) & (contact[:, 2] <= 2.0)).all()
    for row, found in enumerate(np.linalg.norm(residual, axis=1)):
        starts = [field.domain.to_unit(contact)[row], *into_domain(rng.uniform(-0.7, 0.7, (3, 3)))]
        best = min(by_scipy(field, charge[row], start) for start in starts)
        assert found <= best + 0.01 + 1e-3 * best


def test_a_clean_press_is_found_where_it_was(field, held):
    charge = field.charges(held.contact)
    moved = held.contact * np.random.default_rng(0).uniform(0.9, 1.1, held.contact.shape)
    contact, residual = explain(field, charge, NOISE.sigma(charge), moved)
    assert np.abs(contact - held.contact).max() < 0.01
    assert np.abs(residual).max() < 0.01


def test_examples_are_of_all_kinds_and_good_ones_are_near(field, trained):
    """A third are presses with their noise: three charges explain nearly all of it, so these are near."""
    (charge, residual), again = (draw_misfit_examples(trained.split.train, field, NOISE, 600, seed=1) for _ in range(2))
    np.testing.assert_array_equal(again, [charge, residual])
    distance = np.linalg.norm(residual, axis=1)
    assert 0.3 < np.mean(distance < 3.0) < 0.8
    assert np.mean(distance > 100.0) > 0.1
    assert charge.min() >= 1.0
    assert charge.max() <= 1e6
