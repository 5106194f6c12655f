"""Folders of models: writing a version, and reading a version.

    <name>/config.pbtxt            configuration for Triton
    <name>/<version>/model.onnx    graph from charge_pC to contact, contact_std, contact_correlation and misfit,
                                   with the metadata of the model
    <name>/<version>/golden.json   golden vectors, tolerances, and the checksums of model.onnx and of companion files
    <name>/<version>/card.md       model card

A version is written under a temporary name, read back with all checks of a reader, and then renamed. Other processes
therefore never see an incomplete version.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import onnxruntime as ort
from numpy.typing import ArrayLike

from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import ModelError, OutputExists, error_prefix
from isocharge.common.files import new_folder, read_needed, refuse_existing, sha256_of, write_whole
from isocharge.common.versions import package_version
from isocharge.serve.model.golden import (
    Golden,
    check_outputs,
    contact_floors,
    make_golden,
    read_companion_file,
    read_golden,
)
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_labels import NAME
from isocharge.serve.model.session import (
    CORRELATION,
    INPUT,
    OUTPUTS,
    as_batch,
    check_interface,
    check_output_shapes,
    open_session,
    output_widths,
    run,
)


@dataclass(frozen=True)
class Model:
    """A model that was read and checked.

    Attributes:
        folder: Version folder.
        metadata: Metadata of the model.
        golden: Golden vectors.
        session: Session of onnxruntime.
        graph: Content of `model.onnx`.
    """

    folder: Path
    metadata: ModelMetadata
    golden: Golden
    session: ort.InferenceSession
    graph: bytes


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
    _check_checksum(onnx_model, golden, path)
    session = open_session(onnx_model, str(path))
    metadata = ModelMetadata.from_props(session.get_modelmeta().custom_metadata_map, str(path))
    check_interface(session, len(metadata.electrodes), str(path))
    _check_golden_shapes(golden, metadata, folder / "golden.json")
    return Model(folder, metadata, golden, session, graph=onnx_model)


def _check_checksum(onnx_model: bytes, golden: Golden, path: Path) -> None:
    """Check that the checksum of `model.onnx` is equal to the checksum in `golden.json`.

    Args:
        onnx_model: Content of `model.onnx`.
        golden: Golden vectors, which contain the expected checksum.
        path: Path of `model.onnx`, for the error message.

    Raises:
        ModelError: If the checksums differ.
    """
    actual_sha256 = sha256_of(onnx_model)
    if actual_sha256 != golden.sha256:
        raise ModelError(
            f"{path}: expected sha256 {golden.sha256} (golden.json), got {actual_sha256} over {len(onnx_model)} bytes; "
            "the file is damaged or changed: copy or export it again"
        )


def _check_golden_shapes(golden: Golden, metadata: ModelMetadata, path: Path) -> None:
    """Check that golden vectors have one charge for each electrode, and that each output has one row for each press.

    Args:
        golden: Golden vectors.
        metadata: Metadata of the model.
        path: File of the golden vectors, for the error message.

    Raises:
        ModelError: If a shape is wrong.
    """
    shape = golden.charge_pC.shape
    n_electrode = len(metadata.electrodes)
    if len(shape) != 2 or shape[0] == 0 or shape[1] != n_electrode:
        raise ModelError(
            f"{path}: expected charges of shape (n, {n_electrode}) with n > 0, got {shape}; "
            "copy or export the model again"
        )
    check_output_shapes(golden.outputs, len(golden.charge_pC), str(path))


def check_golden(model: Model) -> str:
    """Check that this machine computes the outputs that are stored in the golden vectors of a model.

    Returns:
        Sentence that states how many presses agree.

    Raises:
        ModelError: If an output differs from the output in `golden.json` by more than the tolerance.
    """
    where = str(model.folder / "model.onnx")
    charge_pC = model.golden.charge_pC
    with error_prefix(f"{where}: ", ModelError):
        outputs = run(model.session, charge_pC)
    check_output_shapes(outputs, len(charge_pC), where)
    check_outputs(model.golden, outputs, where)
    return f"this machine computes the outputs in golden.json for {len(charge_pC)} presses"


def _check_version(model: Model) -> str:
    """Check that a version folder has the version number in the metadata, and return a sentence that states it.

    Raises:
        ModelError: If the name of the folder is another version number.
    """
    folder = model.folder
    is_version_folder = folder.name.isdecimal()
    if is_version_folder and folder.name != str(model.metadata.version):
        raise ModelError(
            f"{folder}: expected version {folder.name}, got {model.metadata.label}; "
            "move it into a folder of that version, or export it again"
        )
    return f"the metadata name the model {model.metadata.label}"


def _check_companion_files(model: Model) -> str:
    """Check that the files beside `model.onnx`, such as the charge map, have the checksums in `golden.json`.

    Returns:
        Sentence that names the files.

    Raises:
        ModelError: If a file is missing, is changed, or belongs to another model.
    """
    existing_names = {path.name for path in model.folder.glob("*.npz")}
    names = sorted(existing_names | model.golden.companion_sha256.keys())
    for name in names:
        read_companion_file(model.folder, name, "make the model again")
    if not names:
        return "the model has no charge map"
    return f"{', '.join(names)}: the checksum is that in golden.json"


MODEL_CHECKS: Mapping[str, Callable[[Model], str]] = MappingProxyType(
    {"version": _check_version, "charge map": _check_companion_files, "golden vectors": check_golden}
)
"""Checks of a model that was read, by the name of what is checked.

A check returns a sentence that states what it found, or raises a ModelError.
"""


def load_checked_model(folder: Path) -> Model:
    """Read a version of a model, and make all checks of `MODEL_CHECKS`.

    Args:
        folder: The version folder, as `find_model` returns it.

    Raises:
        ModelError: If a file is missing or damaged, if a computed output differs from the golden vectors, or if the
            name of the folder is another version number than the number in the metadata.
    """
    model = load_model(folder)
    for check in MODEL_CHECKS.values():
        check(model)
    return model


@dataclass(frozen=True)
class ModelCheck:
    """Result of one check of a model folder.

    Attributes:
        name: What was checked: "graph", "origin" or a key of `MODEL_CHECKS`.
        fits: Whether the check succeeded.
        message: Sentence that states what the check found, or what is wrong and how to correct it.
    """

    name: str
    fits: bool
    message: str


def verify_model(folder: Path) -> list[ModelCheck]:
    """Make the checks of `load_checked_model`, and return the result of each check.

    If the graph cannot be read, its check is the only one.

    Args:
        folder: The version folder, as `find_model` returns it.
    """
    try:
        model = load_model(folder)
    except ModelError as error:
        return [ModelCheck("graph", False, str(error))]
    graph = f"model.onnx has the sha256 {model.golden.sha256} that golden.json states"
    made_with = model.metadata.made_with
    origin = (
        f"isocharge {made_with.get('isocharge', 'of an unknown version')} made the model with the command "
        f"{made_with.get('command', 'unknown')!r}, from the dataset with the sha256 {model.metadata.dataset_sha256}; "
        f"this is isocharge {package_version()}"
    )
    checks = [ModelCheck("graph", True, graph), ModelCheck("origin", True, origin)]
    for name, check in MODEL_CHECKS.items():
        try:
            checks.append(ModelCheck(name, True, check(model)))
        except ModelError as error:
            checks.append(ModelCheck(name, False, str(error)))
    return checks


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
    golden_without_files = make_golden(session, onnx_model, charges, contact_floors(metadata))
    golden = replace(
        golden_without_files,
        companion_sha256={name: sha256_of(content) for name, content in companion_files.items()},
    )

    # Write the version under a temporary name. `new_folder` renames it to `target` after the check has succeeded.
    with new_folder(target) as draft:
        write_whole(draft / "model.onnx", onnx_model)
        write_whole(draft / "golden.json", golden.to_json().encode())
        write_whole(draft / "card.md", card.encode())
        for name, content in companion_files.items():
            write_whole(draft / name, content)
        _check_draft(draft, metadata)
    _write_triton_config(folder / "config.pbtxt", metadata, has_correlation=CORRELATION in output_widths(session))
    return target


def _write_triton_config(path: Path, metadata: ModelMetadata, *, has_correlation: bool) -> None:
    """Write the file `config.pbtxt`, with which Triton can serve all versions of a model.

    The file may list only outputs that every version computes. If an existing file does not list the correlations, an
    older version of the model does not compute them. In this case, the new file does not list the correlations either.

    Args:
        path: The file, which may exist already.
        metadata: Metadata of the new version.
        has_correlation: Whether the new version computes correlations.
    """
    n_electrode = len(metadata.electrodes)
    config_without_correlation = triton_config(metadata.name, n_electrode, correlation=False)
    is_older_without_correlation = path.exists() and path.read_text(encoding="utf-8") == config_without_correlation
    lists_correlation = has_correlation and not is_older_without_correlation
    config = triton_config(metadata.name, n_electrode, correlation=lists_correlation)
    write_whole(path, config.encode())


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
    _check_triton_config(folder / "config.pbtxt", name, electrodes)
    return target


def _check_triton_config(path: Path, name: str, electrodes: tuple[str, ...]) -> None:
    """Check that an existing `config.pbtxt` describes a model with this name and these electrodes.

    Args:
        path: The file, which need not exist.
        name: Name of the model.
        electrodes: Names of the electrodes.

    Raises:
        ModelError: If the file exists and describes another model.
    """
    if not path.exists():
        return
    # The text of the file is determined by the name, the number of electrodes, and whether there are correlations.
    text = path.read_text(encoding="utf-8")
    valid_texts = [triton_config(name, len(electrodes), correlation=correlation) for correlation in (False, True)]
    if text in valid_texts:
        return
    first_line = re.match('name: "(.*)"', text)  # contains the name of the model
    if first_line and first_line[1] != name:
        raise ModelError(
            f"{path}: names the model {first_line[1]!r}, its folder is {name!r}: was it copied or renamed? Give it "
            "its old name, or choose another output"
        )
    raise ModelError(
        f"{path}: describes a model other than one with the electrodes {electrodes}; use another model name"
    )


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


def triton_config(name: str, n_electrode: int, *, correlation: bool = True) -> str:
    """Return the text of the file `config.pbtxt`, which describes the inputs and outputs of a model for Triton.

    Args:
        name: Name of the model.
        n_electrode: Number of electrodes.
        correlation: Whether the output with the correlations is listed. If it is not listed, Triton can also serve
            older versions, which do not have this output.
    """
    outputs = {tensor: width for tensor, width in OUTPUTS.items() if correlation or tensor != CORRELATION}
    head = f'name: "{name}"\nplatform: "onnxruntime_onnx"\nmax_batch_size: {MAX_BATCH}\n'
    return head + _tensor_list("input", {INPUT: n_electrode}) + _tensor_list("output", outputs)


def _tensor_list(list_name: str, widths: dict[str, int]) -> str:
    """Return the part of `config.pbtxt` that lists the inputs or the outputs of a model.

    The list contains the widths of the tensors only, because Triton adds the batch dimension.

    Args:
        list_name: "input" or "output".
        widths: Width of each tensor by its name.
    """
    lines = [f'  {{ name: "{name}" data_type: TYPE_FP32 dims: [ {width} ] }}' for name, width in widths.items()]
    return f"{list_name} [\n" + ",\n".join(lines) + "\n]\n"
