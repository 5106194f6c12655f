"""The model folder: its one writer and its one reader.

    <name>/config.pbtxt            for Triton
    <name>/<version>/model.onnx    charge_pC -> contact, contact_std, misfit; the metadata is inside
    <name>/<version>/golden.json   charges, answers, tolerances, and the checksum of model.onnx
    <name>/<version>/card.md       for people

A version appears whole or not at all: it is written under a temporary name, read back as a user reads it, and only then
renamed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import onnxruntime as ort
from numpy.typing import ArrayLike

from isocharge.common.defaults import MAX_BATCH
from isocharge.common.errors import ModelError, OutputExists
from isocharge.common.files import new_folder, read_whole, refuse_existing, sha256_of, write_whole
from isocharge.serve.model.charges import as_batch
from isocharge.serve.model.golden import Golden, check_answers, make_golden, read_golden
from isocharge.serve.model.metadata import NAME, ModelMetadata
from isocharge.serve.model.session import INPUT, OUTPUTS, check_interface, check_rows, open_session, run


@dataclass(frozen=True)
class Model:
    """A model that was read and checked: its version folder, metadata, golden vectors, and a session to run it."""

    folder: Path
    metadata: ModelMetadata
    golden: Golden
    session: ort.InferenceSession


def load_model(folder: Path) -> Model:
    """Read and check a model.

    Args:
        folder: The version folder, as `find_model` gives it.

    Raises:
        ModelError: If a file is missing or damaged, or the model is of another format.
    """
    path = folder / "model.onnx"
    data, golden = _read(path), read_golden(folder / "golden.json")
    _check_intact(data, golden, path)
    session = open_session(data, str(path))
    metadata = ModelMetadata.from_props(session.get_modelmeta().custom_metadata_map, str(path))
    check_interface(session, len(metadata.electrodes), str(path))
    _check_fits(golden, metadata, folder)
    return Model(folder, metadata, golden, session)


def _read(path: Path) -> bytes:
    try:
        return read_whole(path)
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror}); copy or export the model again") from error


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
    try:
        answers = run(model.session, charge_pC)
    except ModelError as error:
        raise ModelError(f"{where}: {error}") from error
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
        further: More files for the version folder, by name; a server leaves them alone.

    Returns:
        The version folder.

    Raises:
        OutputExists: If this version exists already, or a file has the folder's name.
        ChargeError: If the golden charges do not fit the electrodes.
        ModelError: If the graph cannot be loaded as a reader loads it, or disagrees with `metadata`. After any error
            no file of the version is left.
    """
    target = folder / str(metadata.version)
    check_target(folder, metadata.version, metadata.electrodes)
    if folder.resolve().name != metadata.name:
        raise ModelError(f"{folder}: expected a folder named {metadata.name!r}, as the metadata names the model")
    where = f"the new model {metadata.label}"
    session = open_session(onnx_model, where)
    check_interface(session, len(metadata.electrodes), where)
    golden = make_golden(session, onnx_model, as_batch(golden_charge_pC, metadata.electrodes))
    with new_folder(target) as draft:
        write_whole(draft / "model.onnx", onnx_model)
        write_whole(draft / "golden.json", golden.to_json().encode())
        write_whole(draft / "card.md", card.encode())
        for name, content in further.items():
            write_whole(draft / name, content)
        _check_draft(draft, metadata)
    write_whole(folder / "config.pbtxt", triton_config(metadata.name, len(metadata.electrodes)).encode())
    return target


def check_target(folder: Path, version: int, electrodes: tuple[str, ...]) -> None:
    """Refuse a folder in which a model version cannot be written; training checks it before it starts.

    Args:
        folder: The model's folder, named as the model.
        version: Number of the version to write.
        electrodes: Names of the model's electrodes.

    Raises:
        OutputExists: If the version exists already, or a file has the folder's name.
        ModelError: If the folder's name is no model name, or the folder holds a model with other electrodes.
    """
    refuse_existing(folder / str(version))
    if folder.exists() and not folder.is_dir():
        raise OutputExists(f"{folder}: expected a folder or nothing, got a file; choose another place")
    name = folder.resolve().name
    if not NAME.fullmatch(name):
        raise ModelError(f"model name {name!r}: expected letters, digits, '-', '_' and '.'; rename the folder")
    config, expected = folder / "config.pbtxt", triton_config(name, len(electrodes))
    if config.exists() and config.read_text(encoding="utf-8") != expected:
        raise ModelError(
            f"{config}: describes a model other than one with the electrodes {electrodes}; use another model name"
        )


def _check_draft(draft: Path, metadata: ModelMetadata) -> None:
    """Read a new version back as a user reads it."""
    model = load_model(draft)
    inside, given = model.metadata.to_props(), metadata.to_props()
    differing = [key for key in given if inside[key] != given[key]]
    if differing:
        key = differing[0]
        raise ModelError(f"the graph's metadata disagree on {key!r}: expected {given[key]}, got {inside[key]}")
    check_golden(model)


def triton_config(name: str, electrodes: int) -> str:
    """The text of `config.pbtxt` for a model with this number of electrodes; Triton adds the batch dimension."""
    head = f'name: "{name}"\nplatform: "onnxruntime_onnx"\nmax_batch_size: {MAX_BATCH}\n'
    return head + _tensors("input", {INPUT: electrodes}) + _tensors("output", OUTPUTS)


def _tensors(kind: str, widths: dict[str, int]) -> str:
    lines = [f'  {{ name: "{name}" data_type: TYPE_FP32 dims: [ {width} ] }}' for name, width in widths.items()]
    return f"{kind} [\n" + ",\n".join(lines) + "\n]\n"
