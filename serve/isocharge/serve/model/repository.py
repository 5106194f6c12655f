"""Search for a model by name, version or path.

A model repository is a folder of models (`<name>/<version>/model.onnx`); other files in it are ignored. Names are
looked up in the folder that was given, in `$ISOCHARGE_MODELS`, in `./models`, and in the models that ship with
isocharge.
"""

import os
import re
from pathlib import Path

from isocharge.common.errors import ModelError

VERSION = re.compile("[1-9][0-9]{0,17}")
"""Pattern of version folders: whole numbers of 63 bits."""


def find_model(model: str | Path, models: Path | None = None) -> Path:
    """The version folder of a model.

    Args:
        model: A name (`three-25um-biaxial`, the highest version, or `three-25um-biaxial/1`), or the path of a model
            folder, of a version folder, or of a `model.onnx`. A Path, and a text that begins with `.` or `/` or ends
            in `.onnx`, is only ever a path; another text is a path if no model has that name.
        models: Repository in which names are looked up first.

    Raises:
        ModelError: If there is no such model; the message names the folders that were searched and their models.
    """
    roots = repositories(models)
    is_path = isinstance(model, Path) or model.startswith((".", "/")) or model.endswith(".onnx")
    candidates = [Path(model)] if is_path else [*(root / model for root in roots), Path(model)]
    for candidate in candidates:
        version = _version_folder(candidate)
        if version is not None:
            return version
    raise ModelError(_not_found(model, roots, is_path))


def repositories(models: Path | None = None) -> list[Path]:
    """The folders in which names are looked up, in this order.

    Raises:
        ModelError: If `models` is given and no folder; the other folders need not exist.
    """
    if models is not None and not models.is_dir():
        raise ModelError(f"{models}: expected a folder of models, got no folder; correct --models or leave it out")
    variable = os.environ.get("ISOCHARGE_MODELS")
    given = [models] if models is not None else []
    return [*given, *([Path(variable)] if variable else []), Path("models"), _shipped()]


def model_names(root: Path) -> list[str]:
    """Names of the models in a repository."""
    return sorted(folder.name for folder in _folders_in(root) if _versions(folder))


def _shipped() -> Path:
    """Released models: inside the installed package, or at the top of a source checkout."""
    module = Path(__file__).resolve()
    packaged = module.parents[1] / "released"
    return packaged if packaged.is_dir() else module.parents[4] / "models"


def _version_folder(path: Path) -> Path | None:
    if path.name == "model.onnx" and path.is_file():
        return path.parent
    if (path / "model.onnx").is_file():
        return path
    versions = _versions(path)
    return path / str(max(versions)) if versions else None


def version_folders(folder: Path) -> dict[int, Path]:
    """Version folders of a model folder, ascending: the sub-folders whose name is a whole number."""
    return {version: folder / str(version) for version in sorted(_versions(folder))}


def _versions(folder: Path) -> list[int]:
    return [int(entry.name) for entry in _folders_in(folder) if VERSION.fullmatch(entry.name)]


def _folders_in(folder: Path) -> list[Path]:
    """The folders in a folder; none if it is none.

    Raises:
        ModelError: If it cannot be listed.
    """
    try:
        return [entry for entry in folder.iterdir() if entry.is_dir()] if folder.is_dir() else []
    except OSError as error:
        raise ModelError(f"{folder}: cannot be listed ({error.strerror}); try again, or correct its rights") from error


def _not_found(model: str | Path, roots: list[Path], is_path: bool) -> str:
    if is_path:
        return (
            f"{model}: no model; expected a model folder with numbered versions, a version folder with "
            "model.onnx, or a model.onnx"
        )
    looked = "; ".join(f"{root} ({', '.join(model_names(root)) or 'no models'})" for root in roots)
    return f"no model {str(model)!r}; looked in: {looked}; give one of these names, a path, or --models DIR"
