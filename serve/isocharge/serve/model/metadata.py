"""Metadata of a model, stored in the `metadata_props` of its ONNX graph as one JSON value per key.

The metadata describe the sensor for which the model was trained, the order of the charges, the domain in which the
model is valid, and the measured errors of the model. The complete description of the sensor is stored, but this module
reads only its name and the signs of its charges. The name of the sensor is also the name of the coordinate frame of x
and y.
"""

import json
import re
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct, structs, to_builtins

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError, error_context, is_printable, shown
from isocharge.common.structs import Finite, NotNegative, Positive, Settings, Text, WrongKey, convert, parse_json

FORMAT_VERSION = 1
"""Version of the format of the metadata."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
"""Regular expression of the name of a model: characters that are safe in paths, URLs, web pages and `config.pbtxt`."""

VERSION = re.compile("[1-9][0-9]{0,17}")
"""Regular expression of the version of a model: a whole number of at most 63 bits."""

LABEL = re.compile(f"{NAME.pattern}/{VERSION.pattern}")
"""Regular expression of the label of a model, `NAME/VERSION`."""

ModelName = Annotated[str, Meta(pattern=rf"\A{NAME.pattern}\Z", description="letters, digits, '-', '_' and '.'")]

ModelLabel = Annotated[str, Meta(pattern=rf"\A{LABEL.pattern}\Z", description="the label NAME/VERSION of a model")]

Names = Annotated[tuple[Text, ...], Meta(min_length=1)]

NoiseLevel = Annotated[
    NotNegative | tuple[NotNegative, ...],
    Meta(extra_json_schema={"description": "a number from 0, or a list with one for each electrode"}),
]
"""Noise level as one number for all electrodes, or as one number for each electrode."""


class ModelNoise(Struct, frozen=True, kw_only=True):
    """Noise that was added to the charges when the model was trained.

    The variance of the noise of a charge q is `white_pC`^2 + (`gain` * q)^2.

    Attributes:
        name: Name of the noise.
        white_pC: Standard deviation of the part that does not depend on the charge, pC.
        gain: Standard deviation of the part that is proportional to the charge, relative to the charge.
    """

    name: Text
    white_pC: NoiseLevel
    gain: NoiseLevel

    def for_each_electrode(self, n_electrode: int) -> tuple[Array, Array]:
        """Return `white_pC` and `gain` with one value for each electrode, both of shape (n_electrode,)."""
        return np.broadcast_to(self.white_pC, n_electrode), np.broadcast_to(self.gain, n_electrode)

    def variance(self, charge_pC: Array) -> Array:
        """Compute the variance of the noise of charges.

        Args:
            charge_pC: Charges, shape (..., n_electrode), pC.

        Returns:
            Variances, shape (..., n_electrode), pC^2.
        """
        return np.asarray(np.square(self.white_pC) + np.multiply(self.gain, charge_pC) ** 2)


Share = Annotated[float, Meta(ge=0.0, le=1.0)]
"""Share of presses, from 0 to 1."""


class UnnoticedPresses(Struct, frozen=True, kw_only=True):
    """Shares of unnoticed presses among the presses outside the working area.

    A press is unnoticed if the model reports a wrong contact without a flag.

    The area between two circles about the origin is divided into rings of equal width. Each ring is divided into equal
    sectors. The first sector of a ring begins at the x axis, and the other sectors follow anticlockwise.

    Attributes:
        from_mm: Radius of the inner circle, mm.
        to_mm: Radius of the outer circle, mm.
        force_N: Smallest and largest force of the presses, N.
        share: Share of the presses with a wrong contact and no flag, from 0 to 1, for each sector of each ring. The
            rings are listed from the inner circle to the outer circle.
    """

    from_mm: Positive
    to_mm: Positive
    force_N: tuple[Positive, Positive]
    share: Annotated[tuple[tuple[Share, ...], ...], Meta(min_length=1)]

    @property
    def total_share(self) -> float:
        """Share of unnoticed presses between the two circles, from 0 to 1. The rings are weighted by their areas."""
        edges_mm = np.linspace(self.from_mm, self.to_mm, len(self.share) + 1)
        ring_shares = np.mean(self.share, axis=1)
        return float(np.average(ring_shares, weights=np.diff(edges_mm**2)))

    @property
    def summary(self) -> str:
        """Sentence that states the share of unnoticed presses between the two circles.

        The share is stated in percent. A share below 9.5 % has one decimal, and a larger share has no decimals.
        """
        min_force_N, max_force_N = self.force_N
        percent = 100.0 * self.total_share
        decimals = 1 if percent < 9.5 else 0
        return (
            f"{percent:.{decimals}f} % of the presses outside the working area, from {self.from_mm:.3g} to "
            f"{self.to_mm:.3g} mm from the centre and with {min_force_N:g} to {max_force_N:g} N, are answered wrongly "
            "without a flag"
        )


class ModelMetadata(Settings, frozen=True, kw_only=True):
    """Metadata of a model.

    Attributes:
        name: Name of the model, which is also the name of its folder.
        version: Version number, 1 or more, which is also the name of the version folder.
        sensor: Complete description of the sensor as JSON. Only its name and the signs of d31 and d32 are read here.
        electrodes: Names of the electrodes in the order of the charges.
        working_area_mm: Corners (x, y) of the polygon inside which the model was trained, mm.
        probes: Notations of the probes in the training.
        force_range_N: Smallest and largest force in the training, N.
        noise: Noise of the charges in the training.
        dataset_sha256: Checksum of the dataset.
        errors: Measured errors by name. Each name contains the unit.
        made_with: Command and package versions with which the model was made.
        format_version: Version of the format of the metadata.
        yield_force_N: Force at which the film yields at the centre under the sharpest of the probes, N. None if the
            force is unknown or above the range of forces.
        unnoticed: Shares of presses outside the working area whose contact is wrong without a flag. None if the shares
            were not measured.
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
    unnoticed: UnnoticedPresses | None = None

    def __post_init__(self) -> None:
        """Check that the values of the keys are valid and consistent with each other.

        Raises:
            WrongKey: For the first key that is missing or not valid.
        """
        sensor_name = self.sensor.get("name")
        if not isinstance(sensor_name, str) or not sensor_name:
            raise WrongKey("sensor.name", "a text", sensor_name)
        has_duplicate_names = len(set(self.electrodes)) < len(self.electrodes)
        if has_duplicate_names:
            raise WrongKey("electrodes", "names that differ", self.electrodes)
        displayed_texts = {"electrodes": self.electrodes, "probes": self.probes, "sensor.name": (sensor_name,)}
        for key, texts in displayed_texts.items():
            if not all(map(is_printable, texts)):
                raise WrongKey(key, "printable characters", texts)
        min_force_N, max_force_N = self.force_range_N
        if min_force_N > max_force_N:
            raise WrongKey("force_range_N", "a smaller and a larger number", [min_force_N, max_force_N])
        noise_levels = {"white_pC": self.noise.white_pC, "gain": self.noise.gain}
        for key, level in noise_levels.items():
            # A level is one number for all electrodes, or a tuple with one number for each electrode.
            if isinstance(level, tuple) and len(level) != len(self.electrodes):
                raise WrongKey(f"noise.{key}", f"one number for each of {len(self.electrodes)} electrodes", level)

    @property
    def label(self) -> str:
        """Label of the model in prediction records: `name/version`."""
        return f"{self.name}/{self.version}"

    @property
    def frame_id(self) -> str:
        """Name of the sensor, which is also the name of the coordinate frame of x and y."""
        return str(self.sensor["name"])

    @property
    def has_any_sign(self) -> bool:
        """Whether the charges of a touch may have any sign.

        The charges are mostly positive if the sensor describes a film on which tension causes no negative charge.
        """
        match self.sensor:
            case {"film": _, "piezo": {"d31": int() | float() as d31, "d32": int() | float() as d32}}:
                return min(d31, d32) < 0.0 or d31 == d32 == 0.0
        return True

    def to_props(self) -> dict[str, str]:
        """Return the metadata as ONNX `metadata_props`, a table of texts with one JSON text for each field.

        Fields that are None are left out.

        Raises:
            TypeError, ValueError: If a value, such as NaN, cannot be expressed in JSON.
        """
        return {
            name: json.dumps(value, allow_nan=False, default=to_builtins)
            for name, value in structs.asdict(self).items()
            if value is not None
        }

    @classmethod
    def from_props(cls, props: Mapping[str, str], where: str) -> "ModelMetadata":
        """Read the metadata from ONNX `metadata_props`, the table of texts in the file of a model.

        Args:
            props: JSON text of each field, by the name of the field. Other keys are ignored.
            where: Name or file of the model, for error messages.

        Raises:
            ModelError: If the format version is not supported, or a key is missing or wrong.
        """
        place = f"{where}: metadata"
        names = [name for name in cls.__struct_fields__ if name in props]
        # `object` accepts every JSON value. The types are checked at the end, after the version of the format.
        with error_context(ModelError, after="; export the model again"):
            values = {name: parse_json(props[name], f"{place}: {name}", ModelError, object) for name in names}

        version = values.get("format_version", FORMAT_VERSION)
        if version != FORMAT_VERSION:  # the fields of another version may have another meaning
            raise ModelError(
                f"{place} format {shown(version)} is not supported (this version reads {FORMAT_VERSION}); export it "
                "again or upgrade isocharge"
            )
        with error_context(ModelError, after="; export the model again"):
            return convert(values, cls, place, ModelError)
