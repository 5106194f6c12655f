"""Charge curves, contours and the mapping scheme as pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.contours.charge_curves import Curves, Mapping
from isocharge.simulate.plots.figure import FELT, INK, PRESSED, shades


def draw_contours(axes: Any, contours: Sequence[Array], colour: str, label: str = "", width: float = 1.2) -> None:
    """Pieces of contours, shape (n, 2) each, mm; the first one labelled for the legend."""
    for number, points in enumerate(contours):
        axes.plot(*points.T, color=colour, lw=width, label=label if number == 0 else None)


def draw_mapping(axes: Any, mapping: Mapping) -> None:
    """Lines and circles of a mapping scheme, and its presses."""
    points = np.concatenate([np.broadcast_to(mapping.origin, (mapping.angle.size, 1, 2)), mapping.points], axis=1)
    for angle, line in zip(mapping.angle, points, strict=True):
        axes.plot(*line.T, color=PRESSED, lw=0.8)
        axes.annotate(
            f"{np.rad2deg(angle):.0f}°", line[-1], fontsize=7, color=INK, ha="center", va="center",
            xytext=(9 * np.cos(angle), 9 * np.sin(angle)), textcoords="offset points",
        )  # fmt: skip
    for number, distance in enumerate(mapping.distance):
        arc = np.linspace(mapping.angle[0], mapping.angle[-1], 90)
        circle = np.array(mapping.origin) + distance * np.stack([np.cos(arc), np.sin(arc)], axis=1)
        axes.plot(*circle.T, color=PRESSED, lw=0.6, ls="--", label="circles, every step" if number == 0 else None)
    axes.plot(*points[:, 1:].reshape(-1, 2).T, ".", color=FELT, ms=4, label="presses")


def draw_curves(axes: Any, points: Curves, lines: Curves) -> None:
    """Charge against distance on each line of a mapping: marks where the scheme presses, lines between them."""
    colours = shades(points.mapping.angle.size)
    for angle, colour, marks, line in zip(points.mapping.angle, colours, points.own, lines.own, strict=True):
        axes.plot(points.mapping.distance, marks, "o", color=colour, ms=3.5)
        axes.plot(lines.mapping.distance, line, "-", color=colour, lw=1.1, label=f"{np.rad2deg(angle):.0f}°")
    name = points.mapping.electrode
    axes.set(xlabel=f"distance from the centre of {name}, mm", ylabel=f"charge of {name}, pC")
    axes.grid(alpha=0.3)
    axes.legend(title="line from x", fontsize=8, ncols=2)
