"""Reader and writer of datasets. A dataset is a folder with shards, a manifest and a data card.

The manifest is the file manifest.json. The manifest contains the version of the format and the checksum of each shard.
The manifest also describes the sensor, the probes, the ranges, the seed, the solver and the columns. The data card is
the file README.md, which describes the dataset for human readers. The samples are distributed over the shards, which
are files such as shard-00000.npz. Each shard contains the columns x_mm, y_mm, force_N, probe, orientation_deg, outside
and charge_pC. The column charge_pC has the shape (n, n_electrode), and all other columns have the shape (n,).

The column outside marks presses between the working area and the clamp. A network must recognise that such a press is
outside, but need not locate the press. The charges of presses near the clamp are less accurate than the charges of
other presses.

A dataset is written into a temporary folder, which is renamed when the dataset is complete. A dataset of measured
presses has the same format, but the manifest has no entries `solver` and `seed`, and no press is marked as outside.
"""

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from isocharge.common.arrays import Array, Booleans, npz_arrays
from isocharge.common.errors import DatasetError, SensorError, cut, error_context, shown
from isocharge.common.files import StrPath, new_folder, read_needed, sha256_of, write_whole
from isocharge.common.structs import MAX_JSON_BYTES, Positive, Text, convert, parse_json
from isocharge.simulate.sensor.footprint import with_rotation
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict

FORMAT_VERSION = 2
"""Version of the dataset format, which the manifest contains."""

COLUMNS = {
    "x_mm": "position of the press along the drawn direction, mm",
    "y_mm": "position of the press across it, mm",
    "force_N": "force of the press, N, positive pushes",
    "probe": "the object that presses, notation without the angle",
    "orientation_deg": "angle by which the probe is turned against its notation, deg, anticlockwise",
    "outside": "whether the press lies between the working area and the clamp, with a less accurate charge",
    "charge_pC": "touch charge of each electrode, pC, electrodes in the manifest's order",
}
"""Names of the columns of a shard, and their descriptions in the manifest and in the data card."""

ORIGIN_KEYS = ("probes", "ranges", "sampling", "noise", "seed", "solver", "outside", "yield_force_N")
"""Entries of the manifest that describe the origin of the samples, and that the data card repeats."""

MAX_SHARD_BYTES = 1 << 26
"""Largest size of the file of a shard, bytes."""


@dataclass(frozen=True)
class Samples:
    """Presses and the charges that they cause.

    Attributes:
        x_mm: Position of each press along the drawn direction, shape (n,), mm.
        y_mm: Position of each press across the drawn direction, shape (n,), mm.
        force_N: Force of each press, positive for a push, shape (n,), N.
        probe: Notation of the probe of each press without its rotation, shape (n,), text.
        orientation_deg: Rotation of the probe relative to its notation, anticlockwise, shape (n,), degrees.
        charge_pC: Touch charge of each electrode, shape (n, n_electrode), pC.
        outside: Whether each press lies between the working area and the clamp, shape (n,); None if no press does.
    """

    x_mm: Array
    y_mm: Array
    force_N: Array
    probe: np.ndarray
    orientation_deg: Array
    charge_pC: Array
    outside: Booleans | None = None

    def __len__(self) -> int:
        return len(self.x_mm)

    @property
    def probes(self) -> tuple[str, ...]:
        """Notations of the probes. If all presses of a probe have one rotation, the notation contains this rotation.

        The attribute `orientation_deg` contains the rotation of each press.
        """
        notations = []
        for notation in np.unique(self.probe).tolist():
            rotations_deg = np.unique(self.orientation_deg[self.probe == notation])
            notations.append(with_rotation(notation, rotations_deg[0]) if rotations_deg.size == 1 else notation)
        return tuple(notations)

    def columns(self) -> dict[str, np.ndarray]:
        """Return a dictionary with the array of each column by its name."""
        columns = {name: getattr(self, name) for name in COLUMNS}
        if self.outside is None:
            columns["outside"] = np.zeros(np.shape(self.x_mm), dtype=bool)
        return columns

    def __getitem__(self, rows: Booleans) -> "Samples":
        """Return the samples in the selected rows."""
        return Samples(**{name: column[rows] for name, column in self.columns().items()})


@dataclass(frozen=True)
class Dataset:
    """Content of a dataset that has been read.

    Attributes:
        sensor: Sensor to which the charges belong.
        samples: Samples within the working area, in the order of the shards.
        manifest: Content of the manifest.
        sha256: Checksum of the manifest. The checksum identifies the whole dataset, because the manifest contains the
            checksums of the shards.
        outside: Samples between the working area and the clamp; None if there are none.
    """

    sensor: Sensor
    samples: Samples
    manifest: dict[str, Any]
    sha256: str
    outside: Samples | None = None


def write_dataset(folder: StrPath, sensor: Sensor, shards: Iterable[Samples], about: dict[str, Any]) -> Path:
    """Write a dataset into a new folder.

    Args:
        folder: Folder that is created. The folder must not exist yet.
        sensor: Sensor to which the charges belong.
        shards: Samples of each shard, which is one file of the dataset. The samples of a shard are requested from the
            iterable only when the shard is written.
        about: Entries of the manifest about the origin of the samples, such as probes, ranges, seed and solver.

    Returns:
        Path of the folder.

    Raises:
        OutputExists: If the folder already exists.
        DatasetError: If a column of a shard has a wrong shape or type, or if a number in the column is not finite.
    """
    folder = Path(folder)
    with new_folder(folder) as draft:
        write_files(draft, folder.name, sensor, shards, about)
    return folder


def write_files(folder: Path, name: str, sensor: Sensor, shards: Iterable[Samples], about: dict[str, Any]) -> None:
    """Write the files of a dataset into an empty folder: the shards, the manifest and the data card.

    Args:
        folder: The empty folder.
        name: Name of the dataset, which may differ from the name of the folder.
        sensor: Sensor to which the charges belong.
        shards: Samples of each shard, which is one file of the dataset.
        about: Entries of the manifest about the origin of the samples, such as probes, ranges, seed and solver.

    Raises:
        DatasetError: If a column of a shard has a wrong shape or type, if a number in the column is not finite, or if a
            file is too large.
    """
    entries = [
        _write_shard(folder, f"shard-{index:05d}.npz", samples, len(sensor.electrodes))
        for index, samples in enumerate(shards)
    ]
    manifest = {
        "format_version": FORMAT_VERSION,
        "package_version": metadata.version("isocharge"),
        "sensor": sensor_to_dict(sensor),
        "electrodes": list(sensor.electrode_names),
        **about,
        "columns": COLUMNS,
        "samples": sum(entry["samples"] - entry["outside"] for entry in entries),
        "shards": entries,
    }
    write_whole(folder / "manifest.json", (json.dumps(manifest, indent=2) + "\n").encode())
    write_whole(folder / "README.md", data_card(name, manifest).encode())


def _write_shard(folder: Path, file_name: str, samples: Samples, n_electrode: int) -> dict[str, Any]:
    """Check the samples of a shard, and write them into a file.

    Args:
        folder: Folder of the dataset.
        file_name: Name of the file.
        samples: Samples of the shard.
        n_electrode: Number of electrodes of the sensor.

    Returns:
        Entry of the manifest that describes the shard.

    Raises:
        DatasetError: If a column has a wrong shape or type, if a number in the column is not finite, or if the file is
            too large.
    """
    _check_samples(samples, n_electrode, file_name)
    columns = samples.columns()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **columns)
    data = buffer.getvalue()
    if len(data) > MAX_SHARD_BYTES:
        raise DatasetError(
            f"{file_name}: expected at most {MAX_SHARD_BYTES} bytes, got {len(data)}; make smaller shards"
        )
    write_whole(folder / file_name, data)
    n_outside = int(columns["outside"].sum())
    return {"file": file_name, "samples": len(samples), "outside": n_outside, "sha256": sha256_of(data)}


def data_card(name: str, manifest: dict[str, Any]) -> str:
    """Return the data card of a dataset, which is the text of its file `README.md`.

    Args:
        name: Name of the dataset.
        manifest: Content of the file `manifest.json` of the dataset.
    """
    origin = {key: manifest[key] for key in ORIGIN_KEYS if key in manifest}
    lines = [
        "---",  # metadata for data hubs: https://huggingface.co/docs/hub/datasets-cards
        f"pretty_name: {json.dumps(name)}",
        "task_categories: [tabular-regression]",
        "tags: [isocharge, tactile-sensing, piezoelectric]",
        "---",
        "",
        f"# {name}",
        "",
        f"{manifest['samples']} presses on the sensor `{manifest['sensor']['name']}` and the touch charge of each "
        f"electrode ({', '.join(manifest['electrodes'])}).",
        "",
        f"Made by isocharge {manifest['package_version']}. Touch charge is the reading under load minus the reading "
        "without load.",
        "",
        "| column | meaning |",
        "|---|---|",
        *(f"| `{column}` | {meaning} |" for column, meaning in COLUMNS.items()),
        "",
        "```json",
        json.dumps(origin, indent=2),
        "```",
        "",
        "Read it with `isocharge.simulate.read_dataset(folder)`, which checks every shard's checksum.",
        "",
    ]
    return "\n".join(lines)


def _check_samples(samples: Samples, n_electrode: int, shard_label: str) -> None:
    """Raise an error if a shard has no samples, or if its columns have wrong shapes, types or values.

    Args:
        samples: Samples of a shard.
        n_electrode: Number of electrodes of the sensor.
        shard_label: Name of the shard for error messages.

    Raises:
        DatasetError: If there are no samples, if a column has a wrong shape or type, or if a number in the column is
            not finite.
    """
    columns = samples.columns()
    shapes = {name: column.shape for name, column in columns.items()}
    count = samples.x_mm.size
    expected_shapes = dict.fromkeys(COLUMNS, (count,)) | {"charge_pC": (count, n_electrode)}
    if shapes != expected_shapes or count == 0:
        raise DatasetError(
            f"{shard_label}: expected columns of shapes {expected_shapes}, at least one sample, got {shapes}"
        )
    # NumPy denotes the kind of the elements of an array by a letter: U for text, b for truth values, f for floats, and
    # i and u for signed and unsigned integers.
    kinds_and_content = {"probe": ("U", "text"), "outside": ("b", "truth values")}
    numeric_kinds_and_content = ("fiu", "numbers")  # of all other columns; each of the three letters is allowed
    for name, column in columns.items():
        expected_kinds, expected_content = kinds_and_content.get(name, numeric_kinds_and_content)
        if column.dtype.kind not in expected_kinds:
            raise DatasetError(f"{shard_label}: column {name}: expected {expected_content}, got {column.dtype}")
        if expected_content == "numbers" and not np.isfinite(column).all():
            row = int(np.argwhere(~np.isfinite(column))[0, 0])
            raise DatasetError(
                f"{shard_label}: column {name} holds {column[row]} in row {row}; every number must be finite"
            )


def read_dataset(folder: StrPath) -> Dataset:
    """Read a dataset, and check the checksums and the columns of all shards.

    Args:
        folder: Folder of the dataset.

    Returns:
        The dataset. Its manifest is the complete content of the file, including entries that are not checked here.

    Raises:
        DatasetError: If the folder is not a dataset, has a different format version, or is damaged or incomplete. The
            message names the file and a remedy.
    """
    # Read the manifest.
    folder = Path(folder)
    manifest_path = f"{folder}/manifest.json"
    manifest, checksum = _read_manifest(folder)
    checked_manifest = convert(manifest, _Manifest, manifest_path, DatasetError)
    try:
        dataset_sensor = sensor_from_dict(checked_manifest.sensor, manifest_path)
    except SensorError as error:
        raise DatasetError(str(error)) from error
    if checked_manifest.electrodes != list(dataset_sensor.electrode_names):
        raise DatasetError(
            f"{manifest_path}: electrodes: expected the sensor's electrodes in its order, "
            f"{list(dataset_sensor.electrode_names)}, got {shown(checked_manifest.electrodes)}"
        )

    # Read the shards, and concatenate each of their columns.
    shards = [_read_shard(folder, entry, dataset_sensor) for entry in checked_manifest.shards]
    if not shards:
        raise DatasetError(f"{manifest_path}: lists no shards")
    columns = {name: np.concatenate([getattr(shard, name) for shard in shards]) for name in COLUMNS}
    all_samples = Samples(**columns)
    is_outside = columns["outside"]
    if is_outside.all():
        raise DatasetError(f"{manifest_path}: expected presses in the working area, got none; sweep again")
    outside = all_samples[is_outside] if is_outside.any() else None
    return Dataset(dataset_sensor, all_samples[~is_outside], manifest, checksum, outside)


class _Shard(Struct):
    """Entry of the manifest that describes a shard, with the keys that the reader uses."""

    file: Text
    sha256: Text


class _Manifest(Struct):
    """Content of the manifest, with the keys that the reader uses."""

    sensor: dict[str, Any]
    electrodes: list[str]
    shards: list[_Shard]
    yield_force_N: Positive | None = None


def _read_manifest(folder: Path) -> tuple[dict[str, Any], str]:
    """Read the manifest of a dataset, and check the version of the format.

    Args:
        folder: Folder of the dataset.

    Returns:
        Content of the manifest, and checksum of its file.

    Raises:
        DatasetError: If the manifest does not exist, is damaged, or has another version of the format.
    """
    path = folder / "manifest.json"
    if not path.is_file():
        raise DatasetError(
            f"{folder} is not a dataset: it has no manifest.json; make one with 'isocharge simulate sweep'"
        )
    data = read_needed(path, DatasetError, "make the dataset again", MAX_JSON_BYTES)
    with error_context(DatasetError, f"{path}: not a manifest of a dataset: "):
        # The second argument is the beginning of the messages. It is empty, because the block adds its own prefix.
        manifest = parse_json(data, "", DatasetError, dict[str, Any])
        if "format_version" not in manifest:
            raise DatasetError("key 'format_version' is missing")
    version = manifest["format_version"]
    if version != FORMAT_VERSION:
        raise DatasetError(
            f"{path}: format version {shown(version)} is not supported (this version reads {FORMAT_VERSION}); sweep "
            "again with 'isocharge simulate sweep', because version 1 has no presses outside the working area, or "
            "upgrade isocharge for a later version"
        )
    return manifest, sha256_of(data)


def _read_shard(folder: Path, entry: _Shard, sensor: Sensor) -> Samples:
    """Read a shard of a dataset, and check its checksum and its columns.

    Args:
        folder: Folder of the dataset.
        entry: Entry of the shard in the manifest.
        sensor: Sensor of the dataset.

    Returns:
        Samples of the shard.

    Raises:
        DatasetError: If the file is missing or damaged, or does not contain valid columns.
    """
    path = folder / Path(entry.file).name  # without a folder, so that a manifest cannot refer to other folders
    if not path.is_file():
        raise DatasetError(f"{path}: the manifest lists this shard, but the file is missing; make the dataset again")
    data = read_needed(path, DatasetError, "make the dataset again", MAX_SHARD_BYTES)
    checksum = sha256_of(data)
    if checksum != entry.sha256:
        raise DatasetError(
            f"{path} is damaged: expected sha256 {entry.sha256[:12]}..., got {checksum[:12]}...; make the dataset again"
        )
    # The file is not trusted. `npz_arrays` does not execute code that the file may contain.
    try:
        arrays = npz_arrays(data)
        samples = Samples(**{column: arrays[column] for column in COLUMNS})
    except (ValueError, KeyError) as error:
        raise DatasetError(f"{path}: not a shard with the columns {', '.join(COLUMNS)}: {cut(str(error))}") from error
    _check_samples(samples, len(sensor.electrodes), str(path))
    return samples
