"""The report's pictures: error against time, throughput and memory, film and force; calibration; effects."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, NullFormatter

from isocharge.simulate import Domain, Sensor
from isocharge.simulate.numerics.statistics import rms
from isocharge.simulate.plots.figure import FELT, INK, new_axes, new_figure
from isocharge.simulate.plots.film import draw_layout
from isocharge.train.baselines.networks import RELEASED
from isocharge.train.data.presses import position_error
from isocharge.train.model_release.evaluate import FALSE_ALARM_RATE
from isocharge.train.report.case import BAYES, CRAMER_RAO
from isocharge.train.report.measures import MethodRecord, Plot
from isocharge.train.report.studies import COORDINATES, Draws

GREY = "#8a95a5"
"""Colour of secondary lines."""

KINDS = {"paper": "#7a5195", "learnt": "#2f7f6f", "fitted map": "#c47f17", "network": "#2b6cb0"}
"""Colours of the kinds of methods."""

MARKERS = "osv^DPX<>h"
"""Markers of the methods of one kind."""

OWN_STYLES: dict[str, dict[str, Any]] = {
    RELEASED: {"color": FELT, "marker": "*", "ms": 10, "lw": 2.0, "zorder": 3},
    BAYES: {"color": INK, "marker": "", "ls": "-", "lw": 2.0},
    CRAMER_RAO: {"color": INK, "marker": "", "ls": ":", "lw": 2.0},
}
"""How the released model and the limits are drawn; other methods take matplotlib's colours in turn."""

AXES: dict[Plot, str] = {
    "latency": "time of one prediction, median, us",
    "throughput": "predictions per second in batches",
    "memory": "memory of the method, bytes",
}
"""Label of each plot's horizontal axis."""


def speed_plot(records: Sequence[MethodRecord], plot: Plot, limits: Mapping[str, float]) -> Figure:
    """Position error against latency, throughput or memory, one point for each method.

    Args:
        records: Of the methods.
        plot: Which of AXES.
        limits: Name to position error, mm, of what is drawn as a line, unless every method is below it.
    """
    figure, axes = new_axes(10.5, 6.0)
    shown = [record for record in records if record.errors.position_rms_mm]
    markers = {kind: cycle(MARKERS) for kind in KINDS}
    for record in sorted(shown, key=lambda record: record.error_mm):
        colour, hollow = KINDS[record.compared.kind], not record.competes
        marker, fill = next(markers[record.compared.kind]), "white" if hollow else colour
        style: dict[str, Any] = {"color": colour, "mfc": fill, "marker": marker, "ms": 7}
        if record.compared.name == RELEASED:
            style = {"color": FELT, "marker": "*", "ms": 14}
        axes.plot(
            record.cost(plot),
            record.error_mm,
            ls="",
            label=f"{record.compared.name}, {record.error_mm:.3g} mm",
            **style,
        )
    front = sorted((record.cost(plot), record.error_mm) for record in shown if plot in record.best_on)
    step = "steps-pre" if plot == "throughput" else "steps-post"
    axes.plot(*zip(*front, strict=True), ls="--", color=INK, lw=1.0, drawstyle=step, zorder=1, label="unbeaten")
    highest = max(record.error_mm for record in shown if not record.compared.given_force)
    for name, value in limits.items():
        if value <= highest:  # unbiased near a fold: centimetres
            axes.axhline(value, color=INK, ls=OWN_STYLES[name]["ls"], zorder=1, label=f"{name}, {value:.3g} mm")
    _logarithmic(axes, AXES[plot], "position error, rms, mm")
    axes.xaxis.set_major_formatter("{x:,g}")
    if plot == "throughput":
        axes.invert_xaxis()
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    return figure


def _logarithmic(axes: Any, x: str, y: str) -> None:
    """Logarithmic axes with plain numbers."""
    axes.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e3 * low else (1.0,)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.25, which="both", lw=0.5)


def error_maps(sensor: Sensor, domain: Domain, draws: Draws) -> Figure:
    """Root-mean-square errors of the released model over the film."""
    figure = new_figure(11.5, 5.0)
    labels = {
        "position error, rms, mm": position_error(draws.contact, draws.truth),
        "relative force error, rms, %": 100.0 * (draws.contact[:, 2] / draws.truth[:, 2] - 1.0),
    }
    for axes, (label, values) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        cells = axes.hexbin(*draws.truth[:, :2].T, values, gridsize=22, reduce_C_function=rms, cmap="viridis", lw=0.1)
        cells.set_clip_path(Circle((0, 0), domain.radius, transform=axes.transData))
        cells.set_clim(*np.percentile(np.ma.compressed(cells.get_array()), (0.5, 99.5)))
        figure.colorbar(cells, ax=axes, shrink=0.85, label=label)
        draw_layout(axes, sensor, domain.radius)
    return figure


def error_lines(x: Sequence[float], lines: Mapping[str, Sequence[float | None]], label: str) -> Figure:
    """Position errors of several methods, and the limits, against what `label` says."""
    figure, axes = new_axes(8.0, 5.0)
    for name, values in lines.items():
        axes.plot(x, np.array(values, dtype=float), label=name, **_style(name))
    _logarithmic(axes, label, "position error, rms, mm")
    axes.legend(fontsize=8)
    return figure


def _style(name: str) -> dict[str, Any]:
    return {"marker": "o", "ms": 4, "lw": 1.3} | OWN_STYLES.get(name, {})


def calibration(record: Mapping[str, Any]) -> Figure:
    """Coverage of the released model's intervals less their nominal level."""
    figure, axes = new_axes(6.5, 4.4)
    level = 100.0 * np.array(record["levels"])
    axes.axhspan(-2.0, 2.0, color=GREY, alpha=0.15, lw=0)
    for name in COORDINATES:
        axes.plot(level, 100.0 * np.array(record["coverage"][name]) - level, ".-", label=name)
    axes.set(xlabel="nominal level, %", ylabel="truths inside minus nominal, percentage points", xlim=(0, 100))
    axes.grid(alpha=0.25, lw=0.5)
    axes.legend()
    return figure


def mismatch_effect(cases: Sequence[Mapping[str, Any]], nominal: float | None) -> Figure:
    """Errors and alarms where the film, probe or chain is not as the models assume."""
    some = {f"{case['group']}: {case['case']}": case for case in cases if case["group"] != "noise"}
    figure = new_figure(11.5, 1.9 + 0.36 * len(some))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1.0))
    for name in cases[0]["errors"]:
        errors = [case["errors"][name]["position_rms_mm"] for case in some.values()]
        left.plot(errors, [*some], **{**_style(name), "ls": ""}, label=name)
    left.axvline(nominal or np.nan, color=FELT, lw=0.9, ls="--", label="as assumed")
    bars = right.barh([*some], [case["alarms_percent"] for case in some.values()], color=FELT, alpha=0.8, height=0.6)
    right.bar_label(bars, fmt="{:g}", padding=3, fontsize=8)
    right.axvline(100.0 * FALSE_ALARM_RATE, color=INK, lw=0.9, ls="--")
    left.set(xlabel="position error, rms, mm", xscale="log")
    left.invert_yaxis()
    right.set(xlabel="presses with an alarm from the misfit, %", xlim=(0, 112))
    left.xaxis.set_major_formatter("{x:g}")
    left.grid(alpha=0.25, lw=0.5)
    figure.legend(loc="outside lower center", fontsize=8, ncol=6, frameon=False)
    return figure


def limit_lines(limits: Mapping[str, Any]) -> dict[str, float]:
    """Names of the limits in a section's record, and their position errors, mm."""
    known = {BAYES: limits["bayes"], CRAMER_RAO: limits["cramer_rao"]}
    return {name: limit["position_rms_mm"] for name, limit in known.items() if limit}
