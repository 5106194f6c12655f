"""The deflection field of a model's film: beside the model, or shipped for the films of the released ones."""

from importlib.resources import as_file, files
from pathlib import Path

from isocharge.deflection_field import DeflectionField, read_deflection_field
from isocharge.serve.model.metadata import ModelMetadata

FILE = "deflection.json"
"""Name of the field in a model's version folder; `isocharge simulate deflection` writes one."""


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
