"""What the page has to know about a film before the first sample: geometry, electrodes, model, deflection field.

A model carries its sensor whole, as the simulator wrote it. What is missing there is not drawn. The deflection field
lies beside the model, or is shipped for the films of the released ones.
"""

import math
from collections.abc import Mapping
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from msgspec import Struct

from isocharge.common.deflection_field import DeflectionField, read_deflection_field
from isocharge.common.errors import InputError
from isocharge.common.structs import Finite, Positive, convert
from isocharge.serve.model.metadata import ModelMetadata

FILE = "deflection.json"
"""Name of the field in a model's version folder."""


def find_field(model: Path, metadata: ModelMetadata) -> DeflectionField | None:
    """The field of the film for which a model was trained; None if there is none.

    Args:
        model: Version folder.
        metadata: Of the model.

    Raises:
        InputError: If the file in the model's folder is damaged.
    """
    if (model / FILE).is_file():
        return read_deflection_field(model / FILE)
    film = metadata.sensor.get("film")
    with as_file(files("isocharge.serve.viewer") / "fields") as folder:
        fields = map(read_deflection_field, sorted(folder.glob("*.json")))
        return next((field for field in fields if field.fits(film)), None)


def describe_film(name: str, metadata: ModelMetadata, field: DeflectionField | None) -> dict[str, Any]:
    """A film for the page, as JSON.

    Args:
        name: Of the stream, for people.
        metadata: Of the model that answers.
        field: How the film deflects; None if nobody computed it.
    """
    sensor = metadata.sensor
    film = sensor.get("film")
    return {
        "name": name,
        "model": metadata.label,
        "sensor": metadata.frame_id,
        "electrodes": list(metadata.electrodes),
        "outlines_mm": _outlines_mm(sensor, metadata.electrodes),
        "radius_mm": film.get("radius_mm") if isinstance(film, dict) else None,
        "working_area_mm": [[float(x), float(y)] for x, y in metadata.working_area_mm],
        "force_range_N": list(metadata.force_range_N),
        "probes": list(metadata.probes),
        "deflection": None if field is None else field.to_json(),
    }


def _outlines_mm(sensor: Any, electrodes: tuple[str, ...]) -> dict[str, list[list[float]]]:
    """Corners of each electrode where it lies on the real film; none for a sensor of another form."""
    try:
        parts = convert(sensor["electrodes"], dict[str, Point | Positive | _Polygon], "sensor", InputError)
        return {name: _placed(_corners(parts, name), sensor.get("calibration") or {}) for name in electrodes}
    except (InputError, TypeError, ValueError, KeyError):
        return {}


Point = tuple[Finite, Finite]


class _Polygon(Struct):
    polygon_mm: list[Point]


def _corners(parts: Mapping[str, Any], name: str) -> list[Point]:
    if isinstance(part := parts[name], _Polygon):
        return part.polygon_mm
    (x, y), half = part, 0.5 * parts["side_mm"]
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]


def _placed(corners: list[tuple[float, float]], calibration: Any) -> list[list[float]]:
    """Corners after the calibration's turn and shift."""
    shift_x, shift_y = calibration.get("shift_mm", (0.0, 0.0))
    angle = math.radians(calibration.get("rotation_deg", 0.0))
    c, s = math.cos(angle), math.sin(angle)
    return [[c * x - s * y + shift_x, s * x + c * y + shift_y] for x, y in corners]
