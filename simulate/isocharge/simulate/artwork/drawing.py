"""A layout in millimetres, a layer for each kind of thing: one drawing, written as DXF and as SVG."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from isocharge.common.extras import require
from isocharge.simulate.artwork.leads import Leads
from isocharge.simulate.sensor.sensor import Sensor

with require("design"):
    import ezdxf
    from ezdxf import units
    from ezdxf.addons.drawing.config import BackgroundPolicy, Configuration
    from ezdxf.addons.drawing.frontend import Frontend
    from ezdxf.addons.drawing.layout import Margins, Page, Settings, Units
    from ezdxf.addons.drawing.properties import RenderContext
    from ezdxf.addons.drawing.svg import SVGBackend
    from ezdxf.document import Drawing

LAYERS = {"FILM": 7, "ELECTRODES": 1, "LEADS": 30, "RULER": 8, "NAMES": 8}
"""Layers and their colours, numbers of the AutoCAD colour index; BACK is there if a back is described."""

RULER, TICK = 50.0, 10.0
"""Length of the ruler and distance of its ticks, mm: with it a print shows whether its scale is right."""

BELOW, SHORT, HEIGHT = 4.0, 1.5, 2.0
"""Distance of the ruler from the film, length of a tick and height of the letters, mm."""

MARGIN = 5.0
"""Space around the SVG, mm."""


def draw_layout(sensor: Sensor, leads: Leads) -> Drawing:
    """Film, electrodes at their nominal places as closed polylines, leads with their width, names and a ruler."""
    with _without_dates():
        document = ezdxf.new("R2010")  # type: ignore[attr-defined]
    document.units = units.MM
    for name, colour in LAYERS.items():
        document.layers.add(name, color=colour)
    space, radius = document.modelspace(), sensor.film.radius
    space.add_circle((0.0, 0.0), radius, dxfattribs={"layer": "FILM"})
    for path in leads.paths.values():
        space.add_lwpolyline(path.tolist(), dxfattribs={"layer": "LEADS", "const_width": leads.width})
    behind = dict.fromkeys(polygon for electrode in sensor.electrodes for polygon in electrode.back)
    if behind:
        document.layers.add("BACK", color=5)
    for polygon in behind:
        space.add_lwpolyline(polygon, close=True, dxfattribs={"layer": "BACK"})
    for electrode in sensor.electrodes:
        for polygon in electrode.front:
            space.add_lwpolyline(polygon, close=True, dxfattribs={"layer": "ELECTRODES"})
        name = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in electrode.name)
        space.add_text(name, height=HEIGHT, dxfattribs={"layer": "NAMES"}).set_placement(max(electrode.corners))
    y, left = -radius - BELOW, -0.5 * RULER
    ticks = [left + TICK * number for number in range(round(RULER / TICK) + 1)]
    for start, end in (((left, y), (-left, y)), *(((x, y), (x, y - SHORT)) for x in ticks)):
        space.add_line(start, end, dxfattribs={"layer": "RULER"})
    label = space.add_text(f"{RULER:g} mm along x, the drawn direction", height=HEIGHT, dxfattribs={"layer": "RULER"})
    label.set_placement((left, y - SHORT - 1.5 * HEIGHT))
    return document


def to_dxf(document: Drawing) -> str:
    """The drawing as DXF; the same drawing gives the same bytes."""
    stream = io.StringIO()
    with _without_dates():
        document.write(stream)
    return stream.getvalue()


def to_svg(document: Drawing) -> str:
    """The drawing as SVG to scale; texts are outlines."""
    backend = SVGBackend()
    configuration = Configuration(background_policy=BackgroundPolicy.WHITE)
    Frontend(RenderContext(document), backend, config=configuration).draw_layout(document.modelspace())
    page = Page(0.0, 0.0, Units.mm, margins=Margins.all(MARGIN))
    return backend.get_string(page, settings=Settings(fit_page=False))


@contextmanager
def _without_dates() -> Iterator[None]:
    """Fixed dates and identifiers instead of today's."""
    options: Any = ezdxf.options  # type: ignore[attr-defined]
    before = options.write_fixed_meta_data_for_testing
    options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        options.write_fixed_meta_data_for_testing = before
