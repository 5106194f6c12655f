"""Search for a model by its name or path.

A model repository is a folder that contains the folders of several models. Other files in a repository are ignored. The
name of a model is looked up in four repositories in this order: the repository that the caller gives,
`$ISOCHARGE_MODELS`, `./models`, and the repository that is installed with isocharge.

The name of a model consists of characters that are safe in paths, URLs, web pages and the file config.pbtxt. The label
of a model is `NAME/VERSION`. A label contains one slash and no path component `..`. A label can therefore not be the
path of a folder outside the repositories of the user. A file from an untrusted source, such as a recording, can only
select a model in these repositories.
"""

import os
import re
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from isocharge.common.errors import ModelError, shown

NAME_PATTERN = r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}"
"""Regular expression of the name of a model."""

VERSION_PATTERN = "[1-9][0-9]{0,17}"
"""Regular expression of the version of a model: a whole number of at most 63 bits."""

NAME = re.compile(NAME_PATTERN)
VERSION = re.compile(VERSION_PATTERN)

ModelName = Annotated[str, Meta(pattern=rf"\A{NAME_PATTERN}\Z", description="letters, digits, '-', '_' and '.'")]

ModelLabel = Annotated[
    str, Meta(pattern=rf"\A{NAME_PATTERN}/{VERSION_PATTERN}\Z", description="the label NAME/VERSION of a model")
]


def find_model(model: str | Path, models: Path | None = None) -> Path:
    """Find the version folder of a model by its name or path.

    Args:
        model: A name (`three-25um-biaxial` for the highest version, or `three-25um-biaxial/1`), or the path of a model
            folder, of a version folder, or of a `model.onnx`. A Path object is always a path. A text that begins with
            `.` or `/` or ends in `.onnx` is also always a path. Any other text is used as a path only if no model has
            this name.
        models: Repository in which names are looked up first.

    Raises:
        ModelError: If there is no such model. The message names the folders that were searched and their models.
    """
    roots = repositories(models)
    is_path = isinstance(model, Path) or model.startswith((".", "/")) or model.endswith(".onnx")
    candidates = [] if is_path else [root / model for root in roots]
    return _first_model([*candidates, Path(model)], model, roots, is_path)


def find_labelled_model(label: str, models: Path | None = None) -> Path:
    """Find the version folder of a model by a label `NAME/VERSION` that was read from a file.

    Unlike `find_model`, this function searches only the repositories. The label is never used as a path, because the
    file that contains the label may come from an untrusted source.

    Args:
        label: The label, for example the one in a recording.
        models: Repository that is searched first.

    Raises:
        ModelError: If the text is not a label, or if no repository contains the model.
    """
    name, _slash, version = label.partition("/")
    is_label = NAME.fullmatch(name) and VERSION.fullmatch(version)
    if not is_label:
        raise ModelError(f"model {shown(label)}: expected the label NAME/VERSION of a model; give the model by --model")
    roots = repositories(models)
    return _first_model([root / label for root in roots], label, roots, is_path=False)


def repositories(models: Path | None = None) -> list[Path]:
    """Return the repositories in which the name of a model is looked up, in the order of the search.

    Args:
        models: Repository that is searched first. It must exist; the other folders need not exist.

    Raises:
        ModelError: If `models` is given and is not a folder.
    """
    roots: list[Path] = []
    if models is not None:
        if not models.is_dir():
            raise ModelError(f"{models}: expected a folder of models, got no folder; correct --models or leave it out")
        roots.append(models)
    environment_folder = os.environ.get("ISOCHARGE_MODELS")
    if environment_folder:
        roots.append(Path(environment_folder))
    return [*roots, Path("models"), _released_models()]


def model_names(root: Path) -> list[str]:
    """Return the names of the models in a repository, which is a folder of models, in alphabetical order."""
    return sorted(folder.name for folder in _subfolders(root) if version_folders(folder))


def _released_models() -> Path:
    """Return the folder of the released models in the installed package or at the top of a source checkout."""
    # In a source checkout, this module is serve/isocharge/serve/model/model_search.py.
    module = Path(__file__).resolve()
    package_folder = module.parents[1]  # isocharge/serve
    checkout_folder = module.parents[4]
    packaged_models = package_folder / "released"  # exists only in an installed package
    return packaged_models if packaged_models.is_dir() else checkout_folder / "models"


def _version_folder(path: Path) -> Path | None:
    """Return the version folder of the model at a path.

    If the path is a model folder, the folder of the highest version is returned.

    Args:
        path: Path of a model folder, of a version folder, or of a `model.onnx`.

    Returns:
        The version folder; None if there is no model at this path.
    """
    if path.name == "model.onnx" and path.is_file():
        return path.parent
    if (path / "model.onnx").is_file():
        return path
    versions = version_folders(path)
    return versions[max(versions)] if versions else None


def version_folders(folder: Path) -> dict[int, Path]:
    """Return the version folders of a model by their version numbers, in ascending order.

    A version folder is a subfolder of the model folder whose name is the version number. The result is empty if the
    path is not a folder.
    """
    versions = sorted(int(entry.name) for entry in _subfolders(folder) if VERSION.fullmatch(entry.name))
    return {version: folder / str(version) for version in versions}


def _subfolders(folder: Path) -> list[Path]:
    """Return the subfolders of a folder. The list is empty if the path is not a folder.

    Raises:
        ModelError: If the folder cannot be listed.
    """
    try:
        if not folder.is_dir():
            return []
        return [entry for entry in folder.iterdir() if entry.is_dir()]
    except OSError as error:
        raise ModelError(f"{folder}: cannot be listed ({error.strerror}); try again, or correct its rights") from error


def _first_model(candidates: list[Path], model: str | Path, roots: list[Path], is_path: bool) -> Path:
    """Return the version folder of the first path at which there is a model.

    Args:
        candidates: Paths of model folders, of version folders, or of files `model.onnx`.
        model: Name or path of the model, for the error message.
        roots: Repositories that were searched for the name.
        is_path: Whether the model was given as a path. No repository is searched for a path.

    Raises:
        ModelError: If there is no model at any of the paths.
    """
    for candidate in candidates:
        folder = _version_folder(candidate)
        if folder is not None:
            return folder
    if is_path:
        raise ModelError(
            f"{model}: no model; expected a model folder with numbered versions, a version folder with "
            "model.onnx, or a model.onnx"
        )
    searched = "; ".join(f"{root} ({', '.join(model_names(root)) or 'no models'})" for root in roots)
    raise ModelError(
        f"no model {str(model)!r}; looked in: {searched}; give one of these names, a path, or --models DIR"
    )
