"""Tests of the figures of merit: against scikit-learn, brute force and known errors; sentences on invented methods."""

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
from isocharge.train.report.measures import (
    ContactErrors,
    MethodRecord,
    compare_with_evaluated_model,
    interval_coverage,
    pareto_front,
)
from isocharge.train.report.page import markdown_table
from isocharge.train.report.studies import errors_by_force

DOMAIN = Domain(8.0, (0.05, 2.0))


def random_contacts(count, seed):
    """Return contacts (x, y, F), shape (count, 3), mm and N."""
    rng = np.random.default_rng(seed)
    position_mm = rng.normal(0.0, 4.0, (count, 2))
    force_N = rng.uniform(0.1, 2.0, count)
    return np.column_stack([position_mm, force_N])


def test_markdown_table_aligns_text_and_number_columns():
    table = markdown_table(("a", "b", "c"), [("1", "2", "3")], text_columns=2)
    assert table == "| a | b | c |\n|---|---|--:|\n| 1 | 2 | 3 |"


def test_contact_errors_equal_those_of_scikit_learn():
    truth = random_contacts(500, 0)
    estimate = truth + np.random.default_rng(1).normal(0.0, 0.1, truth.shape)
    errors = ContactErrors.compute(estimate, truth)
    coordinate_rms = root_mean_squared_error(truth[:, :2].ravel(), estimate[:, :2].ravel())
    relative_force_rms = root_mean_squared_error(np.ones(500), estimate[:, 2] / truth[:, 2])
    np.testing.assert_allclose(errors.position_rms_mm, np.sqrt(2.0) * coordinate_rms, rtol=1e-3)
    np.testing.assert_allclose(errors.force_rms_percent, 100.0 * relative_force_rms, rtol=1e-3)
    distances = sorted(np.linalg.norm((estimate - truth)[:, :2], axis=1))
    assert distances[248] <= errors.position_median_mm <= distances[251]
    assert distances[473] <= errors.position_p95_mm <= distances[475] * 1.001


def test_presses_without_an_estimate_are_left_out_of_the_errors():
    truth = random_contacts(10, 2)
    estimate = truth + 0.1
    estimate[3] = np.nan
    errors = ContactErrors.compute(estimate, truth)
    assert errors.answered == 0.9
    np.testing.assert_allclose(errors.position_rms_mm, 0.1 * np.sqrt(2.0), rtol=1e-3)
    no_estimate = np.full((10, 3), np.nan)
    assert ContactErrors.compute(no_estimate, truth).position_rms_mm is None


def test_pareto_front_equals_the_front_by_brute_force():
    rng = np.random.default_rng(3)
    for _ in range(50):
        cost = rng.integers(0, 6, 12).astype(float)
        error = rng.integers(0, 6, 12).astype(float)
        error[rng.random(12) < 0.1] = np.nan
        front = pareto_front(cost, error)
        for i in range(12):
            is_dominated = any(
                cost[j] <= cost[i] and error[j] <= error[i] and (cost[j] < cost[i] or error[j] < error[i])
                for j in range(12)
            )
            assert front[i] == (not is_dominated and np.isfinite(error[i]))


def test_coverage_equals_the_level_for_correct_standard_deviations_only():
    rng = np.random.default_rng(4)
    truth = random_contacts(40_000, 5)
    std = rng.uniform(0.1, 1.0, (40_000, 3))
    levels = np.array([0.1, 0.5, 0.68, 0.95])
    estimate = truth + std * rng.standard_normal(truth.shape)
    coverage = interval_coverage(estimate, std, truth, levels)
    np.testing.assert_allclose(coverage, np.broadcast_to(levels[:, None], (4, 3)), atol=0.01)
    worse_estimate = truth + 2.0 * std * rng.standard_normal(truth.shape)
    too_small_coverage = interval_coverage(worse_estimate, std, truth, levels)
    assert (too_small_coverage < levels[:, None] - 0.03).all()


def method_record(name, kind, error_mm, latency_us, *, given_force=False, answered=1.0):
    """Return the record of an invented method with the same throughput as all others."""
    method = ComparedMethod(name, kind, "NumPy", GivenMethod(), given_force=given_force)
    return MethodRecord(
        method=method,
        errors=ContactErrors(error_mm, error_mm, error_mm, 1.0, 1.0, answered),
        bayes_ratio=None,
        single_timing=Timing(name, 1, 1, latency_us, latency_us, 1e6 / latency_us),
        batch_timing=Timing(name, 64, 1, 1.0, 1.0, 1e5),
        memory_bytes=1,
        fit_seconds=0.0,
    )


@pytest.mark.parametrize(
    ("other", "faster_and_more_accurate", "sentence"),
    [
        (
            ("fast", "learnt", 0.21, 5.0),
            [],
            "none of 1 .* is both .* 2 times as fast .* with 5 % more error",
        ),
        (("slow", "learnt", 0.3, 20.0), [], "none of 1 other methods is faster"),
        (("better", "paper", 0.19, 4.0), ["better (NumPy)"], "1 of 1 .* 2.5 times as fast .* with 5 % less error"),
        (("small", "network", 0.19, 5.0), ["small (NumPy)"], "1 of 1 other networks is both faster"),
    ],
)
def test_comparison_names_faster_and_more_accurate_methods(other, faster_and_more_accurate, sentence):
    """Methods that are given the force or do not answer all presses are left out of the comparison."""
    evaluated = method_record("evaluated", "network", 0.2, 10.0)
    with_force = method_record("with force", "paper", 0.1, 1.0, given_force=True)
    incomplete = method_record("incomplete", "paper", 0.1, 1.0, answered=0.9)
    comparison = compare_with_evaluated_model([evaluated, with_force, incomplete, method_record(*other)])
    assert comparison["both"]["latency"] == faster_and_more_accurate
    assert re.search(sentence, comparison["sentences"][0])


def test_errors_are_assigned_to_the_bins_of_their_forces():
    truth = draw_contacts(np.random.default_rng(0), DOMAIN, 3000)
    edges = np.geomspace(0.05, 2.0, 13)
    is_in_bin_10 = (truth[:, 2] > edges[10]) & (truth[:, 2] < edges[11])
    distance_mm = np.where(is_in_bin_10, 0.5, 0.1)
    estimate = truth + distance_mm[:, None] * [0.6, 0.8, 0.0]
    result = errors_by_force(DOMAIN, truth, {"method": estimate}, np.full(3000, 0.2))
    np.testing.assert_allclose(result["position_rms_mm"]["Cramér-Rao"], 0.2, rtol=1e-3)
    np.testing.assert_allclose(result["position_rms_mm"]["method"], [0.1] * 10 + [0.5, 0.1], rtol=1e-3)
    np.testing.assert_allclose(result["force_N"][10] ** 2, edges[10] * edges[11], rtol=1e-3)


def dataset_with_probes(dataset, probe_names, angles_deg):
    """Return the first presses of a dataset with other probes and angles, which are used in turn."""
    count = len(dataset.samples)
    probe_index = np.arange(count) % len(probe_names)
    angle_columns = [np.broadcast_to(angle_deg, count) for angle_deg in angles_deg]
    samples = replace(
        dataset.samples,
        probe=np.array(probe_names)[probe_index],
        orientation_deg=np.choose(probe_index, angle_columns),
    )
    return replace(dataset, samples=samples)


def test_case_has_the_same_number_of_presses_for_each_probe(dataset):
    """The number of presses is rounded down from 101 to a multiple of the number of probes."""
    names = ["circle:1.0", "rectangle:4x2", "triangle:4.0"]
    angles_deg = [0.0, 30.0, np.linspace(0.0, 90.0, len(dataset.samples))]
    rotated_rectangle = parse_probe("rectangle:4x2").rotated(np.deg2rad(30.0))

    all_probes = EvaluationCase.for_dataset(dataset_with_probes(dataset, names, angles_deg), 101, 0)
    assert all_probes.probes == (parse_probe("circle:1.0"), rotated_rectangle, parse_probe("triangle:4.0"))
    assert all_probes.press_count == 99
    assert all_probes.is_rotated

    fixed_probes = EvaluationCase.for_dataset(dataset_with_probes(dataset, names[:2], angles_deg[:2]), 101, 0)
    assert fixed_probes.probes == (parse_probe("circle:1.0"), rotated_rectangle)
    assert fixed_probes.press_count == 100
    assert not fixed_probes.is_rotated


def test_test_sweep_multiplies_the_ranges_of_the_dataset(dataset):
    sweep = EvaluationCase.for_dataset(dataset, 101, 0).test_sweep(2.0)
    assert sweep.radius == pytest.approx(16.0)
    assert sweep.force_range == pytest.approx((0.025, 4.0))
