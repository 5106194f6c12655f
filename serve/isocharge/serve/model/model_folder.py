"""The model folder: its one writer, its one reader, and the search by name, version or path.

    <name>/config.pbtxt            for Triton
    <name>/<version>/model.onnx    charge_pC -> contact, its deviations and correlations, misfit; metadata inside
    <name>/<version>/golden.json   charges, answers, tolerances, and the checksums of model.onnx and of further files
    <name>/<version>/card.md       for people

A version appears whole or not at all: it is written under a temporary name, read back as a user reads it, and only then
renamed.

A model repository is a folder of such folders; other files in it are ignored. Names are looked up in the folder that
was given, in `$ISOCHARGE_MODELS`, in `./models`, and in the models that ship with isocharge.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import onnxruntime as ort
from numpy.typing import ArrayLike

from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import ModelError, OutputExists, shown, told_where
from isocharge.common.files import new_folder, read_needed, refuse_existing, sha256_of, write_whole
from isocharge.common.model_labels import NAME, VERSION
from isocharge.serve.model.golden import Golden, check_answers, contact_floors, make_golden, read_golden
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.session import (
    CORRELATION,
    INPUT,
    OUTPUTS,
    as_batch,
    check_interface,
    check_rows,
    open_session,
    outputs_of,
    run,
)


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


def find_labelled_model(label: str, models: Path | None = None) -> Path:
    """Return the version folder of the model with a label, `NAME/VERSION`, that a file names.

    Unlike `find_model`, this function searches only the repositories and never takes the label as a path, because the
    file may come from somebody else.

    Args:
        label: The label, as a recording holds it.
        models: Repository that is searched first.

    Raises:
        ModelError: If the text is not a label, or no repository has the model.
    """
    name, _, version = label.partition("/")
    if not (NAME.fullmatch(name) and VERSION.fullmatch(version)):
        raise ModelError(f"model {shown(label)}: expected the label NAME/VERSION of a model; give the model by --model")
    roots = repositories(models)
    for root in roots:
        folder = root / name / version
        if (folder / "model.onnx").is_file():
            return folder
    raise ModelError(_not_found(label, roots, is_path=False))


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


@dataclass(frozen=True)
class Model:
    """A model that was read and checked: version folder, metadata, golden vectors, its session, and its bytes."""

    folder: Path
    metadata: ModelMetadata
    golden: Golden
    session: ort.InferenceSession
    graph: bytes


def load_model(folder: Path) -> Model:
    """Read and check a model.

    Args:
        folder: The version folder, as `find_model` gives it.

    Raises:
        ModelError: If a file is missing or damaged, or the model is of another format.
    """
    path = folder / "model.onnx"
    data = read_needed(path, ModelError, "copy or export the model again")
    golden = read_golden(folder / "golden.json")
    _check_intact(data, golden, path)
    session = open_session(data, str(path))
    metadata = ModelMetadata.from_props(session.get_modelmeta().custom_metadata_map, str(path))
    check_interface(session, len(metadata.electrodes), str(path))
    _check_fits(golden, metadata, folder)
    return Model(folder, metadata, golden, session, data)


def _check_intact(data: bytes, golden: Golden, path: Path) -> None:
    if sha256_of(data) != golden.sha256:
        raise ModelError(
            f"{path}: expected sha256 {golden.sha256} (golden.json), got {sha256_of(data)} over {len(data)} bytes; "
            "the file is damaged or changed: copy or export it again"
        )


def _check_fits(golden: Golden, metadata: ModelMetadata, folder: Path) -> None:
    shape = golden.charge_pC.shape
    if len(shape) != 2 or shape[0] == 0 or shape[1] != len(metadata.electrodes):
        raise ModelError(
            f"{folder / 'golden.json'}: expected charges of shape (n, {len(metadata.electrodes)}) with n > 0, "
            f"got {shape}; copy or export the model again"
        )
    check_rows(golden.outputs, len(golden.charge_pC), str(folder / "golden.json"))


def check_golden(model: Model) -> None:
    """Compare the answers of this machine with a model's golden vectors.

    Raises:
        ModelError: If an answer differs from that in golden.json.
    """
    where, charge_pC = str(model.folder / "model.onnx"), model.golden.charge_pC
    with told_where(f"{where}: ", ModelError):
        answers = run(model.session, charge_pC)
    check_rows(answers, len(charge_pC), where)
    check_answers(model.golden, answers, where)


def write_model(
    folder: Path,
    onnx_model: bytes,
    metadata: ModelMetadata,
    golden_charge_pC: ArrayLike,
    card: str,
    further: Mapping[str, bytes] = MappingProxyType({}),
) -> Path:
    """Write a new version of a model.

    Args:
        folder: The model's folder; it has the model's name and may already hold other versions.
        onnx_model: The graph, with `metadata.to_props()` in its metadata_props.
        metadata: The same metadata.
        golden_charge_pC: Inputs of the golden vectors, shape (n, electrodes), pC.
        card: Text of the model card.
        further: More files for the version folder, by name. A server ignores them. Their checksums go into
            `golden.json`.

    Returns:
        The version folder.

    Raises:
        OutputExists: If this version exists already, or a file has the folder's name.
        ChargeError: If the golden charges do not fit the electrodes.
        ModelError: If the graph cannot be loaded as a reader loads it, or disagrees with `metadata`. After any error
            no file of the version is left.
    """
    target = check_target(folder, metadata.version, metadata.electrodes)
    if folder.resolve().name != metadata.name:
        raise ModelError(f"{folder}: expected a folder named {metadata.name!r}, as the metadata names the model")
    where = f"the new model {metadata.label}"
    session = open_session(onnx_model, where)
    check_interface(session, len(metadata.electrodes), where)
    charges = as_batch(golden_charge_pC, metadata.electrodes)
    answers = make_golden(session, onnx_model, charges, contact_floors(metadata))
    golden = replace(answers, companion_sha256={name: sha256_of(content) for name, content in further.items()})
    with new_folder(target) as draft:
        write_whole(draft / "model.onnx", onnx_model)
        write_whole(draft / "golden.json", golden.to_json().encode())
        write_whole(draft / "card.md", card.encode())
        for name, content in further.items():
            write_whole(draft / name, content)
        _check_draft(draft, metadata)
    config, electrodes = folder / "config.pbtxt", len(metadata.electrodes)
    plain = triton_config(metadata.name, electrodes, correlation=False)
    every = CORRELATION in outputs_of(session) and not (config.exists() and config.read_text(encoding="utf-8") == plain)
    write_whole(config, triton_config(metadata.name, electrodes, correlation=every).encode())
    return target


def check_target(folder: Path, version: int, electrodes: tuple[str, ...]) -> Path:
    """The version folder; refused where a model version cannot be written. Training checks it before it starts.

    Args:
        folder: The model's folder, named as the model.
        version: Number of the version to write.
        electrodes: Names of the model's electrodes.

    Raises:
        OutputExists: If the version exists already, or a file has the folder's name.
        ModelError: If the folder's name is no model name, or the folder holds a model with other electrodes.
    """
    target = folder / str(version)
    refuse_existing(target)
    if folder.exists() and not folder.is_dir():
        raise OutputExists(f"{folder}: expected a folder or nothing, got a file; choose another place")
    name = folder.resolve().name
    if not NAME.fullmatch(name):
        raise ModelError(f"model name {name!r}: expected letters, digits, '-', '_' and '.'; rename the folder")
    config = folder / "config.pbtxt"
    expected = [triton_config(name, len(electrodes), correlation=correlation) for correlation in (False, True)]
    if config.exists() and (text := config.read_text(encoding="utf-8")) not in expected:
        named = re.match('name: "(.*)"', text)
        if named and named[1] != name:
            raise ModelError(
                f"{config}: names the model {named[1]!r}, its folder is {name!r}: was it copied or renamed? Give it "
                "its old name, or choose another output"
            )
        raise ModelError(
            f"{config}: describes a model other than one with the electrodes {electrodes}; use another model name"
        )
    return target


def _check_draft(draft: Path, metadata: ModelMetadata) -> None:
    """Read a new version back as a user reads it."""
    model = load_model(draft)
    inside, given = model.metadata.to_props(), metadata.to_props()
    differing = [key for key in given if inside[key] != given[key]]
    if differing:
        key = differing[0]
        raise ModelError(f"the graph's metadata disagree on {key!r}: expected {given[key]}, got {inside[key]}")
    check_golden(model)


def triton_config(name: str, electrodes: int, *, correlation: bool = True) -> str:
    """The text of `config.pbtxt` for a model with this number of electrodes; Triton adds the batch dimension.

    Without `correlation`, which older models do not give, it serves all versions of a model.
    """
    outputs = {tensor: width for tensor, width in OUTPUTS.items() if correlation or tensor != CORRELATION}
    head = f'name: "{name}"\nplatform: "onnxruntime_onnx"\nmax_batch_size: {MAX_BATCH}\n'
    return head + _tensors("input", {INPUT: electrodes}) + _tensors("output", outputs)


def _tensors(kind: str, widths: dict[str, int]) -> str:
    lines = [f'  {{ name: "{name}" data_type: TYPE_FP32 dims: [ {width} ] }}' for name, width in widths.items()]
    return f"{kind} [\n" + ",\n".join(lines) + "\n]\n"
