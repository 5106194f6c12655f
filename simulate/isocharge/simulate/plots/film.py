"""Functions that draw parts of a film to scale, such as electrodes, charge maps and deflections."""

import cmath
from typing import Any

import numpy as np
from matplotlib.patches import Circle as Disk
from matplotlib.patches import Polygon as Patch
from matplotlib.patheffects import withStroke

from isocharge.common.arrays import Complexes
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.numerics.disk import contacts_at
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.plots.figure import FELT, INK
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.sensor import Sensor, outermost_corner
from isocharge.simulate.solver.equilibrium import Equilibrium, deflection


def draw_electrodes(axes: Any, sensor: Sensor, highlight: str = "", names: bool = True, ink: str = INK) -> None:
    """Draw the outlines of the electrodes at their calibrated positions.

    The outlines of metal on the front are solid lines. The outlines of metal on the back are dashed lines.

    Args:
        axes: Axes of matplotlib.
        sensor: Sensor whose electrodes are drawn.
        highlight: Name of an electrode that is drawn in another colour; empty for none.
        names: Whether to write the names of the electrodes.
        ink: Colour of the outlines.
    """
    halo = [withStroke(linewidth=3.0, foreground="white", alpha=0.8)]  # separates dark lines from dark colours
    for electrode in sensor.electrodes:
        colour = FELT if electrode.name == highlight else ink  # FELT is red
        for polygons, style in ((electrode.front, "-"), (electrode.back, "--")):
            for polygon in polygons:
                corners = sensor.calibration.place(np.array(polygon))
                axes.add_patch(Patch(corners, fill=False, ec=colour, lw=1.6, ls=style, zorder=3, path_effects=halo))
        if names:
            centre = sensor.calibration.place(np.array(electrode.centre))
            axes.annotate(electrode.name, centre, ha="center", va="center", color=colour, fontsize=9, path_effects=halo)


def draw_circle(axes: Any, radius: float, **style: Any) -> None:
    """Draw a circle around the centre of the film.

    Args:
        axes: Axes of matplotlib.
        radius: Radius of the circle, mm.
        **style: Arguments that are passed to the patch of matplotlib.
    """
    axes.add_patch(Disk((0, 0), radius, fill=False, **style))


def draw_rim(axes: Any, film: Film, **style: Any) -> None:
    """Draw the rim of a film, which is a circle or an oval.

    Args:
        axes: Axes of matplotlib.
        film: Film whose rim is drawn.
        **style: Arguments that are passed to the patch of matplotlib.
    """
    axes.add_patch(Patch(to_corners(film.rim), fill=False, **style))


def draw_working_area(axes: Any, radius: float, label: str = "") -> None:
    """Draw the edge of a working area as a dotted circle around the centre of the film.

    Args:
        axes: Axes of matplotlib.
        radius: Radius of the working area, mm.
        label: Label of the circle in the legend; empty for no label.
    """
    draw_circle(axes, radius, ls=":", color=INK, label=label)


def frame_film(axes: Any, sensor: Sensor, radius: float, title: str) -> None:
    """Scale and label axes such that they show all electrodes and a circle around the centre of the film.

    Args:
        axes: Axes of matplotlib.
        sensor: Sensor whose electrodes are shown.
        radius: Radius of the circle, mm.
        title: Title of the axes.
    """
    polygons = [polygon for electrode in sensor.electrodes for polygon in electrode.front]
    margin_mm = 0.7
    half_width = max(radius, outermost_corner(sensor, polygons)) + margin_mm
    limits = (-half_width, half_width)
    axes.set(xlim=limits, ylim=limits, xlabel="x, mm", ylabel="y, mm", aspect="equal", title=title)


def draw_layout(axes: Any, sensor: Sensor, radius: float, title: str = "", highlight: str = "") -> None:
    """Draw the electrodes and the working area of a sensor, and scale the axes.

    Args:
        axes: Axes of matplotlib.
        sensor: Sensor whose electrodes are drawn.
        radius: Radius of the working area, mm.
        title: Title of the axes.
        highlight: Name of an electrode that is drawn in another colour; empty for none.
    """
    draw_electrodes(axes, sensor, highlight)
    draw_working_area(axes, radius)
    frame_film(axes, sensor, radius, title)


def draw_charge_map(axes: Any, charge_map: ChargeMap, electrode: int) -> None:
    """Draw the charge that a press of 1 N causes on one electrode, as a function of the position of the press.

    The charge is shown by shades and by labelled contours.

    Args:
        axes: Axes of matplotlib.
        charge_map: Map that computes the charges of contacts.
        electrode: Index of the electrode in the order of the charges.
    """
    # Compute the charge at the points x + iy of a polar grid, which covers the disk of the charge map.
    angle = 2.0 * np.pi * np.linspace(0.0, 1.0, 81)
    points = _polar_grid(charge_map.domain.radius * np.exp(1j * angle), rings=40)
    positions = to_corners(points.ravel())  # (x, y)
    charges = charge_map.charges(contacts_at(positions, force=1.0))
    charge = charges[:, electrode].reshape(points.shape)

    axes.contourf(points.real, points.imag, charge, levels=30, cmap="YlGnBu")
    contour_lines = axes.contour(points.real, points.imag, charge, levels=12, colors=INK, linewidths=0.8)
    axes.clabel(contour_lines, fmt="%.0f", fontsize=7)


def draw_deflection(axes: Any, equilibrium: Equilibrium) -> None:
    """Draw the deflection of the whole film as shades.

    Args:
        axes: Axes of matplotlib.
        equilibrium: Equilibrium of the film under a press.
    """
    points = _polar_grid(equilibrium.film.rim, rings=240)  # x + iy, shape (240, n_angle)
    depth = deflection(equilibrium, to_corners(points.ravel())).reshape(points.shape)
    shades = axes.contourf(points.real, points.imag, depth, levels=24, cmap="viridis_r")
    axes.figure.colorbar(shades, ax=axes, shrink=0.8, label="deflection, mm")
    draw_rim(axes, equilibrium.film, color=INK)
    axes.set(title=f"the film under {equilibrium.force:g} N", xlabel="x, mm", ylabel="y, mm", aspect="equal")


def draw_section(axes: Any, equilibrium: Equilibrium) -> None:
    """Draw the deflection of the film along a straight line through the probe and the centre of the film.

    The vertical axis is stretched.

    Args:
        axes: Axes of matplotlib.
        equilibrium: Equilibrium of the film under a press.
    """
    # Draw the deflection downwards. The horizontal axis is the signed distance from the centre along the line.
    distance, angle = cmath.polar(complex(*equilibrium.at))  # of the probe from the centre
    rim_distance = equilibrium.film.rim_distance(np.array(angle))
    distance_along_section = np.linspace(-1.0, 1.0, 801) * rim_distance
    section_points = np.outer(distance_along_section, [np.cos(angle), np.sin(angle)])  # (x, y)
    depth = deflection(equilibrium, section_points)
    axes.plot(distance_along_section, -depth, color=INK, lw=1.5)

    # Mark the probe as a red bar above the film. An arrow points from the bar to the largest depth of the section.
    bar_height_mm = 0.25
    bar_ends = [distance - equilibrium.probe.reach, distance + equilibrium.probe.reach]
    axes.plot(bar_ends, [bar_height_mm, bar_height_mm], color=FELT, lw=5, solid_capstyle="butt")
    arrow_tip = (distance, -depth.max())
    arrow_start = (distance, bar_height_mm - 0.05)  # just below the bar
    axes.annotate("", arrow_tip, arrow_start, arrowprops={"arrowstyle": "->", "color": FELT})
    axes.set(
        title=f"cut through probe and centre: {depth.max():.2f} mm deep",
        xlabel="along the cut, mm",
        ylabel="-deflection, mm (stretched)",
    )


def _polar_grid(outermost_ring: Complexes, rings: int) -> Complexes:
    """Return the points of a polar grid. The areas between neighbouring rings are equal.

    Args:
        outermost_ring: Points x + iy of the outermost ring, which is closed, shape (n_angle,), mm.
        rings: Number of rings, including the centre.

    Returns:
        Points x + iy, shape (rings, n_angle), mm.
    """
    share_of_outermost_ring = np.sqrt(np.linspace(0.0, 1.0, rings))
    return np.outer(share_of_outermost_ring, outermost_ring)
