"""Creation, colours and output files of matplotlib figures. All pictures of isocharge use this module.

The figures have no window. The module needs matplotlib, so it is imported only where a picture is drawn.
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

INK = "#1b2a41"
PRESSED = "#9aa5b1"
FELT = "#d1495b"
"""Colours of outlines, of true presses and of estimated presses."""

COLOURS = ("#d1495b", "#2e6f9e", "#3a8f5c", "#c98a1b")
"""Colours of the electrodes in the order of the charges."""

FORMATS = ("png", "svg", "pdf")
"""Formats of a picture, which are also the allowed suffixes of its file name."""

DPI = 130
"""Resolution of PNG files, dots per inch."""

LAST_SHADE = 0.92
"""End of the part of the viridis colour map that `shades` uses, from 0 to 1.

The remaining part is hardly visible on white.
"""


def new_figure(width: float, height: float) -> Figure:
    """Return a new figure without a window.

    Args:
        width: Width, inches.
        height: Height, inches.
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def new_axes(width: float, height: float, rows: int = 1, columns: int = 1) -> tuple[Figure, Any]:
    """Return a new figure and its axes, as `subplots` of matplotlib does.

    Args:
        width: Width, inches.
        height: Height, inches.
        rows: Number of rows of axes.
        columns: Number of columns of axes.
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
        **legend: Arguments of `Axes.legend`.
    """
    axes.set(xlabel=x, ylabel=y, title=title)
    axes.grid(alpha=0.3, which="both")
    axes.legend(**{"fontsize": 8} | legend)


def shades(count: int) -> Array:
    """Return RGBA colours from dark to light for an ordered set of lines, shape (count, 4)."""
    return np.asarray(colormaps["viridis"](np.linspace(0.0, LAST_SHADE, count)))


def check_picture(path: Path) -> None:
    """Check the file name of a picture before the picture is computed.

    Raises:
        InputError: If the suffix is not one of `FORMATS`.
        OutputExists: If the file exists.
    """
    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise InputError(f"{path}: expected a picture with the suffix {', '.join(FORMATS)}, got {path.suffix!r}")
    refuse_existing(path)


def picture_bytes(figure: Figure, kind: str = "png") -> bytes:
    """Convert a figure into the bytes of an image file.

    The file contains neither a date nor random identifiers, so equal figures have equal bytes.

    Args:
        figure: The figure.
        kind: Format of the file: "png", "svg" or "pdf".

    Returns:
        The bytes of the file.
    """
    # Without these entries, matplotlib writes the present date. PNG files have no date.
    date_metadata: dict[str, dict[str, None]] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
    buffer = BytesIO()
    # A fixed salt replaces the random identifiers of SVG elements. Text is stored as text, not as outlines.
    with rc_context({"svg.hashsalt": "isocharge", "svg.fonttype": "none"}):
        figure.savefig(buffer, format=kind, dpi=DPI, metadata=date_metadata[kind])
    return buffer.getvalue()


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure to a file. The suffix of the path selects the format. A failed write leaves no partial file."""
    write_whole(path, picture_bytes(figure, path.suffix.lstrip(".").lower()))
