"""Error against time, throughput or memory: one point for each method and form, the limits drawn in."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter

from isocharge.common.arrays import Array
from isocharge.simulate.plots.figure import INK, new_figure
from isocharge.train.baselines import networks
from isocharge.train.report.measures import MethodRecord, Plot
from isocharge.train.report.pictures import GREY, LIMIT_STYLES, RELEASED

KINDS = {"paper": "#7a5195", "learnt": "#2f7f6f", "fitted map": "#c47f17", "network": "#2b6cb0"}
"""Colours of the kinds of methods."""

KIND_LABELS = {
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

AXES: dict[Plot, str] = {
    "latency": "time of one prediction, median, us",
    "throughput": "predictions per second in batches of {batch}",
    "memory": "memory of the method, bytes",
}
"""Label of each plot's horizontal axis."""


def speed_plot(records: Sequence[MethodRecord], plot: Plot, limits: dict[str, float], batch: int) -> Figure:
    """Position error against latency, throughput or memory, one point for each method and form.

    Args:
        records: Of the methods.
        plot: Which of AXES.
        limits: Name to position error, mm, of what is drawn as a line, unless every method is below it.
        batch: Presses in a batch, for the label.
    """
    figure = new_figure(10.5, 6.6)
    axes = figure.subplots()
    shown = [record for record in records if record.errors.position_rms_mm]
    fair = [record.error_mm for record in shown if not record.force_given]
    limits = {name: value for name, value in limits.items() if value <= max(fair)}  # unbiased near a fold: centimetres
    _error_axis(axes, fair + list(limits.values()))
    _points(axes, shown, plot)
    _front(axes, shown, plot)
    for name, value in limits.items():
        axes.axhline(value, color=INK, lw=1.4, ls=LIMIT_STYLES[name], zorder=1)
    axes.set(xscale="log", xlabel=AXES[plot].format(batch=batch), ylabel="position error, rms, mm")
    axes.grid(alpha=0.25, which="both", lw=0.5)
    if plot == "throughput":
        axes.invert_xaxis()
    _name_all(axes, shown, plot, limits)
    _legend(axes, shown)
    return figure


STRETCH = 0.97
"""The error axis is logarithmic in the distance from this share of the smallest error: stretched near the limit. What
is given the force may lie below; it is drawn at the axis' lower end."""


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
    """Round numbers from low to high, the nicest first, at heights (0 to 1) that keep their labels apart."""
    ticks: list[float] = []
    for digits in NICE:
        for tick in (float(f"{digit * 10.0**power:.6g}") for power in range(-3, 2) for digit in digits):
            if low <= tick <= high and all(abs(height(tick) - height(other)) > 0.045 for other in ticks):
                ticks.append(tick)
    return sorted(ticks)


def _points(axes: Any, records: Sequence[MethodRecord], plot: Plot) -> None:
    """Points, the forms of one method joined by a thin line."""
    for name in dict.fromkeys(record.name for record in records):
        forms = [record for record in records if record.name == name]
        spots = sorted((record.cost(plot), _height(axes, record)) for record in forms)
        axes.plot(*np.array(spots).T, color=_colour(forms[0]), lw=0.9, alpha=0.6, zorder=2)
    for record in records:
        released = record.form == "Predictor"
        colour = _colour(record)
        hollow = record.force_given or record.errors.answered < 1.0
        axes.plot(
            record.cost(plot),
            _height(axes, record),
            MARKERS.get(record.form, "o"),
            color=colour,
            mfc="white" if hollow else colour,
            ms=17 if released else 7,
            mec="white" if released else colour,
            zorder=5 if released else 3,
        )


def _front(axes: Any, records: Sequence[MethodRecord], plot: Plot) -> None:
    front = sorted((record.cost(plot), record.error_mm) for record in records if plot in record.best_on)
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


def _name_all(axes: Any, records: Sequence[MethodRecord], plot: Plot, limits: dict[str, float]) -> None:
    """Names of methods and limits in a column right of the plot, without overlap, each with a line to its height."""
    entries = [(value, f"{name}, {value:.3g} mm", INK) for name, value in limits.items()]
    edge = axes.get_xlim()[1]
    for name in dict.fromkeys(record.name for record in records):
        forms = [record for record in records if record.name == name]
        error, colour = _height(axes, forms[0]), _colour(forms[0])
        nearest = (min if edge < axes.get_xlim()[0] else max)(record.cost(plot) for record in forms)
        axes.plot([nearest, edge], [error, error], color=colour, lw=0.5, alpha=0.35, zorder=1)
        entries.append((error, _short(forms[0]), colour))
    entries.sort(key=lambda entry: entry[0])
    axes.set_xlim(axes.get_xlim()[0], edge)
    heights = [_axes_height(axes, entry[0]) for entry in entries]
    for (error, label, colour), height in zip(entries, spread(heights, 0.037), strict=True):
        axes.annotate(
            label,
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


def _height(axes: Any, record: MethodRecord) -> float:
    return max(record.error_mm, float(axes.get_ylim()[0]))


def _colour(record: MethodRecord) -> str:
    return RELEASED if record.name.startswith(networks.RELEASED) else KINDS[record.kind]


def spread(targets: Sequence[float], apart: float) -> list[float]:
    """Heights at least `apart` from each other, in the same ascending order, near the target heights."""
    heights: list[float] = []
    for height in targets:
        heights.append(max(height, heights[-1] + apart) if heights else height)
    beyond = heights[-1] - max(1.0, targets[-1])
    if beyond > 0.0:
        heights[-1] -= beyond
        for k in range(len(heights) - 2, -1, -1):
            heights[k] = min(heights[k], heights[k + 1] - apart)
    return heights


def _short(record: MethodRecord) -> str:
    notes = []
    if record.force_given:
        notes.append(f"{record.error_mm:.3g} mm")
    if record.errors.answered < 1.0:
        notes.append(f"{100 * record.errors.answered:.3g} % answered")
    return record.name + (f" ({', '.join(notes)})" if notes else "")


def _legend(axes: Any, records: Sequence[MethodRecord]) -> None:
    for kind in dict.fromkeys(record.kind for record in records):
        axes.plot([], [], "-", lw=4, color=KINDS[kind], label=KIND_LABELS[kind])
    for form in MARKERS:
        if any(record.form == form for record in records):
            colour = RELEASED if form == "Predictor" else GREY
            axes.plot([], [], MARKERS[form], color=colour, label=_form_label(form), ms=7)
    axes.figure.legend(loc="outside lower center", fontsize=8, ncol=5, frameon=False)


def _form_label(form: str) -> str:
    return "released model (Predictor)" if form == "Predictor" else form
