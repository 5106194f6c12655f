"""Every file that is read, truncated at each byte, with faults, with junk in its tables, and with what is no file."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from attacks.faults import mutated, with_junk
from isocharge.common.contact_domain import Domain
from isocharge.common.files import sha256_of
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
from isocharge.serve.live.device import create_stages
from isocharge.serve.model.charge_file import FILE, charge_map_bytes
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.model_folder import read_checked, read_golden
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.virtual_sensor.script import load_script
from isocharge.simulate import Circle, Samples, load_amplifier, load_sensor, parse_probe, read_dataset, write_dataset
from isocharge.simulate.sensor.sensor_file import sensor_from_dict, sensor_to_dict
from isocharge.train import CalibrationProblem, read_earlier
from isocharge.train.calibration.folder import film_table, json_text
from isocharge.train.training.config import load_config
from model_files import put_charge_map, put_graph

ROOT = Path(__file__).parents[2]
MODEL = "three-25um-biaxial"

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


@pytest.fixture
def files(tmp_path):
    """A folder of good files, which the functions of KINDS read."""
    folder = tmp_path
    sensors = ROOT / "simulate/isocharge/simulate/sensors"
    shutil.copy(sensors / "three-25um-biaxial.toml", folder / "sensor.toml")
    (folder / "device.toml").write_text(DEVICE)
    (folder / "noise.toml").write_text(NOISE)
    shutil.copy(next((ROOT / "train/configs").glob("*.toml")), folder / "config.toml")
    (folder / "script.toml").write_text("presses = [[0, 0, 0, 0], [1, 1, 1, 1.5]]\n[faults]\nlose_share = 0.1\n")
    (folder / "charges.csv").write_text("A,B,C\n800.5,700.25,900\n1,2,3\n")
    with Recorder(folder / "touch.rec", "linear/1", {"tare": {"frames": 10}}) as recorder:
        for k in range(3):
            recorder.event(chunk=Chunk(bytes(9), 1e9 + k, k, 0.0))
            recorder.write('{"timestamp": 1.0, "latency_us": 9.0}')
            recorder.event(tare=True)
    return folder


def _load_device(path):
    device = load_device(path)
    device.parser().feed(b"\xa5\x5a123456")
    create_stages(Setup(("A", "B", "C", "D"), device))


def _read_charges(path):
    assert np.isfinite(read_charges(path, ("A", "B", "C"))).all()


KINDS = {
    "sensor": ("sensor.toml", load_sensor),
    "device": ("device.toml", _load_device),
    "noise": ("noise.toml", load_amplifier),
    "configuration": ("config.toml", load_config),
    "script": ("script.toml", load_script),
    "charges": ("charges.csv", _read_charges),
    "recording": ("touch.rec", lambda path: list(Recording(path).events())),
}
"""Name of the file, and the function that reads it, by the kind of the file."""


def number_bomb(rng, text):
    """A number of the text in another notation, or one that nobody expects."""
    place = rng.choice(list(re.finditer(r"-?\d+(\.\d+)?", text)))
    return text[: place.start()] + rng.choice(NUMBERS) + text[place.end() :]


NUMBERS = ("1" * 23, "1" * 400, "1" * 5000, "1_0", "nan", "inf", "-inf", "1e999", "0x10", "true", "[]", "{}", "-0")


def repeated(piece, before=b"", after=b""):
    """Return a function that repeats a piece a given number of times between other bytes."""
    return lambda count: before + piece * count + after


BOMBS = (
    repeated(b"[", before=b"a = "),
    repeated(b"{a = ", before=b"a = "),
    repeated(b"a.", after=b"a = 1"),
    repeated(b"'a' . ", after=b"a = 1"),
    lambda n: b"".join(b"[s%d]\n" % k for k in range(n)),
    lambda n: b"[electrodes]\nside_mm = 3\n" + b"".join(b"e%d = [0, 0]\n" % k for k in range(n)),
    repeated(b'{"a":'),
    lambda n: b"[" * n + b"]" * n,
    repeated(b"c,", after=b"\n"),
    lambda n: b"A,B,C\n" + b"1,2,3\n" * (n // 10) + b"x\n",
    repeated(b'"'),
    repeated(b"\n"),
    bytes,
)

FAULTS = {
    "cut": (2_000, lambda rng, good: good[: rng.randrange(len(good))]),
    "bytes": (5_000, mutated),
    "numbers": (2_000, lambda rng, good: number_bomb(rng, good.decode()).encode()),
    "bombs": (300, lambda rng, _: rng.choice(BOMBS)(rng.choice((30, 900, 20_000, 200_000)))),
}
"""Number of inputs, and what makes one of them from a good file."""


def json_with_junk(rng, good):
    """Return a file of JSON with junk in one place of it."""
    return json.dumps(with_junk(rng, json.loads(good))).encode()


@pytest.fixture
def attack_file(attack):
    """Function that reads a good file, and then sends versions of it, which `make` returns, to the reader of a path."""

    def send(name, path, read, make, count):
        good = path.read_bytes()
        read(path)

        def read_bytes(data):
            path.write_bytes(data)
            read(path)

        attack(name, read_bytes, lambda rng: make(rng, good), count)
        path.write_bytes(good)

    return send


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("faults", FAULTS)
def test_settings_and_recordings(kind, faults, files, attack_file):
    file, read = KINDS[kind]
    count, make = FAULTS[faults]
    attack_file(f"{kind} {faults}", files / file, read, make, count)


def test_tables_with_junk(attack, model):
    """Junk of the right syntax, where the readers of text do not stop it."""
    sensor = sensor_to_dict(load_sensor("three-25um-biaxial"))
    device = {"frames": {"format": "text", "columns": ["A"]}, "leak": {"tau_s": 1.0}, "tare": {"frames": 9}, "hum": {}}
    props = {name: json.loads(value) for name, value in load_model(model).metadata.to_props().items()}
    golden = json.loads((model / "golden.json").read_text())
    golden["inputs"]["charge_pC"] = golden["inputs"]["charge_pC"][:2]

    def check_vectors(value):
        (model / "golden.json").write_text(json.dumps(value))
        check_golden(load_model(model))

    def read_props(value):
        ModelMetadata.from_props({str(name): json.dumps(item) for name, item in value.items()}, "junk")

    def read_device(value):
        create_stages(Setup(("A", "B", "C"), device_from_table(value, "junk")))

    def table(rng, good):
        return {name: with_junk(rng, item) if rng.random() < 0.3 else item for name, item in good.items()}

    attack("sensor tables", lambda value: sensor_from_dict(value, "junk"), lambda rng: table(rng, sensor), 12_000)
    attack("device tables", read_device, lambda rng: table(rng, device), 12_000)
    attack("metadata", read_props, lambda rng: table(rng, props), 12_000)
    attack("golden vectors", check_vectors, lambda rng: with_junk(rng, golden), 2_000)


@pytest.fixture
def repository(tmp_path):
    """A repository with a copy of a released model."""
    shutil.copytree(find_model(MODEL).parent, tmp_path / "models" / MODEL)
    return tmp_path / "models"


@pytest.fixture
def model(repository):
    """The version folder of the model in the repository."""
    return repository / MODEL / "1"


def test_a_model_with_faults(model, attack):
    """The checksum fits: what is refused is refused by the graph, its interface or its answers."""
    good = (model / "model.onnx").read_bytes()

    def read(data):
        put_graph(model, data)
        check_golden(load_model(model))

    attack("files model", read, lambda rng: mutated_head(rng, good), 1_500)  # nodes and metadata, not the numbers
    attack("files model", read, lambda rng: mutated(rng, good), 1_500)


def mutated_head(rng, good):
    """Return a file with faults among its first 4000 bytes."""
    return mutated(rng, good[:4000]) + good[4000:]


@pytest.fixture
def dataset(tmp_path):
    rng = np.random.default_rng(0)
    columns = {name: rng.uniform(0.1, 2.0, 5) for name in ("x_mm", "y_mm", "force_N", "orientation_deg")}
    samples = Samples(**columns, probe=np.array(["circle:1.0"] * 5), charge_pC=rng.uniform(100, 2000, (5, 3)))
    about = {"probes": ["circle:1.0"], "ranges": {"radius_mm": 8.0}, "seed": 3, "solver": {"order": 4}}
    return write_dataset(tmp_path / "presses", load_sensor("three-25um-biaxial"), [samples], about)


def test_calibrations_with_faults(tmp_path, attack_file):
    """A film that is taken from a file with faults is finite, and the next calibration can begin with it."""
    problem = CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))
    path = tmp_path / "calibration.json"
    path.write_text(json_text(film_table(problem, problem.film_before)))

    def read(_):
        film = read_earlier(tmp_path, problem)
        assert np.isfinite(film.values).all()
        assert np.linalg.eigvalsh(film.covariance)[0] > -1e-6

    _, with_other_number = FAULTS["numbers"]
    attack_file("calibration bytes", path, read, mutated_head, 2_000)
    attack_file("calibration", path, read, json_with_junk, 1_000)
    attack_file("calibration numbers", path, read, with_other_number, 500)


def test_charge_maps_with_faults(model, attack_file):
    """A file is accepted only with the checksum that `golden.json` contains."""
    series = ChargeSeries(
        domain=Domain(8.0, (0.05, 2.0)), electrodes=("A", "B", "C"), coefficients=np.ones((1, 2, 2, 2, 3))
    )
    good = charge_map_bytes(series)
    put_charge_map(model, good)
    golden = read_golden(model / "golden.json")

    def read(_):
        assert read_checked(model, FILE, golden) == good

    attack_file("charges.npz bytes", model / FILE, read, mutated, 3_000)


def test_a_dataset_with_faults(dataset, attack, attack_file):
    path, shard = dataset / "manifest.json", dataset / "shard-00000.npz"
    good, good_shard = path.read_bytes(), shard.read_bytes()

    def read_shard(data):
        shard.write_bytes(data)
        manifest = json.loads(good)
        manifest["shards"][0]["sha256"] = sha256_of(data)
        path.write_text(json.dumps(manifest))
        read_dataset(dataset)

    attack_file("manifest bytes", path, lambda _: read_dataset(dataset), mutated, 5_000)
    attack_file("manifest", path, lambda _: read_dataset(dataset), json_with_junk, 5_000)
    attack("shard", read_shard, lambda rng: mutated(rng, good_shard), 5_000)


NOTATIONS = (
    "circle:1.0",
    "growing-finger:6.0",
    "rectangle:4.0x2.0@30",
    "triangle:4.0@-3",
    "ellipse:4.0x2.0@30",
    "polygon:0,0;1,0;1,1;0,1",
)


def test_probes_with_faults(attack):
    attack(
        "probes",
        parse_probe,
        lambda rng: mutated(rng, rng.choice(NOTATIONS).encode()).decode("utf-8", "replace"),
        30_000,
    )
