"""Functions that draw an electrode layout as DXF and SVG files, and that write a design into a folder.

The unit of the drawing is the millimetre. There is one layer for each kind of object.
"""

import io
import json
from pathlib import Path

from isocharge.common.errors import require
from isocharge.common.files import new_folder, write_whole
from isocharge.simulate.layout.design import Design
from isocharge.simulate.numerics.polygon import to_corners
from isocharge.simulate.plots.error_maps import error_maps_picture
from isocharge.simulate.plots.figure import picture_bytes
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_toml

with require("design"):
    import ezdxf
    from ezdxf import units
    from ezdxf.addons.drawing.config import BackgroundPolicy, Configuration
    from ezdxf.addons.drawing.frontend import Frontend
    from ezdxf.addons.drawing.layout import Margins, Page, Settings, Units
    from ezdxf.addons.drawing.properties import RenderContext
    from ezdxf.addons.drawing.svg import SVGBackend
    from ezdxf.document import Drawing

# ezdxf then writes the same dates and identifiers into every file, so that equal drawings result in equal files.
ezdxf.options.write_fixed_meta_data_for_testing = True

LAYERS = {"FILM": 7, "ELECTRODES": 1, "NAMES": 8, "BACK": 5}
"""Names of the layers of a drawing, and their colours in the AutoCAD colour index."""

MARGIN = 5.0
"""Margin around an SVG drawing, mm."""


def draw_layout(sensor: Sensor) -> Drawing:
    """Create a drawing of the film, the electrodes with their names, and the metal on the back of the film.

    The electrodes are closed polylines at their nominal positions. The layer `BACK` is empty if the back is completely
    covered with metal.

    Args:
        sensor: Sensor with the layout.

    Returns:
        The drawing as a DXF document.
    """
    # Create an empty drawing in mm with one layer for each kind of object.
    document = ezdxf.new("R2010")
    document.units = units.MM
    for name, colour in LAYERS.items():
        document.layers.add(name, color=colour)

    # Draw the film and the electrodes with their names.
    space = document.modelspace()
    if sensor.film.oval:
        rim = to_corners(sensor.film.rim[:-1]).tolist()
        space.add_lwpolyline(rim, close=True, dxfattribs={"layer": "FILM"})
    else:
        space.add_circle((0.0, 0.0), sensor.film.radius, dxfattribs={"layer": "FILM"})
    for electrode in sensor.electrodes:
        for polygon in electrode.front:
            space.add_lwpolyline(polygon, close=True, dxfattribs={"layer": "ELECTRODES"})
        # The name is written at the rightmost corner of the pad. Characters that are not printable are replaced.
        name = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in electrode.name)
        rightmost_corner = max(electrode.corners)  # tuples (x, y) are compared by x first
        space.add_text(name, dxfattribs={"layer": "NAMES"}).set_placement(rightmost_corner)

    # Draw the metal of the back, unless it covers the whole film. If only some electrodes have their own metal on the
    # back, the other electrodes need metal of their own shape. Electrodes may share a polygon, which is drawn once.
    if any(electrode.back for electrode in sensor.electrodes):
        back = [polygon for electrode in sensor.electrodes for polygon in electrode.back or electrode.front]
        for polygon in dict.fromkeys(back):
            space.add_lwpolyline(polygon, close=True, dxfattribs={"layer": "BACK"})
    return document


def to_dxf(document: Drawing) -> str:
    """Convert a drawing into the text of a DXF file. Equal drawings result in equal texts."""
    stream = io.StringIO()
    document.write(stream)
    return stream.getvalue()


def to_svg(document: Drawing) -> str:
    """Convert a drawing into the text of an SVG file with the correct scale. Letters become outlines."""
    backend = SVGBackend()
    configuration = Configuration(background_policy=BackgroundPolicy.WHITE)
    frontend = Frontend(RenderContext(document), backend, config=configuration)
    frontend.draw_layout(document.modelspace())

    # A width and a height of 0 mean that the page has the size of the drawing. The drawing is not scaled to the page.
    page = Page(0.0, 0.0, Units.mm, margins=Margins.all(MARGIN))
    text: str = backend.get_string(page, settings=Settings(fit_page=False))
    return text


def write_design(design: Design, folder: Path) -> None:
    """Write a designed layout into a new folder.

    The files are `sensor.toml`, `layout.svg`, `layout.dxf`, `design.json`, and the picture `design.png` of the position
    errors. Equal designs result in identical files.

    Args:
        design: Result of the design.
        folder: Folder that is created.

    Raises:
        OutputExists: If the folder already exists.
        OutputError: If the files cannot be written.
    """
    case = design.case
    # Errors of the new layout if the nuisance parameters (probe radius, pretension and gains) are uncertain
    errors = design.errors_after.to_dict()["with_nuisances"]
    sensor_comment = [
        f"Positions searched for {case.electrodes} electrodes over {case.radius:g} mm, goal {case.goal}:",
        f"lower limit of the position error {errors['worst_mm']:.3f} mm at worst, {errors['rms_mm']:.3f} mm rms.",
    ]
    drawing = draw_layout(design.sensor)
    files = {
        "sensor.toml": sensor_to_toml(design.sensor, sensor_comment).encode(),
        "layout.svg": to_svg(drawing).encode(),
        "layout.dxf": to_dxf(drawing).encode(),
        "design.json": (json.dumps(design.to_dict(), indent=1, allow_nan=False) + "\n").encode(),
        "design.png": picture_bytes(error_maps_picture(design)),
    }
    # The files are written into a temporary folder, which is renamed to `folder` when all files are complete.
    with new_folder(folder) as temporary_folder:
        for name, content in files.items():
            write_whole(temporary_folder / name, content)
