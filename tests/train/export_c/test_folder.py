"""The folder of an export: whole or absent, its README true, its examples right."""

import json
import re
import shutil
import subprocess
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from isocharge.serve import (
    BinaryParser,
    Chunk,
    Contact,
    Faults,
    Frame,
    Predictor,
    TouchStream,
    VirtualSensor,
    device_from_table,
    encode_frame,
    find_model,
    load_device,
    wander,
)
from isocharge.simulate import load_amplifier
from isocharge.train.export_c.folder import export_c
from processes import finished

HERE = Path(__file__).parent
MODEL = "three-25um-biaxial-student"
EXAMPLE = ("host_example.c", "isocharge_chain.c", "isocharge_frames.c", "isocharge_model.c")
ONLY_PYTHON = {"gap", "repeat", "restart"}
"""Flags of a record that the example does not compute."""

BOARD = """
name = "bench board"
[saturation]
limit_pC = 4000.0
[leak]
tau_s = 10.0
"""


def test_command_writes_the_folder_once(command, refused, tmp_path):
    (tmp_path / "board.toml").write_text(BOARD)
    words = ("train", "export-c", "three-25um-biaxial", "--device", tmp_path / "board.toml", "-o", tmp_path / "c")
    code, out, err = command(*words)
    assert (code, out, "isocharge_model.c" in err) == (0, "", True)
    header = (tmp_path / "c/isocharge_device.h").read_text()
    assert "#define ISOCHARGE_LEAK_TAU_S {(isocharge_real)10.0, " in header
    assert header.startswith('/* The numbers of the signal chain, from the device file "bench board". Written by')
    readme = (tmp_path / "c" / "README.md").read_text()
    assert 'the numbers of the signal chain, from the device file "bench board" |' in readme
    assert "Written by `isocharge train export-c three-25um-biaxial --" in readme
    refused(*words, message="is already there and is not overwritten", code=1)


def test_no_folder_is_left_of_what_cannot_be_written(refused, tmp_path):
    damaged = tmp_path / "damaged"
    shutil.copytree(find_model("three-25um-biaxial"), damaged)
    data = bytearray((damaged / "model.onnx").read_bytes())
    data[2000] ^= 1
    (damaged / "model.onnx").write_bytes(data)
    (tmp_path / "board.toml").write_text("[leak]\ntau_s = {X = 1.0}\n")
    (tmp_path / "wires.toml").write_text('[channels]\nA = "1"\nfront_end = "current"\n')
    for words, message in [
        ((damaged,), "expected sha256"),
        (("no-such-model",), "no model 'no-such-model'"),
        (("three-25um-biaxial", "--device", tmp_path / "board.toml"), "one for each of the electrodes"),
        (("three-25um-biaxial", "--device", tmp_path / "wires.toml"), "channels.front_end: expected one of the"),
    ]:
        refused("train", "export-c", *words, "-o", tmp_path / "c", message=message)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["board.toml", "damaged", "wires.toml"]


def test_the_readme_says_what_works(exports, run_commands, installed, tmp_path, compile_c):
    """Its lines compile, its C compiles, and its table names every file."""
    folder = Path(shutil.copytree(exports[0], tmp_path / "c"))
    text = (folder / "README.md").read_text()
    printed = "".join(
        run_commands(lines, folder, installed("all")) for lines in re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    )
    assert "golden vectors, 0 wrong numbers" in printed
    assert (folder / "host_example").exists()
    (lines,) = re.findall(r"```c\n(.*?)```", text, re.DOTALL)
    include, body = lines.split("\n\n")
    (folder / "call.c").write_text(
        f"{include}\nint main(void)\n{{\n{body}return (flags & ISOCHARGE_OUTSIDE) || !(contact[2] > 0);\n}}\n"
    )
    program = compile_c("gcc", folder, folder / "call", "call.c", "isocharge_model.c")
    assert finished([program]).returncode == 0
    for path in exports[0].iterdir():
        assert path.stem in text or path.name == "README.md"
    assert "| the numbers of the signal chain, the defaults, because no device file was given |" in text


@pytest.fixture(scope="module")
def host(tmp_path_factory, compile_c):
    """The host example for a board with a leak, compiled with sanitizers, and its board."""
    folder = tmp_path_factory.mktemp("host")
    (folder / "board.toml").write_text(BOARD)
    board = load_device(folder / "board.toml")
    export = export_c(find_model(MODEL), folder / "c", board)
    options = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    return compile_c("gcc", export, folder / "host", *EXAMPLE, options=options), board


def played(program, path, *words):
    """Exit code, records and stderr of the host example."""
    done = finished([program, path, *map(str, words)], timeout=60)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()], done.stderr


def check_records(records, expected):
    """Lines of the host example against our records."""
    for theirs, mine in zip(records, expected, strict=True):
        flags = [word for word in mine.flags if word not in ONLY_PYTHON]
        assert (theirs["seq"], theirs["t_device_us"], theirs["contact"]) == (mine.seq, mine.t_device_us, mine.contact)
        assert sorted(theirs["flags"]) == sorted(flags)
        for name in Contact._fields[:7]:
            value = getattr(mine, name)
            assert theirs[name] == (None if value is None else pytest.approx(value, rel=1e-4, abs=1e-4))


def test_a_recording_gives_our_records_frame_by_frame(host, film, tmp_path):
    """Bytes of a virtual board with a leak, drift, lost frames and damaged bytes, in C and in Python."""
    program, board = host
    amplifier = load_amplifier("bench").start(3, 400.0, np.random.default_rng(0))
    play = wander(seed=1, seconds=6.0, rate_Hz=400.0, force_range_N=(0.05, 0.5))
    faults = Faults(corrupt_share=0.0005, lose_share=0.01)
    sensor = VirtualSensor(film.charges, play, noise=lambda q, _: amplifier(q), faults=faults)
    data = b"".join(islice(sensor.frames(), 2400))
    expected = list(TouchStream(Predictor(MODEL), board).feed(Chunk(data, 0.0, 0)))
    (tmp_path / "frames.bin").write_bytes(data)
    code, records, err = played(program, tmp_path / "frames.bin")
    assert (code, err) == (0, "")
    check_records(records, expected)
    assert sum(record["contact"] for record in records) > 100


def test_host_example_says_what_is_wrong(host, tmp_path):
    program, _ = host
    (tmp_path / "text").write_text("801.2,799.5,803.3\n" * 1000)
    (tmp_path / "four").write_bytes(b"".join(encode_frame(Frame(k, 5000 * k, (1.0,) * 4)) for k in range(3)))
    noisy = np.random.default_rng(0).normal(0.0, 100.0, (2500, 3))
    (tmp_path / "noisy").write_bytes(b"".join(encode_frame(Frame(k, 5000 * k, tuple(q))) for k, q in enumerate(noisy)))
    for name, message in [
        ("text", "no intact frame came"),
        ("four", "expected 3 charges, as the model three-25um-biaxial-student/1 has electrodes; frame 0 has 4"),
        ("noisy", "cannot tare"),
        ("missing", "No such file"),
    ]:
        code, _, err = played(program, tmp_path / name)
        assert (code, message in err) == (1, True), err
    assert played(program, tmp_path / "noisy", 1, 2)[0] == 2


needs_compiler_of_sketches = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")


def run_sketch(export, folder, pins, *options, start_us=0):
    """What the sketch sends, compiled with a host's Arduino, while its pins read these counts from `start_us` on."""
    objects = []
    for source in sorted(export.glob("*.c")):
        objects.append(folder / f"{source.stem}.o")
        subprocess.run(["gcc", "-std=c11", "-c", source, "-o", objects[-1]], check=True)
    ino = f'-DSKETCH="{export / "isocharge_sketch.ino"}"'
    words = ["g++", "-Wall", "-Wextra", "-Werror", *options, ino, "-I", export, "-I", HERE / "board"]
    subprocess.run([*words, HERE / "board/run_sketch.cpp", *objects, "-o", folder / "sketch"], check=True)
    lines = "".join(f"{start_us + 5000 * (k + 1)} {' '.join(map(str, row))}\n" for k, row in enumerate(pins.tolist()))
    return subprocess.run([folder / "sketch"], input=lines.encode(), capture_output=True, check=True).stdout


@needs_compiler_of_sketches
def test_sketch_prints_our_contacts_and_sends_frames_that_we_read(exports, tmp_path):
    """Rest, a press of some hundred counts, rest."""
    export = exports[0] / "arduino/isocharge_sketch"
    pins = np.random.default_rng(1).normal(20.0, 1.0, (900, 3))
    pins[400:600] += [700.0, 750.0, 800.0]
    pins = pins.astype(int)
    printed = run_sketch(export, tmp_path, pins).decode()
    data = b"".join(encode_frame(Frame(k, 5000 * (k + 1), tuple(map(float, row)))) for k, row in enumerate(pins))
    records = TouchStream(Predictor(MODEL), device_from_table({}, "x")).feed(Chunk(data, 0.0, 0))
    expected = [record.force_N for record in records if record.contact]
    assert len(expected) > 150
    np.testing.assert_allclose([float(force) for force in re.findall(r">force_N:(\S+)", printed)], expected, atol=1e-3)
    frames = BinaryParser().feed(run_sketch(export, tmp_path, pins, "-DSEND_FRAMES=1"))
    assert [frame.values for frame in frames] == [tuple(map(float, row)) for row in pins.tolist()]
    assert [frame.t_us for frame in frames[:2]] == [5000, 10000]


@needs_compiler_of_sketches
def test_clock_of_a_board_that_begins_again_leaves_the_hum_removed(tmp_path):
    """After 71.6 minutes, `micros` is 0 again. A hum with another phase would look like touches."""
    device = device_from_table({"hum": {"frequency_Hz": 50.0}}, "x")
    export = export_c(find_model(MODEL), tmp_path / "c", device) / "arduino/isocharge_sketch"
    times_s = 0.005 * np.arange(2000)
    hum = 40.0 * np.sin(2.0 * np.pi * (50.0 * times_s + 0.1))
    pins = np.random.default_rng(1).normal(20.0, 1.0, (2000, 3)) + hum[:, None]
    printed = run_sketch(export, tmp_path, np.round(pins).astype(int), start_us=2**32 - 5_000_000)
    assert b"force_N" not in printed
