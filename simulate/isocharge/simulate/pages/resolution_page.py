"""The page of `isocharge simulate identify --html`: the map of least errors, for every force between the ends.

Limits are tabulated on rings for a few forces, as logarithms in 16 bits; the page interpolates them in the logarithms
of error and force, in which both are smooth. Style and script are the files beside this module.
"""

import base64
import json
import re
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.identifiability.identification import Identification, LimitMap

RINGS, ANGLES, FORCES = 100, 90, 13
"""Distances from the centre, angles and forces at which limits are tabulated."""

SMALLEST, LARGEST = 1e-6, 1e6
"""Ends of what 16 bits hold, mm or percent; the step between is 0.04 %."""

SHARES = (0.01, 0.9)
"""Shares of all values at the ends of the colours, before these are rounded to 1, 2 or 5 times a power of ten."""

NEAT = (1.0, 2.0, 5.0, 10.0)
"""Mantissas of round numbers."""


def resolution_page(identification: Identification) -> str:
    """The page, as HTML with everything in it."""
    rings = identification.maps[0].rings.spread(identification.area.searched, RINGS, ANGLES)
    low, high = identification.area.force_range
    forces = np.geomspace(low, high, FORCES if high > low else 1)
    maps = [LimitMap.of(identification.charges, identification.noise, float(force), rings) for force in forces]
    about = identification.to_dict()
    data = {
        "sensor": about["sensor"],
        "probe": about["probe"],
        "noise": identification.noise.name,
        "area": about["working_area"],
        "folds_mm": about["folds_mm"],
        "twins": about["twins"],
        "electrodes": _electrodes(identification),
        "force_N": forces.tolist(),
        "radius_mm": 1e3 * identification.area.searched,
        "rings": RINGS,
        "angles": ANGLES,
        "position": _table(np.array([1e3 * limits.position for limits in maps])),
        "force": _table(np.array([1e2 * limits.relative_force for limits in maps])),
    }
    return _filled(f"Resolution of {about['sensor']}", data)


def _electrodes(identification: Identification) -> list[dict[str, Any]]:
    """Names and corners, mm, at their calibrated positions."""
    place = identification.sensor.calibration.place
    return [
        {"name": electrode.name, "corners_mm": (1e3 * place(np.array(electrode.corners))).round(4).tolist()}
        for electrode in identification.sensor.electrodes
    ]


def _table(values: Array) -> dict[str, Any]:
    """Values, shape (n_force, n_ring, n_angle), as little-endian 16 bit logarithms, and the ends of their colours."""
    share = np.log(np.clip(values, SMALLEST, LARGEST) / SMALLEST) / np.log(LARGEST / SMALLEST)
    low, high = np.quantile(values, SHARES)
    return {
        "log16": base64.b64encode(np.round(65535 * share).astype("<u2").tobytes()).decode(),
        "smallest": SMALLEST,
        "largest": LARGEST,
        "colours": [_neat(float(low), -1), max(_neat(float(high), 1), 10.0 * _neat(float(low), -1))],
    }


def _neat(value: float, direction: int) -> float:
    """The next round number downwards (-1) or upwards (1), between the ends of the table."""
    value = float(np.clip(value, 10.0 * SMALLEST, LARGEST / 10.0))
    power = 10.0 ** np.floor(np.log10(value))
    neat = [mantissa * power for mantissa in NEAT]
    chosen = min(each for each in neat if each >= value * (1 - 1e-9)) if direction > 0 else max(
        each for each in neat if each <= value * (1 + 1e-9)
    )  # fmt: skip
    return float(f"{chosen:.3g}")


def _filled(title: str, data: dict[str, Any]) -> str:
    """The files beside this module as one; the data cannot end their script element."""
    folder = files(__package__)
    page = folder.joinpath("resolution.html").read_text("utf-8")
    parts = {
        "title": escape(title),
        "style": folder.joinpath("resolution.css").read_text("utf-8"),
        "script": folder.joinpath("resolution.js").read_text("utf-8"),
        "data": json.dumps(data, allow_nan=False).replace("<", "\\u003c"),
    }
    return re.sub(r"@@(\w+)@@", lambda mark: parts[mark[1]], page)
