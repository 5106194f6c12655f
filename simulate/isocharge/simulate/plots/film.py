"""The film to scale: electrodes, probe, working area, charge map."""

from typing import Any

import numpy as np
from matplotlib.patches import Circle as Disk
from matplotlib.patches import Polygon as Patch

from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.plots.figure import FELT, INK
from isocharge.simulate.sensor.probe import Circle, Probe
from isocharge.simulate.sensor.sensor import Sensor


def draw_electrodes(axes: Any, sensor: Sensor, highlight: str = "", names: bool = True, ink: str = INK) -> None:
    """Outlines of the electrodes where they really sit, with their names."""
    for electrode in sensor.electrodes:
        corners = 1e3 * sensor.calibration.place(np.array(electrode.corners))
        colour = FELT if electrode.name == highlight else ink
        axes.add_patch(Patch(corners, fill=False, ec=colour, lw=1.6, zorder=3))
        if names:
            axes.annotate(electrode.name, corners.mean(axis=0), ha="center", va="center", color=colour, fontsize=9)


def draw_probe(axes: Any, probe: Probe, at: tuple[float, float], label: str = "", colour: str = FELT) -> None:
    """The footprint of a press at (x, y), m."""
    style: dict[str, Any] = {
        "fill": True,
        "fc": colour,
        "ec": colour,
        "alpha": 0.35,
        "zorder": 2,
        "label": label or None,
    }
    x, y = 1e3 * at[0], 1e3 * at[1]
    if isinstance(probe, Circle):
        axes.add_patch(Disk((x, y), 1e3 * probe.radius, **style))
    else:
        corners = 1e3 * probe.outline
        axes.add_patch(Patch(np.stack([x + corners.real, y + corners.imag], axis=1), **style))


def draw_working_area(axes: Any, radius: float, label: str = "") -> None:
    """A dotted circle of `radius` (m) about the centre."""
    axes.add_patch(Disk((0, 0), 1e3 * radius, fill=False, ls=":", color=INK, label=label or None))


def frame_film(axes: Any, sensor: Sensor, radius: float, title: str = "") -> None:
    """Axes in mm, to scale, that show all electrodes and a circle of `radius` (m) about the centre."""
    corners = [corner for e in sensor.electrodes for corner in sensor.calibration.place(np.array(e.corners))]
    reach = 1e3 * max(radius, *(float(np.hypot(*corner)) for corner in corners)) + 0.7
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x, mm", ylabel="y, mm", aspect="equal")
    if title:
        axes.set_title(title)


def draw_charge_map(axes: Any, film: ForwardMap, number: int, force: float = 1.0, count: int = 81) -> None:
    """Shades and labelled contours of one electrode's charge over the position of a press."""
    radius = film.radius * np.sqrt(np.linspace(0.0, 1.0, count // 2))
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    charge = 1e12 * film.forward(x.ravel(), y.ravel(), np.full(x.size, force))
    values = charge[:, number].reshape(x.shape)
    axes.contourf(1e3 * x, 1e3 * y, values, levels=30, cmap="YlGnBu")
    lines = axes.contour(1e3 * x, 1e3 * y, values, levels=12, colors=INK, linewidths=0.8)
    axes.clabel(lines, fmt="%.0f", fontsize=7)
