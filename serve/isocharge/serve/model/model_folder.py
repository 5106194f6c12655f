"""Folders of models: finding a model by its name or path, writing a version, and reading a version.

    <name>/config.pbtxt            configuration for Triton
    <name>/<version>/model.onnx    graph from charge_pC to contact, contact_std, contact_correlation and misfit,
                                   with the metadata of the model
    <name>/<version>/golden.json   golden vectors, tolerances, and the checksums of model.onnx and of companion files
    <name>/<version>/card.md       model card

A version is written under a temporary name, read back with all checks of a reader, and then renamed. Other processes
therefore never see an incomplete version.

A model repository is a folder that contains the folders of several models. Other files in a repository are ignored. The
name of a model is looked up in four repositories in this order: the repository that the caller gives,
`$ISOCHARGE_MODELS`, `./models`, and the repository that is installed with isocharge. The label of a model is
`NAME/VERSION`. A label contains one slash and no path component `..`. A label can therefore not be the path of a folder
outside the repositories of the user. A file from an untrusted source, such as a recording, can only select a model in
these repositories.
"""

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike

from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import ModelError, error_context, shown
from isocharge.common.files import StrPath, check_new_output, new_folder, read_needed, sha256_of, write_whole
from isocharge.serve.model.contact import as_charges
from isocharge.serve.model.metadata import LABEL, NAME, VERSION, ModelMetadata
from isocharge.serve.model.session import (
    GRAPH_FILE,
    INPUT,
    OUTPUTS,
    Golden,
    check_interface,
    contact_floors,
    make_golden,
    open_session,
    read_golden,
    run,
)


def find_model(model: StrPath, models: StrPath | None = None) -> Path:
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


def find_labelled_model(label: str, models: StrPath | None = None) -> Path:
    """Find the version folder of a model by a label `NAME/VERSION` that was read from a file.

    Unlike `find_model`, this function searches only the repositories. The label is never used as a path, because the
    file that contains the label may come from an untrusted source.

    Args:
        label: The label, for example the one in a recording.
        models: Repository that is searched first.

    Raises:
        ModelError: If the text is not a label, or if no repository contains the model.
    """
    if not LABEL.fullmatch(label):
        raise ModelError(f"model {shown(label)}: expected the label NAME/VERSION of a model; give the model by --model")
    roots = repositories(models)
    return _first_model([root / label for root in roots], label, roots, is_path=False)


def repositories(models: StrPath | None = None) -> list[Path]:
    """Return the repositories in which the name of a model is looked up, in the order of the search.

    A repository is a folder that contains the folders of several models.

    Args:
        models: Folder of the repository that is searched first. This folder must exist. The other folders need not
            exist.

    Raises:
        ModelError: If `models` is given and is not a folder.
    """
    if models is not None and not Path(models).is_dir():
        raise ModelError(f"{models}: expected a folder of models, got no folder; correct --models or leave it out")
    environment_folder = os.environ.get("ISOCHARGE_MODELS") or None  # an empty variable counts as missing
    folders = (models, environment_folder, "models", _released_models())
    return [Path(folder) for folder in folders if folder is not None]


def model_names(root: Path) -> list[str]:
    """Return the names of the models in a repository, which is a folder of models, in alphabetical order.

    A folder is skipped if its name cannot be the name of a model. An example is `lost+found` on a mounted volume, which
    only the superuser may list. Any other folder that cannot be listed is assumed to be a model.
    """
    folders = [folder for folder in _subfolders(root) if NAME.fullmatch(folder.name)]
    return sorted(folder.name for folder in folders if _may_be_model(folder))


def _may_be_model(folder: Path) -> bool:
    """Return whether a folder contains versions, or cannot be listed."""
    try:
        return bool(version_folders(folder))
    except ModelError:
        return True


def _released_models() -> Path:
    """Return the folder of the released models in the installed package or at the top of a source checkout."""
    # In a source checkout, this module is serve/isocharge/serve/model/model_folder.py.
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
    """Return the version folders of a model, with their version numbers as keys in ascending order.

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


def _first_model(candidates: list[Path], model: StrPath, roots: list[Path], is_path: bool) -> Path:
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


@dataclass(frozen=True)
class Model:
    """A model that was read and checked.

    Attributes:
        folder: Version folder.
        metadata: Metadata of the model.
        golden: Golden vectors.
        session: Session of onnxruntime.
    """

    folder: Path
    metadata: ModelMetadata
    golden: Golden
    session: ort.InferenceSession


def load_model(folder: Path) -> Model:
    """Read a version of a model, and check that its files are complete and fit together.

    Args:
        folder: The version folder, as `find_model` returns it.

    Raises:
        ModelError: If a file is missing or damaged, or has an unsupported format.
    """
    golden = read_golden(folder / "golden.json")
    where = str(folder / GRAPH_FILE)
    session = open_session(read_checked(folder, GRAPH_FILE, golden), where)
    metadata = ModelMetadata.from_props(session.get_modelmeta().custom_metadata_map, where)
    n_electrode = len(metadata.electrodes)
    check_interface(session, n_electrode, where)
    if golden.charge_pC.shape[1] != n_electrode:
        raise ModelError(
            f"{folder / 'golden.json'}: expected charges of shape (n, {n_electrode}), got {golden.charge_pC.shape}; "
            "copy or export the model again"
        )
    return Model(folder, metadata, golden, session)


def read_checked(folder: Path, name: str, golden: Golden) -> bytes:
    """Read a file of a version, and compare it with its checksum in `golden.json`.

    A companion file is a further file of a model, such as `charges.npz`. The companion file of another model would have
    the right format but give wrong contacts.

    Args:
        folder: The version folder.
        name: Name of the file.
        golden: Golden vectors of the version, with the checksums.

    Raises:
        ModelError: If the file cannot be read, or if its checksum is missing in `golden.json` or differs from the one
            in `golden.json`.
    """
    content = read_needed(folder / name, ModelError, "copy or export the model again")
    # If `golden.json` does not list the file, the text "no such file" takes the place of its checksum. The comparison
    # then fails, and the message contains the text.
    expected_sha256 = golden.checksums.get(name, "no such file")
    actual_sha256 = sha256_of(content)
    if actual_sha256 != expected_sha256:
        raise ModelError(
            f"{folder / name}: expected sha256 {expected_sha256} (golden.json), got {actual_sha256} over "
            f"{len(content)} bytes; the file is damaged or changed, or belongs to another model: copy the whole folder "
            "of the model again, or make it again"
        )
    return content


def check_golden(model: Model) -> None:
    """Check that this machine computes the outputs that are stored in the golden vectors of a model.

    Raises:
        ModelError: If an output differs from the output in `golden.json` by more than the tolerance.
    """
    where = str(model.folder / "model.onnx")
    golden = model.golden
    with error_context(ModelError, f"{where}: "):
        outputs = run(model.session, golden.charge_pC)
    for name, rows in outputs.items():
        expected = np.array(golden.outputs[name])
        # Below its floor, a value has a constant tolerance, because a relative tolerance would approach 0.
        tolerance = golden.tolerance.relative * np.maximum(np.abs(expected), golden.tolerance.floor[name])
        is_close = np.abs(rows - expected) <= tolerance  # False also for a value that is not a number
        if not is_close.all():
            row, column = np.argwhere(~is_close)[0]
            raise ModelError(
                f"{where}: {name}[{row}, {column}]: expected {expected[row, column]:.9g} +- "
                f"{tolerance[row, column]:.1g} (golden.json), got {rows[row, column]:.9g}; copy or export the model "
                "again"
            )


def load_checked_model(folder: Path) -> Model:
    """Read a version of a model, and make all checks that do not depend on the use of the model.

    One of the checks computes the golden vectors again. These are the charges and the outputs in `golden.json`.

    Args:
        folder: The version folder, as `find_model` returns it.

    Raises:
        ModelError: If a file is missing, is damaged or belongs to another model, if a computed output differs from the
            golden vectors, or if the names of the folders differ from the name and the version in the metadata.
    """
    model = load_model(folder)
    _check_folder_names(folder, model.metadata)
    # A companion file is a further file of the model, such as `charges.npz`. It may be missing, or may lie in the
    # folder without a checksum in `golden.json` (`golden.files`).
    existing_names = {path.name for path in folder.glob("*.npz")}
    for companion_name in sorted(existing_names | model.golden.files.keys()):
        read_checked(folder, companion_name, model.golden)  # raises an error if the file is not the expected one
    check_golden(model)
    return model


def _check_folder_names(folder: Path, metadata: ModelMetadata) -> None:
    """Check that a version folder and its parent are named after the version and the name of the model.

    A version folder may have a name that is not a number, for example while the version is prepared. Such a folder is
    not checked.

    Args:
        folder: The version folder. If its path ends in `..` and a version, as in `../1`, only the version is checked.
        metadata: Metadata of the model in the folder.

    Raises:
        ModelError: If the names differ from the metadata.
    """
    name, version = folder.absolute().parts[-2:]  # the path `../1` gives the name `..`, which is not resolved
    is_version_folder = version.isdecimal()
    is_other_version = version != str(metadata.version)
    is_other_name = name not in (metadata.name, "..")
    if is_version_folder and (is_other_version or is_other_name):
        raise ModelError(
            f"{folder}: expected {name}/{version}, as the folders are called, got {metadata.label}; move it into "
            "folders of that name and version, or export it again"
        )


def write_model(
    folder: StrPath,
    onnx_model: bytes,
    metadata: ModelMetadata,
    golden_charge_pC: ArrayLike,
    card: str,
    companion_files: Mapping[str, bytes] = MappingProxyType({}),
) -> Path:
    """Write a new version of a model.

    Args:
        folder: The model's folder. It has the model's name and may already contain other versions.
        onnx_model: Content of `model.onnx`, with `metadata.to_props()` in its metadata_props.
        metadata: The metadata of the model.
        golden_charge_pC: Input charges of the golden vectors, shape (n, electrodes), pC.
        card: Text of the model card.
        companion_files: Contents of companion files for the version folder, by file name. Their checksums are stored in
            `golden.json`. Servers only compare these checksums.

    Returns:
        The version folder.

    Raises:
        OutputExists: If this version exists already.
        OutputError: If the folder cannot be written.
        ChargeError: If the golden charges do not fit the electrodes.
        ModelError: If a reader would refuse the model, or if its metadata differ from `metadata`. After any error, no
            file of the version remains.
    """
    folder = Path(folder)
    target = check_target(folder, metadata.version, metadata.electrodes)
    if folder.resolve().name != metadata.name:
        raise ModelError(f"{folder}: expected a folder named {metadata.name!r}, as the metadata names the model")

    # Compute the golden vectors with the new model.
    where = f"the new model {metadata.label}"
    session = open_session(onnx_model, where)
    check_interface(session, len(metadata.electrodes), where)
    charges = as_charges(golden_charge_pC, metadata.electrodes, is_batch=True)
    golden = make_golden(session, onnx_model, charges, contact_floors(metadata), companion_files)

    # Write the version under a temporary name. `new_folder` renames it to `target` after the check has succeeded.
    with new_folder(target) as draft:
        files = {GRAPH_FILE: onnx_model, "golden.json": golden.to_json(), "card.md": card.encode(), **companion_files}
        for name, content in files.items():
            write_whole(draft / name, content)
        # Make all checks that are made when a model is read. The metadata in the graph must also equal the expected
        # metadata.
        model = load_model(draft)
        differences = metadata.to_props().items() ^ model.metadata.to_props().items()  # pairs in only one of the two
        if differences:
            raise ModelError(f"the graph's metadata disagree with the stated ones: {shown(sorted(differences))}")
        check_golden(model)
    write_whole(folder / "config.pbtxt", triton_config(metadata.name, len(metadata.electrodes)).encode())
    return target


def check_target(folder: Path, version: int, electrodes: tuple[str, ...]) -> Path:
    """Check that a new version of a model can be written, and return the folder of this version.

    Commands that train a model call this function before they begin, in order to report an invalid folder at once.

    Args:
        folder: The model's folder, which has the name of the model.
        version: Number of the version to write.
        electrodes: Names of the electrodes of the model.

    Raises:
        OutputExists: If the version exists already.
        OutputError: If the folder cannot be written, for example because a file has the same name.
        ModelError: If the name of the folder is not a valid name of a model, or if the folder contains a model with
            other electrodes or with another order of the electrodes. The error is also raised if the folder contains
            other files and is therefore not the folder of one model. Such a folder may be a dataset, a single version
            of a model, or a repository of several models.
    """
    target = folder / str(version)
    check_new_output(target)
    name = folder.resolve().name
    if not NAME.fullmatch(name):
        raise ModelError(f"model name {name!r}: expected letters, digits, '-', '_' and '.'; rename the folder")

    config_path = folder / "config.pbtxt"
    versions = version_folders(folder)
    is_model_folder = config_path.exists() or versions
    if any(folder.glob("[!.]*")) and not is_model_folder:
        raise ModelError(
            f"{folder}: expected a new folder or the folder of a model, got one with other files; choose another "
            "output, such as models/NAME"
        )
    if config_path.exists() and config_path.read_bytes() != triton_config(name, len(electrodes)).encode():
        raise ModelError(
            f"{config_path}: describes a model other than {name!r} with the electrodes {electrodes}; use another model "
            "name or, if the folder was copied or renamed, its old name"
        )

    # Electrodes of the last version that can be read; if there is none, the new electrodes
    last_electrodes = electrodes
    for existing in versions.values():  # from the first version to the last
        with suppress(ModelError):  # a damaged version does not prevent a new one
            last_electrodes = load_model(existing).metadata.electrodes
    if last_electrodes != electrodes:
        raise ModelError(
            f"{folder}: expected the electrodes {last_electrodes} of its last version in this order, because programs "
            f"send their charges in it, got {electrodes}; use another model name or this order"
        )
    return target


def triton_config(name: str, n_electrode: int) -> str:
    """Return the text of the file `config.pbtxt`, which describes the inputs and outputs of a model for Triton.

    Args:
        name: Name of the model.
        n_electrode: Number of electrodes.
    """
    config = f'name: "{name}"\nplatform: "onnxruntime_onnx"\nmax_batch_size: {MAX_BATCH}\n'
    for list_name, widths in (("input", {INPUT: n_electrode}), ("output", OUTPUTS)):
        # The widths do not contain the batch dimension, because Triton adds it. Doubled braces become single braces.
        lines = [f'  {{ name: "{tensor}" data_type: TYPE_FP32 dims: [ {width} ] }}' for tensor, width in widths.items()]
        config += f"{list_name} [\n" + ",\n".join(lines) + "\n]\n"
    return config
