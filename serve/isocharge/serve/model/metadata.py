"""The metadata of a model: the `metadata_props` of its ONNX graph, one JSON value per key.

From `model.onnx` alone one can read for which sensor the model was trained, in which order it takes the charges, where
it may be trusted and how large its errors are. The sensor is stored whole but only its name is read here: the frame
that x and y refer to.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from isocharge.common.errors import ModelError
from isocharge.common.tables import Table, parse_json, shown

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
"""Pattern of model names: safe in paths, URLs, pages and config.pbtxt."""

FORMAT_VERSION = 1
"""Version of the metadata."""


@dataclass(frozen=True, kw_only=True)
class ModelMetadata:
    """Everything a user of a model file needs to know.

    Attributes:
        name: Model name, equal to its folder's.
        version: Number from 1; the name of the version folder.
        sensor: The whole sensor as JSON; only its `name` is read here.
        electrodes: Electrode names in the order of the charges.
        working_area_mm: Polygon (x, y), mm, inside which the model was trained.
        probes: Notations of the probes in the training.
        force_range_N: Smallest and largest force in the training, N.
        noise: The noise model of the training, with its parameters.
        dataset_sha256: Checksum of the dataset.
        errors: Measured errors, by names that carry the unit.
        made_with: The command and the package versions.
        format_version: Version of the metadata.
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
        try:
            version = _table(props, ("format_version",), where).whole("format_version", least=1)
            if version == FORMAT_VERSION:
                return cls(**_fields(_table(props, tuple(field.name for field in fields(cls)), where)))
        except ModelError as error:
            raise ModelError(f"{error}; export the model again") from error
        raise ModelError(
            f"{where}: metadata format {version} is not supported (this version reads {FORMAT_VERSION}); "
            "export it again or upgrade isocharge"
        )


def _to_json(key: str, value: Any) -> str:
    try:
        return json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ModelError(f"model metadata {key!r}: expected a JSON value, got {shown(value)} ({error})") from error


def _table(props: Mapping[str, str], names: tuple[str, ...], where: str) -> Table:
    """The values of those of these fields that `props` has."""
    values: dict[str, Any] = {}
    for name in names:
        if name in props:
            values[name] = parse_json(props[name], f"{where}: metadata: {name}", ModelError)
    return Table(values, f"{where}: metadata", ModelError)


def _fields(table: Table) -> dict[str, Any]:
    """The arguments of `ModelMetadata`."""
    sensor, errors = table.table("sensor"), table.table("errors")
    sensor.text("name")
    return {
        "name": _name(table),
        "version": table.whole("version", least=1),
        "sensor": dict(sensor.values),
        "electrodes": _electrodes(table),
        "working_area_mm": _polygon(table, "working_area_mm"),
        "probes": _texts(table, "probes"),
        "force_range_N": _range(table, "force_range_N"),
        "noise": dict(table.table("noise").values),
        "dataset_sha256": table.text("dataset_sha256"),
        "errors": {name: errors.number(name) for name in errors},
        "made_with": dict(table.table("made_with").values),
    }


def _name(table: Table) -> str:
    name = table.text("name")
    if not NAME.fullmatch(name):
        table.refuse("name", "letters, digits, '-', '_' and '.'")
    return name


def _texts(table: Table, key: str) -> tuple[str, ...]:
    texts = table.texts(key)
    if not texts:
        table.refuse(key, "one text or more")
    return texts


def _electrodes(table: Table) -> tuple[str, ...]:
    names = _texts(table, "electrodes")
    if len(set(names)) < len(names):
        table.refuse("electrodes", "names that differ")
    return names


def _range(table: Table, key: str) -> tuple[float, float]:
    low, high = table.numbers(key, count=2, of="a smaller and a larger number")
    if low > high:
        table.refuse(key, "a smaller and a larger number")
    return low, high


def _polygon(table: Table, key: str) -> tuple[tuple[float, float], ...]:
    points = table.sequence(key, of="points")
    if len(points) < 3:
        table.refuse(key, "three points or more")
    corners = [table.as_numbers(key, point, count=2, of="points of two numbers") for point in points]
    return tuple((x, y) for x, y in corners)
