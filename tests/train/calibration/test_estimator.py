"""Tests of the estimator of a film on films whose charges are a closed formula."""

import tracemalloc
from dataclasses import replace
from functools import partial, partialmethod

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from tests.benchmarks.measured_films import measured_presses, with_rig_errors
from tests.train.calibration.conftest import rig, uneven_film

from isocharge.common.contact_domain import with_log_force
from isocharge.serve.model.robust_estimate import RobustProblem
from isocharge.simulate import NoiseModel, noise_model
from isocharge.simulate.mechanics.warming import warmed
from isocharge.train.calibration import estimator
from isocharge.train.calibration.contact_error import ContactSensitivity
from isocharge.train.calibration.estimator import NOISE_RATIOS, Hypothesis, estimate, hypotheses
from isocharge.train.calibration.film_estimate import SESSION, terms
from isocharge.train.calibration.press_data import Linearised, PressData, PressErrors, in_domain
from isocharge.train.data.presses import draw_contacts

ONE = Hypothesis(
    (1.0, 1.0),
    0.003,
    tuple(20.0 if one.name == "offset" else 1e-4 for one in SESSION),
    PressErrors(noise_model("reference")),
    1.0,
)
"""A hypothesis with offsets and a discrepancy."""


@pytest.fixture
def _one_hypothesis(monkeypatch):
    """Estimate a film under one hypothesis, with nearly normal weights of the presses."""
    monkeypatch.setattr(estimator, "hypotheses", lambda *_: [ONE])
    monkeypatch.setattr(estimator, "SEARCH_SIZES", ONE.sizes)
    monkeypatch.setattr(RobustProblem, "estimate", partialmethod(RobustProblem.estimate, tolerance=1e-4))
    monkeypatch.setattr(estimator, "RobustProblem", partial(RobustProblem, freedom=1e9))


def draw_unknowns(problem, hypothesis, rng):
    """Draw all unknowns of a film under a hypothesis, within the bounds of the properties."""
    prior = problem.prior
    unknowns = rng.multivariate_normal(prior.mean, prior.covariance(hypothesis.sizes))
    low, high = prior.layout.prior.bounds
    unknowns[prior.layout.film] = np.clip(unknowns[prior.layout.film], low, high)
    return unknowns


def model(problem, synthetic, unknowns, contact):
    """Charges of contacts (x, y, F) with offsets and discrepancy, independent of the estimator."""
    layout = problem.prior.layout
    charge = synthetic.charges(unknowns[layout.film], contact)
    coefficients = unknowns[layout.coefficients].reshape(-1, charge.shape[1])
    return charge * (1.0 + terms(contact, synthetic.domain) @ coefficients) + unknowns[layout.offset]


def presses_on(problem, synthetic, unknowns, count, rng):
    contact = draw_contacts(rng, problem.domain, count)
    charge = problem.noise.add(model(problem, synthetic, unknowns, contact), rng)
    return measured_presses(problem, with_rig_errors(contact, rng), charge)


def film_estimate(problem, synthetic, presses):
    return estimate(synthetic, PressData.of(presses, problem.noise, problem.solved_domain), problem.prior)


def test_contacts_follow_a_change_of_the_unknowns_by_least_squares():
    rng = np.random.default_rng(8)
    residual, by_film, by_contact = (rng.standard_normal((7, columns)) for columns in (1, 5, 3))
    change = rng.standard_normal(5)
    expected = np.linalg.lstsq(by_contact, -(residual[:, 0] + by_film @ change))[0]
    found = Linearised(residual.T, by_film[None], by_contact[None]).contact_change(change)
    np.testing.assert_allclose(found, [expected])


@pytest.mark.usefixtures("_one_hypothesis")
def test_estimate_minimises_the_sum_of_squares_of_all_unknowns_and_contacts(problem, synthetic):
    """SciPy searches for the unknowns and the contacts together, of which some were not measured."""
    rng = np.random.default_rng(1)
    unknowns = draw_unknowns(problem, ONE, rng)
    presses = presses_on(problem, synthetic, unknowns, 12, rng)
    presses.contact[2, :2] = presses.contact[5] = np.nan
    presses.contact[7, 2] = presses.charge_pC[9, 1] = np.nan
    data = PressData.of(presses, problem.noise, problem.solved_domain)
    found = estimate(synthetic, data, problem.prior)

    prior, n_unknown = problem.prior, len(unknowns)
    whitening = np.linalg.inv(np.linalg.cholesky(prior.covariance(ONE.sizes)))

    def residuals(parameters):
        values, contact = prior.mean + parameters[:n_unknown], parameters[n_unknown:].reshape(-1, 3)
        charge = model(problem, synthetic, values, in_domain(contact, synthetic.domain))
        return np.concatenate(
            [
                whitening @ parameters[:n_unknown],
                ((charge - data.charge) / data.charge_std).ravel(),
                ((contact - data.contact) / data.contact_std).ravel(),
            ]
        )

    log_contact = with_log_force(found.contact)
    start = np.concatenate([found.film.values - prior.mean, log_contact.ravel()])
    solution = least_squares(residuals, start, x_scale="jac", xtol=1e-10, ftol=1e-12)
    values, contact = prior.mean + solution.x[:n_unknown], solution.x[n_unknown:].reshape(-1, 3)
    std = np.sqrt(np.diag(found.film.covariance))
    assert (np.abs(found.film.values - values) < 0.05 * std).all()
    assert (np.abs(log_contact - contact) < [0.02, 0.02, 0.01]).all()

    # The covariance is that of the unknowns in the inverse of the whole matrix of second derivatives.
    whole = np.linalg.inv(solution.jac.T @ solution.jac)[:n_unknown, :n_unknown]
    np.testing.assert_allclose(found.film.covariance, whole, atol=0.02 * np.diag(whole).max())


@pytest.mark.usefixtures("few_hypotheses")
def test_ellipses_of_contacts_contain_95_percent_on_films_of_all_hypotheses(problem, synthetic, monkeypatch):
    """The films are drawn from the hypotheses with their probabilities, with the stated errors of the contacts."""
    monkeypatch.setattr(estimator, "FORCE_SCATTERS", (((0.0, 0.0), 1.0),))
    monkeypatch.setattr(estimator, "POSITION_RATIOS", ((1.0, 1.0),))
    within = []
    for seed in range(16):
        rng = np.random.default_rng([seed, 3])
        all_hypotheses = list(hypotheses(problem.noise))
        probability = np.array([one.probability for one in all_hypotheses])
        hypothesis = all_hypotheses[rng.choice(len(all_hypotheses), p=probability / probability.sum())]
        unknowns = draw_unknowns(problem, hypothesis, rng)
        presses = presses_on(replace(problem, noise=hypothesis.errors.noise), synthetic, unknowns, 8, rng)
        film = film_estimate(problem, synthetic, presses).film
        # The offsets and the drift of the session are not errors of later contacts in this comparison.
        lasting = np.r_[problem.prior.layout.film, problem.prior.layout.coefficients]
        gain = ContactSensitivity.of(film, synthetic, problem.domain).film_gain[:, :2, lasting]
        error = gain @ (film.values - unknowns)[lasting]
        covariance = gain @ film.covariance[np.ix_(lasting, lasting)] @ gain.swapaxes(1, 2)
        squared = (error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum(axis=1)
        within.append((squared < chi2.ppf(0.95, 2)).mean())
    assert 0.88 < np.mean(within) <= 0.99


@pytest.mark.usefixtures("few_hypotheses")
def test_bad_press_is_left_out_and_hardly_changes_the_estimate(problem, synthetic):
    values, _, presses = rig(problem, synthetic, 12, seed=4)
    good = film_estimate(problem, synthetic, presses)
    presses.contact[3, 0] += 3.0
    found = film_estimate(problem, synthetic, presses)
    assert np.flatnonzero(found.is_bad).tolist() == [3]
    assert found.press_chi2[3] > 20.0 > good.press_chi2.max()
    std = np.sqrt(np.diag(good.film.covariance))[problem.prior.layout.film]
    assert (np.abs(found.film.film_values - good.film.film_values) < 1.5 * std).all()
    assert abs(found.film.value("pretension") - values[0]) < 4.0 * found.film.std("pretension")


@pytest.mark.first_cases(1)
@pytest.mark.usefixtures("few_hypotheses")
@pytest.mark.parametrize("gain", [0.014, 0.002])
def test_noise_is_estimated_and_noisy_presses_are_not_bad(problem, synthetic, monkeypatch, gain):
    monkeypatch.setattr(estimator, "NOISE_RATIOS", NOISE_RATIOS)
    estimates = []
    for seed in (0, 1):
        _, _, presses = rig(replace(problem, noise=NoiseModel("bench", 1.0, gain)), synthetic, 30, seed)
        found = film_estimate(problem, synthetic, presses)
        assert not found.is_bad.any()
        estimates.append(found.film.noise.gain)
    assert np.mean(estimates) == pytest.approx(gain, rel=0.15)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("ratio", [3.0, 8.0])
def test_positions_worse_than_stated_are_not_taken_for_noise(problem, synthetic, monkeypatch, ratio):
    monkeypatch.setattr(estimator, "IMPERFECTION_SCALES", (((1.0, 1.0), 1.0),))
    values, _, presses = rig(problem, synthetic, 20, seed=0)
    scatter_mm = 0.1 * np.sqrt(ratio**2 - 1.0)
    presses.contact[:, :2] += scatter_mm * np.random.default_rng(0).standard_normal((20, 2))
    found = film_estimate(problem, synthetic, presses)
    assert found.hypothesis.errors.position_ratio == ratio
    assert found.film.noise.gain < 1.2 * problem.noise.gain
    assert found.is_bad.sum() <= 1
    assert abs(found.film.value("pretension") - values[0]) < 3.0 * found.film.std("pretension")


@pytest.mark.usefixtures("few_hypotheses")
def test_touches_at_unknown_places_find_a_change_of_the_pretension(problem, synthetic, monkeypatch):
    """Four charges have one number more than a contact has unknowns, and the estimate before knows the rest."""
    monkeypatch.setattr(estimator, "NOISE_RATIOS", NOISE_RATIOS[:2])
    values, _, presses = rig(problem, synthetic, 20, seed=5)
    earlier = film_estimate(problem, synthetic, presses).film.drifted()
    changed = values.copy()
    changed[0] += 0.3
    for ratio in (1.0, 0.3):  # a frame of each touch, and an average of ten frames
        noise = NoiseModel("bench", ratio * problem.noise.white, ratio * problem.noise.gain)
        _, contact, touches = rig(replace(problem, noise=noise), synthetic, 40, seed=6, values=changed)
        touches.contact[:] = np.nan
        found = film_estimate(replace(problem, earlier=earlier), synthetic, touches)
        std = found.film.std("pretension")
        assert abs(found.film.value("pretension") - changed[0]) < 3.0 * std
        assert std < 0.6 * earlier.std("pretension")
        assert np.median(np.hypot(*(found.contact - contact)[:, :2].T)) < 0.3
        assert found.hypothesis.errors.noise.white == noise.white
        assert found.film.noise.gain == pytest.approx(problem.noise.gain)  # of a frame


def test_one_press_needs_little_memory(problem, synthetic, monkeypatch):
    """After one press, almost all of the 1,296 hypotheses are probable, and their covariances would fill 230 MB."""
    monkeypatch.setattr(estimator, "NOISE_RATIOS", NOISE_RATIOS[:2])
    tracemalloc.start()
    film_estimate(problem, synthetic, presses_on(problem, synthetic, problem.prior.mean, 1, np.random.default_rng(3)))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 5e7


def test_warming_changes_the_shares_of_the_uneven_tension(problem):
    """Temperature adds the same tension in all directions, so the difference of the tensions in MPa remains."""
    layout = problem.prior.layout
    tension, difference = layout.index("pretension"), layout.index("tension_difference")
    estimate_of_film = uneven_film(problem)
    drift = estimate_of_film.drifted().covariance
    sensor, _ = layout.prior.film(estimate_of_film.film_values)
    film = replace(sensor.film, expansion=(100e-6, 100e-6), ring_expansion=23e-6)
    warm = warmed(replace(sensor, film=film), 0.01).film
    expected_slope = (warm.deviator[0] / warm.pretension + 0.25) / (warm.pretension - 1.2)
    assert drift[difference, tension] / drift[tension, tension] == pytest.approx(expected_slope, rel=0.01)
