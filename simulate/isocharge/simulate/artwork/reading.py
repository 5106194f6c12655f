"""Electrodes from the layers of a DXF drawing."""

from itertools import chain
from operator import itemgetter
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import numpy as np

from isocharge.common.errors import SensorError, cut
from isocharge.common.extras import require
from isocharge.simulate.numerics.polygon import area_of, to_complex
from isocharge.simulate.sensor.sensor import MAX_ELECTRODES, Electrode, check_polygon

with require("design"):
    import ezdxf
    from ezdxf.enums import InsertUnits
    from ezdxf.path import make_path
    from ezdxf.units import conversion_factor

LINES = ("LWPOLYLINE", "POLYLINE", "CIRCLE", "ELLIPSE", "SPLINE")
"""What outlines metal; only the first has a width that is read."""

TEXTS = ("TEXT", "MTEXT")
"""What names metal."""

TOUCHING = 1e-3
"""Distance up to which polygons are one electrode, mm."""

ROUND = 0.01
"""Largest distance of an arc from the polygon that stands for it, mm."""


def read_artwork(path: str | Path, layer: str = "ELECTRODES", back: str = "") -> tuple[Electrode, ...]:
    """The electrodes of a DXF drawing, such as that of `isocharge simulate design`.

    Closed lines are polygons, open polylines with a width are traces; what touches or overlaps is one electrode. Names
    are the nearest texts, or A, B, C... if these do not differ. A drawing without a unit is taken to be in mm.

    Args:
        path: The DXF file.
        layer: Of the metal of the front.
        back: Layer of the metal of the back, which all electrodes share; "" for a back that is metal all over.

    Raises:
        SensorError: If the file or a layer cannot be read, or something on it is no line, crosses itself, or is open
            without a width.
    """
    try:
        document: Any = ezdxf.readfile(path)  # type: ignore[attr-defined]
    except (OSError, ezdxf.DXFError) as error:  # type: ignore[attr-defined]
        raise SensorError(f"{path}: expected a DXF file: {error}") from error
    scale = conversion_factor(InsertUnits(document.units or InsertUnits.Millimeters), InsertUnits.Millimeters)
    polygons, groups = _polygons(document, layer, scale, path), list[list[Electrode]]()
    for polygon in polygons:
        joined = [group for group in groups if any(polygon.overlaps(other, TOUCHING) for other in group)]
        groups = [group for group in groups if group not in joined] + [[*chain(*joined), polygon]]
    groups.sort(key=lambda group: polygons.index(group[0]))
    behind = tuple(polygon.corners for polygon in _polygons(document, back, scale, path)) if back else ()
    return tuple(
        Electrode(name, pad.corners, more=tuple(polygon.corners for polygon in more), back=behind)
        for name, (pad, *more) in zip(_names(document, groups, scale), groups, strict=False)
    )


def _polygons(document: Any, layer: str, scale: float, path: str | Path) -> list[Electrode]:
    """The polygons of a layer, each an electrode of its own; pads before traces."""
    shapes, polygons = [shape for shape in document.modelspace() if shape.dxftype() not in TEXTS], []
    for shape in (shape for shape in shapes if shape.dxf.layer.lower() == layer.lower()):
        where = f"{path}: layer {layer!r}: {shape.dxftype()} #{shape.dxf.handle}"
        if shape.dxftype() not in LINES:
            raise SensorError(f"{where}: expected one of {', '.join(LINES)}; redraw or explode it, or delete it")
        outline = make_path(shape)
        closed = shape.closed if shape.dxftype() == "LWPOLYLINE" else outline.is_closed
        corners = tuple((scale * at.x, scale * at.y) for at in outline.flattening(ROUND / scale))
        if closed:
            corners = corners[:-1] if area_of(np.array(corners)) > 0.0 else corners[:0:-1]
            check_polygon(where, corners)
        elif (width := _width_of(shape)) > 0.0:
            (corners,) = Electrode(where, ()).with_trace(corners, scale * width).more
        else:
            raise SensorError(f"{where} is open and has no width; close it, or give it the width of a trace")
        polygons.append((not closed, Electrode(where, corners)))
    if not polygons:
        known = ", ".join(sorted({shape.dxf.layer for shape in shapes if shape.dxftype() in LINES}))
        raise SensorError(f"{path}: layer {layer!r} has no lines; those that have are {cut(known)}")
    return [polygon for _, polygon in sorted(polygons, key=itemgetter(0))]


def _width_of(line: Any) -> float:
    """Width of a polyline that is equally wide everywhere, else 0, in the drawing's unit."""
    if line.dxftype() != "LWPOLYLINE":
        return 0.0
    widths = {line.dxf.const_width or width for width in chain(*line.get_points("se"))}
    return float(widths.pop()) if len(widths) == 1 else 0.0


def _names(document: Any, groups: list[list[Electrode]], scale: float) -> list[str]:
    """The texts nearest to the corners of each group's pad, or letters."""
    shown = document.modelspace().query(" ".join(TEXTS))
    texts = {text.plain_text(): scale * complex(*text.dxf.insert.vec2) for text in shown}
    pads = [to_complex(np.array(group[0].corners)) for group in groups]
    names = [min(texts, key=lambda text: np.abs(pad - texts[text]).min()) for pad in pads if texts]
    return names if len(set(names)) == len(groups) else [*ascii_uppercase, *map(str, range(MAX_ELECTRODES))]
