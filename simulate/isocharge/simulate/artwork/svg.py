"""A layout as SVG in millimetres: one user unit is one millimetre, y up as in the sensor's frame."""

import re
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.artwork.leads import Leads
from isocharge.simulate.artwork.ruler import RULER_MM, drawing_height_mm, ruler_lines_mm
from isocharge.simulate.sensor.sensor import Sensor

MARGIN_MM = 5.0
"""Space around the film, mm."""

DIGITS = 6
"""Decimals of a millimetre in the file: a nanometre."""


NO_XML = re.compile("[^\\t\\n\\r\\x20-\\ud7ff\\ue000-\\ufffd\\U00010000-\\U0010ffff]")
"""Characters that XML cannot hold, not even escaped; a sensor's file can have them in a name."""


def layout_svg(sensor: Sensor, leads: Leads) -> str:
    """Film, electrodes at their nominal places, leads, a ruler and the x axis, the drawn direction."""
    radius = 1e3 * sensor.film.radius
    half, below = radius + MARGIN_MM, radius + drawing_height_mm() + MARGIN_MM
    width, height = 2.0 * half, half + below
    body = [
        f'<circle id="film" cx="0" cy="0" r="{_number(radius)}" fill="none" stroke="#1b2a41" stroke-width="0.1"/>',
        '<path id="drawn-direction" d="M -3 0 L 3 0 M 2 0.6 L 3 0 L 2 -0.6" fill="none" stroke="#9aa5b1" '
        'stroke-width="0.1"/>',
        *(
            f'<polyline id={quoteattr(f"lead-{lead.electrode}")} points="{_points(1e3 * lead.path)}" fill="none" '
            f'stroke="#c98a1b" stroke-width="{_number(1e3 * leads.width)}" stroke-linejoin="round"/>'
            for lead in leads.leads
        ),
        *(
            f"<polygon id={quoteattr(f'electrode-{electrode.name}')} "
            f'points="{_points(1e3 * np.array(electrode.corners))}" fill="#d1495b" stroke="none"/>'
            for electrode in sensor.electrodes
        ),
        *(
            f'<line class="ruler" x1="{_number(x1)}" y1="{_number(y1)}" x2="{_number(x2)}" y2="{_number(y2)}" '
            'stroke="#1b2a41" stroke-width="0.1"/>'
            for x1, y1, x2, y2 in ruler_lines_mm(radius)
        ),
    ]
    names = [_text(electrode.name, 1e3 * np.array(electrode.centre), 2.0) for electrode in sensor.electrodes]
    names.append(_text(f"{RULER_MM:g} mm", np.array([0.0, -radius - drawing_height_mm()]), 2.5))
    lines = "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{_number(width)}mm" height="{_number(height)}mm" '
            f'viewBox="{_number(-half)} {_number(-half)} {_number(width)} {_number(height)}">',
            f"<title>{escape(sensor.name)}, electrodes seen from the side that is touched, in mm</title>",
            '<g id="layout" transform="scale(1,-1)">',
            *body,
            "</g>",
            '<g id="names" font-family="sans-serif" text-anchor="middle" fill="#1b2a41">',
            *names,
            "</g>",
            "</svg>",
            "",
        ]
    )
    return NO_XML.sub("\N{REPLACEMENT CHARACTER}", lines)


def _text(text: str, at_mm: Array, size_mm: float) -> str:
    """A text at a place of the sensor's frame; texts are not mirrored, so they stand outside the turned group."""
    x, y = at_mm[0], -at_mm[1] + 0.35 * size_mm
    return f'<text x="{_number(x)}" y="{_number(y)}" font-size="{_number(size_mm)}">{escape(text)}</text>'


def _points(corners_mm: Array) -> str:
    return " ".join(f"{_number(x)},{_number(y)}" for x, y in corners_mm)


def _number(value: float) -> str:
    return f"{round(float(value), DIGITS) + 0.0:g}" if float(value).is_integer() else f"{float(value):.{DIGITS}f}"
