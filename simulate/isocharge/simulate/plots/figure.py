"""Functions that create matplotlib figures and write them to files. All pictures of isocharge use this module.

The figures are not shown in a window. This module imports matplotlib, so only modules that draw pictures import it.
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
"""Colour of outlines."""

PRESSED = "#9aa5b1"
"""Colour of true presses."""

FELT = "#d1495b"
"""Colour of estimated presses, and of objects that are emphasised."""

COLOURS = ("#d1495b", "#2e6f9e", "#3a8f5c", "#c98a1b")
"""Colours of the electrodes in the order of the charges."""

FORMATS = ("png", "svg", "pdf")
"""Formats of pictures, which are also the allowed suffixes of their file names."""

DPI = 130
"""Resolution of PNG files, dots per inch."""

LAST_SHADE = 0.92
"""Fraction of the colour map `viridis` that `shades` uses, from its dark end.

The remaining colours are hardly visible on white.
"""


def new_figure(width: float, height: float) -> Figure:
    """Create a figure that is not shown in a window.

    Args:
        width: Width of the figure, inches.
        height: Height of the figure, inches.
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


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


def check_picture(path: Path) -> None:
    """Raise an error if a picture cannot be written to a path. Call this function before computing the picture.

    Args:
        path: Path of the picture.

    Raises:
        InputError: If the suffix is not one of `FORMATS`.
        OutputExists: If the file exists.
    """
    if path.suffix.lstrip(".").lower() not in FORMATS:
        raise InputError(f"{path}: expected a picture with the suffix {', '.join(FORMATS)}, got {path.suffix!r}")
    refuse_existing(path)


def picture_bytes(figure: Figure, file_format: str = "png") -> bytes:
    """Convert a figure into the content of an image file.

    The content includes neither a date nor random identifiers. Equal figures therefore result in equal bytes.

    Args:
        figure: Figure to be converted.
        file_format: Format of the file: "png", "svg" or "pdf".
    """
    # The value None removes the present date, which matplotlib would write into SVG and PDF files.
    date_metadata: dict[str, dict[str, None]] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
    buffer = BytesIO()

    # With a fixed salt, the identifiers of SVG elements are not random. Text is stored as text, not as outlines.
    with rc_context({"svg.hashsalt": "isocharge", "svg.fonttype": "none"}):
        figure.savefig(buffer, format=file_format, dpi=DPI, metadata=date_metadata[file_format])
    return buffer.getvalue()


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure to a file. The suffix of the path determines the format.

    If an error occurs, no file is written.

    Args:
        figure: Figure to be written.
        path: Path of the file, whose suffix is one of `FORMATS`.
    """
    write_whole(path, picture_bytes(figure, path.suffix.lstrip(".").lower()))
