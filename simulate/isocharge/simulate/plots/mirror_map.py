"""Picture that shows the mirror region of a sensor on the whole film."""

import numpy as np
from matplotlib.figure import Figure

from isocharge.simulate.identifiability.mirror_region import MirrorRegion
from isocharge.simulate.plots.figure import INK, new_figure
from isocharge.simulate.plots.film import draw_circle, draw_electrodes
from isocharge.simulate.sensor.sensor import Sensor


def mirror_picture(sensor: Sensor, mirror: MirrorRegion) -> Figure:
    """Draw a map of the presses outside the working area that have the charges of a press inside it.

    Args:
        sensor: Sensor whose mirror region is drawn.
        mirror: Mirror region of the sensor.

    Returns:
        Figure with the clamp, the working area, the electrodes, and the share of such presses at each position.
    """
    figure = new_figure(7.4, 6.4)
    axes = figure.subplots()

    # Compute the corners of the cells, shape (n_ring + 1, n_sector + 1). A cell is the part of a ring in one sector.
    n_sector = mirror.share.shape[1]
    edge_angle = 2.0 * np.pi * np.arange(n_sector + 1) / n_sector
    corner_x = np.outer(mirror.edges, np.cos(edge_angle))
    corner_y = np.outer(mirror.edges, np.sin(edge_angle))
    shades = axes.pcolormesh(corner_x, corner_y, mirror.share, vmin=0.0, vmax=1.0, cmap="Reds")
    figure.colorbar(shades, ax=axes, label="share of the forces that cannot be noticed", shrink=0.85)

    film_radius = sensor.film.radius
    draw_circle(axes, film_radius, color=INK, lw=2.0)
    draw_circle(axes, mirror.inner, color=INK, ls="--", lw=1.6)
    draw_electrodes(axes, sensor)
    title = (
        f"{sensor.name}: {100.0 * mirror.total_share:.2g} % of the presses of {mirror.forces[0]:.2g} to "
        f"{mirror.forces[-1]:.2g} N\noutside the working area (dashed, {mirror.inner:.3g} mm) cannot be noticed"
    )
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title=title)
    axes.margins(0.03)
    return figure
