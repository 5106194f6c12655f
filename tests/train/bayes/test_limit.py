"""The Bayes limit: its parts are tested in test_posterior."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, InputError
from isocharge.common.resumable_run import resume_parts
from isocharge.simulate import Circle, noise_model
from isocharge.train import BayesLimit, BayesProblem, bayes_estimate, bayes_limit
from isocharge.train.bayes import posterior


@pytest.fixture
def problem(sensor):
    return BayesProblem(sensor, Circle(1.0))


def test_the_limit_is_what_the_estimates_give(problem, spline):
    limit = bayes_limit(problem, 40, seed=5, charge_map=spline)
    assert 0.05 < limit.position_median_mm < limit.position_rms_mm < 0.4
    assert limit.presses == 40


def test_errors_by_hand():
    truth = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 2.0]])
    limit = BayesLimit.of(truth + np.array([[0.3, 0.4, 0.01], [0.0, 0.0, 0.0]]), truth)
    assert limit.position_rms_mm == pytest.approx(0.5 / np.sqrt(2.0))
    assert limit.position_median_mm == pytest.approx(0.25)
    assert limit.force_rms_percent == pytest.approx(1.0 / np.sqrt(2.0))
    assert limit.position_p95_mm == pytest.approx(0.475)
    assert limit.force_median_percent == pytest.approx(0.5)


def test_who_computes_does_not_matter_and_a_run_keeps_it(problem, film, spline, tmp_path, monkeypatch):
    monkeypatch.setattr(posterior, "CHUNK", 2)
    charge = film.charges(np.array([[3.0, -2.0, 1.5], [0.0, 1.0, 0.2], [-5.0, 5.0, 0.7]]))
    here = bayes_estimate(problem, charge, charge_map=spline)
    assert here[0] == pytest.approx(np.array([[3.0, -2.0, 1.5], [0.0, 1.0, 0.2], [-5.0, 5.0, 0.7]]), abs=0.05)
    with ThreadPoolExecutor(2) as pool, resume_parts(tmp_path / "it", {}) as run:
        there = bayes_estimate(problem, charge, charge_map=spline, executor=run.keeping("bayes", pool))
        kept = bayes_estimate(problem, 0.0 * charge, charge_map=spline, executor=run.keeping("bayes", pool))
    np.testing.assert_array_equal(here, there)
    np.testing.assert_array_equal(here, kept)  # loaded, whatever the charges are now


@pytest.mark.parametrize(
    ("charge", "options", "error", "message"),
    [
        (np.empty((0, 3)), {}, ChargeError, "n at least 1"),
        (np.ones((1, 3)), {"force_range": (0.1, 1.0)}, InputError, "expected the problem's"),
        (np.ones((1, 3)), {"noise": noise_model("clean")}, InputError, "noise"),
    ],
)
def test_what_does_not_fit_is_refused(sensor, spline, charge, options, error, message):
    with pytest.raises(error, match=message):
        bayes_estimate(BayesProblem(sensor, Circle(1.0), **options), charge, charge_map=spline)
