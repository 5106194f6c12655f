"""Position errors of a designed layout, and of the one that it began from, on one scale."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter

from isocharge.simulate.layout.case import KNOWN
from isocharge.simulate.layout.design import Design, ErrorMap
from isocharge.simulate.plots.figure import FELT, new_figure
from isocharge.simulate.plots.film import draw_electrodes, draw_working_area
from isocharge.simulate.sensor.sensor import Sensor

LARGEST = 10.0
"""Errors above this multiple of the smallest have the colour of the end."""

AROUND = 1.0
"""Space around the electrodes, mm."""


def error_maps_picture(design: Design) -> Figure:
    """Errors with the nuisances of the case as colours, before and after."""
    case, layouts = design.case, [(design.sensor, design.after)]
    if design.before:
        layouts.insert(0, (case.sensor, design.before))
    figure = new_figure(6.4 * len(layouts) + 1.0, 6.0)
    smallest = min(float(errors.unknown.min()) for _, errors in layouts)
    norm = LogNorm(smallest, LARGEST * smallest)
    corners = np.concatenate([electrode.corners for sensor, _ in layouts for electrode in sensor.electrodes])
    reach = float(max(case.radius, np.abs(corners).max())) + AROUND
    every = figure.subplots(1, len(layouts), squeeze=False)[0]
    for axes, (sensor, errors) in zip(every, layouts, strict=True):
        shown = _draw_errors(axes, sensor, errors, norm)
        draw_working_area(axes, case.radius)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x, mm", ylabel="y, mm", aspect="equal")
    bar = figure.colorbar(shown, ax=list(every), label="least position error (rms), mm", shrink=0.85, extend="max")
    bar.ax.yaxis.set_major_formatter(ScalarFormatter())
    bar.ax.yaxis.set_minor_formatter(ScalarFormatter())
    known = "everything else known" if case.nuisances == KNOWN else "with what nobody knows exactly"
    figure.suptitle(f"{case.force:g} N, {case.probe.notation}, noise {case.noise.name}, {known}")
    return figure


def _draw_errors(axes: Any, sensor: Sensor, errors: ErrorMap, norm: LogNorm) -> Any:
    """Errors as colours, the worst place, and the electrodes."""
    draw_electrodes(axes, sensor)
    axes.plot(*errors.presses[np.argmax(errors.unknown)], "x", color=FELT, ms=9, mew=2)
    worst, rms = errors.unknown.max(), np.sqrt(np.mean(errors.unknown**2))
    axes.set_title(f"{sensor.name}\nworst {worst:.3g} mm (cross), rms {rms:.3g} mm")
    return axes.tripcolor(*errors.presses.T, errors.unknown, norm=norm, cmap="viridis", shading="gouraud")
