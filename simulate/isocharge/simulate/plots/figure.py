"""Pictures of a film: electrodes, probe, working area, curves and contours, to scale, in mm and pC.

The one home of what every picture of a sensor has in common; the demo, the commands and the paper's figures share it.
Needs matplotlib and is imported where a picture is made only.
"""

from io import BytesIO
from pathlib import Path

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from isocharge.errors import InputError
from isocharge.files import refuse_existing, write_whole

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
