"""Pictures of a film: electrodes, probe, working area, curves and contours, to scale, in mm and pC.

The one home of what every picture of a sensor has in common; the demo, the commands and the paper's figures share it.
Needs matplotlib and is imported where a picture is made only.
"""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disk
from matplotlib.patches import Polygon as Patch

from isocharge.arrays import Array
from isocharge.errors import InputError
from isocharge.files import refuse_existing, write_whole
from isocharge.simulate.contours import Contour
from isocharge.simulate.curves import Curves, Mapping
from isocharge.simulate.forward import ForwardMap
from isocharge.simulate.probe import Circle, Probe
from isocharge.simulate.sensor import Sensor

INK, PRESSED, FELT = "#1b2a41", "#9aa5b1", "#d1495b"
"""Colours of outlines, of what was pressed and of what was felt."""

COLOURS = ("#d1495b", "#2e6f9e", "#3a8f5c", "#c98a1b")
"""Of the electrodes, in their order."""

FORMATS = ("png", "svg", "pdf")
DPI = 130


def new_figure(width: float, height: float) -> Figure:
    """A figure of so many inches that no window belongs to."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def check_picture(path: Path) -> None:
    """Raise InputError for a suffix that is no picture's, OutputExists if the file is there."""
    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise InputError(f"{path}: expected a picture's name ending in {', '.join(FORMATS)}, got {path.suffix!r}")
    refuse_existing(path)


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the path's suffix, whole or not at all; the same figure gives the same bytes."""
    kind = path.suffix.lstrip(".").lower()
    dated = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
    page = BytesIO()
    with rc_context({"svg.hashsalt": "isocharge", "svg.fonttype": "none"}):
        figure.savefig(page, format=kind, dpi=DPI, metadata=dated)
    write_whole(path, page.getvalue())


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


def draw_contours(axes: Any, contours: Sequence[Contour], colour: str, label: str = "", width: float = 1.2) -> None:
    """Pieces of contours, the first one labelled for the legend."""
    for number, contour in enumerate(contours):
        axes.plot(*1e3 * contour.points.T, color=colour, lw=width, label=label if number == 0 else None)


def draw_mapping(axes: Any, mapping: Mapping, degrees: bool = True) -> None:
    """Lines and circles of a mapping scheme, and its presses."""
    points = 1e3 * np.concatenate([np.broadcast_to(mapping.origin, (mapping.angle.size, 1, 2)), mapping.points], axis=1)
    for angle, line in zip(mapping.angle, points, strict=True):
        axes.plot(*line.T, color=PRESSED, lw=0.8)
        if degrees:
            axes.annotate(
                f"{np.rad2deg(angle):.0f}°", line[-1], fontsize=7, color=INK, ha="center", va="center",
                xytext=(9 * np.cos(angle), 9 * np.sin(angle)), textcoords="offset points",
            )  # fmt: skip
    for number, distance in enumerate(mapping.distance):
        arc = np.linspace(mapping.angle[0], mapping.angle[-1], 90)
        circle = np.array(mapping.origin) + distance * np.stack([np.cos(arc), np.sin(arc)], axis=1)
        axes.plot(*1e3 * circle.T, color=PRESSED, lw=0.6, ls="--", label="circles, every step" if number == 0 else None)
    axes.plot(*points[:, 1:].reshape(-1, 2).T, ".", color=FELT, ms=4, label="presses")


def draw_curves(axes: Any, points: Curves, lines: Curves | None = None, legend: bool = True) -> None:
    """Charge against distance on each line of a mapping: marks where the scheme presses, lines between."""
    shades = _shades(points.mapping.angle.size)
    for number, (angle, colour) in enumerate(zip(points.mapping.angle, shades, strict=True)):
        name = f"{np.rad2deg(angle):.0f}°"
        axes.plot(1e3 * points.mapping.distance, 1e12 * points.own[number], "o", color=colour, ms=3.5)
        smooth = lines or points
        axes.plot(1e3 * smooth.mapping.distance, 1e12 * smooth.own[number], "-", color=colour, lw=1.1, label=name)
    name = points.mapping.electrode
    axes.set(xlabel=f"distance from the centre of {name}, mm", ylabel=f"charge of {name}, pC")
    axes.grid(alpha=0.3)
    if legend:
        axes.legend(title="line from x", fontsize=8, ncols=2)


def _shades(count: int) -> Array:
    from matplotlib import colormaps

    shades: Array = colormaps["viridis"](np.linspace(0.0, 0.92, count))
    return shades
