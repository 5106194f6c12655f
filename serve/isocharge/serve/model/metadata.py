"""What a model file says about itself: the `metadata_props` of its ONNX graph, one JSON value per key.

Whoever holds only `model.onnx` can read from it which sensor it was made for, in which order the charges go in, where
it may be trusted and how well it did. The sensor travels whole but is opaque here, except for its name, which is the
frame that x and y refer to.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from isocharge.errors import ModelError

FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class ModelMetadata:
    """Everything a user of a model file needs to know.

    Attributes:
        name: Model name, equal to its folder's.
        version: From 1; the name of the version folder.
        sensor: The whole sensor as JSON; only its `name` is read here.
        electrodes: Electrode names in the order of the charges.
        working_area_mm: Polygon (x, y), mm, inside which the model was trained.
        probes: Probe notations it was trained with.
        force_range_N: Smallest and largest force it was trained with, N.
        noise: The noise model of the training, with its parameters.
        dataset_sha256: Checksum of the dataset.
        errors: Measured errors, by names that carry the unit.
        made_with: The command and the package versions.
        format_version: Of this metadata.
    """

    name: str
    version: int
    sensor: Mapping[str, Any]
    electrodes: tuple[str, ...]
    working_area_mm: tuple[tuple[float, float], ...]
    probes: tuple[str, ...]
    force_range_N: tuple[float, float]
    noise: Mapping[str, Any]
    dataset_sha256: str
    errors: Mapping[str, float]
    made_with: Mapping[str, Any]
    format_version: int = FORMAT_VERSION

    @property
    def label(self) -> str:
        """`name/version`, as prediction records carry it."""
        return f"{self.name}/{self.version}"

    @property
    def frame_id(self) -> str:
        """The sensor's name: the frame of x and y."""
        return str(self.sensor["name"])

    def to_props(self) -> dict[str, str]:
        """The metadata as ONNX `metadata_props`: field name to JSON.

        Raises:
            ModelError: If a value is not JSON, NaN included.
        """
        return {field.name: _to_json(field.name, getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_props(cls, props: Mapping[str, str], where: str) -> "ModelMetadata":
        """Read ONNX `metadata_props`.

        Args:
            props: Field name to JSON; other keys are left alone.
            where: The file, for messages.

        Raises:
            ModelError: If the format version is another, or a key is missing or wrong.
        """
        version = _read(props, "format_version", where)
        if version != FORMAT_VERSION:
            raise ModelError(
                f"{where}: metadata format {version} is not supported (this version reads {FORMAT_VERSION}); "
                "export it again or upgrade isocharge"
            )
        return cls(**{field.name: _read(props, field.name, where) for field in fields(cls)})


def _to_json(key: str, value: Any) -> str:
    try:
        return json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ModelError(f"model metadata {key!r}: expected a JSON value, got {value!r} ({error})") from error


def _read(props: Mapping[str, str], key: str, where: str) -> Any:
    if key not in props:
        raise ModelError(f"{where}: the metadata has no {key!r}; export the model with `isocharge train fit`")
    try:
        return _READERS[key](json.loads(props[key]))
    except ValueError as error:
        raise ModelError(f"{where}: metadata {key!r}: {error}; export the model again") from error


def _expect(holds: bool, expected: str, value: Any) -> None:
    if not holds:
        raise ValueError(f"expected {expected}, got {value!r}")


def _text(value: Any) -> str:
    _expect(isinstance(value, str) and value != "", "a text", value)
    return str(value)


def _count(value: Any) -> int:
    _expect(isinstance(value, int) and not isinstance(value, bool) and value > 0, "a whole number from 1", value)
    return int(value)


def _number(value: Any) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    _expect(is_number and math.isfinite(value), "a finite number", value)
    return float(value)


def _mapping(value: Any) -> dict[str, Any]:
    _expect(isinstance(value, dict), "a JSON object", value)
    return dict(value)


def _sensor(value: Any) -> dict[str, Any]:
    _text(_mapping(value).get("name"))
    return dict(value)


def _errors(value: Any) -> dict[str, float]:
    return {name: _number(error) for name, error in _mapping(value).items()}


def _texts(value: Any) -> tuple[str, ...]:
    _expect(isinstance(value, list) and len(value) > 0, "a list of texts", value)
    return tuple(map(_text, value))


def _electrodes(value: Any) -> tuple[str, ...]:
    names = _texts(value)
    _expect(len(set(names)) == len(names), "electrode names that differ", value)
    return names


def _pair(value: Any) -> tuple[float, float]:
    _expect(isinstance(value, list) and len(value) == 2, "two numbers", value)
    return _number(value[0]), _number(value[1])


def _range(value: Any) -> tuple[float, float]:
    low, high = _pair(value)
    _expect(low <= high, "a smaller and a larger number", value)
    return low, high


def _polygon(value: Any) -> tuple[tuple[float, float], ...]:
    _expect(isinstance(value, list) and len(value) >= 3, "at least three points", value)
    return tuple(map(_pair, value))


_READERS: dict[str, Callable[[Any], Any]] = {
    "name": _text,
    "version": _count,
    "sensor": _sensor,
    "electrodes": _electrodes,
    "working_area_mm": _polygon,
    "probes": _texts,
    "force_range_N": _range,
    "noise": _mapping,
    "dataset_sha256": _text,
    "errors": _errors,
    "made_with": _mapping,
    "format_version": _count,
}
