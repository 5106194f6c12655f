"""The posterior against closed forms, brute force, and itself; the Bayes limit from it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from isocharge.common.errors import ChargeError, InputError
from isocharge.simulate import Circle, Domain, ForwardMap, NoiseModel, noise_model
from isocharge.train import BayesLimit, BayesProblem, bayes_estimate, bayes_limit
from isocharge.train.bayes.posterior import Cells, Posterior
from isocharge.train.data.presses import draw_contacts

REFERENCE, UNIT = noise_model("reference"), Domain(1.0, (1.0, 1.0 + 1e-9))


@dataclass(frozen=True)
class Straight:
    """Charges that are a quadratic function of place, at a force that is known all but exactly."""

    offset: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray
    domain: Domain = UNIT

    @property
    def electrodes(self):
        return tuple(map(str, range(self.offset.size)))

    def force_weights(self, logs):
        return np.exp(logs)[..., None]

    def scaled_charges(self, position):
        return (self.offset + position @ self.linear + position**2 @ self.quadratic)[:, None]

    def scaled_gradients(self, position):
        moved = self.linear.T + 2.0 * position[:, None, :] * self.quadratic.T
        return moved[:, None]


def straight(seed: int, electrodes: int = 4) -> Straight:
    rng = np.random.default_rng(seed)
    return Straight(100.0 + rng.random(electrodes), rng.normal(size=(2, electrodes)), np.zeros((2, electrodes)))


def spread(charges, count, seed):
    """Presses from the prior and their noisy charges."""
    rng = np.random.default_rng(seed)
    contact = draw_contacts(rng, charges.domain, count)
    return contact, REFERENCE.add(charges.charges(contact), rng)


@pytest.mark.parametrize("seed", range(2))
def test_linear_charges_in_white_noise_give_the_textbook_gaussian(seed):
    made, white = straight(seed), 0.01
    noisy = made.scaled_charges(np.array([[0.2, -0.3]]))[:, 0] + white * np.random.default_rng(seed).normal(size=(1, 4))
    mean, std = Posterior(made, NoiseModel("white", white, 0.0), 1.0).mean_and_std(noisy)
    covariance = white**2 * np.linalg.inv(made.linear @ made.linear.T)
    best = np.linalg.lstsq(made.linear.T, (noisy - made.offset)[0], rcond=None)[0]
    assert (np.abs(mean[0, :2] - best) < 0.01 * std[0, :2]).all()
    assert std[0, :2] == pytest.approx(np.sqrt(np.diag(covariance)), rel=5e-3)


def test_at_the_edge_of_the_disk_the_gaussian_is_cut_off():
    made = Straight(np.array([100.0, 100.0]), np.eye(2), np.zeros((2, 2)), domain=Domain(1000.0, (1.0, 1.0 + 1e-9)))
    noisy = np.array([[1100.0, 100.0]])  # x is 1000, y is 0: on an edge that is all but straight
    mean, std = Posterior(made, NoiseModel("white", 1.0, 0.0), 1000.0).mean_and_std(noisy)
    half = stats.halfnorm()
    assert mean[0, :2] == pytest.approx([1000.0 - half.mean(), 0.0], abs=0.003)
    assert std[0, :2] == pytest.approx([half.std(), 1.0], rel=0.01)


def test_two_places_with_the_same_charges_are_both_found():
    """Charges even in x: the mean is in the middle, where the contact certainly is not, and the deviation says so."""
    made = Straight(np.array([100.0, 100.0]), np.array([[0.0, 0.0], [0.0, 1.0]]), np.array([[1.0, 0.0], [0.0, 0.0]]))
    noisy = made.scaled_charges(np.array([[0.6, 0.1]]))[:, 0]
    mean, std = Posterior(made, NoiseModel("white", 0.001, 0.0), 1.0).mean_and_std(noisy)
    assert mean[0, :2] == pytest.approx([0.0, 0.1], abs=1e-4)
    assert std[0, 0] == pytest.approx(0.6, rel=1e-3)


def brute_force(charges, noise, charge, centre, reach, count):
    """Mean and deviation of (x, y, F) by a plain sum over a box, cut off at the prior's edges."""
    low, high = centre - reach, centre + reach
    low[2], high[2] = (
        np.maximum(low[2], np.log(charges.domain.force_range[0])),
        np.minimum(high[2], np.log(charges.domain.force_range[1])),
    )
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b, n in zip(low, high, count, strict=True)]
    x, y, logs = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    inside = np.hypot(x, y) <= charges.domain.radius
    contact = np.stack([x, y, np.exp(logs)], axis=1)[inside]
    known = charges.charges(contact)
    likelihood = stats.norm.logpdf(charge, known, noise.sigma(known)).sum(axis=1)
    mass = np.exp(likelihood - likelihood.max())
    mass /= mass.sum()
    mean = mass @ contact
    std = np.sqrt(mass @ (contact - mean) ** 2)
    mean[2] = (mass @ (1.0 / contact[:, 2])) / (mass @ (1.0 / contact[:, 2] ** 2))
    return mean, std


@pytest.mark.parametrize(
    ("noise", "contact"),
    [
        (REFERENCE, (7.2, 3.4, 0.0503)),
        (REFERENCE, (0.1, 0.0, 1.995)),
        (NoiseModel("loud", 1.0, 0.05), (1.0, 2.0, 0.4)),  # the likelihood's 1 / sigma moves the mean by a tenth
    ],
)
def test_as_brute_force(spline, noise, contact):
    charge = spline.charges(np.array([contact])) + (noise is REFERENCE) * np.array([[0.5, -1.0, 0.3]])
    mean, std = Posterior(spline, noise, spline.domain.radius).mean_and_std(charge)
    centre, reach = np.append(mean[0, :2], np.log(mean[0, 2])), 6.5 * np.append(std[0, :2], std[0, 2] / mean[0, 2])
    expected_mean, expected_std = brute_force(spline, noise, charge[0], centre, reach, (100, 100, 20))
    assert std[0] == pytest.approx(expected_std, rel=0.01)
    assert (np.abs(mean[0] - expected_mean) < 0.01 * expected_std).all()


def test_deviations_are_as_large_as_errors(spline):
    """Simulated presses and their noise: the squares of error over deviation are one on average."""
    contact, charge = spread(spline, 120, seed=3)
    mean, std = Posterior(spline, REFERENCE, spline.domain.radius).mean_and_std(charge)
    squares = np.mean(((mean - contact) / std) ** 2, axis=0)
    assert squares == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 120))


def test_charges_of_nothing_still_give_an_answer(spline):
    """What no press gives: the nearest that the prior knows, finite."""
    mean, std = Posterior(spline, REFERENCE, spline.domain.radius).mean_and_std(np.array([[0.0, -5.0, 1e6]]))
    assert np.isfinite([mean, std]).all()
    assert np.hypot(*mean[0, :2]) <= spline.domain.radius * (1.0 + 1e-12)


@pytest.mark.parametrize(
    ("changes", "charge", "message"),
    [
        ({}, np.ones((2, 4)), r"shape \(n, 3\), n at least 1, got shape \(2, 4\)"),
        ({}, np.array([[np.nan, 1.0, 1.0]]), "finite"),
        ({"noise": noise_model("clean")}, np.ones((2, 3)), "white noise"),
        ({"radius": 9.0}, np.ones((2, 3)), "up to the charge table's 8 mm"),
    ],
)
def test_bad_input_is_refused(spline, changes, charge, message):
    with pytest.raises((ChargeError, InputError), match=message):
        replace(Posterior(spline, REFERENCE, spline.domain.radius), **changes).mean_and_std(charge)


@pytest.fixture
def problem(sensor):
    return BayesProblem(sensor, Circle(1.0))


def test_the_limit_is_what_the_estimates_give(problem, spline, monkeypatch):
    monkeypatch.setattr(ForwardMap, "build", None)  # the map is given
    limit = bayes_limit(problem, 40, seed=5, charge_map=spline)
    assert 0.05 < limit.position_median_mm < limit.position_rms_mm < 0.4
    assert limit.presses == 40


def test_errors_by_hand():
    truth = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 2.0]])
    limit = BayesLimit.of(truth + np.array([[0.3, 0.4, 0.01], [0.0, 0.0, 0.0]]), truth)
    position = limit.position_rms_mm, limit.position_median_mm, limit.position_p95_mm
    assert position == pytest.approx((0.5 / np.sqrt(2.0), 0.25, 0.475))
    assert (limit.force_rms_percent, limit.force_median_percent) == pytest.approx((1.0 / np.sqrt(2.0), 0.5))


def test_a_map_of_other_forces_is_refused(sensor, spline):
    with pytest.raises(InputError, match="expected the problem's"):
        bayes_estimate(BayesProblem(sensor, Circle(1.0), force_range=(0.1, 1.0)), np.ones((1, 3)), charge_map=spline)


@pytest.mark.parametrize("radius", [0.4, 30.0])
def test_cells_cover_the_disk_once(radius):
    """Those of the first round, and the finer ones in their place."""
    cells = Cells.roots(radius)
    for parts in ([cells], [*cells.finer(radius)]):
        insides = [(part.side**2 * share[:, None], centre) for part in parts for share, centre in [part.inside(radius)]]
        area = sum(areas.sum() for areas, _ in insides)
        assert area == pytest.approx(np.pi * radius**2, rel=2e-4)
        assert np.abs(sum((areas * centre).sum(axis=0) for areas, centre in insides)).max() < 1e-6 * radius * area
