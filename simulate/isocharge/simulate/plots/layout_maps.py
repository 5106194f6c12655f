"""Pictures of a designed layout: errors before and after on one scale, trade-offs, placement tolerances."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disk
from matplotlib.ticker import NullFormatter, ScalarFormatter

from isocharge.common.arrays import Array
from isocharge.simulate.layout.costs import ErrorMap, ToleranceCost, TradeOff
from isocharge.simulate.plots.figure import FELT, INK, new_figure, shades
from isocharge.simulate.plots.film import draw_electrodes
from isocharge.simulate.sensor.sensor import Sensor

LARGEST = 10.0
"""Errors above this multiple of the smallest have the colour of the end."""


def error_maps_picture(
    before: tuple[Sensor, ErrorMap] | None, after: tuple[Sensor, ErrorMap], radius: float, title: str
) -> Figure:
    """Position errors with the nuisances of the task as colours, on one scale; m in, mm on the axes."""
    layouts = [layout for layout in (before, after) if layout]
    figure = new_figure(6.4 * len(layouts) + 1.0, 6.0)
    axes = np.atleast_1d(figure.subplots(1, len(layouts)))
    smallest = min(float(errors.task.min()) for _, errors in layouts)
    norm = LogNorm(1e3 * smallest, 1e3 * LARGEST * smallest)
    reach = 1e3 * max(_reach(sensor, radius) for sensor, _ in layouts)
    for one, (sensor, errors) in zip(axes, layouts, strict=True):
        shown = _draw_errors(one, errors, norm)
        draw_electrodes(one, sensor)
        one.add_patch(Disk((0, 0), 1e3 * radius, fill=False, ls=":", color=INK))
        worst = errors.presses[int(np.argmax(errors.task))]
        one.plot(*1e3 * worst, "x", color=FELT, ms=9, mew=2)
        one.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x, mm", ylabel="y, mm", aspect="equal")
        rms = float(np.sqrt(np.mean(errors.task**2)))
        one.set_title(f"{sensor.name}\nworst {1e3 * errors.task.max():.3g} mm (cross), rms {1e3 * rms:.3g} mm")
    bar = figure.colorbar(shown, ax=list(axes), label="least position error (rms), mm", shrink=0.85)
    bar.ax.yaxis.set_major_formatter(ScalarFormatter())
    bar.ax.yaxis.set_minor_formatter(ScalarFormatter())
    figure.suptitle(title)
    return figure


def trade_off_picture(trade: TradeOff, goal: str, side: float) -> Figure:
    """Error against radius for each number of electrodes, and against the size of the squares (m)."""
    figure = new_figure(12.0, 5.0)
    left, right = figure.subplots(1, 2)
    for (number, errors), colour in zip(trade.by_number.items(), shades(len(trade.by_number)), strict=True):
        left.plot(1e3 * trade.radius, 1e3 * errors, "o-", color=colour, label=f"{number}")
    left.set(xlabel="working radius, mm", title=f"squares of {1e3 * side:g} mm")
    left.legend(title="electrodes", fontsize=8)
    right.plot(1e3 * trade.side, 1e3 * trade.by_side, "o-", color=INK)
    right.set(xlabel="side of the squares, mm", title="size")
    what = "worst" if goal == "worst" else "rms of the"
    for axes in (left, right):
        axes.set_yscale("log")
        axes.set_ylabel(f"{what} least position error, mm")
        axes.yaxis.set_major_formatter(ScalarFormatter())
        axes.yaxis.set_minor_formatter(ScalarFormatter() if axes is right else NullFormatter())
        axes.grid(alpha=0.3, which="both")
    left.yaxis.set_minor_formatter(ScalarFormatter())
    return figure


def tolerance_picture(costs: Sequence[ToleranceCost], worst: float) -> Figure:
    """What placement tolerances cost; `worst` is the error of the exact layout, m."""
    figure = new_figure(6.4, 4.4)
    axes = figure.subplots()
    tolerance = [0.0, *(1e3 * cost.tolerance for cost in costs)]
    axes.plot(tolerance, [1e3 * worst, *(1e3 * cost.measured for cost in costs)], "o-", color=INK,
              label="worst error, places measured afterwards")  # fmt: skip
    axes.plot(tolerance, [0.0, *(1e3 * cost.unmeasured for cost in costs)], "s--", color=FELT,
              label="added error (rms), places not measured")  # fmt: skip
    axes.set(xlabel="placement tolerance, mm", ylabel="position error, mm", ylim=(0.0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def _reach(sensor: Sensor, radius: float) -> float:
    corners = np.concatenate([np.array(electrode.corners) for electrode in sensor.electrodes])
    return float(max(radius, np.abs(corners).max())) + 1e-3


def _draw_errors(axes: Any, errors: ErrorMap, norm: LogNorm) -> Any:
    """Errors on their square grid as an image."""
    step = float(np.unique(np.round(np.diff(np.unique(errors.presses[:, 0])), 9))[0])
    index = np.round(errors.presses / step).astype(int)
    half = int(np.abs(index).max())
    image: Array = np.full((2 * half + 1, 2 * half + 1), np.nan)
    image[index[:, 1] + half, index[:, 0] + half] = 1e3 * errors.task
    edge = 1e3 * step * (half + 0.5)
    return axes.imshow(image, origin="lower", extent=(-edge, edge, -edge, edge), norm=norm, cmap="viridis")
