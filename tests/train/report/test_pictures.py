"""Tests of the studies and the pictures: the values that are drawn, and the mismatches that are simulated."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from isocharge.simulate import Domain, load_sensor
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report import QUICK, pictures
from isocharge.train.report.case import EvaluationCase
from isocharge.train.report.studies import Mismatch, NoiseDraws, measure_mismatch, mismatches


@pytest.fixture(scope="module")
def case(dataset):
    """The case of a dataset with 1,500 test presses."""
    return EvaluationCase.for_dataset(dataset, 1500, 0)


@pytest.fixture(scope="module")
def clean(dataset):
    """The first 1,500 presses of the dataset, without noise."""
    samples = dataset.samples
    contact = np.column_stack([samples.x_mm, samples.y_mm, samples.force_N])
    return LabelledPresses(contact[:1500], samples.charge_pC[:1500])


@pytest.fixture(scope="module")
def charge_by_mismatch(case, clean):
    """The charges of all mismatches that need no solve, by the name of the mismatch."""
    settings = replace(QUICK, shapes=(), mismatch_cases=False)
    return {mismatch.name: mismatch.charge for mismatch in mismatches(case, clean, settings)}


@pytest.mark.parametrize("factor", [0.1, 0.3, 1.0, 3.0, 10.0])
def test_noise_mismatch_has_the_noise_of_its_name(case, clean, charge_by_mismatch, factor):
    noise = charge_by_mismatch[f"x {factor:g}"] - clean.charge
    assert np.std(noise / case.noise.sigma(clean.charge)) == pytest.approx(factor, rel=0.05)


def test_gain_mismatch_has_the_gain_errors_of_its_name(charge_by_mismatch):
    nominal_charge = charge_by_mismatch["x 1"]
    random_gains = charge_by_mismatch["each off by 1 % rms"] / nominal_charge
    assert np.std(random_gains) == pytest.approx(0.01, rel=0.05)
    for electrode, name in enumerate("ABC"):
        gains = np.ones(3)
        gains[electrode] = 1.2
        np.testing.assert_allclose(charge_by_mismatch[f"{name} off by 20 %"], nominal_charge * gains)


def test_dead_electrode_measures_only_white_noise(case, charge_by_mismatch):
    nominal_charge = charge_by_mismatch["x 1"]
    for electrode, name in enumerate("ABC"):
        charge = charge_by_mismatch[f"{name} dead"]
        np.testing.assert_array_equal(np.delete(charge, electrode, 1), np.delete(nominal_charge, electrode, 1))
        assert np.std(charge[:, electrode]) == pytest.approx(case.noise.white, rel=0.1)


def test_mismatch_is_measured_by_errors_alarms_and_coverage():
    truth = np.tile([1.0, 2.0, 1.0], (10, 1))
    error = np.linspace(0.1, 1.0, 10)[:, None]
    std = np.full((10, 3), 0.45)
    misfit = 10.0 * error
    released = SimpleNamespace(answer=lambda _: (truth + error, std, misfit))
    result = measure_mismatch(Mismatch("gain", "off", truth, truth), "released", released, (), 2.5)
    assert result["presses"] == 10
    assert result["alarms_percent"] == 80.0
    assert result["coverage_68"] == 0.4
    expected_rms_mm = np.sqrt(2.0 * np.mean(error**2))
    assert result["errors"]["released"]["position_rms_mm"] == pytest.approx(expected_rms_mm, rel=1e-3)


def test_error_maps_show_the_errors_at_their_positions():
    """The errors are 0.1 mm and 10 % on the left half of the film, and 0.2 mm and 20 % on the right half."""
    rng = np.random.default_rng(0)
    truth = np.column_stack([rng.uniform(-5.0, 5.0, (5000, 2)), rng.uniform(0.1, 2.0, 5000)])
    relative_error = np.where(truth[:, :1] < 0.0, 0.1, 0.2)
    direction = np.column_stack([np.full(5000, 0.6), np.full(5000, 0.8), truth[:, 2]])
    draws = NoiseDraws(truth, truth + relative_error * direction, std=truth, misfit=truth[:, 0])
    figure = pictures.error_maps(load_sensor("three-25um-biaxial"), Domain(5.0, (0.1, 2.0)), draws)
    position_axes, force_axes, *_ = figure.axes
    for axes, unit in ((position_axes, 1.0), (force_axes, 100.0)):
        cells = axes.collections[0]
        is_right = cells.get_offsets()[:, 0] > 0.5
        np.testing.assert_allclose(cells.get_array()[is_right], 0.2 * unit)
        assert cells.get_clim() == pytest.approx((0.1 * unit, 0.2 * unit))


def stub_record(name, error_mm, cost, cost_value, *, is_on_front):
    """Return an object with the attributes of a `MethodRecord` that the plots use."""
    return SimpleNamespace(
        method=SimpleNamespace(name=name, kind="network", given_force=False),
        errors=SimpleNamespace(position_rms_mm=error_mm),
        error_mm=error_mm,
        is_comparable=True,
        cost={cost: cost_value}.get,
        pareto_costs={cost} if is_on_front else set(),
    )


@pytest.mark.parametrize("cost", ["latency", "throughput", "memory"])
def test_cost_plot_draws_methods_pareto_front_and_limits(cost):
    """The two best methods are on the front, and the limit that is larger than all errors is left out."""
    records = [
        stub_record(pictures.EVALUATED_MODEL, 0.1, cost, 8.0, is_on_front=True),
        stub_record("small", 0.3, cost, 2.0, is_on_front=True),
        stub_record("large", 0.5, cost, 9.0, is_on_front=False),
    ]
    limits = {pictures.BAYES: 0.05, pictures.CRAMER_RAO: 0.7}
    axes = pictures.cost_plot(records, cost, limits).axes[0]
    *points, front, limit = axes.lines
    assert [point.get_marker() == "*" for point in points] == [True, False, False]
    assert axes.xaxis_inverted() == (cost == "throughput")
    assert list(front.get_xdata()) == [2.0, 8.0]
    # Between two methods the error of the front is that of the method with the lower cost.
    assert front.get_drawstyle() == ("steps-pre" if cost == "throughput" else "steps-post")
    assert limit.get_ydata()[0] == 0.05


def test_coverage_plot_shows_coverage_minus_level():
    coverage = {name: [0.6, 0.85] for name in ("x", "y", "force")}
    lines = pictures.coverage_plot({"levels": [0.5, 0.9], "coverage": coverage}).axes[0].lines
    assert len(lines) == 3
    for line in lines:
        assert line.get_xdata() == pytest.approx([50.0, 90.0])
        assert line.get_ydata() == pytest.approx([10.0, -5.0])


def mismatch_result(group, name, error_mm, alarms_percent):
    """Return an entry of the results of mismatches with one method."""
    errors = {"method": {"position_rms_mm": error_mm}}
    return {"group": group, "case": name, "errors": errors, "alarms_percent": alarms_percent}


@pytest.mark.parametrize(("nominal_error_mm", "line_at"), [(0.2, 0.2), (None, np.nan)])
def test_mismatch_plot_leaves_out_the_noise(nominal_error_mm, line_at):
    results = [
        mismatch_result("noise", "x 3", 9.0, 9.0),
        mismatch_result("gain", "A", 0.3, 40.0),
        mismatch_result("gain", "B", 0.5, 70.0),
    ]
    figure = pictures.mismatch_plot(results, nominal_error_mm)
    error_axes, alarm_axes = figure.axes
    errors, nominal_line = error_axes.lines
    assert figure.get_size_inches()[1] == pytest.approx(1.9 + 2 * 0.36)
    assert errors.get_xdata().tolist() == [0.3, 0.5]
    assert nominal_line.get_xdata() == pytest.approx([line_at, line_at], nan_ok=True)
    assert [bar.get_width() for bar in alarm_axes.patches] == [40.0, 70.0]
    assert alarm_axes.lines[0].get_xdata()[0] == pytest.approx(1.0)
