"""Maps of the least possible error over the film: what a layout allows, and what a design has gained."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from isocharge.simulate.identifiability.identification import Identification, LimitMap
from isocharge.simulate.layout.case import NO_NUISANCES
from isocharge.simulate.layout.design import Design, ErrorMap
from isocharge.simulate.plots.figure import FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_circle, draw_electrodes, draw_working_area
from isocharge.simulate.sensor.sensor import Sensor

SMALLEST_MM, LARGEST_MM = 0.02, 5.0
"""Position errors at the ends of the colours, mm; smaller and larger ones have the colours of the ends."""

TICKS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Position errors that the colour bar names, mm."""

MOST_TIMES = 10.0
"""Errors above this multiple of the smallest have the colour of the end."""

MARGIN = 1.0
"""Space around the electrodes, mm."""


def identification_picture(identification: Identification) -> Figure:
    """Maps under the least and the greatest force, and the error against distance."""
    figure = new_figure(16.0, 5.2)
    weak, strong, curves = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    for axes, limit_map in ((weak, identification.maps[0]), (strong, identification.maps[-1])):
        shades = draw_limit_map(axes, identification, limit_map)
    figure.colorbar(
        shades, ax=[weak, strong], label="least position error (rms), mm", ticks=TICKS, format="%g", pad=0.01
    )
    _draw_distance(curves, identification)
    title = f"{identification.sensor.name}, {identification.probe.notation}, noise {identification.noise.name}"
    figure.suptitle(title, fontsize=13)
    return figure


def draw_limit_map(axes: Any, identification: Identification, limit_map: LimitMap) -> Any:
    """Position errors under one force as colours, with folds, working area and electrodes to scale."""
    x, y = limit_map.rings.position.reshape(-1, 2).T
    levels = np.geomspace(SMALLEST_MM, LARGEST_MM, 25)
    shown = np.clip(limit_map.position.ravel(), SMALLEST_MM, LARGEST_MM)
    shades = axes.tricontourf(x, y, shown, levels, norm=LogNorm(), cmap="viridis")
    folds = identification.area.folds
    axes.plot(*folds.T, ".", color=FELT, ms=3)
    draw_circle(axes, identification.area.radius, ls="--", lw=1.8, color="white")
    draw_electrodes(axes, identification.sensor)
    reach = identification.area.searched
    title = f"{limit_map.force:g} N; dashed: working area, {identification.area.radius:g} mm"
    title += "; red: folds" if len(folds) else ""
    axes.set(title=title, xlabel="x, mm", ylabel="y, mm", aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
    return shades


def _draw_distance(axes: Any, identification: Identification) -> None:
    """Median and worst error of every ring against its distance from the centre."""
    area = identification.area
    for number, limit_map in enumerate(identification.maps):
        colour = ("#8fb8de", "#3a7ca5", INK)[number - len(identification.maps)]
        distance = limit_map.rings.distance
        axes.semilogy(distance, np.median(limit_map.position, axis=1), color=colour, label=f"{limit_map.force:g} N")
        axes.semilogy(distance, limit_map.position.max(axis=1), ":", color=colour)
    axes.plot([], [], ":", color=INK, label="worst of the ring")
    axes.axhline(area.error, color=FELT, lw=0.8)
    axes.axvline(area.radius, ls="--", color=INK, label=f"working area, {area.radius:g} mm")
    if np.isfinite(area.fold_radius):
        axes.axvline(area.fold_radius, color=FELT, label=f"first fold, {area.fold_radius:.1f} mm")
    axes.set(
        xlabel="distance from the centre, mm",
        ylabel="least position error (rms), mm",
        xlim=(0.0, area.searched),
        ylim=(0.005, 20.0),
    )
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")


def error_maps_picture(design: Design) -> Figure:
    """Errors with the nuisances of the case as colours, before and after."""
    case, layouts = design.case, [(design.sensor, design.after)]
    if design.before:
        layouts.insert(0, (case.sensor, design.before))
    figure = new_figure(6.4 * len(layouts) + 1.0, 6.0)
    smallest = min(float(errors.with_nuisances.min()) for _, errors in layouts)
    norm = LogNorm(smallest, MOST_TIMES * smallest)
    electrodes = [electrode for sensor, _ in layouts for electrode in sensor.electrodes]
    corners = np.concatenate([polygon for electrode in electrodes for polygon in electrode.front])
    reach = float(max(case.radius, np.abs(corners).max())) + MARGIN
    every = figure.subplots(1, len(layouts), squeeze=False)[0]
    for axes, (sensor, errors) in zip(every, layouts, strict=True):
        shown = _draw_errors(axes, sensor, errors, norm)
        draw_working_area(axes, case.radius)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x, mm", ylabel="y, mm", aspect="equal")
    bar = figure.colorbar(shown, ax=list(every), label="least position error (rms), mm", shrink=0.85, extend="max")
    bar.ax.yaxis.set_major_formatter(ScalarFormatter())
    bar.ax.yaxis.set_minor_formatter(ScalarFormatter())
    known = "everything else known" if case.nuisances == NO_NUISANCES else "with what nobody knows exactly"
    figure.suptitle(f"{case.force:g} N, {case.probe.notation}, noise {case.noise.name}, {known}")
    return figure


def _draw_errors(axes: Any, sensor: Sensor, errors: ErrorMap, norm: LogNorm) -> Any:
    """Errors as colours, the worst place, and the electrodes."""
    draw_electrodes(axes, sensor)
    axes.plot(*errors.presses[np.argmax(errors.with_nuisances)], "x", color=FELT, ms=9, mew=2)
    worst, rms = errors.with_nuisances.max(), np.sqrt(np.mean(errors.with_nuisances**2))
    axes.set_title(f"{sensor.name}\nworst {worst:.3g} mm (cross), rms {rms:.3g} mm")
    return axes.tripcolor(*errors.presses.T, errors.with_nuisances, norm=norm, cmap="viridis", shading="gouraud")
