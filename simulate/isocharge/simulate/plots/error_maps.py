"""Pictures of an identification or a design that show the lower limit of the position error over the film."""

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

MIN_ERROR_mm = 0.02
"""Position error at the lower end of the colour scale, mm. Smaller errors have the colour of this error."""

MAX_ERROR_mm = 5.0
"""Position error at the upper end of the colour scale, mm. Larger errors have the colour of this error."""

TICKS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Position errors that are labelled on the colour bar, mm."""

MAX_ERROR_RATIO = 10.0
"""Ratio of the largest to the smallest error of the colour scale in the maps of a design, dimensionless."""

MARGIN = 1.0
"""Margin around the electrodes in the maps of a design, mm."""

FORCE_COLOURS = ("#8fb8de", "#3a7ca5", INK)
"""Colours of the curves for ascending forces. The last colour belongs to the largest force."""


def identification_picture(identification: Identification) -> Figure:
    """Draw the position errors of an identification.

    Two maps show the errors over the film for the smallest and the largest force. A diagram shows the errors as a
    function of the distance from the centre.

    Args:
        identification: Result of `identify`.

    Returns:
        Figure with the two maps and the diagram.
    """
    figure = new_figure(16.0, 5.2)
    smallest_force_axes, largest_force_axes, distance_axes = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    draw_limit_map(smallest_force_axes, identification, identification.maps[0])
    coloured_areas = draw_limit_map(largest_force_axes, identification, identification.maps[-1])
    figure.colorbar(  # both maps have the same colour scale
        coloured_areas,
        ax=[smallest_force_axes, largest_force_axes],
        label="lower limit of the position error (rms), mm",
        ticks=TICKS,
        format="%g",
        pad=0.01,
    )
    _draw_distance(distance_axes, identification)
    title = f"{identification.sensor.name}, {identification.probe.notation}, noise {identification.noise.name}"
    figure.suptitle(title, fontsize=13)
    return figure


def draw_limit_map(axes: Any, identification: Identification, limit_map: LimitMap) -> Any:
    """Draw a map of the position errors for one force, with the folds, the working area and the electrodes.

    Args:
        axes: Axes of matplotlib.
        identification: Result of `identify`, with the sensor and the working area.
        limit_map: Lower limits of the position error for one force.

    Returns:
        The coloured areas of the map, for which a colour bar can be drawn.
    """
    # Draw the errors as colours. Errors outside the colour scale get the first or the last colour.
    x, y = limit_map.rings.position.reshape(-1, 2).T  # mm
    levels = np.geomspace(MIN_ERROR_mm, MAX_ERROR_mm, 25)
    errors = np.clip(limit_map.position.ravel(), MIN_ERROR_mm, MAX_ERROR_mm)
    coloured_areas = axes.tricontourf(x, y, errors, levels, norm=LogNorm(), cmap="viridis")

    # Draw the folds, which are positions (x, y), the working area, and the electrodes.
    folds = identification.area.folds
    fold_x, fold_y = folds.T
    axes.plot(fold_x, fold_y, ".", color=FELT, ms=3)
    draw_circle(axes, identification.area.radius, ls="--", lw=1.8, color="white")
    draw_electrodes(axes, identification.sensor)
    axis_limits = (-identification.area.search_radius, identification.area.search_radius)
    title = f"{limit_map.force:g} N; dashed: working area, {identification.area.radius:g} mm"
    if len(folds):
        title += "; red: folds"
    axes.set(title=title, xlabel="x, mm", ylabel="y, mm", aspect="equal", xlim=axis_limits, ylim=axis_limits)
    return coloured_areas


def _draw_distance(axes: Any, identification: Identification) -> None:
    """Draw the median and the largest position error on each ring as functions of the distance from the centre.

    Args:
        axes: Axes of matplotlib.
        identification: Result of `identify`, which contains a map of the errors for each force.
    """
    area = identification.area

    # Draw two curves for each force. With fewer forces than colours, the last colours are used.
    colours = FORCE_COLOURS[len(FORCE_COLOURS) - len(identification.maps) :]
    for limit_map, colour in zip(identification.maps, colours, strict=True):
        distance = limit_map.rings.distance
        median_error = np.median(limit_map.position, axis=1)
        largest_error = limit_map.position.max(axis=1)
        axes.semilogy(distance, median_error, color=colour, label=f"{limit_map.force:g} N")
        axes.semilogy(distance, largest_error, ":", color=colour)
    axes.plot([], [], ":", color=INK, label="worst of the ring")  # an entry of the legend for all dotted curves

    # Mark the allowed error, the working area, and the distance of the nearest fold if there is one.
    axes.axhline(area.error, color=FELT, lw=0.8)
    axes.axvline(area.radius, ls="--", color=INK, label=f"working area, {area.radius:g} mm")
    if np.isfinite(area.fold_radius):
        axes.axvline(area.fold_radius, color=FELT, label=f"first fold, {area.fold_radius:.1f} mm")
    axes.set(
        xlabel="distance from the centre, mm",
        ylabel="lower limit of the position error (rms), mm",
        xlim=(0.0, area.search_radius),
        ylim=(0.005, 20.0),
    )
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")


def error_maps_picture(design: Design) -> Figure:
    """Draw maps of the position errors of the initial layout and of the new layout.

    The errors include the effect of the nuisance parameters of the design case.

    Args:
        design: Result of the design of a layout.

    Returns:
        Figure with one map for each layout. If the errors of the initial layout are unknown, the figure has one map.
    """
    case = design.case
    layouts = [(design.sensor, design.errors_after)]
    if design.errors_before:
        layouts.insert(0, (case.sensor, design.errors_before))  # the map of the initial layout is on the left

    # Both maps have the same colour scale. Their axes have the same limits and show all electrodes.
    smallest = min(float(errors.with_nuisances.min()) for _, errors in layouts)
    norm = LogNorm(smallest, MAX_ERROR_RATIO * smallest)
    electrodes = [electrode for sensor, _ in layouts for electrode in sensor.electrodes]
    corners = np.concatenate([polygon for electrode in electrodes for polygon in electrode.front])
    half_width = float(max(case.radius, np.abs(corners).max())) + MARGIN
    limits = (-half_width, half_width)

    figure = new_figure(6.4 * len(layouts) + 1.0, 6.0)
    all_axes = figure.subplots(1, len(layouts), squeeze=False)[0]
    for axes, (sensor, errors) in zip(all_axes, layouts, strict=True):
        coloured_area = _draw_errors(axes, sensor, errors, norm)
        draw_working_area(axes, case.radius)
        axes.set(xlim=limits, ylim=limits, xlabel="x, mm", ylabel="y, mm", aspect="equal")

    # One colour bar is enough for both maps.
    label = "lower limit of the position error (rms), mm"
    colour_bar = figure.colorbar(coloured_area, ax=list(all_axes), label=label, shrink=0.85, extend="max")
    colour_bar.ax.yaxis.set_major_formatter(ScalarFormatter())
    colour_bar.ax.yaxis.set_minor_formatter(ScalarFormatter())
    nuisances = "without nuisances" if case.nuisances == NO_NUISANCES else "with nuisances"
    figure.suptitle(f"{case.force:g} N, {case.probe.notation}, noise {case.noise.name}, {nuisances}")
    return figure


def _draw_errors(axes: Any, sensor: Sensor, errors: ErrorMap, norm: LogNorm) -> Any:
    """Draw the position errors of one layout as colours, and mark the largest error and the electrodes.

    Args:
        axes: Axes of matplotlib.
        sensor: Sensor with the electrodes of the layout.
        errors: Position errors of the layout.
        norm: Range of the colour scale.

    Returns:
        The coloured area of the map, for which a colour bar can be drawn.
    """
    draw_electrodes(axes, sensor)
    position_error = errors.with_nuisances  # shape (n_press,), mm
    worst_x, worst_y = errors.presses[np.argmax(position_error)]
    axes.plot(worst_x, worst_y, "x", color=FELT, ms=9, mew=2)
    rms = np.sqrt(np.mean(position_error**2))
    axes.set_title(f"{sensor.name}\nworst {position_error.max():.3g} mm (cross), rms {rms:.3g} mm")
    x, y = errors.presses.T
    return axes.tripcolor(x, y, position_error, norm=norm, cmap="viridis", shading="gouraud")
