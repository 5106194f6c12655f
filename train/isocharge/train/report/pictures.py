"""Pictures of a report: errors against costs, place and force, coverage of intervals, and effects of mismatches."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, NullFormatter

from isocharge.common.contact_errors import position_error
from isocharge.common.statistics import rms
from isocharge.simulate import Domain, Sensor
from isocharge.simulate.plots.figure import FELT, INK, new_axes, new_figure
from isocharge.simulate.plots.film import draw_layout
from isocharge.train.baselines.networks import EVALUATED_MODEL
from isocharge.train.model_release.evaluate import FALSE_ALARM_RATE
from isocharge.train.report.case import BAYES, CRAMER_RAO
from isocharge.train.report.measures import Cost, MethodRecord
from isocharge.train.report.studies import COORDINATES, NoiseDraws

GREY = "#8a95a5"
"""Colour of shaded areas."""

KIND_COLOURS = {"paper": "#7a5195", "learnt": "#2f7f6f", "fitted map": "#c47f17", "network": "#2b6cb0"}
"""Colour of each kind of method."""

MARKERS = "osv^DPX<>h"
"""Markers that the methods of one kind use in turn."""

LINE_STYLES: dict[str, dict[str, Any]] = {
    EVALUATED_MODEL: {"color": FELT, "marker": "*", "ms": 10, "lw": 2.0, "zorder": 3},
    BAYES: {"color": INK, "marker": "", "ls": "-", "lw": 2.0},
    CRAMER_RAO: {"color": INK, "marker": "", "ls": ":", "lw": 2.0},
}
"""Matplotlib styles of the evaluated model and of the limits, by name.

Other methods have the style `DEFAULT_LINE_STYLE`.
"""

DEFAULT_LINE_STYLE: dict[str, Any] = {"marker": "o", "ms": 4, "lw": 1.3}
"""Matplotlib style of a method that is not in `LINE_STYLES`. Its colour is the next colour of Matplotlib's cycle."""

COST_LABELS: dict[Cost, str] = {
    "latency": "time of one prediction, median, us",
    "throughput": "predictions per second in batches",
    "memory": "memory of the method, bytes",
}
"""Label of the horizontal axis of each plot of the error against a cost."""

POSITION_ERROR_LABEL = "position error, rms, mm"
"""Label of the axis of the position error."""

COVERAGE_TOLERANCE = 2.0
"""Half width of the shaded band in the plot of the coverage, percentage points."""


def cost_plot(records: Sequence[MethodRecord], cost: Cost, limits: Mapping[str, float]) -> Figure:
    """Draw the position error against a cost, with one point for each method.

    Args:
        records: Records of the methods.
        cost: Name of the cost.
        limits: Theoretical limits of the position error, mm, by name. Each limit is drawn as a horizontal line, unless
            it is larger than the errors of all methods that do not use the true force. The limit of unbiased estimators
            can be so large, because the methods may be biased.

    Returns:
        Figure with logarithmic axes and the Pareto front.
    """
    figure, axes = new_axes(10.5, 6.0)
    # Methods without an error (None) cannot be drawn, and neither can an error of zero on a logarithmic axis.
    drawn_records = [record for record in records if record.errors.position_rms_mm]
    drawn_records.sort(key=lambda record: record.error_mm)
    _draw_methods(axes, drawn_records, cost)
    _draw_pareto_front(axes, drawn_records, cost)

    largest_error_mm = max(record.error_mm for record in drawn_records if not record.method.given_force)
    for name, limit_mm in limits.items():
        if limit_mm <= largest_error_mm:
            line_style = LINE_STYLES[name]["ls"]
            axes.axhline(limit_mm, color=INK, ls=line_style, zorder=1, label=f"{name}, {limit_mm:.3g} mm")

    _set_logarithmic_axes(axes, COST_LABELS[cost], POSITION_ERROR_LABEL)
    axes.xaxis.set_major_formatter("{x:,g}")
    if cost == "throughput":  # better methods are on the left in all plots
        axes.invert_xaxis()
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    return figure


def _draw_methods(axes: Axes, records: Sequence[MethodRecord], cost: Cost) -> None:
    """Draw one point for each method.

    The colour shows the kind of the method. Methods of one kind have different markers. If a method uses the true force
    or has no estimate for some presses, its point is hollow. The evaluated model is a star.

    Args:
        axes: Axes of matplotlib.
        records: Results of the methods.
        cost: Cost on the horizontal axis.
    """
    markers_by_kind = {kind: cycle(MARKERS) for kind in KIND_COLOURS}
    for record in records:
        kind = record.method.kind
        colour = KIND_COLOURS[kind]
        fill_colour = colour if record.is_comparable else "white"
        marker = next(markers_by_kind[kind])
        style: dict[str, Any] = {"color": colour, "mfc": fill_colour, "marker": marker, "ms": 7}
        if record.method.name == EVALUATED_MODEL:
            style = {"color": FELT, "marker": "*", "ms": 14}
        label = f"{record.method.name}, {record.error_mm:.3g} mm"
        axes.plot(record.cost(cost), record.error_mm, ls="", label=label, **style)


def _draw_pareto_front(axes: Axes, records: Sequence[MethodRecord], cost: Cost) -> None:
    """Draw the Pareto front of a cost as steps.

    A method is on the front if no other method is better in both error and cost. Between two methods, the steps show
    the error of the cheaper method. For the throughput, the method with the higher value is the cheaper one, so the
    direction of the steps is reversed.

    Args:
        axes: Axes of matplotlib.
        records: Results of the methods.
        cost: Cost on the horizontal axis.
    """
    front = sorted((record.cost(cost), record.error_mm) for record in records if cost in record.pareto_costs)
    costs, errors_mm = zip(*front, strict=True)
    draw_style = "steps-pre" if cost == "throughput" else "steps-post"
    axes.plot(costs, errors_mm, ls="--", color=INK, lw=1.0, drawstyle=draw_style, zorder=1, label="Pareto front")


def _set_logarithmic_axes(axes: Axes, x_label: str, y_label: str) -> None:
    """Set both axes to logarithmic scales, and label them with plain numbers instead of powers of ten.

    An axis that covers less than three decades also has labels at 2 and 5 times the powers of ten.

    Args:
        axes: Axes of matplotlib.
        x_label: Label of the horizontal axis.
        y_label: Label of the vertical axis.
    """
    axes.set(xscale="log", yscale="log", xlabel=x_label, ylabel=y_label)
    for axis in (axes.xaxis, axes.yaxis):
        lower, upper = axis.get_view_interval()
        is_short = upper < 1e3 * lower
        labelled_multiples = (1.0, 2.0, 5.0) if is_short else (1.0,)
        axis.set_major_locator(LogLocator(subs=labelled_multiples))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.25, which="both", lw=0.5)


def error_maps(sensor: Sensor, domain: Domain, draws: NoiseDraws) -> Figure:
    """Draw maps of the root-mean-square errors of the evaluated model over the film.

    The left map shows the position error in mm, and the right map shows the relative error of the force in %.

    Args:
        sensor: The sensor, whose electrodes are drawn.
        domain: The working area, whose edge is drawn.
        draws: Estimates of the evaluated model under several noise draws.

    Returns:
        Figure with both maps.
    """
    figure = new_figure(11.5, 5.0)
    force_error_percent = 100.0 * (draws.estimate[:, 2] / draws.truth[:, 2] - 1.0)
    errors_by_label = {
        POSITION_ERROR_LABEL: position_error(draws.estimate, draws.truth),
        "relative force error, rms, %": force_error_percent,
    }
    x_mm = draws.truth[:, 0]
    y_mm = draws.truth[:, 1]
    for axes, (label, errors) in zip(figure.subplots(1, 2), errors_by_label.items(), strict=True):
        # Each hexagonal cell shows the root mean square of the errors of the presses in it.
        cells = axes.hexbin(x_mm, y_mm, errors, gridsize=22, reduce_C_function=rms, cmap="viridis", lw=0.1)
        working_area = Circle((0, 0), domain.radius, transform=axes.transData)
        cells.set_clip_path(working_area)

        # Single outliers do not determine the colour scale.
        cell_errors = np.ma.compressed(cells.get_array())
        lowest_colour, highest_colour = np.percentile(cell_errors, (0.5, 99.5))
        cells.set_clim(lowest_colour, highest_colour)
        figure.colorbar(cells, ax=axes, shrink=0.85, label=label)
        draw_layout(axes, sensor, domain.radius)
    return figure


def error_lines(x: Sequence[float], lines: Mapping[str, Sequence[float | None]], x_label: str) -> Figure:
    """Draw the position errors of several methods and limits as lines.

    Args:
        x: Values on the horizontal axis.
        lines: Position errors at these values, mm, by the name of the method or limit; None for no value.
        x_label: Label of the horizontal axis, with its unit.

    Returns:
        Figure with logarithmic axes.
    """
    figure, axes = new_axes(8.0, 5.0)
    for name, errors_mm in lines.items():
        axes.plot(x, np.array(errors_mm, dtype=float), label=name, **_line_style(name))
    _set_logarithmic_axes(axes, x_label, POSITION_ERROR_LABEL)
    axes.legend(fontsize=8)
    return figure


def _line_style(name: str) -> dict[str, Any]:
    """Return the Matplotlib style of the line of a method or limit, by its name."""
    return DEFAULT_LINE_STYLE | LINE_STYLES.get(name, {})


def coverage_plot(record: Mapping[str, Any]) -> Figure:
    """Draw the coverage of the intervals of the evaluated model minus the nominal level, in percentage points.

    A shaded band shows the tolerance. If a point is above zero, the intervals contain more true values than their
    nominal level states.

    Args:
        record: Result of `studies.coverage_by_level`, with the nominal levels and the coverage of each coordinate.

    Returns:
        Figure with one curve for each of x, y and the force.
    """
    figure, axes = new_axes(6.5, 4.4)
    level_percent = 100.0 * np.array(record["levels"])
    axes.axhspan(-COVERAGE_TOLERANCE, COVERAGE_TOLERANCE, color=GREY, alpha=0.15, lw=0)
    for name in COORDINATES:
        coverage_percent = 100.0 * np.array(record["coverage"][name])
        axes.plot(level_percent, coverage_percent - level_percent, ".-", label=name)
    axes.set(xlabel="nominal level, %", ylabel="coverage minus nominal level, percentage points", xlim=(0, 100))
    axes.grid(alpha=0.25, lw=0.5)
    axes.legend()
    return figure


def mismatch_plot(results: Sequence[Mapping[str, Any]], nominal_error_mm: float | None) -> Figure:
    """Draw the position errors and the alarms for all mismatches except those of the noise.

    A mismatch is a condition that differs from the assumptions of the models, such as another probe. Each mismatch is
    one row, which both panels of the figure share.

    Args:
        results: Results of `studies.measure_mismatch`.
        nominal_error_mm: Position error of the evaluated model without a mismatch, mm; None if it is unknown.

    Returns:
        Figure with the errors on the left and the alarms on the right.
    """
    shown_results = [result for result in results if result["group"] != "noise"]
    labels = [f"{result['group']}: {result['case']}" for result in shown_results]
    figure = new_figure(11.5, 1.9 + 0.36 * len(shown_results))
    error_axes, alarm_axes = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1.0))

    method_names = results[0]["errors"].keys()
    for name in method_names:
        errors_mm = [result["errors"][name]["position_rms_mm"] for result in shown_results]
        point_style = {**_line_style(name), "ls": ""}
        error_axes.plot(errors_mm, labels, **point_style, label=name)
    # Without a nominal error, no line is drawn at NaN, and only the legend contains the line.
    error_axes.axvline(nominal_error_mm or np.nan, color=FELT, lw=0.9, ls="--", label="without mismatch")
    error_axes.set(xlabel=POSITION_ERROR_LABEL, xscale="log")
    error_axes.invert_yaxis()  # the first mismatch is the top row
    error_axes.xaxis.set_major_formatter("{x:g}")
    error_axes.grid(alpha=0.25, lw=0.5)

    alarms_percent = [result["alarms_percent"] for result in shown_results]
    _draw_alarms(alarm_axes, labels, alarms_percent)
    figure.legend(loc="outside lower center", fontsize=8, ncol=6, frameon=False)
    return figure


def _draw_alarms(axes: Axes, labels: Sequence[str], alarms_percent: Sequence[float]) -> None:
    """Draw the percentage of presses with an alarm as one bar for each mismatch.

    A dashed line shows the percentage of good presses with an alarm.

    Args:
        axes: Axes of matplotlib.
        labels: Labels of the mismatches.
        alarms_percent: Percentage of presses with an alarm for each mismatch.
    """
    bars = axes.barh(labels, alarms_percent, color=FELT, alpha=0.8, height=0.6)
    axes.bar_label(bars, fmt="{:g}", padding=3, fontsize=8)
    axes.axvline(100.0 * FALSE_ALARM_RATE, color=INK, lw=0.9, ls="--")
    axes.set(xlabel="presses with an alarm from the misfit, %", xlim=(0, 112))


def limit_errors(limits: Mapping[str, Any]) -> dict[str, float]:
    """Return the position errors of the limits that were computed, mm, by the name of the limit.

    Args:
        limits: Entry "limits" of a section of the report.
    """
    limits_by_name = {BAYES: limits["bayes"], CRAMER_RAO: limits["cramer_rao"]}
    return {name: limit["position_rms_mm"] for name, limit in limits_by_name.items() if limit}
