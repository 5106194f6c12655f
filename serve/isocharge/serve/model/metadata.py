"""The metadata of a model: the `metadata_props` of its ONNX graph, one JSON value per key.

From `model.onnx` alone one can read for which sensor the model was trained, in which order it takes the charges, where
it may be trusted and how large its errors are. The sensor is stored whole but only its name is read here: the frame
that x and y refer to.
"""

import json
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, to_builtins

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError, shown
from isocharge.common.model_labels import ModelName
from isocharge.common.printable_text import is_printable
from isocharge.common.structs import Finite, NotNegative, Positive, Settings, Text, WrongKey, convert, parse_json

FORMAT_VERSION = 1
"""Version of the metadata."""


Names = Annotated[tuple[Text, ...], Meta(min_length=1)]

NoiseLevel = Annotated[
    NotNegative | tuple[NotNegative, ...],
    Meta(extra_json_schema={"description": "a number from 0, or a list with one for each electrode"}),
]
"""Standard deviation of the noise of all electrodes, or of each."""


class ModelNoise(Struct, frozen=True, kw_only=True):
    """The noise of the charges that a model was trained for.

    The standard deviation of a charge q is the root of `white_pC`^2 + (`gain` * q)^2.

    Attributes:
        name: Name of the noise model.
        white_pC: Standard deviation that does not depend on the charge, pC.
        gain: Standard deviation in proportion to the charge, dimensionless.
    """

    name: Text
    white_pC: NoiseLevel
    gain: NoiseLevel

    def of_each(self, electrodes: int) -> tuple[Array, Array]:
        """Return `white_pC` and `gain` of each electrode, both of shape (electrodes,)."""
        return np.broadcast_to(self.white_pC, electrodes), np.broadcast_to(self.gain, electrodes)

    def variance(self, charge_pC: Array) -> Array:
        """Return the variance of the noise of charges, both of shape (..., n_electrode), in pC and pC^2."""
        white_pC = np.asarray(self.white_pC)
        gain = np.asarray(self.gain)
        return np.asarray(white_pC**2 + (gain * charge_pC) ** 2)


class ModelMetadata(Settings, frozen=True, kw_only=True):
    """Everything a user of a model file needs to know.

    Attributes:
        name: Model name, equal to its folder's.
        version: Number from 1; the name of the version folder.
        sensor: The whole sensor as JSON; only its `name` is read here.
        electrodes: Electrode names in the order of the charges.
        working_area_mm: Polygon (x, y), mm, inside which the model was trained.
        probes: Notations of the probes in the training.
        force_range_N: Smallest and largest force in the training, N.
        noise: The noise of the training.
        dataset_sha256: Checksum of the dataset.
        errors: Measured errors, by names that carry the unit.
        made_with: The command and the package versions.
        format_version: Version of the metadata.
        yield_force_N: Force beyond which the film yields under the sharpest of the probes, N; None if that is beyond
            the range, or not known.
    """

    name: ModelName
    version: Annotated[int, Meta(ge=1)]
    sensor: dict[str, Any]
    electrodes: Names
    working_area_mm: Annotated[tuple[tuple[Finite, Finite], ...], Meta(min_length=3)]
    probes: Names
    force_range_N: tuple[Finite, Finite]
    noise: ModelNoise
    dataset_sha256: Text
    errors: dict[str, Finite]
    made_with: dict[str, Any]
    format_version: int = FORMAT_VERSION
    yield_force_N: Positive | None = None

    def __post_init__(self) -> None:
        if "name" not in self.sensor:
            raise WrongKey("sensor.name")
        if not isinstance(name := self.sensor["name"], str) or not name:
            raise WrongKey("sensor.name", "a text", name)
        if len(set(self.electrodes)) < len(self.electrodes):
            raise WrongKey("electrodes", "names that differ", self.electrodes)
        for key, texts in (("electrodes", self.electrodes), ("probes", self.probes), ("sensor.name", (name,))):
            if not all(is_printable(text) for text in texts):
                raise WrongKey(key, "printable characters", texts)
        if self.force_range_N[0] > self.force_range_N[1]:
            raise WrongKey("force_range_N", "a smaller and a larger number", list(self.force_range_N))
        for key, level in (("white_pC", self.noise.white_pC), ("gain", self.noise.gain)):
            if isinstance(level, tuple) and len(level) != len(self.electrodes):
                raise WrongKey(f"noise.{key}", f"one number for each of {len(self.electrodes)} electrodes", level)

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
        known = [name for name in self.__struct_fields__ if getattr(self, name) is not None]
        return {name: _to_json(name, getattr(self, name)) for name in known}

    @classmethod
    def from_props(cls, props: Mapping[str, str], where: str) -> "ModelMetadata":
        """Read ONNX `metadata_props`.

        Args:
            props: Field name to JSON; other keys are left alone.
            where: The file, for messages.

        Raises:
            ModelError: If the format version is another, or a key is missing or wrong.
        """
        where = f"{where}: metadata"
        try:
            known = [name for name in cls.__struct_fields__ if name in props]
            values = {name: parse_json(props[name], f"{where}: {name}", ModelError, object) for name in known}
            version = convert(values, _Version, where, ModelError).format_version
            if version == FORMAT_VERSION:
                return convert(values, cls, where, ModelError)
        except ModelError as error:
            raise ModelError(f"{error}; export the model again") from error
        raise ModelError(
            f"{where} format {version} is not supported (this version reads {FORMAT_VERSION}); export it again or "
            "upgrade isocharge"
        )


class _Version(Struct):
    """What is read first of any version."""

    format_version: Annotated[int, Meta(ge=1)]


def _to_json(key: str, value: Any) -> str:
    try:
        return json.dumps(value, allow_nan=False, default=to_builtins)
    except (TypeError, ValueError) as error:
        raise ModelError(f"model metadata {key!r}: expected a JSON value, got {shown(value)} ({error})") from error
