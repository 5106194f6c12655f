"""Functions that create matplotlib figures and write them to files. All pictures of isocharge use this module.

The figures are not shown in a window. Only modules that draw pictures import this module, because it imports
matplotlib.
"""

from io import BytesIO
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from isocharge.common.errors import InputError
from isocharge.common.files import check_new_output, write_whole

INK = "#1b2a41"
"""Colour of outlines."""

PRESSED = "#9aa5b1"
"""Colour of true presses."""

FELT = "#d1495b"
"""Colour of estimated presses, and of objects that are emphasised."""

COLOURS = ("#004488", "#ddaa33", "#56b4e9", "#d1495b", "#882255", "#c91f16", "#1845fb", "#9aa5b1")
"""Colours of the electrodes in the order of the charges. People with red-green blindness can tell them apart."""

FORMATS = ("png", "svg", "pdf")
"""Formats of pictures, which are also the allowed suffixes of their file names."""

DPI = 130
"""Resolution of PNG files, dots per inch."""


def new_figure(width: float, height: float) -> Figure:
    """Create a figure that is not shown in a window.

    Args:
        width: Width of the figure, inches.
        height: Height of the figure, inches.
    """
    return Figure(figsize=(width, height), layout="constrained")


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
    check_new_output(path)


def picture_bytes(figure: Figure, file_format: str = "png") -> bytes:
    """Convert a figure into the content of an image file.

    The content includes neither a date nor random identifiers. Equal figures therefore result in equal bytes.

    Args:
        figure: Figure to be converted.
        file_format: Format of the file: "png", "svg" or "pdf".
    """
    # The value None removes the present date, which matplotlib would write into SVG and PDF files.
    date_metadata = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
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
