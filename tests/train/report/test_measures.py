"""Figures of merit against scikit-learn, SciPy, brute force and planted errors; sentences on made-up methods."""

import re
from dataclasses import replace

import numpy as np
import pytest
from sklearn.metrics import root_mean_squared_error

from isocharge.serve.benchmark import Timing
from isocharge.simulate import Domain, parse_probe
from isocharge.train.baselines.compared_methods import ComparedMethod, GivenMethod
from isocharge.train.data.presses import draw_contacts
from isocharge.train.report.case import EvaluationCase
from isocharge.train.report.measures import Errors, MethodRecord, coverage, pareto, verdict
from isocharge.train.report.page import table
from isocharge.train.report.studies import by_force


def contacts(count, seed):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.normal(0.0, 4.0, (count, 2)), rng.uniform(0.1, 2.0, count)])


def test_a_table_has_a_rule_for_each_column():
    assert table(("a", "b", "c"), [("1", "2", "3")], 2) == "| a | b | c |\n|---|---|--:|\n| 1 | 2 | 3 |"


def test_errors_by_scikit_learn():
    truth = contacts(500, 0)
    found = truth + np.random.default_rng(1).normal(0.0, 0.1, truth.shape)
    figures = Errors.of(found, truth)
    plane = root_mean_squared_error(truth[:, :2].ravel(), found[:, :2].ravel())
    force = root_mean_squared_error(np.ones(500), found[:, 2] / truth[:, 2])
    np.testing.assert_allclose(figures.position_rms_mm, np.sqrt(2.0) * plane, rtol=1e-3)
    np.testing.assert_allclose(figures.force_rms_percent, 100.0 * force, rtol=1e-3)
    distances = sorted(np.linalg.norm((found - truth)[:, :2], axis=1))
    assert distances[248] <= figures.position_median_mm <= distances[251]
    assert distances[473] <= figures.position_p95_mm <= distances[475] * 1.001


def test_presses_without_an_answer_do_not_count():
    truth = contacts(10, 2)
    found = truth + 0.1
    found[3] = np.nan
    figures = Errors.of(found, truth)
    assert figures.answered == 0.9
    np.testing.assert_allclose(figures.position_rms_mm, 0.1 * np.sqrt(2.0), rtol=1e-3)
    assert Errors.of(np.full((10, 3), np.nan), truth).position_rms_mm is None


def test_the_front_by_brute_force():
    rng = np.random.default_rng(3)
    for _ in range(50):
        cost, error = rng.integers(0, 6, 12).astype(float), rng.integers(0, 6, 12).astype(float)
        error[rng.random(12) < 0.1] = np.nan
        front = pareto(cost, error)
        for i in range(12):
            beaten = any(
                cost[j] <= cost[i] and error[j] <= error[i] and (cost[j] < cost[i] or error[j] < error[i])
                for j in range(12)
            )
            assert front[i] == (not beaten and np.isfinite(error[i]))


def test_true_deviations_cover_their_level():
    rng = np.random.default_rng(4)
    truth, std = contacts(40_000, 5), rng.uniform(0.1, 1.0, (40_000, 3))
    levels = np.array([0.1, 0.5, 0.68, 0.95])
    covered = coverage(truth + std * rng.standard_normal(truth.shape), std, truth, levels)
    np.testing.assert_allclose(covered, np.broadcast_to(levels[:, None], (4, 3)), atol=0.01)
    too_small = coverage(truth + 2.0 * std * rng.standard_normal(truth.shape), std, truth, levels)
    assert (too_small < levels[:, None] - 0.03).all()


def method(name, kind, error, p50, *, per_second=1e5, given=False, answered=1.0):
    compared = ComparedMethod(name, kind, "NumPy", GivenMethod(), given_force=given)
    timings = Timing(name, 1, 1, p50, p50, 1e6 / p50), Timing(name, 64, 1, 1.0, 1.0, per_second)
    return MethodRecord(compared, Errors(error, error, error, 1.0, 1.0, answered), None, *timings, 1, 0.0)


@pytest.mark.parametrize(
    ("other", "both", "sentence"),
    [
        (
            ("near", "learnt", 0.21, 5.0),
            [],
            "none of 1 .* is both .* .2 times as fast, 5 % more error",
        ),
        (("slow", "learnt", 0.3, 20.0), [], "none of 1 other methods is faster"),
        (("better", "paper", 0.19, 4.0), ["better (NumPy)"], "1 of 1 other .* .2.5 times as fast, 5 % less error"),
        (("small", "network", 0.19, 5.0), ["small (NumPy)"], "1 of 1 networks that give the contact alone"),
    ],
)
def test_what_is_faster_or_more_accurate_is_said(other, both, sentence):
    released = method("released", "network", 0.2, 10.0)
    silent = [method("given", "paper", 0.1, 1.0, given=True), method("rarely", "paper", 0.1, 1.0, answered=0.9)]
    said = verdict([released, *silent, method(*other)])
    assert said["both"]["latency"] == both
    assert re.search(sentence, said["sentences"][0])


DOMAIN = Domain(8.0, (0.05, 2.0))


def test_errors_fall_into_the_bins_of_their_forces():
    truth = draw_contacts(np.random.default_rng(0), DOMAIN, 3000)
    edges = np.geomspace(0.05, 2.0, 13)
    strong = (truth[:, 2] > edges[10]) & (truth[:, 2] < edges[11])
    contact = truth + np.where(strong, 0.5, 0.1)[:, None] * [0.6, 0.8, 0.0]
    found = by_force(DOMAIN, truth, {"method": contact}, np.full(3000, 0.2))
    np.testing.assert_allclose(found["position_rms_mm"]["Cramér-Rao"], 0.2, rtol=1e-3)
    np.testing.assert_allclose(found["position_rms_mm"]["method"], [0.1] * 10 + [0.5, 0.1], rtol=1e-3)
    np.testing.assert_allclose(found["force_N"][10] ** 2, edges[10] * edges[11], rtol=1e-3)


def test_a_case_has_the_dataset_s_probes_and_as_many_presses_of_each(dataset):
    """A probe at one angle carries it; one at any angle is turned at random."""
    samples = dataset.samples
    rows, third = len(samples.force_N), np.arange(len(samples.force_N)) % 3
    probe = np.array(["circle:1.0", "rectangle:4x2", "triangle:4.0"])[third]
    angles = np.choose(third, [np.zeros(rows), np.full(rows, 30.0), np.linspace(0.0, 90.0, rows)])
    turned, fixed = third < 3, third < 2
    for chosen, probes, presses in ((turned, 3, 99), (fixed, 2, 100)):
        some = {name: np.asarray(getattr(samples, name))[chosen] for name in ("x_mm", "y_mm", "force_N", "charge_pC")}
        mixed = replace(samples, **some, probe=probe[chosen], orientation_deg=angles[chosen])
        case = EvaluationCase.of(replace(dataset, samples=mixed), 101, 0)
        assert (len(case.probes), case.presses, case.rotated) == (probes, presses, chosen is turned)
        assert case.probes[1] == parse_probe("rectangle:4x2").rotated(np.deg2rad(30.0))
        assert case.probes[2:] == (parse_probe("triangle:4.0"),) * (probes - 2)
    twice = case.sweep(2.0)
    assert (twice.radius, *twice.force_range) == pytest.approx((16.0, 0.025, 4.0))
