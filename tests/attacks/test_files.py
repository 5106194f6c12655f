"""Every file that is read, truncated at each byte, with faults, with junk in its tables, and with what is no file."""

import base64
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from isocharge.common.files import sha256_of
from isocharge.common.resumable_run import resume_folder
from isocharge.serve import (
    Chunk,
    Recorder,
    Recording,
    check_golden,
    device_from_table,
    find_model,
    load_device,
    load_model,
    read_charges,
)
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.virtual_sensor.script import load_script
from isocharge.simulate import Samples, load_amplifier, load_sensor, parse_probe, read_dataset, write_dataset
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train.training.config import load_config
from isocharge.train.training.descent import tensors

ROOT = Path(__file__).parents[2]

DEVICE = """
name = "bench"
[frames]
format = "described"
sync = "A5 5A"
length = 12
checksum = "crc-16/ccitt-false"
fields = [{name = "seq", type = "u16"}, {name = "A", type = "i16", scale = 0.1}, {name = "B", type = "f32"}]
[channels]
A = "A"
[gain]
pC_per_unit = {A = 0.0457, B = -0.0459, C = 0.0457, D = 1}
[saturation]
limit_pC = 1500.0
[hum]
frequency_Hz = 50.0
[tare]
frames = 100
[leak]
tau_s = {A = 10.0, B = 10.2, C = 9.9, D = 1}
[touch]
floor_pC = 10.0
[common_mode]
"""

NOISE = 'like = "bench"\nwhite_pC = 0.5\ntau_s = 1.0\nlimit_pC = inf\nbits = 0\n'


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder of good files, by kind: (path, function that reads it)."""
    folder = tmp_path_factory.mktemp("files")
    return {name: (folder / file, read) for name, (file, read) in _write(folder).items()}


def _write(folder):
    sensors = ROOT / "simulate/isocharge/simulate/sensors"
    shutil.copy(sensors / "three-25um-biaxial.toml", folder / "sensor.toml")
    (folder / "device.toml").write_text(DEVICE)
    (folder / "noise.toml").write_text(NOISE)
    shutil.copy(next((ROOT / "train/configs").glob("*.toml")), folder / "config.toml")
    (folder / "script.csv").write_text("seconds,x_mm,y_mm,force_N\n0,0,0,0\n1,1,1,1.5\n2,2,1e0,0\n")
    (folder / "charges.csv").write_text("A,B,C\n800.5,700.25,900\n1,2,3\n")
    with Recorder(folder / "touch.rec", "linear/1", "every", {"tare": {"frames": 10}}) as recorder:
        for k in range(3):
            recorder.chunk(Chunk(bytes(9), 1e9 + k, k, 0.0), ['{"timestamp": 1.0, "latency_us": 9.0}'])
            recorder.tare()
    return {
        "sensor": ("sensor.toml", load_sensor),
        "device": ("device.toml", _load_device),
        "noise": ("noise.toml", lambda path: load_amplifier(str(path))),
        "configuration": ("config.toml", load_config),
        "script": ("script.toml", load_script),
        "charges": ("charges.csv", _read_charges),
        "recording": ("touch.rec", lambda path: list(Recording(path).events())),
    }


def _load_device(path):
    device = load_device(path)
    device.parser().feed(b"\xa5\x5a123456")
    device.chain(("A", "B", "C", "D"))


def _read_charges(path):
    with path.open(encoding="utf-8-sig", newline="") as lines:
        assert np.isfinite(read_charges(lines, ("A", "B", "C"), "charges")).all()


KINDS = ("sensor", "device", "noise", "configuration", "script", "charges", "recording")


@pytest.mark.parametrize("kind", KINDS)
def test_truncated_at_each_byte(kind, files, attack):
    path, read = files[kind]
    good, ends = path.read_bytes(), iter(range(10**9))
    read(path)

    def cut(_):
        return good[: next(ends) % len(good)]

    attack(f"files {kind}", _from_bytes(path, read, good), cut, len(good))
    path.write_bytes(good)


def _from_bytes(path, read, good):
    """Reads bytes as the file's; the good ones are put back, in case a test fails."""

    def from_bytes(data):
        path.write_bytes(data)
        try:
            read(path)
        finally:
            path.write_bytes(good)

    return from_bytes


@pytest.mark.parametrize("kind", KINDS)
def test_with_faults(kind, files, attack, faults):
    path, read = files[kind]
    good, mutated = path.read_bytes(), faults[0]
    attack(f"files {kind}", _from_bytes(path, read, good), lambda rng: mutated(rng, good), 5_000)


def _number_bombs(rng, text):
    """A number of the text in another notation, or one that nobody expects."""
    numbers = list(re.finditer(r"-?\d+(\.\d+)?", text))
    place = rng.choice(numbers)
    new = rng.choice(
        (
            "1" * 23,
            "1" * 400,
            "1" * 5000,
            "1_0",
            "nan",
            "inf",
            "-inf",
            "1e999",
            "0x10",
            "true",
            "[]",
            "{}",
            "-0",
            "1e-320",
        )
    )
    return text[: place.start()] + new + text[place.end() :]


@pytest.mark.parametrize("kind", KINDS)
def test_with_numbers_that_nobody_expects(kind, files, attack):
    path, read = files[kind]
    good = path.read_bytes()
    attack(
        f"files {kind}",
        _from_bytes(path, read, good),
        lambda rng: _number_bombs(rng, good.decode()).encode(),
        2_000,
    )


BOMBS = {
    "arrays": lambda n: b"a = " + b"[" * n,
    "tables": lambda n: b"a = " + b"{a = " * n,
    "keys": lambda n: b"a." * n + b"a = 1",
    "quoted keys": lambda n: b"'a' . " * n + b"a = 1",
    "sections": lambda n: b"".join(b"[s%d]\n" % k for k in range(n)),
    "electrodes": lambda n: b"[electrodes]\nside_mm = 3\n" + b"".join(b"e%d = [0, 0]\n" % k for k in range(n)),
    "json": lambda n: b'{"a":' * n,
    "lists": lambda n: b"[" * n + b"]" * n,
    "columns": lambda n: b"c," * n + b"\n",
    "rows": lambda n: b"A,B,C\n" + b"1,2,3\n" * (n // 10) + b"x\n",
    "quotes": lambda n: b'"' * n,
    "blank lines": lambda n: b"\n" * n,
    "zeros": bytes,
}


@pytest.mark.parametrize("kind", KINDS)
def test_bombs(kind, files, attack):
    path, read = files[kind]
    good = path.read_bytes()
    attack(
        f"files {kind}",
        _from_bytes(path, read, good),
        lambda rng: rng.choice(list(BOMBS.values()))(rng.choice((30, 900, 20_000, 200_000))),
        300,
    )


@pytest.mark.parametrize("how", ["sensor", "device", "metadata", "golden"])
def test_tables_with_junk(how, attack, faults, model):
    """Junk of the right syntax, where the readers of text do not stop it."""
    _, with_junk = faults
    sensor = sensor_to_dict(load_sensor("three-25um-biaxial"))
    device = {"frames": {"format": "text", "columns": ["A"]}, "leak": {"tau_s": 1.0}, "tare": {"frames": 9}, "hum": {}}
    folder, props = model, load_model(model).metadata.to_props()
    golden = json.loads((folder / "golden.json").read_text())
    golden = golden | {"inputs": {"charge_pC": golden["inputs"]["charge_pC"][:2]}}
    cases = {
        "sensor": (sensor, lambda value: sensor_from_dict(value, "junk")),
        "device": (device, lambda value: device_from_table(value, "junk").chain(("A", "B", "C"))),
        "metadata": (
            {name: json.loads(value) for name, value in props.items()},
            lambda value: ModelMetadata.from_props(_props(value), "junk"),
        ),
        "golden": (golden, lambda value: _load_golden(folder, value)),
    }
    good, read = cases[how]
    attack(f"tables {how}", read, lambda rng: with_junk(rng, good), 12_000 if how != "golden" else 2_000)


def _props(value):
    return {str(name): json.dumps(item) for name, item in value.items()} if isinstance(value, dict) else {}


def _load_golden(folder, value):
    path = folder / "golden.json"
    good = path.read_bytes()
    path.write_text(json.dumps(value))
    try:
        check_golden(load_model(folder))
    finally:
        path.write_bytes(good)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A copy of a released model."""
    folder = tmp_path_factory.mktemp("models") / "three-25um-biaxial"
    shutil.copytree(find_model("three-25um-biaxial").parent, folder)
    return folder / "1"


def test_a_model_with_faults(model, attack, faults):
    """The checksum fits: what is refused is refused by the graph, its interface or its answers."""
    mutated, _ = faults
    graph, golden = model / "model.onnx", json.loads((model / "golden.json").read_text())
    good = graph.read_bytes()

    def read(data):
        graph.write_bytes(data)
        (model / "golden.json").write_text(json.dumps(golden | {"sha256": sha256_of(data)}))
        check_golden(load_model(model))

    head = 4000  # nodes and metadata; most of the rest is numbers
    attack("files model", read, lambda rng: mutated(rng, good[:head]) + good[head:], 1_500)
    attack("files model", read, lambda rng: mutated(rng, good), 1_500)
    graph.write_bytes(good)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    rng = np.random.default_rng(0)
    columns = {name: rng.uniform(0.1, 2.0, 5) for name in ("x_mm", "y_mm", "force_N", "orientation_deg")}
    samples = Samples(**columns, probe=np.array(["circle:1.0"] * 5), charge_pC=rng.uniform(100, 2000, (5, 3)))
    about = {"probes": ["circle:1.0"], "ranges": {"radius_mm": 8.0}, "seed": 3, "solver": {"order": 4}}
    return write_dataset(
        tmp_path_factory.mktemp("data") / "presses", load_sensor("three-25um-biaxial"), [samples], about
    )


def test_a_dataset_with_faults(dataset, attack, faults):
    mutated, with_junk = faults
    path, shard = dataset / "manifest.json", dataset / "shard-00000.npz"
    good, good_shard = path.read_bytes(), shard.read_bytes()

    def read_manifest(data):
        path.write_bytes(data)
        read_dataset(dataset)

    def read_shard(data):
        shard.write_bytes(data)
        manifest = json.loads(good)
        manifest["shards"][0]["sha256"] = sha256_of(data)
        path.write_text(json.dumps(manifest))
        read_dataset(dataset)

    attack("files manifest", read_manifest, lambda rng: mutated(rng, good), 5_000)
    attack("files manifest", read_manifest, lambda rng: json.dumps(with_junk(rng, json.loads(good))).encode(), 5_000)
    attack("files shard", read_shard, lambda rng: mutated(rng, good_shard), 5_000)
    path.write_bytes(good)
    shard.write_bytes(good_shard)


def test_parts_of_runs_with_faults(tmp_path, attack, faults):
    """Their checksums fit; a part that is garbage is computed again, and the run goes on."""
    mutated, _ = faults
    array, state = io.BytesIO(), io.BytesIO()
    np.save(array, np.arange(12.0).reshape(3, 4))
    torch.save({"step": 3, "weights": torch.zeros(3)}, state)
    with resume_folder(tmp_path / "target", {"a": 1}) as run:

        def read_array(data):
            run.save("solve-0000.npy", data)
            assert len(list(in_order(run.keeping("solve"), lambda job: np.zeros(job), [2]))) == 1

        def read_state(data):
            run.save("weights", data)
            run.load_as("weights", tensors)

        attack("files part", read_array, lambda rng: mutated(rng, array.getvalue()), 2_000)
        attack("files checkpoint", read_state, lambda rng: mutated(rng, state.getvalue()), 2_000)


NOTATIONS = ("circle:1.0", "rectangle:4.0x2.0@30", "triangle:4.0@-3", "polygon:0,0;1,0;1,1;0,1")


def test_probes_with_faults(attack, faults):
    mutated, _ = faults
    attack(
        "probes",
        parse_probe,
        lambda rng: mutated(rng, rng.choice(NOTATIONS).encode()).decode("utf-8", "replace"),
        30_000,
    )


def test_chunks_of_recordings_with_junk(tmp_path, attack, faults):
    _, with_junk = faults
    path = tmp_path / "junk.rec"
    header = {"isocharge_recording": 1, "model": "linear/1", "policy": "every", "device": {}}
    chunk = {"chunk": [1e9, 5, 0.0, base64.b64encode(b"abc").decode()]}
    record = {"timestamp": 1e9, "latency_us": 5.0}

    def read(lines):
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        for event in Recording(path).events():
            assert event.chunk is None or isinstance(event.chunk.data, bytes)

    def lines(rng):
        return with_junk(rng, header), chunk, with_junk(rng, chunk), with_junk(rng, record)

    attack("files recording", read, lambda rng: lines(rng) if rng.random() < 0.3 else (header, *lines(rng)[1:]), 6_000)
