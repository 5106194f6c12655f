"""The report's pictures of errors, calibration and effects, and the colours and lines of all its pictures."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from isocharge.common.arrays import Integers
from isocharge.simulate import Sensor
from isocharge.simulate.numerics.statistics import rms
from isocharge.simulate.plots.figure import FELT, INK, new_figure, save_picture
from isocharge.simulate.plots.film import draw_electrodes, draw_working_area, frame_film
from isocharge.train.data.alarms import FALSE_ALARMS
from isocharge.train.data.domain import ContactDomain
from isocharge.train.report.limits import BAYES, CRAMER_RAO
from isocharge.train.report.maps import COORDINATES, Draws

GREY, RELEASED = "#8a95a5", FELT
"""Colours of secondary lines, and of the released model."""

LINES = ("#2b6cb0", "#2f7f6f", "#c47f17", "#7a5195", "#8c564b", "#4c9be8")
"""Colours of methods where kinds do not tell them apart."""

LIMIT_STYLES = {BAYES: "-", CRAMER_RAO: ":"}
"""How the limits are drawn."""


def error_maps(sensor: Sensor, domain: ContactDomain, draws: Draws) -> Figure:
    """Root-mean-square errors of the released model over the film."""
    figure = new_figure(11.5, 5.0)
    for axes, values, label in zip(
        figure.subplots(1, 2),
        (draws.position_mm, draws.force_percent),
        ("position error, rms, mm", "relative force error, rms, %"),
        strict=True,
    ):
        cells = axes.hexbin(*draws.truth[:, :2].T, values, gridsize=22, reduce_C_function=rms, cmap="viridis", lw=0.1)
        cells.set_clip_path(Circle((0, 0), domain.radius_mm, transform=axes.transData))
        cells.set_clim(*np.percentile(np.ma.compressed(cells.get_array()), (0.5, 99.5)))
        axes.figure.colorbar(cells, ax=axes, shrink=0.85, label=label)
        draw_electrodes(axes, sensor)
        draw_working_area(axes, 1e-3 * domain.radius_mm)
        frame_film(axes, sensor, 1e-3 * domain.radius_mm)
    return figure


def against_force(lines: dict[str, Any], released: str) -> Figure:
    """Position error of several methods, and the limits, against the force."""
    figure = new_figure(8.0, 5.0)
    axes = figure.subplots()
    colours = iter(LINES)
    for name, values in lines["position_rms_mm"].items():
        style: dict[str, Any] = {"lw": 1.4, "marker": ".", "color": None}
        if name in LIMIT_STYLES:
            style = {"lw": 2.0, "ls": LIMIT_STYLES[name], "color": INK}
        elif name == released:
            style = {"lw": 2.0, "marker": "*", "ms": 9, "color": RELEASED}
        else:
            style["color"] = next(colours, GREY)
        axes.plot(lines["force_N"], np.array(values, dtype=float), label=name, **style)
    axes.set(xscale="log", yscale="log", xlabel="force, N", ylabel="position error, rms, mm")
    _plain_ticks(axes)
    axes.grid(alpha=0.25, which="both", lw=0.5)
    axes.legend(fontsize=8)
    return figure


def _plain_ticks(axes: Any) -> None:
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        steps = [step * 10.0**power for power in range(-3, 4) for step in (1, 1.5, 2, 3, 5, 7)]
        axis.set_major_locator(FixedLocator([step for step in steps if low <= step <= high]))
        axis.set_major_formatter(plain)
        axis.set_minor_formatter(NullFormatter())


def calibration(record: dict[str, Any]) -> Figure:
    """Coverage of the released model's intervals against their nominal level, and the difference of both."""
    figure = new_figure(9.5, 4.4)
    left, right = figure.subplots(1, 2)
    level = 100.0 * np.array(record["levels"])
    for axes in (left, right):
        axes.axhline(0.0, color=GREY, lw=1.0) if axes is right else axes.plot([0, 100], [0, 100], color=GREY, lw=1.0)
    for name, colour in zip(COORDINATES, (LINES[0], LINES[1], RELEASED), strict=True):
        covered = 100.0 * np.array(record["coverage"][name])
        left.plot(level, covered, ".-", color=colour, label=name)
        right.plot(level, covered - level, ".-", color=colour, label=name)
    left.set(xlabel="nominal level, %", ylabel="truths inside, %", aspect="equal", xlim=(0, 100), ylim=(0, 100))
    right.set(xlabel="nominal level, %", ylabel="inside minus nominal, percentage points", xlim=(0, 100))
    reach = max(3.5, 1.15 * float(np.abs(right.get_ylim()).max()))
    right.set_ylim(-reach, reach)
    right.axhspan(-2.0, 2.0, color=GREY, alpha=0.15, lw=0)
    left.legend()
    for axes in (left, right):
        axes.grid(alpha=0.25, lw=0.5)
    return figure


def noise_effect(cases: Sequence[dict[str, Any]], released: str) -> Figure:
    """Position error against the level of the noise."""
    some = [case for case in cases if case["group"] == "noise"]
    levels = [float(case["case"].removeprefix("x ")) for case in some]
    lines = {name: [case["errors"][name]["position_rms_mm"] for case in some] for name in some[0]["errors"]}
    figure = new_figure(8.0, 4.6)
    axes = figure.subplots()
    _method_lines(axes, levels, lines, released)
    axes.set(xscale="log", yscale="log", xlabel="noise over reference", ylabel="position error, rms, mm")
    _plain_ticks(axes)
    axes.grid(alpha=0.25, which="both", lw=0.5)
    axes.legend(fontsize=8)
    return figure


def _method_lines(axes: Any, x: Sequence[float], lines: dict[str, list[float]], released: str) -> None:
    colours = iter(LINES)
    for name, values in lines.items():
        mine = name == released
        axes.plot(
            x,
            values,
            marker="*" if mine else ".",
            ms=9 if mine else 5,
            lw=2.0 if mine else 1.3,
            color=RELEASED if mine else next(colours, GREY),
            label=name,
        )


def mismatch_effect(cases: Sequence[dict[str, Any]], released: str, nominal: float | None) -> Figure:
    """Errors and alarms where the film, probe or chain is not as the models assume."""
    some = [case for case in cases if case["group"] != "noise"]
    figure = new_figure(11.5, 1.9 + 0.36 * len(some))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1.0))
    height = np.arange(len(some))[::-1]
    _error_dots(left, some, height, released)
    if nominal:
        left.axvline(nominal, color=RELEASED, lw=0.9, ls="--")
        left.annotate(
            "as assumed", (nominal, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=8
        )
    right.barh(height, [case["alarms_percent"] for case in some], color=RELEASED, alpha=0.8, height=0.6)
    for y, case in zip(height, some, strict=True):
        right.annotate(
            f"{case['alarms_percent']:g}",
            (case["alarms_percent"], y),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    right.axvline(100.0 * FALSE_ALARMS, color=INK, lw=0.9, ls="--")
    left.set(
        xlabel="position error, rms, mm",
        xscale="log",
        yticks=height,
        yticklabels=[_case_label(case) for case in some],
        ylim=(-0.7, len(some) - 0.3),
    )
    right.set(xlabel="presses with an alarm from the misfit, %", xlim=(0, 112))
    left.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    left.grid(alpha=0.25, lw=0.5)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", fontsize=8, ncol=6, frameon=False)
    return figure


def _error_dots(axes: Any, cases: Sequence[dict[str, Any]], height: Integers, released: str) -> None:
    known = [(y, case["errors"]) for y, case in zip(height, cases, strict=True) if case["errors"]]
    colours = iter(LINES)
    for name in known[0][1]:
        mine = name == released
        axes.plot(
            [errors[name]["position_rms_mm"] for _, errors in known],
            [y for y, _ in known],
            "*" if mine else "o",
            ms=12 if mine else 5,
            color=RELEASED if mine else next(colours, GREY),
            label=name,
            zorder=3 if mine else 2,
        )


def _case_label(case: dict[str, Any]) -> str:
    return f"{case['group']}: {case['case']}" if case["group"] in ("probe", "pretension", "gain") else str(case["case"])


def draw_all(
    folder: Path, stem: str, drawings: dict[str, Callable[[], Figure]], progress: Callable[[str], None]
) -> dict[str, list[str]]:
    """Draw and write every picture; name to files."""
    files = {}
    for name, draw in drawings.items():
        progress(f"drawing: {name}")
        figure = draw()
        files[name] = [f"{stem}-{name}.{kind}" for kind in ("png", "svg")]
        for file in files[name]:
            save_picture(figure, folder / file)
    return files
