"""Pictures of a designed layout: errors before and after on one scale, placement tolerances."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from isocharge.common.arrays import Array
from isocharge.simulate.layout.costs import ErrorMap, ToleranceCost
from isocharge.simulate.plots.figure import FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_circle, draw_electrodes, frame_film
from isocharge.simulate.sensor.sensor import Sensor

LARGEST = 10.0
"""Errors above this multiple of the smallest have the colour of the end."""


def error_maps_picture(
    before: tuple[Sensor, ErrorMap] | None, after: tuple[Sensor, ErrorMap], radius: float, title: str
) -> Figure:
    """Position errors with the nuisances of the task as colours, on one scale, mm, over a disk of `radius` (mm)."""
    layouts = [layout for layout in (before, after) if layout]
    figure = new_figure(6.4 * len(layouts) + 1.0, 6.0)
    axes = np.atleast_1d(figure.subplots(1, len(layouts), sharex=True, sharey=True))
    smallest = min(float(errors.task.min()) for _, errors in layouts)
    norm = LogNorm(smallest, LARGEST * smallest)
    for one, (sensor, errors) in zip(axes, layouts, strict=True):
        shown = _draw_errors(one, errors, norm)
        draw_electrodes(one, sensor)
        draw_circle(one, radius, ls=":", color=INK)
        one.plot(*errors.presses[int(np.argmax(errors.task))], "x", color=FELT, ms=9, mew=2)
        rms = float(np.sqrt(np.mean(errors.task**2)))
        frame_film(one, sensor, radius, f"{sensor.name}\nworst {errors.task.max():.3g} mm (cross), rms {rms:.3g} mm")
    reach = max(one.get_xlim()[1] for one in axes)
    axes[0].set(xlim=(-reach, reach), ylim=(-reach, reach))
    bar = figure.colorbar(shown, ax=list(axes), label="least position error (rms), mm", shrink=0.85)
    bar.ax.yaxis.set_major_formatter(ScalarFormatter())
    bar.ax.yaxis.set_minor_formatter(ScalarFormatter())
    figure.suptitle(title)
    return figure


def tolerance_picture(costs: Sequence[ToleranceCost], worst: float) -> Figure:
    """What placement tolerances cost; `worst` is the error of the exact layout, mm."""
    figure = new_figure(6.4, 4.4)
    axes = figure.subplots()
    tolerance = [0.0, *(cost.tolerance for cost in costs)]
    measured, unmeasured = [worst, *(cost.measured for cost in costs)], [0.0, *(cost.unmeasured for cost in costs)]
    axes.plot(tolerance, measured, "o-", color=INK, label="worst error, places measured afterwards")
    axes.plot(tolerance, unmeasured, "s--", color=FELT, label="added error (rms), places not measured")
    axes.set(xlabel="placement tolerance, mm", ylabel="position error, mm", ylim=(0.0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def _draw_errors(axes: Any, errors: ErrorMap, norm: LogNorm) -> Any:
    """Errors on their square grid as an image."""
    step = float(np.unique(np.round(np.diff(np.unique(errors.presses[:, 0])), 6))[0])
    index = np.round(errors.presses / step).astype(int)
    half = int(np.abs(index).max())
    image: Array = np.full((2 * half + 1, 2 * half + 1), np.nan)
    image[index[:, 1] + half, index[:, 0] + half] = errors.task
    edge = step * (half + 0.5)
    return axes.imshow(image, origin="lower", extent=(-edge, edge, -edge, edge), norm=norm, cmap="viridis")
