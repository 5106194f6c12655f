"""A layout as DXF in millimetres, a layer for each kind of thing."""

import io

from isocharge.common.arrays import Array
from isocharge.common.extras import require
from isocharge.simulate.artwork.leads import Leads
from isocharge.simulate.artwork.ruler import RULER_MM, drawing_height_mm, ruler_lines_mm
from isocharge.simulate.sensor.sensor import Sensor

with require("design"):
    import ezdxf
    from ezdxf import units

LAYERS = {"FILM": 7, "ELECTRODES": 1, "LEADS": 2, "RULER": 8, "NAMES": 8}
"""Layers and their colours, numbers of the AutoCAD colour index."""


def layout_dxf(sensor: Sensor, leads: Leads) -> str:
    """Film, electrodes at their nominal places as closed polylines, leads with their width, names and a ruler."""
    document = ezdxf.new("R2010")  # type: ignore[attr-defined]
    document.units = units.MM
    for name, colour in LAYERS.items():
        document.layers.add(name, color=colour)
    space, radius = document.modelspace(), 1e3 * sensor.film.radius
    space.add_circle((0.0, 0.0), radius, dxfattribs={"layer": "FILM"})
    for electrode in sensor.electrodes:
        corners = [(1e3 * x, 1e3 * y) for x, y in electrode.corners]
        space.add_lwpolyline(corners, close=True, dxfattribs={"layer": "ELECTRODES"})
        text = space.add_text(electrode.name, height=1.5, dxfattribs={"layer": "NAMES"})
        text.set_placement((1e3 * electrode.centre[0], 1e3 * electrode.centre[1]))
    for lead in leads.leads:
        attributes = {"layer": "LEADS", "const_width": 1e3 * leads.width}
        space.add_lwpolyline(_pairs(1e3 * lead.path), dxfattribs=attributes)
    for x1, y1, x2, y2 in ruler_lines_mm(radius):
        space.add_line((x1, y1), (x2, y2), dxfattribs={"layer": "RULER"})
    label = space.add_text(f"{RULER_MM:g} mm", height=2.0, dxfattribs={"layer": "RULER"})
    label.set_placement((0.0, -radius - drawing_height_mm()))
    stream = io.StringIO()
    document.write(stream)
    return stream.getvalue()


def _pairs(points: Array) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in points]
