"""Figures without a window: colours, sizes, and how they become files. Every picture of isocharge uses it.

It needs matplotlib, so it is imported only where a picture is drawn.
"""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.files import refuse_existing, write_whole

INK, PRESSED, FELT = "#1b2a41", "#9aa5b1", "#d1495b"
"""Colours of outlines, of true presses and of estimated ones."""

COLOURS = ("#d1495b", "#2e6f9e", "#3a8f5c", "#c98a1b")
"""Colours of the electrodes, in their order."""

FORMATS = ("png", "svg", "pdf")
"""Formats of a picture; a file's suffix names its own."""

DPI = 130
"""Resolution of PNG files, dots per inch."""

PALEST = 0.92
"""End of the viridis scale that `shades` uses, from 0 to 1: its last yellow cannot be seen on white."""


def new_figure(width: float, height: float) -> Figure:
    """A figure that no window belongs to; width and height in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_axes(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    """A figure and its axes, as matplotlib's `subplots` gives them; width and height in inches."""
    figure = new_figure(width, height)
    return figure, figure.subplots(rows, columns)


def finish_axes(axes: Any, x: str, y: str, title: str = "", **legend: Any) -> None:
    """Labels, grid and legend of a plot with lines."""
    axes.set(xlabel=x, ylabel=y, title=title)
    axes.grid(alpha=0.3, which="both")
    axes.legend(**{"fontsize": 8} | legend)


def shades(count: int) -> Array:
    """Colours of lines that have an order, from dark to pale: RGBA, shape (count, 4)."""
    return np.asarray(colormaps["viridis"](np.linspace(0.0, PALEST, count)))


def check_picture(path: Path) -> None:
    """Check the name of a picture before anything is computed.

    Raises:
        InputError: If its suffix is not one of FORMATS.
        OutputExists: If the file exists.
    """
    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise InputError(f"{path}: expected a picture's name ending in {', '.join(FORMATS)}, got {path.suffix!r}")
    refuse_existing(path)


def picture_bytes(figure: Figure, kind: str = "png") -> bytes:
    """A figure as PNG, SVG or PDF; the same figure gives the same bytes."""
    dates: dict[str, None] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
    buffer = BytesIO()
    with rc_context({"svg.hashsalt": "isocharge", "svg.fonttype": "none"}):
        figure.savefig(buffer, format=kind, dpi=DPI, metadata=dates)
    return buffer.getvalue()


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the path's suffix, whole or not at all."""
    write_whole(path, picture_bytes(figure, path.suffix.lstrip(".").lower()))
