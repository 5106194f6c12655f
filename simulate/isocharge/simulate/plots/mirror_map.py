"""Picture that shows the mirror region of a sensor on the whole film."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from isocharge.simulate.identifiability.mirror_region import MirrorRegion
from isocharge.simulate.plots.figure import FELT, INK, new_figure
from isocharge.simulate.plots.film import draw_circle, draw_electrodes
from isocharge.simulate.sensor.sensor import Sensor


def mirror_picture(sensor: Sensor, mirror: MirrorRegion) -> Figure:
    """Draw the mirror region of a sensor.

    A press outside the working area cannot be noticed if it has the same charges as a press inside the working area. A
    map shows the share of such presses at each position. A diagram shows this share as a function of the distance from
    the centre.

    Args:
        sensor: Sensor whose mirror region is drawn.
        mirror: Mirror region of the sensor.

    Returns:
        Figure with the map and the diagram.
    """
    figure = new_figure(13.0, 5.8)
    film_axes, distance_axes = figure.subplots(1, 2)
    shades = _draw_region(film_axes, sensor, mirror)
    figure.colorbar(shades, ax=film_axes, label="share of the forces that cannot be noticed", shrink=0.85)
    _draw_distance(distance_axes, mirror)
    min_force = mirror.forces[0]
    max_force = mirror.forces[-1]
    figure.suptitle(
        f"{sensor.name}: presses of {min_force:.2g} to {max_force:.2g} N with the charges of a press in "
        "the working area",
        fontsize=13,
    )
    return figure


def _draw_region(axes: Any, sensor: Sensor, mirror: MirrorRegion) -> Any:
    """Draw a map of the share of unnoticeable presses, with the clamp, the working area and the electrodes.

    An unnoticeable press lies outside the working area and has the same charges as a press inside the working area.

    Args:
        axes: Axes of matplotlib.
        sensor: Sensor whose mirror region is drawn.
        mirror: Mirror region of the sensor.

    Returns:
        The coloured cells of the map, for which a colour bar can be drawn.
    """
    # Compute the corners of the cells, shape (n_ring + 1, n_sector + 1). A cell is the part of a ring in one sector.
    n_sector = mirror.share.shape[1]
    edge_angle = 2.0 * np.pi * np.arange(n_sector + 1) / n_sector
    corner_x = np.outer(mirror.edges, np.cos(edge_angle))
    corner_y = np.outer(mirror.edges, np.sin(edge_angle))
    shades = axes.pcolormesh(corner_x, corner_y, mirror.share, vmin=0.0, vmax=1.0, cmap="Reds")

    # Draw the clamp, the working area and the electrodes.
    film_radius = sensor.film.radius
    draw_circle(axes, film_radius, color=INK, lw=2.0)
    draw_circle(axes, mirror.inner, color=INK, ls="--", lw=1.6)
    draw_electrodes(axes, sensor)
    axis_limits = (-1.03 * film_radius, 1.03 * film_radius)
    title = f"dashed: working area, {mirror.inner:.3g} mm; solid: clamp, {film_radius:g} mm"
    axes.set(xlim=axis_limits, ylim=axis_limits, aspect="equal", xlabel="x, mm", ylabel="y, mm", title=title)
    return shades


def _draw_distance(axes: Any, mirror: MirrorRegion) -> None:
    """Draw the share of unnoticeable presses as a function of their distance from the centre.

    An unnoticeable press lies outside the working area and has the same charges as a press inside the working area.

    Args:
        axes: Axes of matplotlib.
        mirror: Mirror region of a sensor.
    """
    axes.stairs(100.0 * mirror.share.mean(axis=1), mirror.edges, color=FELT, lw=2.0)
    axes.axvline(mirror.inner, ls="--", color=INK)
    axes.set(
        xlim=(0.0, mirror.outer),
        ylim=(0.0, 105.0),
        xlabel="distance from the centre, mm",
        ylabel="presses that cannot be noticed, %",
        title=f"{100.0 * mirror.total_share:.2g} % of the presses outside the working area",
    )
    axes.grid(alpha=0.3)
