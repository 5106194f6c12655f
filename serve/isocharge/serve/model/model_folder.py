"""Folders of models: writing a version, and reading a version.

    <name>/config.pbtxt            configuration for Triton
    <name>/<version>/model.onnx    graph from charge_pC to contact, contact_std, contact_correlation and misfit,
                                   with the metadata of the model
    <name>/<version>/golden.json   golden vectors, tolerances, and the checksums of model.onnx and of companion files
    <name>/<version>/card.md       model card

A version is written under a temporary name, read back with all checks of a reader, and then renamed. Other processes
therefore never see an incomplete version.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import onnxruntime as ort
from numpy.typing import ArrayLike

from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import ModelError, OutputExists, error_prefix
from isocharge.common.files import new_folder, read_needed, refuse_existing, sha256_of, write_whole
from isocharge.serve.model.contact import as_batch
from isocharge.serve.model.golden import (
    Golden,
    check_outputs,
    contact_floors,
    make_golden,
    read_companion_file,
    read_golden,
)
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_search import NAME
from isocharge.serve.model.session import INPUT, OUTPUTS, check_interface, open_session, run


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
    path = folder / "model.onnx"
    onnx_model = read_needed(path, ModelError, "copy or export the model again")
    golden = read_golden(folder / "golden.json")
    actual_sha256 = sha256_of(onnx_model)
    if actual_sha256 != golden.sha256:
        raise ModelError(
            f"{path}: expected sha256 {golden.sha256} (golden.json), got {actual_sha256} over {len(onnx_model)} bytes; "
            "the file is damaged or changed: copy or export it again"
        )
    session = open_session(onnx_model, str(path))
    metadata = ModelMetadata.from_props(session.get_modelmeta().custom_metadata_map, str(path))
    n_electrode = len(metadata.electrodes)
    check_interface(session, n_electrode, str(path))
    if golden.charge_pC.shape[1] != n_electrode:
        raise ModelError(
            f"{folder / 'golden.json'}: expected charges of shape (n, {n_electrode}), got {golden.charge_pC.shape}; "
            "copy or export the model again"
        )
    return Model(folder, metadata, golden, session)


def check_golden(model: Model) -> None:
    """Check that this machine computes the outputs that are stored in the golden vectors of a model.

    Raises:
        ModelError: If an output differs from the output in `golden.json` by more than the tolerance.
    """
    where = str(model.folder / "model.onnx")
    with error_prefix(f"{where}: ", ModelError):
        outputs = run(model.session, model.golden.charge_pC)
    check_outputs(model.golden, outputs, where)


def load_checked_model(folder: Path) -> Model:
    """Read a version of a model, and make all checks that do not depend on the use of the model.

    Args:
        folder: The version folder, as `find_model` returns it.

    Raises:
        ModelError: If a file is missing, is damaged or belongs to another model, if a computed output differs from the
            golden vectors, or if the name of the folder is another version number than the number in the metadata.
    """
    model = load_model(folder)
    is_version_folder = folder.name.isdecimal()
    if is_version_folder and folder.name != str(model.metadata.version):
        raise ModelError(
            f"{folder}: expected version {folder.name}, got {model.metadata.label}; "
            "move it into a folder of that version, or export it again"
        )
    existing_names = {path.name for path in folder.glob("*.npz")}
    for name in sorted(existing_names | model.golden.companion_sha256.keys()):
        read_companion_file(folder, name, "make the model again")
    check_golden(model)
    return model


def write_model(
    folder: Path,
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
        OutputExists: If this version exists already, or a file has the folder's name.
        ChargeError: If the golden charges do not fit the electrodes.
        ModelError: If a reader would refuse the model, or its metadata differ from `metadata`. After any error no file
            of the version remains.
    """
    target = check_target(folder, metadata.version, metadata.electrodes)
    if folder.resolve().name != metadata.name:
        raise ModelError(f"{folder}: expected a folder named {metadata.name!r}, as the metadata names the model")

    # Compute the golden vectors with the new model.
    where = f"the new model {metadata.label}"
    session = open_session(onnx_model, where)
    check_interface(session, len(metadata.electrodes), where)
    charges = as_batch(golden_charge_pC, metadata.electrodes)
    golden = make_golden(session, onnx_model, charges, contact_floors(metadata), companion_files)

    # Write the version under a temporary name. `new_folder` renames it to `target` after the check has succeeded.
    with new_folder(target) as draft:
        write_whole(draft / "model.onnx", onnx_model)
        write_whole(draft / "golden.json", golden.to_json().encode())
        write_whole(draft / "card.md", card.encode())
        for name, content in companion_files.items():
            write_whole(draft / name, content)
        _check_draft(draft, metadata)
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
        OutputExists: If the version exists already, or a file has the folder's name.
        ModelError: If the name of the folder is not a valid name of a model, or if the folder contains a model with
            another number of electrodes.
    """
    target = folder / str(version)
    refuse_existing(target)
    if folder.exists() and not folder.is_dir():
        raise OutputExists(f"{folder}: expected a folder or nothing, got a file; choose another place")
    name = folder.resolve().name
    if not NAME.fullmatch(name):
        raise ModelError(f"model name {name!r}: expected letters, digits, '-', '_' and '.'; rename the folder")
    config_path = folder / "config.pbtxt"
    if config_path.exists() and config_path.read_text(encoding="utf-8") != triton_config(name, len(electrodes)):
        raise ModelError(
            f"{config_path}: describes a model other than {name!r} with the electrodes {electrodes}; use another model "
            "name or, if the folder was copied or renamed, its old name"
        )
    return target


def _check_draft(draft: Path, metadata: ModelMetadata) -> None:
    """Check the files of a new version with all checks that are made when a model is read.

    The metadata in the new `model.onnx` must also equal the expected metadata.

    Args:
        draft: Folder with the files of the new version.
        metadata: The expected metadata.

    Raises:
        ModelError: If a reader would refuse the model, or the metadata differ.
    """
    model = load_model(draft)
    actual = model.metadata.to_props()
    expected = metadata.to_props()
    for key, value in expected.items():
        if actual[key] != value:
            raise ModelError(f"the graph's metadata disagree on {key!r}: expected {value}, got {actual[key]}")
    check_golden(model)


def triton_config(name: str, n_electrode: int) -> str:
    """Return the text of the file `config.pbtxt`, which describes the inputs and outputs of a model for Triton.

    Args:
        name: Name of the model.
        n_electrode: Number of electrodes.
    """
    head = f'name: "{name}"\nplatform: "onnxruntime_onnx"\nmax_batch_size: {MAX_BATCH}\n'
    return head + _tensor_list("input", {INPUT: n_electrode}) + _tensor_list("output", OUTPUTS)


def _tensor_list(list_name: str, widths: dict[str, int]) -> str:
    """Return the part of `config.pbtxt` that lists the inputs or the outputs of a model.

    The list contains the widths of the tensors only, because Triton adds the batch dimension.

    Args:
        list_name: "input" or "output".
        widths: Width of each tensor by its name.
    """
    lines = [f'  {{ name: "{name}" data_type: TYPE_FP32 dims: [ {width} ] }}' for name, width in widths.items()]
    return f"{list_name} [\n" + ",\n".join(lines) + "\n]\n"
