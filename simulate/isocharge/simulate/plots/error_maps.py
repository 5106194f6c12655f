"""Pictures of a film that show the lower limits of the position errors, or the mirror region of a sensor."""

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from isocharge.common.arrays import Array
from isocharge.simulate.identifiability.identification import Identification
from isocharge.simulate.identifiability.mirror_region import MirrorRegion
from isocharge.simulate.layout.case import NO_NUISANCES
from isocharge.simulate.layout.design import Design
from isocharge.simulate.plots.figure import COLOURS, FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_circle, draw_electrodes, draw_rim, draw_working_area
from isocharge.simulate.sensor.sensor import Sensor

MAX_ERROR_RATIO = 10.0
"""Ratio of the largest to the smallest error on the colour scale of the error maps of a layout, dimensionless."""

ERROR_LABEL = "lower limit of the position error (rms), mm"
"""Label of the colour bars and of the error axis."""


def identification_picture(identification: Identification) -> Figure:
    """Draw the lower limits of the position errors that `identify` has computed.

    Two maps show the errors over the film for the smallest and the largest force. The colour scale of both maps ends at
    the allowed error. Red points mark folds, which are contacts at which the charges do not determine the contact. A
    diagram shows the errors as a function of the distance from the centre.

    Args:
        identification: Result of `identify`.

    Returns:
        Figure with the two maps and the diagram.
    """
    area = identification.area  # working area; `area.error` is the largest position error that is allowed in it, mm
    figure = new_figure(16.0, 5.2)
    *map_axes, distance_axes = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.1))
    limit_maps = (identification.maps[0], identification.maps[-1])  # for the smallest and the largest force
    # The attribute `position` of a map contains position errors (mm). The attribute `rings.position` contains the
    # coordinates (x, y) of the presses (mm).
    smallest_error = min(limit_map.position.min() for limit_map in limit_maps)
    colour_scale = LogNorm(smallest_error, max(area.error, 2.0 * smallest_error))  # the scale must not be empty
    for axes, limit_map in zip(map_axes, limit_maps, strict=True):
        presses = limit_map.rings.position.reshape(-1, 2)
        coloured_area = _draw_errors(axes, identification.sensor, presses, limit_map.position.ravel(), colour_scale)
        axes.plot(*area.folds.T, ".", color=FELT, ms=3)
        draw_circle(axes, area.radius, ls="--", lw=1.8, color="white")
        folds = "; red: folds" if len(area.folds) else ""
        axes.set_title(f"{limit_map.force:g} N; dashed: working area, {area.radius:g} mm{folds}")
    _add_colour_bar(figure, coloured_area, map_axes)
    _draw_distance(distance_axes, identification)
    figure.suptitle(
        f"{identification.sensor.name}, {identification.probe.rotated_notation}, noise {identification.noise.name}",
        fontsize=13,
    )
    return figure


def _draw_distance(axes: Any, identification: Identification) -> None:
    """Draw the median and the largest position error on each ring as functions of the distance from the centre.

    Args:
        axes: Axes of matplotlib.
        identification: Result of `identify`, which contains a map of the errors for each force. The attribute
            `position` of such a map contains the position errors, shape (n_ring, n_angle), mm.
    """
    area = identification.area
    axes.set_prop_cycle(color=COLOURS)
    for limit_map in identification.maps:
        distance = limit_map.rings.distance
        median_error = np.median(limit_map.position, axis=1)  # of each ring
        (curve,) = axes.semilogy(distance, median_error, label=f"{limit_map.force:g} N")
        axes.semilogy(distance, limit_map.position.max(axis=1), ":", color=curve.get_color())
    axes.plot([], [], ":", color=INK, label="worst of the ring")  # an entry of the legend for all dotted curves

    # Mark the allowed error, the working area, and the distance of the nearest fold if there is one.
    axes.axhline(area.error, color=FELT, lw=0.8)
    axes.axvline(area.radius, ls="--", color=INK, label=f"working area, {area.radius:g} mm")
    if np.isfinite(area.fold_radius):
        axes.axvline(area.fold_radius, color=FELT, label=f"first fold, {area.fold_radius:.1f} mm")
    largest_error = 20.0 * area.error  # near a fold, the error is infinite
    axes.set(xlabel="distance from the centre, mm", ylabel=ERROR_LABEL, xlim=(0.0, area.search_radius))
    axes.set_ylim(top=min(axes.get_ylim()[1], largest_error))
    _label_errors(axes.yaxis)
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

    # Both maps have the same colour scale and the same axes, which show all electrodes. Any of the coloured areas can
    # therefore be used for the colour bar.
    smallest_error = min(errors.with_nuisances.min() for _, errors in layouts)
    colour_scale = LogNorm(smallest_error, MAX_ERROR_RATIO * smallest_error)
    figure = new_figure(6.4 * len(layouts) + 1.0, 6.0)
    all_axes = figure.subplots(1, len(layouts), squeeze=False, sharex=True, sharey=True)[0]
    for axes, (sensor, errors) in zip(all_axes, layouts, strict=True):
        position_error = errors.with_nuisances  # shape (n_press,), mm
        coloured_area = _draw_errors(axes, sensor, errors.presses, position_error, colour_scale)
        # Mark the position (x, y) of the largest error by a cross.
        axes.plot(*errors.presses[np.argmax(position_error)], "x", color=FELT, ms=9, mew=2)
        draw_working_area(axes, case.radius)
        rms = np.sqrt(np.mean(position_error**2))
        axes.set_title(f"{sensor.name}\nworst {position_error.max():.3g} mm (cross), rms {rms:.3g} mm")

    _add_colour_bar(figure, coloured_area, all_axes)
    nuisances = "without nuisances" if case.nuisances == NO_NUISANCES else "with nuisances"
    figure.suptitle(f"{case.force:g} N, {case.probe.notation}, noise {case.noise.name}, {nuisances}")
    return figure


def _draw_errors(axes: Any, sensor: Sensor, presses: Array, errors: Array, colour_scale: LogNorm) -> Any:
    """Draw a map that shows the position errors as colours and the electrodes as outlines.

    Args:
        axes: Axes of matplotlib.
        sensor: Sensor with the electrodes.
        presses: Positions (x, y) of the presses, shape (n, 2), mm.
        errors: Position error of each press, shape (n,), mm.
        colour_scale: Range of the colour scale.

    Returns:
        The coloured area of the map, for which a colour bar can be drawn.
    """
    draw_electrodes(axes, sensor)
    axes.set(xlabel="x, mm", ylabel="y, mm", aspect="equal")
    return axes.tripcolor(*presses.T, errors, norm=colour_scale, cmap="viridis", shading="gouraud")


def _add_colour_bar(figure: Figure, coloured_area: Any, axes: list[Any]) -> None:
    """Add a colour bar for position errors beside several axes that have the same colour scale."""
    colour_bar = figure.colorbar(coloured_area, ax=axes, label=ERROR_LABEL, shrink=0.85, extend="max")
    _label_errors(colour_bar.ax.yaxis)


def _label_errors(axis: Any) -> None:
    """Label a logarithmic axis of errors with a few decimal numbers, which do not overlap."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


def mirror_picture(sensor: Sensor, mirror: MirrorRegion) -> Figure:
    """Draw a map of the presses outside the working area that have the same charges as a press inside the working area.

    Args:
        sensor: Sensor whose mirror region is drawn.
        mirror: Mirror region of the sensor, which was computed for several forces at each position.

    Returns:
        Figure with the clamp, the working area and the electrodes. Shades show at each position the share of the forces
        at which a press has the same charges as a press inside the working area.
    """
    figure = new_figure(7.4, 6.4)
    axes = figure.subplots()

    # Compute the corners x + iy of the cells, shape (n_ring + 1, n_sector + 1). A cell is the part of a ring in one
    # sector. The rings have the radii `mirror.edges`, from the working area (`mirror.inner`) outwards, mm.
    n_sector = mirror.share.shape[1]
    edge_angle = np.linspace(0.0, 2.0 * np.pi, n_sector + 1)
    corners = np.outer(mirror.edges, np.exp(1j * edge_angle))
    shades = axes.pcolormesh(corners.real, corners.imag, mirror.share, vmin=0.0, vmax=1.0, cmap="Reds")
    figure.colorbar(shades, ax=axes, label="share of the forces that cannot be noticed", shrink=0.85)

    draw_rim(axes, sensor.film, color=INK, lw=2.0)
    draw_circle(axes, mirror.inner, color=INK, ls="--", lw=1.6)
    draw_electrodes(axes, sensor)
    axes.set(
        aspect="equal",
        xlabel="x, mm",
        ylabel="y, mm",
        title=f"{sensor.name}: {100.0 * mirror.total_share:.2g} % of the presses of {mirror.forces[0]:.2g} to "
        f"{mirror.forces[-1]:.2g} N\noutside the working area (dashed, {mirror.inner:.3g} mm) cannot be noticed",
    )
    axes.margins(0.03)
    return figure
