"""Charge curves, contours and the mapping scheme as pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from isocharge.simulate.contours.charge_curves import Curves, Mapping
from isocharge.simulate.contours.field_contours import Contour
from isocharge.simulate.plots.figure import FELT, INK, PRESSED, shades


def draw_contours(axes: Any, contours: Sequence[Contour], colour: str, label: str = "", width: float = 1.2) -> None:
    """Pieces of contours, the first one labelled for the legend."""
    for number, contour in enumerate(contours):
        axes.plot(*contour.points.T, color=colour, lw=width, label=label if number == 0 else None)


def draw_mapping(axes: Any, mapping: Mapping, degrees: bool = True) -> None:
    """Lines and circles of a mapping scheme, and its presses."""
    points = np.concatenate([np.broadcast_to(mapping.origin, (mapping.angle.size, 1, 2)), mapping.points], axis=1)
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
        axes.plot(*circle.T, color=PRESSED, lw=0.6, ls="--", label="circles, every step" if number == 0 else None)
    axes.plot(*points[:, 1:].reshape(-1, 2).T, ".", color=FELT, ms=4, label="presses")


def draw_curves(axes: Any, points: Curves, lines: Curves | None = None, legend: bool = True) -> None:
    """Charge against distance on each line of a mapping: marks where the scheme presses, lines between them."""
    colours = shades(points.mapping.angle.size)
    for number, (angle, colour) in enumerate(zip(points.mapping.angle, colours, strict=True)):
        name = f"{np.rad2deg(angle):.0f}°"
        axes.plot(points.mapping.distance, points.own[number], "o", color=colour, ms=3.5)
        smooth = lines or points
        axes.plot(smooth.mapping.distance, smooth.own[number], "-", color=colour, lw=1.1, label=name)
    name = points.mapping.electrode
    axes.set(xlabel=f"distance from the centre of {name}, mm", ylabel=f"charge of {name}, pC")
    axes.grid(alpha=0.3)
    if legend:
        axes.legend(title="line from x", fontsize=8, ncols=2)
