"""The commands as a user and a script meet them: data on stdout, words on stderr, a clean end."""

import csv
import json
import re
import signal
import socket
import threading
import time
from functools import partial

import numpy as np
import pytest
from typer.testing import CliRunner

from isocharge.cli.serve.app import serve_app
from isocharge.errors import ChargeError, InputError, ModelError, OutputExists, PortError, PortLost, SensorError
from isocharge.serve import BinaryParser, Port, Script, VirtualSensor, wander
from isocharge.serve.virtual_sensor.pseudo_port import PseudoPort
from isocharge.simulate import Circle, ForwardMap, load_sensor, virtual_film


@pytest.fixture
def presses(tmp_path, film):
    """A CSV of two presses, columns not in the model's order."""
    path = tmp_path / "presses.csv"
    a, b, c = film.charge_pC([1.0, -2.0], [0.5, 3.0], [1.0, 0.25]).T
    path.write_text("C,A,B\n" + "".join(f"{k:.9g},{i:.9g},{j:.9g}\n" for i, j, k in zip(a, b, c, strict=True)))
    return path


def run(*arguments, stdin=None):
    """A command in this process; an error of ours is raised."""
    result = CliRunner().invoke(serve_app, [str(a) for a in arguments], input=stdin)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture
def start(start_command):
    return partial(start_command, "serve")


@pytest.fixture
def sensor(film):
    with VirtualSensor(film.charge_pC, wander(seed=2, seconds=20.0)) as sensor:
        yield sensor


@pytest.mark.parametrize("command", ["predict", "check", "stream", "virtual", "replay", "plot", "doctor"])
def test_help_has_an_example(command):
    text = run(command, "--help").stdout
    assert f"Example: isocharge serve {command} " in " ".join(text.split())


def test_predict_to_csv(presses, models):
    result = run("predict", "linear", presses, "--models", models)
    lines = result.stdout.splitlines()
    assert lines[0] == "x_mm,y_mm,force_N,x_std_mm,y_std_mm,force_std_N,misfit,flags"
    contacts = np.loadtxt(lines[1:], delimiter=",", usecols=(0, 1, 2))
    np.testing.assert_allclose(contacts, [[1, 0.5, 1], [-2, 3, 0.25]], atol=5e-6)
    assert (result.exit_code, result.stderr) == (0, "")


def test_predict_to_csv_tells_what_not_to_trust(models):
    text = "A,B,C\n800,800,800\n9e9,9e9,9e9\n2000,2000,2000\n2700,-9,2700\n"
    rows = list(csv.DictReader(run("predict", "linear", "-", "--models", models, stdin=text).stdout.splitlines()))
    assert [row["flags"] for row in rows] == ["", "outside beyond", "outside", "outside misfit"]


def test_predict_to_records(presses, models):
    records = [
        json.loads(line) for line in run("predict", "linear", presses, "--json", "--models", models).stdout.splitlines()
    ]
    assert [(round(r["x_mm"], 4), r["contact"], r["timestamp"], r["model"]) for r in records] == [
        (1.0, True, None, "linear/1"),
        (-2.0, True, None, "linear/1"),
    ]


def test_predict_from_a_file_of_measured_presses(presses, models):
    """Its further columns cost a word on stderr."""
    expected = run("predict", "linear", presses, "--models", models).stdout
    header, *rows = presses.read_text().splitlines()
    presses.write_text("\n".join(["x_mm,y_mm,force_N," + header, *(f"1,,2,{row}" for row in rows)]))
    result = run("predict", "linear", presses, "--models", models)
    assert result.stdout == expected
    assert result.stderr == f"{presses}: ignored columns: ['x_mm', 'y_mm', 'force_N']\n"


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte order mark"])
def test_predict_from_stdin(presses, models, mark):
    expected = run("predict", "linear", presses, "--models", models).stdout
    text = mark + presses.read_bytes().replace(b"\n", b"\r\n") + b"\r\n"
    assert run("predict", "linear", "-", "--models", models, stdin=text).stdout == expected


@pytest.mark.parametrize(
    ("model", "text", "error", "said"),
    [
        ("linear", "A,B\n1,2\n", ChargeError, "stdin: expected a header with one column for each .*missing: 'C'"),
        ("linear", "A,B,C\n1,2,\n", ChargeError, "stdin, line 2, column 'C'"),
        ("linear", "", ChargeError, "stdin: empty"),
        ("cubic", "A,B,C\n", ModelError, "no model 'cubic'"),
    ],
)
def test_predict_refuses_with_the_reason(models, model, text, error, said):
    with pytest.raises(error, match=said):
        run("predict", model, "-", "--models", models, stdin=text)


@pytest.mark.parametrize("file", ["nowhere.csv", "."])
def test_predict_without_a_file(models, file):
    with pytest.raises(InputError, match=r"cannot be read .*expected a CSV file, or - for stdin"):
        run("predict", "linear", file, "--models", models)


@pytest.fixture
def measured(tmp_path, film):
    """Write presses of the linear film, their forces read on a scale with an error of its own."""

    def write(*, scale=1.0, count=6, known="x_mm,y_mm,force_N"):
        rng = np.random.default_rng(1)
        x, y, force = rng.uniform(-4, 4, count), rng.uniform(-4, 4, count), rng.uniform(0.2, 1.5, count)
        values = dict(zip(("x_mm", "y_mm", "force_N"), (x, y, scale * force), strict=True))
        table = np.column_stack([*(values[name] for name in known.split(",")), film.charge_pC(x, y, force)])
        path = tmp_path / "measured.csv"
        path.write_text(f"{known},A,B,C,day\n" + "".join(",".join(map(repr, row)) + ",1\n" for row in table.tolist()))
        return path

    return write


def test_check_of_a_film_that_fits(measured, models, command):
    path = measured()
    code, out, err = command("serve", "check", "linear", path, "--models", models)
    assert (code, err) == (0, f"{path}: ignored columns: ['day']\n")
    lines = out.splitlines()
    assert lines[0].split() == ["line", "x,", "mm", "y,", "mm", "force,", "N", "off,", "mm", "off,", "%", "flags"]
    assert [line.split()[0] for line in lines[1:7]] == list("234567")
    assert lines[-1] == "fits: noise explains the errors"


def test_check_of_a_film_that_does_not_fit(measured, models, command):
    code, out, _ = command("serve", "check", "linear", measured(scale=0.9), "--models", models)
    assert code == 1
    assert "does not fit: 0 mm and 11 % beyond noise: calibrate the film again" in out
    assert "forces are 1.111 +- 0.0041 times the known ones" in out


def test_check_takes_the_rig_s_uncertainty(measured, models, command):
    words = ["serve", "check", "linear", measured(scale=0.97), "--models", models, "--json"]
    assert [command(*words, "--force-std", share)[0] for share in (0.01, 0.05)] == [1, 0]
    values = json.loads(command(*words, "--position-std", "0.4", "--force-std", "0.05")[1])
    assert values["position_mm"]["rig"] == pytest.approx(0.4 * 2**0.5)
    assert values["force_percent"]["rig"] == pytest.approx(5.0)
    assert values["force_percent"]["rms"] == pytest.approx(100 * (1 / 0.97 - 1), rel=1e-3)
    assert values["model"] == "linear/1"


def test_check_of_many_presses_shows_the_worst(measured, models, command):
    _, out, _ = command("serve", "check", "linear", measured(count=100, known="force_N"), "--models", models)
    assert out.startswith("the 40 worst of 100 presses; --json has all\n")
    assert out.splitlines()[2].split()[-2] == "-"
    assert "position" not in out


@pytest.mark.parametrize("count", [1, 2])
def test_check_of_too_few_presses(measured, models, command, count):
    code, out, _ = command("serve", "check", "linear", measured(count=count), "--models", models)
    assert (code, "too few presses to say" in out) == (1, True)


@pytest.mark.parametrize(
    ("text", "words", "said"),
    [
        ("x_mm,y_mm,A,B\n1,2,3,4\n", [], "PressError: .*missing: 'C'"),
        ("x_mm,y_mm,A,B,C\n", [], "PressError: .*expected one press or more"),
        ("force_N,A,B,C\n1,2,3,4\n", ["--force-std", "0"], "PressError: force_std: expected a positive share"),
        ("force_N,A,B,C\n1,2,3,4\n", ["--position-std", "nan"], "PressError: position_std_mm: expected a positive"),
        (None, [], "PressError: .*cannot be read"),
    ],
)
def test_check_refuses_with_the_reason(tmp_path, models, command, text, words, said):
    path = tmp_path / "measured.csv"
    if text is not None:
        path.write_text(text)
    code, out, err = command("serve", "check", "linear", path, "--models", models, *words)
    assert (code, out) == (2, "")
    assert re.match(said, err)


def test_stream_counts_records(sensor, models):
    result = run("stream", "linear", "--port", sensor.url, "--count", 150, "--models", models)
    records = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(records) == 150
    assert [r["seq"] for r in records] == list(range(records[0]["seq"], records[0]["seq"] + 150))
    assert "taring, leave the film alone" in result.stderr
    assert "tared: A " in result.stderr
    assert "0 lost, 0 repeated, 0 restarts; 0 CRC errors, 0 malformed" in result.stderr.splitlines()[-1]
    assert "p50" in result.stderr.splitlines()[-1]


def test_stream_for_some_seconds(sensor, models):
    result = run("stream", "linear", "--port", sensor.url, "--seconds", 0.5, "--models", models)
    assert 50 < len(result.stdout.splitlines()) < 300


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stream_ends_cleanly_when_told_to(sensor, models, start, number):
    process = start("stream", "linear", "--port", sensor.url, "--models", models)
    json.loads(process.stdout.readline())
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0
    assert "Traceback" not in err
    assert " frames, 0 lost" in err.splitlines()[-1]
    assert all(json.loads(line) for line in out.splitlines())


def test_stream_ends_cleanly_when_the_pipe_closes(sensor, models, start):
    process = start("stream", "linear", "--port", sensor.url, "--models", models)
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=20) == 0
    assert "Error" not in process.stderr.read()


def test_stream_without_a_port(models):
    with pytest.raises(PortError, match="/dev/ttyNone: cannot be opened"):
        run("stream", "linear", "--port", "/dev/ttyNone", "--models", models)


def test_stream_of_a_port_that_vanishes(film, models, start):
    with VirtualSensor(film.charge_pC, wander(seed=2)) as sensor:
        process = start("stream", "linear", "--port", sensor.url, "--models", models, "--no-reconnect")
        process.stdout.readline()
    _, err = process.communicate(timeout=20)
    assert process.returncode == 1
    assert PortLost.__name__ in err
    assert " frames, 0 lost" in err


def test_virtual_sensor_plays_and_cleans_up(start, tmp_path):
    link = tmp_path / "film"
    process = start("virtual", "three-25um-biaxial", "--link", link, "--noise", "clean", "--force-max", "0.5")
    url = process.stdout.readline().strip()
    assert str(link.readlink()) == url
    parser, frames = BinaryParser(), []
    with Port(str(link)) as port:
        for chunk in port:
            frames += parser.feed(chunk.data)
            if len(frames) > 300:
                break
    assert {len(frame.values) for frame in frames} == {3}
    assert max(sum(frame.values) for frame in frames) > 300.0
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert (process.returncode, link.is_symlink()) == (0, False)
    assert "frames sent, " in err.splitlines()[-1]


def test_virtual_sensor_for_a_time(start):
    process = start("virtual", "three-25um-biaxial", "--seconds", "0.3", "--rate-Hz", "100")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out.startswith("/dev/")) == (0, True)
    assert 25 < int(err.splitlines()[-1].split()[0]) < 100


def test_virtual_sensor_does_not_overwrite(tmp_path):
    taken = tmp_path / "film"
    taken.write_text("mine")
    with pytest.raises(OutputExists, match="film: the path exists already"):
        run("virtual", "three-25um-biaxial", "--link", taken, "--seconds", "0")
    assert taken.read_text() == "mine"


def test_virtual_sensor_that_is_unknown():
    with pytest.raises(SensorError):
        run("virtual", "five-25um-biaxial")


def test_stream_to_csv_and_udp(sensor, models):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5.0)
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        words = ["--output", "csv", "--udp", address, "--count", 120, "--models", models]
        result = run("stream", "linear", "--port", sensor.url, *words)
        datagrams = [json.loads(listener.recv(65536)) for _ in range(120)]
    rows = list(csv.DictReader(result.stdout.splitlines()))
    assert [int(row["seq"]) for row in rows] == [datagram["seq"] for datagram in datagrams]
    assert float(rows[-1]["charge_pC.A"]) == pytest.approx(datagrams[-1]["charge_pC"]["A"], abs=1e-6)


def test_stream_of_nothing_ends_in_time(models):
    """Also where no record ever comes."""
    silent = PseudoPort()
    result = run("stream", "linear", "--port", silent.url, "--seconds", 0.3, "--models", models)
    silent.close()
    assert (result.exit_code, result.stdout) == (0, "")


def test_record_and_replay(sensor, models, tmp_path):
    path = tmp_path / "touch.rec"
    words = ["--record", path, "--count", 300, "--offset-limit-pC", 90, "--models", models]
    streamed = run("stream", "linear", "--port", sensor.url, *words)
    replayed = run("replay", path, "--models", models)
    assert len(streamed.stdout.splitlines()) == 300
    assert replayed.stdout == streamed.stdout
    assert " frames, 0 lost" in replayed.stderr
    began = time.monotonic()
    assert run("replay", path, "--real-time", "--models", models).stdout == streamed.stdout
    assert time.monotonic() - began > 1.2  # 300 frames at 200 Hz


@pytest.mark.parametrize(("number", "unwritten"), [(signal.SIGINT, 0), (signal.SIGKILL, 30)])
def test_a_recording_that_was_interrupted_is_readable(sensor, models, start, tmp_path, number, unwritten):
    """A kill leaves out the records of the chunk that was being made; Ctrl-C leaves out none that was printed."""
    path = tmp_path / "touch.rec"
    process = start("stream", "linear", "--port", sensor.url, "--record", path, "--models", models)
    lines = [process.stdout.readline() for _ in range(150)]
    process.send_signal(number)
    lines += process.communicate(timeout=20)[0].splitlines(keepends=True)
    replayed = run("replay", path, "--models", models).stdout.splitlines(keepends=True)
    assert len(replayed) >= 150 - unwritten
    common = min(len(replayed), len(lines) - 1)  # the last line that was printed may have been cut
    assert replayed[:common] == lines[:common]
    assert unwritten or len(replayed) >= len(lines) - 1


def test_a_new_tare_is_asked_for_by_a_signal(film, models, start):
    with VirtualSensor(film.charge_pC, rest(seconds=60.0), offset_pC=[5.0, 6.0, 7.0]) as sensor:
        process = start("stream", "linear", "--port", sensor.url, "--models", models)
        records = (json.loads(process.stdout.readline()) for _ in range(600))
        next(record for record in records if record["tare_pC"])
        process.send_signal(signal.SIGUSR1)
        flags = [record["flags"] for record in records]
    assert ["tare"] in flags
    assert flags[-1] == []


def rest(seconds, rate_Hz=200.0):
    """Nothing touches but at the very end."""
    n = round(seconds * rate_Hz)
    return Script(np.zeros(n), np.zeros(n), np.where(np.arange(n) < n - 1, 0.0, 1.0), rate_Hz)


def test_doctor_in_words(film, models):
    hum = lambda q, rng: q + rng.normal(0.0, 0.3, q.shape)  # noqa: E731
    with VirtualSensor(film.charge_pC, rest(60.0), noise=hum, offset_pC=[5.0, -6.0, 150.0]) as sensor:
        result = run("doctor", "--port", sensor.url, "--seconds", 1.5, "--model", "linear", "--models", models)
    assert "at 115200 baud: binary frames of isocharge" in result.stdout
    assert "0 bad pieces" in result.stdout
    assert "0 lost, 0 repeated; a device clock" in result.stdout
    assert "rest near zero on channel 3: 150 pC" in result.stdout
    assert "the amplifier's time constants" in result.stdout


def test_doctor_as_json(film):
    with VirtualSensor(film.charge_pC, rest(60.0), offset_pC=[5.0, -6.0, 7.0]) as sensor:
        found = json.loads(run("doctor", "--port", sensor.url, "--seconds", 1.0, "--json").stdout)
    assert found["rate_Hz"] == pytest.approx(200.0, rel=0.02)
    assert [round(channel["offset_pC"], 3) for channel in found["channels"]] == [5.0, -6.0, 7.0]


def test_doctor_fails_where_nothing_is_recognised(command):
    silent = PseudoPort()
    code, out, _ = command("serve", "doctor", "--port", silent.url, "--seconds", 0.5)
    silent.close()
    assert (code, "not one byte came" in out) == (1, True)


def test_doctor_writes_a_file_that_works(film, models, command, tmp_path):
    path = tmp_path / "board.toml"
    encode = lambda frame: b"%d;" % frame.seq + b";".join(b"%.3f" % q for q in frame.values) + b"\n"  # noqa: E731
    noise = lambda q, rng: q + rng.normal(0.0, 0.3, q.shape)  # noqa: E731
    with VirtualSensor(film.charge_pC, rest(60.0), noise=noise, encode=encode) as sensor:
        words = ["--port", sensor.url, "--seconds", 1, "--model", "linear", "--models", models]
        code, _, err = command("serve", "doctor", *words, "--write", path)
        assert (code, f"{path} written" in err) == (0, True)
        again, _, err = command("serve", "doctor", *words, "--write", path)
        assert (again, "not overwritten" in err) == (1, True)
        streamed = run("stream", "linear", "--port", sensor.url, "--device", path, "--count", 150, "--models", models)
    assert 'columns = ["seq", "ch1", "ch2", "ch3"]' in path.read_text()
    records = [json.loads(line) for line in streamed.stdout.splitlines()]
    assert records[-1]["tare_pC"] is not None
    assert records[-1]["seq"] - records[0]["seq"] == 149


def test_doctor_waits_for_its_port(film, command, tmp_path):
    link = tmp_path / "film"
    with VirtualSensor(film.charge_pC, rest(60.0)) as sensor:
        plugging = threading.Timer(0.3, link.symlink_to, (sensor.url,))
        plugging.start()
        code, out, _ = command("serve", "doctor", "--port", link, "--wait", 10, "--seconds", 0.5)
        plugging.join()
    assert (code, "binary frames of isocharge" in out) == (0, True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--pC-per-unit", "much"], "--pC-per-unit: expected a number like 0.0457, or A=0.0457,B=-0.0457, got 'much'"),
        (["--pC-per-unit", "A=1,B"], "--pC-per-unit: expected a number"),
        (["--request", ""], "--request: expected at least one byte"),
        (["--request", r"\x1"], "--request: expected a text like"),
        (["--write", "/proc/none/board.toml"], "--write /proc/none/board.toml: cannot be written"),
    ],
)
def test_doctor_refuses_with_the_reason(film, command, words, said):
    with VirtualSensor(film.charge_pC, rest(60.0)) as sensor:
        code, _, err = command("serve", "doctor", "--port", sensor.url, "--seconds", 0.5, *words)
    assert (code, said in err) == (2, True), err


def test_scripted_presses_as_text_are_felt(start, tmp_path):
    link = tmp_path / "film"
    script = tmp_path / "presses.csv"
    script.write_text("seconds,x_mm,y_mm,force_N\n0,0,0,0\n1.2,0,0,0\n1.3,1,2,0.5\n9,1,2,0.5\n")
    words = ["--link", link, "--frames", "teleplot", "--script", script, "--force-max", "0.5", "--noise", "clean"]
    process = start("virtual", "three-25um-biaxial", *words)
    process.stdout.readline()
    result = run("stream", "three-25um-biaxial", "--port", link, "--count", 400)
    last = json.loads(result.stdout.splitlines()[-1])
    assert (last["x_mm"], last["y_mm"], last["force_N"]) == pytest.approx((1.0, 2.0, 0.5), abs=0.05)


def test_presses_beyond_the_usual_radius(start, tmp_path):
    """A script may go as far as it says."""
    link, script = tmp_path / "film", tmp_path / "presses.csv"
    script.write_text("seconds,x_mm,y_mm,force_N\n0,14,0,0\n1.2,14,0,0\n1.3,14,0,0.5\n9,14,0,0.5\n")
    model, words = "four-25um-biaxial-15mm", ["--link", link, "--force-max", "0.5", "--noise", "clean"]
    process = start("virtual", model, "--script", script, *words)
    process.stdout.readline()
    last = json.loads(run("stream", model, "--port", link, "--count", 300).stdout.splitlines()[-1])
    assert (last["x_mm"], last["y_mm"], last["force_N"]) == pytest.approx((14.0, 0.0, 0.5), abs=0.1)


@pytest.mark.parametrize(
    ("words", "radius_mm"), [((), 8.0), (("--radius", 15), 15.0), (("--script", "far.csv"), 13.0), (("--film", 1), 8.0)]
)
def test_a_virtual_film_is_solved_as_far_as_it_is_pressed(tmp_path, monkeypatch, words, radius_mm):
    def build(*_, radius, **__):
        raise InputError(f"asked for {radius:.6f} m")

    (tmp_path / "far.csv").write_text("seconds,x_mm,y_mm,force_N\n0,5,12,0\n1,5,12,0\n2,5,12,1\n3,5,12,1\n4,5,12,0\n")
    monkeypatch.setattr(ForwardMap, "build", build)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=f"asked for {1e-3 * radius_mm:.6f} m"):
        run("virtual", "four-25um-biaxial-15mm", *words)


HELD = "seconds,x_mm,y_mm,force_N\n0,0,0,0\n0.5,0,0,0\n0.501,1,2,0.5\n60,1,2,0.5\n"
"""A script: half a second without touch, then one press that is held."""


def held_charge_pC(start, folder, sensor, film):
    """The touch charges of HELD that the command plays, pC, and what it says on stderr."""
    link, script = folder / f"film{film}", folder / "held.csv"
    script.write_text(HELD)
    words = ["--link", link, "--script", script, "--force-max", "0.5", "--noise", "clean", "--film", film]
    process = start("virtual", sensor, *words)
    process.stdout.readline()
    parser, frames = BinaryParser(), []
    with Port(str(link)) as port:
        for chunk in port:
            frames += parser.feed(chunk.data)
            if len(frames) > 250:
                break
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    values = np.array([frame.values for frame in frames])
    rest = values[values.sum(axis=1) < values.sum(axis=1).mean()]
    return values[-1] - rest[0], err


def charge_of_film_pC(sensor, seed):
    """The same from a forward map of the film that the seed draws."""
    film, probe = virtual_film(load_sensor(sensor), Circle(1e-3), seed)
    forward_map = ForwardMap.build(film, probe, 3e-3, (0.2, 0.5))
    return 1e12 * forward_map.forward(np.array([1e-3]), np.array([2e-3]), np.array([0.5]))[0]


def test_virtual_film_plays_the_charges_of_its_film_and_does_not_tell_it(start, tmp_path):
    """Seed 9 draws a rather slack film, which is solved in the shortest time."""
    sensor = "three-25um-biaxial"
    charge_pC, err = held_charge_pC(start, tmp_path, sensor, 9)
    np.testing.assert_allclose(charge_pC, charge_of_film_pC(sensor, 9), rtol=2e-3)
    described = ForwardMap.build(load_sensor(sensor), Circle(1e-3), 3e-3, (0.2, 0.5))
    described_pC = 1e12 * described.forward(np.array([1e-3]), np.array([2e-3]), np.array([0.5]))[0]
    assert np.abs(charge_pC / described_pC - 1.0).max() > 0.02
    first, last = err.splitlines()
    assert first == "playing film 9 of three-25um-biaxial at 200 Hz; Ctrl-C stops"
    assert re.fullmatch(r"\d+ frames sent, \d+ withheld because no program read them, 0 lost and 0 .*", last)


@pytest.mark.slow
def test_a_seed_is_a_film(start, tmp_path):
    sensor = "four-25um-biaxial"
    charges = []
    for run_number, film in enumerate((3, 3, 4)):
        folder = tmp_path / str(run_number)
        folder.mkdir()
        charges.append(held_charge_pC(start, folder, sensor, film)[0])
        np.testing.assert_allclose(charges[-1], charge_of_film_pC(sensor, film), rtol=2e-3)
    np.testing.assert_array_equal(charges[0], charges[1])
    assert np.abs(charges[2] / charges[0] - 1.0).max() > 0.05


def test_virtual_film_of_a_seed_is_one_draw(monkeypatch):
    """What the command solves: the same for the same seed, another for another, the described without one."""
    solved = []

    def build(sensor, probe, **_):
        solved.append((sensor, probe))
        raise InputError("not solved in this test")

    monkeypatch.setattr(ForwardMap, "build", build)
    for words in ((), ("--film", 3), ("--film", 3, "--seed", 8), ("--film", 4)):
        with pytest.raises(InputError, match="not solved"):
            run("virtual", "four-25um-biaxial", "--probe", "circle:1.5", *words)
    described = load_sensor("four-25um-biaxial"), Circle(1.5e-3)
    assert solved[0] == described
    assert solved[1] == solved[2] == virtual_film(*described, 3)
    assert solved[3] == virtual_film(*described, 4) != solved[1]


@pytest.mark.parametrize("probe", ["rectangle:4x2", "triangle:4"])
def test_virtual_film_needs_a_round_probe(probe):
    with pytest.raises(InputError, match=f"--film: expected a round --probe like circle:1.0.*got '{probe}'"):
        run("virtual", "three-25um-biaxial", "--film", 1, "--probe", probe)


def test_virtual_sensor_of_described_frames_with_faults(start, tmp_path):
    link, device = tmp_path / "film", tmp_path / "board.toml"
    device.write_text(
        '[frames]\nformat = "described"\nsync = "AA 55"\nlength = 14\nchecksum = "crc-16/x-25"\nfields = [\n'
        '{name = "seq", type = "u16"}, {name = "t_ms", type = "u16"},\n'
        '{name = "A", type = "i16", scale = 0.1}, {name = "B", type = "i16", scale = 0.1},'
        '{name = "C", type = "i16", scale = 0.1}]\n'
    )
    words = ["--link", link, "--device", device, "--lose", "0.05", "--corrupt", "0.001", "--force-max", "0.5"]
    process = start("virtual", "three-25um-biaxial", *words, "--unplug-every", "1.4")
    process.stdout.readline()
    result = run("stream", "three-25um-biaxial", "--port", link, "--device", device, "--seconds", 3)
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    came_back = sum("reconnected" in line["flags"] for line in lines)
    assert 1 <= came_back <= 2
    assert f"{came_back} reconnects" in result.stderr.splitlines()[-1]
    assert any("gap" in line["flags"] for line in lines)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert "damaged on purpose" in err.splitlines()[-1]
    assert not link.is_symlink()
