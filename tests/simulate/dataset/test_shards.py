"""Dataset format: round trip, manifest, and errors for incomplete or damaged datasets."""

import errno
import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import DatasetError, OutputError
from isocharge.simulate import Samples, load_sensor, read_dataset, write_dataset
from isocharge.simulate.dataset.shards import COLUMNS


def samples(count=5, seed=0):
    rng = np.random.default_rng(seed)
    return Samples(
        x_mm=rng.uniform(-8, 8, count),
        y_mm=rng.uniform(-8, 8, count),
        force_N=rng.uniform(0.05, 2, count),
        probe=np.array(["circle:1.0"] * count),
        orientation_deg=np.zeros(count),
        charge_pC=rng.uniform(100, 2000, (count, 3)),
    )


SENSOR = load_sensor("three-25um-biaxial")
ABOUT = {"probes": ["circle:1.0"], "ranges": {"radius_mm": 8.0}, "seed": 3, "solver": {"order": 4}}


@pytest.fixture
def dataset(tmp_path):
    """A dataset with two shards, which contain 5 and 3 samples."""
    return write_dataset(str(tmp_path / "presses"), SENSOR, [samples(5, 0), samples(3, 1)], ABOUT)


def edit(folder, change):
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


# Round trip


def test_dataset_round_trip(dataset):
    read = read_dataset(dataset)
    assert read.sensor == SENSOR
    for name in COLUMNS:
        both = np.concatenate([samples(5, 0).columns()[name], samples(3, 1).columns()[name]])
        np.testing.assert_array_equal(getattr(read.samples, name), both)


def test_samples_outside_are_read_separately(tmp_path):
    is_outside = np.array([False, True, False, True, True])
    mixed = replace(samples(5, 0), outside=is_outside)
    read = read_dataset(write_dataset(tmp_path / "presses", SENSOR, [mixed, samples(3, 1)], ABOUT))
    assert read.manifest["samples"] == len(read.samples) == 5
    np.testing.assert_array_equal(read.samples.x_mm[:2], mixed.x_mm[~is_outside])
    np.testing.assert_array_equal(read.outside.charge_pC, mixed.charge_pC[is_outside])
    everywhere = replace(samples(2), outside=np.ones(2, dtype=bool))
    with pytest.raises(DatasetError, match="expected presses in the working area, got none"):
        read_dataset(write_dataset(tmp_path / "none", SENSOR, [everywhere], ABOUT))


def test_manifest_and_card_describe_the_dataset(dataset):
    manifest = read_dataset(dataset).manifest
    assert (manifest["format_version"], manifest["samples"], manifest["seed"]) == (2, 8, 3)
    assert (manifest["electrodes"], manifest["columns"]) == (["A", "B", "C"], COLUMNS)
    names = ["shard-00000.npz", "shard-00001.npz"]
    assert sorted(path.name for path in dataset.iterdir()) == ["README.md", "manifest.json", *names]
    assert [(shard["file"], shard["samples"]) for shard in manifest["shards"]] == list(zip(names, (5, 3), strict=True))
    card = (dataset / "README.md").read_text()
    for part in ("# presses\n", "8 presses", "`three-25um-biaxial`", "circle:1.0", '"seed": 3', *COLUMNS):
        assert part in card


# Damage


def test_read_dataset_of_another_folder_raises_dataset_error(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "nothing", tmp_path / "file"):
        with pytest.raises(DatasetError, match=f"{path} is not a dataset: it has no manifest.json; make one with"):
            read_dataset(path)


def write_shard(folder, data):
    """Replace the bytes of the first shard, and write the correct checksum into the manifest."""
    (folder / "shard-00000.npz").write_bytes(data)
    edit(folder, lambda manifest: manifest["shards"][0].update(sha256=hashlib.sha256(data).hexdigest()))


def shard(**columns):
    """Return a function that replaces columns of the first shard of a dataset, or removes them if they are None."""

    def replace_columns(folder):
        path = folder / "shard-00000.npz"
        arrays = dict(np.load(path)) | columns
        np.savez(path, allow_pickle=True, **{name: array for name, array in arrays.items() if array is not None})
        write_shard(folder, path.read_bytes())

    return replace_columns


MANIFESTS = {
    "a version to come": (lambda table: table.update(format_version=3), "format version 3 is not supported"),
    "no presses outside": (lambda table: table.update(format_version=1), "sweep again with 'isocharge simulate sweep'"),
    "yield": (lambda table: table.update(yield_force_N=0), "yield_force_N"),
    "no sensor": (lambda table: table.pop("sensor"), "key 'sensor' is missing"),
    "no shards": (lambda table: table.update(shards=[]), "lists no shards"),
    "film": (lambda table: table["sensor"]["film"].update(colour="red"), r"unknown key 'film\.colour'"),
    "electrodes": (  # else read as each other's charges
        lambda table: table.update(electrodes=["B", "A", "C"]),
        r"expected the sensor's electrodes in its order, \['A', 'B', 'C'\], got \['B'",
    ),
    "shards": (lambda table: table.update(shards=[{"file": 3, "sha256": ""}]), "shards"),
}
COLUMNS_OF = {
    "a column is missing": (shard(force_N=None), "not a shard with the columns x_mm, y_mm"),
    "too long": (shard(x_mm=np.zeros(6)), r"expected columns of shapes .* got .*'x_mm': \(6,\)"),
    "too many electrodes": (shard(charge_pC=np.zeros((5, 4))), r"got .*'charge_pC': \(5, 4\)"),
    "no samples": (shard(**{n: np.zeros((0, 3) if n == "charge_pC" else 0) for n in COLUMNS}), "at least one sample"),
    "NaN": (shard(x_mm=np.array([0, 1, np.nan, 3, 4])), "column x_mm holds nan in row 2; every number must be finite"),
    "text": (shard(x_mm=np.array(list("abcde"))), "column x_mm: expected numbers, got <U1"),
    "objects": (shard(x_mm=np.array([None] * 5)), "not a shard"),
    "outside of numbers": (shard(outside=np.zeros(5)), "column outside: expected truth values, got float64"),
    "probe of numbers": (shard(probe=np.zeros(5)), "column probe: expected text, got float64"),
}
DAMAGE = {
    **{
        f"manifest: {text[:20]}": (
            lambda folder, text=text: (folder / "manifest.json").write_text(text, encoding="latin-1"),
            r"manifest\.json: not a manifest of a dataset",
        )
        for text in ("", "[]", "{}", "\xff", "[" * 100_000, '{"format_version": 1' + "0" * 5000)
    },
    **{
        name: (lambda folder, change=change: edit(folder, change), rf"manifest\.json: .*{message}")
        for name, (change, message) in MANIFESTS.items()
    },
    "a shard is missing": (
        lambda folder: (folder / "shard-00001.npz").unlink(),
        r"shard-00001\.npz: the manifest lists this shard, but the file is missing",
    ),
    "a shard of another dataset": (
        lambda folder: shutil.copy(folder / "shard-00001.npz", folder / "shard-00000.npz"),
        r"shard-00000\.npz is damaged: expected sha256 [0-9a-f]{12}\.\.\., got",
    ),
    "a shard outside the folder": (
        lambda folder: (
            shutil.move(folder / "shard-00000.npz", folder.parent),
            edit(folder, lambda table: table["shards"][0].update(file="../shard-00000.npz")),
        ),
        "the file is missing",
    ),
    **{name: (spoil, rf"shard-00000\.npz: .*{message}") for name, (spoil, message) in COLUMNS_OF.items()},
    "a shard that is no npz file": (
        lambda folder: write_shard(folder, b"garbage"),
        r"shard-00000\.npz: not a shard with the columns",
    ),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_damaged_dataset_raises_dataset_error(dataset, what):
    """A manifest cannot name files outside the dataset, and code in a shard is not executed."""
    spoil, message = DAMAGE[what]
    spoil(dataset)
    with pytest.raises(DatasetError, match=message):
        read_dataset(dataset)


# Writing: whole or not at all


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"charge_pC": np.full((5, 3), np.inf)}, r"column charge_pC holds \[inf inf inf\] in row 0"),
        ({"x_mm": np.zeros(4)}, r"expected columns of shapes"),
    ],
)
def test_invalid_samples_are_not_written(tmp_path, changes, message):
    with pytest.raises(DatasetError, match=rf"shard-00001\.npz: {message}"):
        write_dataset(tmp_path / "presses", SENSOR, [samples(), replace(samples(), **changes)], ABOUT)
    assert list(tmp_path.iterdir()) == []


def test_full_disk_leaves_no_partial_dataset(tmp_path, monkeypatch):
    """The disk is full when one of the files is written, for each file in turn."""
    for failing in range(1, 5):
        calls = []

        def full(_handle, calls=calls, failing=failing):
            calls.append(1)
            if len(calls) == failing:
                raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr("os.fsync", full)
        with pytest.raises(OutputError, match="presses cannot be written: No space left on device"):
            write_dataset(tmp_path / "new" / "presses", SENSOR, [samples(), samples()], ABOUT)
        assert list(tmp_path.iterdir()) == []
