"""What the report's pictures show is what it was given; what differs from the models' assumptions is what is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from isocharge.simulate import Domain, load_sensor
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report import QUICK, pictures
from isocharge.train.report.case import EvaluationCase
from isocharge.train.report.studies import Deviation, Draws, deviations, measured


def test_deviations_are_as_large_as_their_names_say(dataset):
    case, samples = EvaluationCase.of(dataset, 1500, 0), dataset.samples
    contact = np.column_stack([samples.x_mm, samples.y_mm, samples.force_N])[:1500]
    clean = LabelledPresses(contact, samples.charge_pC[:1500])
    every = deviations(case, clean, replace(QUICK, shapes=(), mismatch_cases=False))
    charge = {deviation.name: deviation.charge for deviation in every}
    usual = charge["x 1"]
    for level in (0.1, 0.3, 1.0, 3.0, 10.0):
        off = (charge[f"x {level:g}"] - clean.charge) / case.noise.sigma(clean.charge)
        assert np.std(off) == pytest.approx(level, rel=0.05)
    assert np.std(charge["each off by 1 % rms"] / usual) == pytest.approx(0.01, rel=0.05)
    for name, one in zip("ABC", np.eye(3), strict=True):
        np.testing.assert_allclose(charge[f"{name} off by 20 %"], usual * (1.0 + 0.2 * one))
        dead = charge[f"{name} dead"]
        np.testing.assert_array_equal(dead[:, one == 0.0], usual[:, one == 0.0])
        assert np.std(dead[:, one == 1.0]) == pytest.approx(case.noise.white, rel=0.1)


def test_what_differs_is_measured_by_errors_alarms_and_coverage():
    truth = np.tile([1.0, 2.0, 1.0], (10, 1))
    shift = np.linspace(0.1, 1.0, 10)[:, None]
    released = SimpleNamespace(answer=lambda _: (truth + shift, np.full((10, 3), 0.45), 10.0 * shift))
    found = measured(Deviation("gain", "off", truth, truth), "ours", released, (), 2.5)
    assert (found["presses"], found["alarms_percent"], found["coverage_68"]) == (10, 80.0, 0.4)
    assert found["errors"]["ours"]["position_rms_mm"] == pytest.approx(np.sqrt(2.0 * np.mean(shift**2)), rel=1e-3)


def test_errors_are_drawn_over_the_film():
    """On the left 0.1 mm and 10 %, on the right 0.2 mm and 20 %."""
    rng = np.random.default_rng(0)
    truth = np.column_stack([rng.uniform(-5.0, 5.0, (5000, 2)), rng.uniform(0.1, 2.0, 5000)])
    size = np.where(truth[:, :1] < 0.0, 0.1, 0.2)
    contact = truth + size * np.column_stack([np.tile([0.6, 0.8], (5000, 1)), truth[:, 2]])
    draws = Draws(truth, contact, truth, truth[:, 0])
    figure = pictures.error_maps(load_sensor("three-25um-biaxial"), Domain(5.0, (0.1, 2.0)), draws)
    for axes, unit in zip(figure.axes, (1.0, 100.0), strict=False):
        cells = axes.collections[0]
        right = cells.get_offsets()[:, 0] > 0.5
        np.testing.assert_allclose(cells.get_array()[right], 0.2 * unit)
        assert cells.get_clim() == pytest.approx((0.1 * unit, 0.2 * unit))


@pytest.mark.parametrize("plot", ["latency", "throughput", "memory"])
def test_better_is_to_the_left_and_below(plot):
    """The best two are on the front; the released model is marked; a limit above all errors is left out."""
    records = [
        SimpleNamespace(
            compared=SimpleNamespace(name=name, kind="network", given_force=False),
            errors=SimpleNamespace(position_rms_mm=error),
            error_mm=error,
            competes=True,
            cost={plot: cost}.get,
            best_on={plot} if error < 0.5 else {},
        )
        for name, error, cost in ((pictures.RELEASED, 0.1, 8.0), ("small", 0.3, 2.0), ("large", 0.5, 9.0))
    ]
    axes = pictures.speed_plot(records, plot, {pictures.BAYES: 0.05, pictures.CRAMER_RAO: 0.7}).axes[0]
    *points, front, limit = axes.lines
    assert [line.get_marker() == "*" for line in points] == [True, False, False]
    assert (axes.xaxis_inverted(), [*front.get_xdata()]) == (plot == "throughput", [2.0, 8.0])
    # between two methods the error is that of the one that is no costlier
    assert front.get_drawstyle() == ("steps-pre" if plot == "throughput" else "steps-post")
    assert limit.get_ydata()[0] == 0.05


def test_coverage_is_drawn_less_its_level():
    record = {"levels": [0.5, 0.9], "coverage": {name: [0.6, 0.85] for name in ("x", "y", "force")}}
    lines = pictures.calibration(record).axes[0].lines
    assert [line.get_xydata().ravel() for line in lines] == [pytest.approx([50.0, 10.0, 90.0, -5.0])] * 3


def test_effects_are_drawn_without_those_of_noise():
    cases = [
        {"group": group, "case": name, "errors": {"ours": {"position_rms_mm": mm}}, "alarms_percent": percent}
        for group, name, mm, percent in (("noise", "x 3", 9.0, 9.0), ("gain", "A", 0.3, 40.0), ("gain", "B", 0.5, 70.0))
    ]
    for nominal, at in ((0.2, 0.2), (None, np.nan)):
        figure = pictures.mismatch_effect(cases, nominal)
        left, right = figure.axes
        errors, assumed = left.lines
        assert figure.get_size_inches()[1] == pytest.approx(1.9 + 0.72)
        assert errors.get_xdata().tolist() == [0.3, 0.5]
        assert assumed.get_xdata() == pytest.approx([at, at], nan_ok=True)
        assert [bar.get_width() for bar in right.patches] == [40.0, 70.0]
        assert right.lines[0].get_xdata()[0] == pytest.approx(1.0)
