"""Functions that create and label the axes of the paper's figures, and draw probes."""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.patches import Polygon as Patch

from isocharge.common.arrays import Array
from isocharge.simulate import Probe
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.plots.figure import FELT, new_figure

LAST_SHADE = 0.92
"""Fraction of the colour map `viridis` that `shades` uses, from its dark end.

The remaining colours are hardly visible on white.
"""


def new_axes(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    """Create a figure with axes, like the function `subplots` of matplotlib.

    Args:
        width: Width of the figure, inches.
        height: Height of the figure, inches.
        rows: Number of rows of axes.
        columns: Number of columns of axes.

    Returns:
        The figure, and its axes or an array of its axes.
    """
    figure = new_figure(width, height)
    return figure, figure.subplots(rows, columns)


def finish_axes(axes: Any, x: str, y: str, title: str = "", **legend: Any) -> None:
    """Add labels, a title, a grid and a legend to axes.

    Args:
        axes: Axes of matplotlib.
        x: Label of the x axis.
        y: Label of the y axis.
        title: Title of the axes.
        **legend: Arguments that are passed to `Axes.legend`.
    """
    axes.set(xlabel=x, ylabel=y, title=title)
    axes.grid(alpha=0.3, which="both")
    axes.legend(**{"fontsize": 8} | legend)


def shades(count: int) -> Array:
    """Return colours from dark to light for an ordered set of lines.

    Args:
        count: Number of colours.

    Returns:
        Red, green, blue and opacity of each colour, from 0 to 1, shape (count, 4).
    """
    return np.asarray(colormaps["viridis"](np.linspace(0.0, LAST_SHADE, count)))


def draw_probe(axes: Any, probe: Probe, at: tuple[float, float], label: str = "") -> None:
    """Draw the footprint of a probe that presses on the film.

    Args:
        axes: Axes of matplotlib.
        probe: Probe whose footprint is drawn.
        at: Position (x, y) of the centroid of the footprint, mm.
        label: Label of the footprint in the legend; empty for no label.
    """
    style: dict[str, Any] = {"fill": True, "fc": FELT, "ec": FELT, "alpha": 0.35, "zorder": 2, "label": label}
    axes.add_patch(Patch(to_corners(complex(*at) + probe.outline), **style))
