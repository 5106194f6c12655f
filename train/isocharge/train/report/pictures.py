"""The report's pictures, from its record and the draws behind it; each as PNG and SVG."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from isocharge.simulate import Sensor
from isocharge.simulate.arrays import Array, Integers
from isocharge.simulate.drawing import (
    FELT,
    INK,
    draw_electrodes,
    draw_working_area,
    frame_film,
    new_figure,
    save_picture,
)
from isocharge.train.charge_field import Domain
from isocharge.train.report.limits import BAYES, CRAMER_RAO
from isocharge.train.report.maps import COORDINATES, Draws
from isocharge.train.report.measures import rms

GREY, RELEASED = "#8a95a5", FELT
"""Colours of what is beside the point, and of the released model."""

KINDS = {"paper": "#7a5195", "learnt": "#2f7f6f", "fitted map": "#c47f17", "network": "#2b6cb0"}
"""Colours of the kinds of methods."""

KIND_WORDS = {
    "paper": "Mirbagheri et al. 2007",
    "learnt": "learnt from presses",
    "fitted map": "search on a forward map",
    "network": "network",
}

MARKERS = {
    "Predictor": "*",
    "NumPy": "o",
    "scikit-learn": "s",
    "SciPy KD-tree": "^",
    "SciPy least_squares": "v",
    "torch": "P",
    "ONNX Runtime": "D",
    "ONNX Runtime, bound": "X",
}
"""Markers of what computes a method."""

LINES = ("#2b6cb0", "#2f7f6f", "#c47f17", "#7a5195", "#8c564b", "#4c9be8")
"""Colours of methods where kinds do not tell them apart."""


AXES = {
    "latency": ("p50_us", "time of one prediction, median, us"),
    "throughput": ("per_second", "predictions per second in batches of {batch}"),
    "memory": ("memory_bytes", "memory of the method, bytes"),
}
"""Plot to the figure along its horizontal axis, and its words."""


def speed(records: Sequence[dict[str, Any]], plot: str, limits: dict[str, float], batch: int) -> Figure:
    """Position error against latency, throughput or memory, one point for each method and form.

    Args:
        records: Of the methods.
        plot: Which of AXES.
        limits: Name to position error, mm, of what is drawn as a line.
        batch: Presses in a batch, for the words.
    """
    key, words = AXES[plot]
    figure = new_figure(10.5, 6.6)
    axes = figure.subplots()
    shown = [record for record in records if record["errors"]["position_rms_mm"]]
    fair = [record["errors"]["position_rms_mm"] for record in shown if not record["force_given"]]
    _error_axis(axes, fair + list(limits.values()))
    _points(axes, shown, key)
    _front(axes, shown, key, plot)
    for name, value in limits.items():
        axes.axhline(value, color=INK, lw=1.4, ls=LIMIT_STYLES[name], zorder=1)
    axes.set(xscale="log", xlabel=words.format(batch=batch), ylabel="position error, rms, mm")
    axes.grid(alpha=0.25, which="both", lw=0.5)
    if plot == "throughput":
        axes.invert_xaxis()
    _name_all(axes, shown, key, limits)
    _legend(axes, shown)
    return figure


LIMIT_STYLES = {BAYES: "-", CRAMER_RAO: ":"}

STRETCH = 0.97
"""The error axis is logarithmic in the distance from this share of the smallest error: stretched near the limit. What
is told the force may lie below; it is drawn at the axis' lower end."""


def _error_axis(axes: Any, errors: Sequence[float]) -> None:
    base = STRETCH * min(errors)

    def forward(value: Array) -> Array:
        logs: Array = np.log(np.maximum(np.asarray(value, dtype=float) - base, 1e-4))
        return logs

    axes.set_yscale("function", functions=(forward, lambda height: np.exp(height) + base))
    low, high = base + 0.35 * (min(errors) - base), base + 1.3 * (max(errors) - base)
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(FixedLocator(_ticks(low, high, lambda tick: _axes_height(axes, tick))))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


NICE = ((1, 2, 5), (1.5, 3, 4, 7), (1.2, 1.7, 2.5, 6, 8), tuple(np.arange(1.05, 3.0, 0.05)))
"""Leading digits of ticks, the nicest first."""


def _ticks(low: float, high: float, height: Callable[[float], float]) -> list[float]:
    """Round numbers from low to high, the nicest first, at heights (0 to 1) that keep their words apart."""
    ticks: list[float] = []
    for digits in NICE:
        for tick in (float(f"{digit * 10.0**power:.6g}") for power in range(-3, 2) for digit in digits):
            if low <= tick <= high and all(abs(height(tick) - height(other)) > 0.045 for other in ticks):
                ticks.append(tick)
    return sorted(ticks)


def _points(axes: Any, records: Sequence[dict[str, Any]], key: str) -> None:
    """Points, the forms of one method joined by a thin line."""
    for name in dict.fromkeys(record["name"] for record in records):
        forms = [record for record in records if record["name"] == name]
        spots = sorted((record[key], _height(axes, record)) for record in forms)
        axes.plot(*np.array(spots).T, color=_colour(forms[0]), lw=0.9, alpha=0.6, zorder=2)
    for record in records:
        released = record["form"] == "Predictor"
        colour = _colour(record)
        hollow = record["force_given"] or record["errors"]["answered"] < 1.0
        axes.plot(
            record[key],
            _height(axes, record),
            MARKERS.get(record["form"], "o"),
            color=colour,
            mfc="white" if hollow else colour,
            ms=17 if released else 7,
            mec="white" if released else colour,
            zorder=5 if released else 3,
        )


def _front(axes: Any, records: Sequence[dict[str, Any]], key: str, plot: str) -> None:
    front = sorted((r[key], r["errors"]["position_rms_mm"]) for r in records if plot in r["best_on"])
    if len(front) > 1:
        style = "steps-post" if plot != "throughput" else "steps-pre"
        axes.plot(
            *np.array(front).T,
            color=INK,
            lw=1.0,
            ls="--",
            drawstyle=style,
            alpha=0.7,
            zorder=1,
            label="nothing beats these",
        )


def _name_all(axes: Any, records: Sequence[dict[str, Any]], key: str, limits: dict[str, float]) -> None:
    """Names of methods and limits in a column beside the plot, kept apart, each led to its height."""
    entries = [(value, f"{name}, {value:.3g} mm", INK) for name, value in limits.items()]
    edge = axes.get_xlim()[1]
    for name in dict.fromkeys(record["name"] for record in records):
        forms = [record for record in records if record["name"] == name]
        error, colour = _height(axes, forms[0]), _colour(forms[0])
        nearest = (min if edge < axes.get_xlim()[0] else max)(record[key] for record in forms)
        axes.plot([nearest, edge], [error, error], color=colour, lw=0.5, alpha=0.35, zorder=1)
        entries.append((error, _short(forms[0]), colour))
    entries.sort(key=lambda entry: entry[0])
    axes.set_xlim(axes.get_xlim()[0], edge)
    heights = [_axes_height(axes, entry[0]) for entry in entries]
    for (error, words, colour), height in zip(entries, spread(heights, 0.037), strict=True):
        axes.annotate(
            words,
            (1.0, error),
            xycoords=("axes fraction", "data"),
            xytext=(1.05, height),
            textcoords="axes fraction",
            fontsize=9,
            va="center",
            color=colour,
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colour,
                "lw": 0.7,
                "alpha": 0.6,
                "relpos": (0.0, 0.5),
                "shrinkB": 0,
            },
        )


def _axes_height(axes: Any, value: float) -> float:
    """Where a value of the vertical axis lies, 0 to 1."""
    return float(axes.transAxes.inverted().transform(axes.transData.transform((1.0, value)))[1])


def _height(axes: Any, record: dict[str, Any]) -> float:
    return max(float(record["errors"]["position_rms_mm"]), float(axes.get_ylim()[0]))


def _colour(record: dict[str, Any]) -> str:
    return RELEASED if record["name"].startswith("released") else KINDS[record["kind"]]


def spread(wanted: Sequence[float], apart: float) -> list[float]:
    """Heights at least so far apart, in the same ascending order, as near to the wanted ones as a sweep brings them."""
    heights: list[float] = []
    for height in wanted:
        heights.append(max(height, heights[-1] + apart) if heights else height)
    beyond = heights[-1] - max(1.0, wanted[-1])
    if beyond > 0.0:
        heights[-1] -= beyond
        for k in range(len(heights) - 2, -1, -1):
            heights[k] = min(heights[k], heights[k + 1] - apart)
    return heights


def _short(record: dict[str, Any]) -> str:
    errors, notes = record["errors"], []
    if record["force_given"]:
        notes.append(f"{errors['position_rms_mm']:.3g} mm")
    if errors["answered"] < 1.0:
        notes.append(f"{100 * errors['answered']:.3g} % answered")
    return str(record["name"]) + (f" ({', '.join(notes)})" if notes else "")


def _legend(axes: Any, records: Sequence[dict[str, Any]]) -> None:
    for kind in dict.fromkeys(record["kind"] for record in records):
        axes.plot([], [], "-", lw=4, color=KINDS[kind], label=KIND_WORDS[kind])
    for form in MARKERS:
        if any(record["form"] == form for record in records):
            colour = RELEASED if form == "Predictor" else GREY
            axes.plot([], [], MARKERS[form], color=colour, label=_form_words(form), ms=7)
    axes.figure.legend(loc="outside lower center", fontsize=8, ncol=5, frameon=False)


def _form_words(form: str) -> str:
    return "released model (Predictor)" if form == "Predictor" else form


def error_maps(sensor: Sensor, domain: Domain, draws: Draws) -> Figure:
    """Root-mean-square errors of the released model over the film."""
    figure = new_figure(11.5, 5.0)
    for axes, values, words in zip(
        figure.subplots(1, 2),
        (draws.position_mm, draws.force_percent),
        ("position error, rms, mm", "relative force error, rms, %"),
        strict=True,
    ):
        cells = axes.hexbin(*draws.truth[:, :2].T, values, gridsize=22, reduce_C_function=rms, cmap="viridis", lw=0.1)
        cells.set_clip_path(Circle((0, 0), domain.radius_mm, transform=axes.transData))
        cells.set_clim(*np.percentile(np.ma.compressed(cells.get_array()), (0.5, 99.5)))
        axes.figure.colorbar(cells, ax=axes, shrink=0.85, label=words)
        draw_electrodes(axes, sensor)
        draw_working_area(axes, 1e-3 * domain.radius_mm)
        frame_film(axes, sensor, 1e-3 * domain.radius_mm, words)
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


FARTHEST_MM = 50.0
"""Errors beyond this, from methods that explode outside of what they know, are drawn here."""


def wrong_world(cases: Sequence[dict[str, Any]], released: str, nominal: float | None) -> Figure:
    """Errors and alarms where the film, probe or chain is not as the models were told."""
    some = [case for case in cases if case["group"] != "noise"]
    figure = new_figure(11.5, 1.6 + 0.36 * len(some))
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.5, 1.0))
    height = np.arange(len(some))[::-1]
    _error_dots(left, some, height, released)
    if nominal:
        left.axvline(nominal, color=RELEASED, lw=0.9, ls="--")
        left.annotate(
            "as told", (nominal, 1.0), xycoords=("data", "axes fraction"), ha="center", va="bottom", fontsize=8
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
    right.axvline(1.0, color=INK, lw=0.9, ls="--")
    left.set(
        xlabel="position error, rms, mm",
        xscale="log",
        yticks=height,
        yticklabels=[_case_words(case) for case in some],
        ylim=(-0.7, len(some) - 0.3),
    )
    right.set(xlabel="presses with an alarm from the misfit, %", xlim=(0, 112))
    left.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    left.grid(alpha=0.25, lw=0.5)
    left.legend(fontsize=8, loc="lower right")
    return figure


def _error_dots(axes: Any, cases: Sequence[dict[str, Any]], height: Integers, released: str) -> None:
    known = [(y, case["errors"]) for y, case in zip(height, cases, strict=True) if case["errors"]]
    colours = iter(LINES)
    for name in known[0][1]:
        mine = name == released
        axes.plot(
            [min(errors[name]["position_rms_mm"], FARTHEST_MM) for _, errors in known],
            [y for y, _ in known],
            "*" if mine else "o",
            ms=12 if mine else 5,
            color=RELEASED if mine else next(colours, GREY),
            label=name,
            zorder=3 if mine else 2,
        )


def _case_words(case: dict[str, Any]) -> str:
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
