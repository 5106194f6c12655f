"""Description of the film, the electrodes and the model, which a page reads before the first sample."""

import math
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.structs import plain_values
from isocharge.serve.model.contact import Validity
from isocharge.serve.model.metadata import ModelMetadata


def describe_film(name: str, metadata: ModelMetadata) -> dict[str, Any]:
    """Return the description of a film and its electrodes as a JSON object for the page.

    If the metadata of the model do not describe a part of the film, the page does not draw this part.

    Args:
        name: Name of the stream, which the page shows.
        metadata: Metadata of the model.
    """
    description = {
        "name": name,
        "model": metadata.label,
        "electrodes": metadata.electrodes,
        "polygons_mm": _electrode_polygons(metadata.sensor, metadata.electrodes),
        "film": metadata.sensor.get("film"),
        "working_area_mm": metadata.working_area_mm,
        "force_range_N": metadata.force_range_N,
        "misfit_limit": Validity.of(metadata).misfit_limit,
        "probes": metadata.probes,
        "unnoticed": metadata.unnoticed,
    }
    return dict(plain_values(description))


def _electrode_polygons(sensor: dict[str, Any], electrodes: tuple[str, ...]) -> dict[str, list[Array]]:
    """Return the polygons of each electrode at its calibrated place, or at its designed place without a calibration.

    The calibration has measured a rotation and a shift of all electrodes. The first polygon of an electrode is its pad.
    All further polygons describe additional metal that belongs to the electrode, such as leads.

    Args:
        sensor: Description of the sensor in the metadata of the model, which may be incomplete.
        electrodes: Names of the electrodes.

    Returns:
        Corners (x, y) of the polygons, each of shape (n, 2), mm, by electrode name. The dictionary is empty if the
        description of the sensor has an unknown form.
    """
    try:
        calibration = sensor.get("calibration") or {}
        shift_mm = np.array(calibration.get("shift_mm", (0.0, 0.0)), float)
        angle = math.radians(calibration.get("rotation_deg", 0.0))
        rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        return {
            name: [
                np.array(corners, float) @ rotation.T + shift_mm  # corners of shape (n, 2)
                for corners in _designed_polygons(sensor["electrodes"], name)
            ]
            for name in electrodes
        }
    except (TypeError, ValueError, KeyError, AttributeError):  # the description has an unknown form
        return {}


def _designed_polygons(parts: dict[str, Any], name: str) -> list[Any]:
    """Return the polygons of an electrode according to its design, before a calibration has corrected them.

    If the design contains only a point for the electrode, the electrode is a square around this point.

    The polygons are lists or arrays of corners (x, y), mm.

    Args:
        parts: Section `electrodes` of a sensor file: a point (x, y) or polygons for each electrode name, and the side
            of the squares under the key `side_mm`.
        name: Name of the electrode.
    """
    part = parts[name]
    if isinstance(part, dict):
        return [part["polygon_mm"], *part.get("more_mm", [])]
    unit_square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return [(unit_square - 0.5) * parts["side_mm"] + part]  # here, `part` is the point in the middle
