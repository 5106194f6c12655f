"""Reader of electrodes from a DXF drawing."""

from itertools import chain, combinations
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from isocharge.common.errors import SensorError, cut
from isocharge.common.extras import require
from isocharge.simulate.numerics.polygon import area_of, to_complex
from isocharge.simulate.sensor.sensor import MAX_ELECTRODES, Corners, Electrode, check_polygon

with require("design"):
    import ezdxf
    from ezdxf.enums import InsertUnits
    from ezdxf.path import make_path
    from ezdxf.units import conversion_factor

LINE_TYPES = ("LWPOLYLINE", "POLYLINE", "CIRCLE", "ELLIPSE", "SPLINE")
"""Types of DXF entities that may be outlines of metal. A width is only read from entities of the type LWPOLYLINE."""

TEXT_TYPES = ("TEXT", "MTEXT")
"""Types of DXF entities that may be the name of an electrode."""

TOUCHING_DISTANCE = 1e-3
"""Largest distance between two polygons that belong to the same electrode, mm."""

ARC_TOLERANCE = 0.01
"""Largest distance between an arc and the chords that replace the arc, mm."""


def read_artwork(path: str | Path, layer: str = "ELECTRODES", back: str = "") -> tuple[Electrode, ...]:
    """Read the electrodes of a DXF drawing, such as a drawing that `isocharge simulate design` wrote.

    Closed lines are polygons of metal, and open polylines with a width are traces. Polygons and traces that touch or
    overlap form one electrode. The name of an electrode is the text that is nearest to its first polygon. If there are
    no texts, or two electrodes have the same nearest text, all electrodes are named A, B, C and so on. If a drawing has
    no unit, its unit is assumed to be mm.

    Args:
        path: Path of the DXF file.
        layer: Name of the layer with the metal of the front.
        back: Name of the layer with the metal of the back, which all electrodes share. If it is empty, the whole back
            is covered with metal.

    Returns:
        The electrodes, in the order of their first polygons.

    Raises:
        SensorError: If the file or a layer cannot be read, or if an object of a layer is not a line, crosses itself, or
            is open and has no width.
    """
    try:
        document: Any = ezdxf.readfile(path)
    except (OSError, ezdxf.DXFError) as error:
        raise SensorError(f"{path}: expected a DXF file: {error}") from error
    unit = InsertUnits(document.units or InsertUnits.Millimeters)  # `units` is zero if the drawing has no unit
    scale = conversion_factor(unit, InsertUnits.Millimeters)  # length of a unit of the drawing, mm
    polygons_of_electrodes = _touching_groups(_polygons(document, layer, scale, path))

    # Read the polygons of the back, which all electrodes share.
    back_corners: tuple[Corners, ...] = ()
    if back:
        back_corners = tuple(polygon.corners for polygon in _polygons(document, back, scale, path))

    electrodes = []
    names = _names(document, polygons_of_electrodes, scale)  # there may be more names than electrodes
    for name, (first_polygon, *other_polygons) in zip(names, polygons_of_electrodes, strict=False):
        other_corners = tuple(polygon.corners for polygon in other_polygons)
        electrodes.append(Electrode(name, first_polygon.corners, more=other_corners, back=back_corners))
    return tuple(electrodes)


def _touching_groups(polygons: list[Electrode]) -> list[list[Electrode]]:
    """Divide polygons into groups of polygons that are connected.

    Polygons that touch or overlap are connected, directly or through other polygons.

    Args:
        polygons: Polygons, each as an electrode of its own.

    Returns:
        The groups, in the order of their first polygons.
    """
    # Compare each pair of polygons once, and number the groups of connected polygons.
    is_connected = np.zeros((len(polygons), len(polygons)), dtype=bool)
    for (row, polygon), (column, other) in combinations(enumerate(polygons), 2):
        is_connected[row, column] = polygon.overlaps(other, TOUCHING_DISTANCE)
    _group_count, group_numbers = connected_components(is_connected, directed=False)

    # A dictionary keeps the order in which its keys are added, which is the order of the first polygons.
    groups: dict[int, list[Electrode]] = {}
    for polygon, group_number in zip(polygons, group_numbers.tolist(), strict=True):
        groups.setdefault(group_number, []).append(polygon)
    return list(groups.values())


def _polygons(document: Any, layer: str, scale: float, path: str | Path) -> list[Electrode]:
    """Read the polygons of a layer, and return each polygon as a separate electrode.

    A closed line is the outline of a pad. An open line with a width is a trace, and the outline of the trace is the
    polygon.

    Args:
        document: DXF document.
        layer: Name of the layer. Upper and lower case are not distinguished.
        scale: Length of a unit of the drawing, mm.
        path: Path of the file for error messages.

    Returns:
        The pads, followed by the traces. The name of each electrode states the layer and the handle of its line in the
        drawing, because error messages contain this name.

    Raises:
        SensorError: If the layer has no lines, or an object of the layer cannot be an electrode.
    """
    # The texts of the drawing are not metal, but may be names of electrodes; see `_names`.
    shapes = [shape for shape in document.modelspace() if shape.dxftype() not in TEXT_TYPES]
    pads = []
    traces = []
    for shape in shapes:
        if shape.dxf.layer.lower() != layer.lower():
            continue
        label = f"{path}: layer {layer!r}: {shape.dxftype()} #{shape.dxf.handle}"  # for error messages
        if shape.dxftype() not in LINE_TYPES:
            raise SensorError(f"{label}: expected one of {', '.join(LINE_TYPES)}; redraw or explode it, or delete it")

        # A polyline of the type LWPOLYLINE is closed only if its flag says so, because a trace may end at its start.
        # Any other line is closed if its ends coincide.
        curve = make_path(shape)
        is_closed = shape.closed if shape.dxftype() == "LWPOLYLINE" else curve.is_closed

        # Compute points of the line in mm. Arcs are replaced by chords.
        chord_ends = curve.flattening(ARC_TOLERANCE / scale)
        points = tuple((scale * point.x, scale * point.y) for point in chord_ends)
        width = scale * _width(shape)
        if is_closed:
            corners = _anticlockwise_corners(points)
            check_polygon(label, corners)
            pads.append(Electrode(label, corners))
        elif width > 0.0:
            # `with_trace` converts the centre line into the polygon of the trace, which is the only item of `more`.
            (trace_corners,) = Electrode(label, ()).with_trace(points, width).more
            traces.append(Electrode(label, trace_corners))
        else:
            raise SensorError(f"{label} is open and has no width; close it, or give it the width of a trace")
    if not pads and not traces:
        layers_with_lines = ", ".join(sorted({shape.dxf.layer for shape in shapes if shape.dxftype() in LINE_TYPES}))
        raise SensorError(f"{path}: layer {layer!r} has no lines; the layers with lines are {cut(layers_with_lines)}")
    return [*pads, *traces]


def _anticlockwise_corners(points: Corners) -> Corners:
    """Return the corners of a closed line in anticlockwise order, without the repetition of the first corner.

    Args:
        points: Points (x, y) of the line, mm. The last point is equal to the first point.
    """
    is_anticlockwise = area_of(np.array(points)) > 0.0  # the area of a clockwise polygon is negative
    if is_anticlockwise:
        return points[:-1]
    return points[:0:-1]  # reversed order, from the last point to the second point


def _width(line: Any) -> float:
    """Return the width of a line in the unit of the drawing.

    The width is 0 if the line is not of the type LWPOLYLINE, has no width, or has a width that is not constant.
    """
    if line.dxftype() != "LWPOLYLINE":
        return 0.0

    # The code "se" selects the start width and the end width of each section. If the polyline has a constant width, the
    # constant width replaces both.
    start_and_end_widths = chain(*line.get_points("se"))
    different_widths = {line.dxf.const_width or width for width in start_and_end_widths}
    has_constant_width = len(different_widths) == 1
    return float(different_widths.pop()) if has_constant_width else 0.0


def _names(document: Any, groups: list[list[Electrode]], scale: float) -> list[str]:
    """Return names for groups of polygons, each of which becomes an electrode.

    The name of a group is the text of the drawing that is nearest to the first polygon of the group. If two groups have
    the same nearest text, or if the drawing has no texts, the names are the letters from A to Z, followed by numbers.

    Args:
        document: DXF document.
        groups: Polygons of each group.
        scale: Length of a unit of the drawing, mm.

    Returns:
        At least one name for each group, in the order of the groups. If the names are letters and numbers, there may be
        more names than groups.
    """
    text_positions = {  # x + iy, mm
        text.plain_text(): scale * complex(*text.dxf.insert.vec2)
        for text in document.modelspace().query(" ".join(TEXT_TYPES))
    }
    nearest_texts = []
    for group in groups:
        first_polygon = group[0]
        corners = to_complex(np.array(first_polygon.corners))
        distances = {text: float(np.abs(corners - position).min()) for text, position in text_positions.items()}
        if distances:  # empty if the drawing has no texts
            nearest_texts.append(min(distances, key=lambda text: distances[text]))
    has_different_text_for_each_group = len(set(nearest_texts)) == len(groups)
    if has_different_text_for_each_group:
        return nearest_texts
    numbers = [str(number) for number in range(MAX_ELECTRODES)]
    return [*ascii_uppercase, *numbers]
