"""The commands as a user and a script meet them: data on stdout, words on stderr, a clean end."""

import csv
import json
import re
import signal
import socket
import threading
import time

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, InputError, ModelError, PortError, PortLost
from isocharge.serve import Script, VirtualSensor, wander
from isocharge.serve.virtual_sensor.pseudo_port import PseudoPort


@pytest.mark.parametrize("command", ["predict", "check", "stream", "virtual", "replay", "plot", "doctor"])
def test_help_has_an_example(command, run):
    text = run(command, "--help").stdout
    assert f"Example: isocharge serve {command} " in " ".join(text.split())


def test_predict_to_csv(presses, models, run):
    result = run("predict", "linear", presses, "--models", models)
    lines = result.stdout.splitlines()
    assert lines[0] == "x_mm,y_mm,force_N,x_std_mm,y_std_mm,force_std_N,misfit,flags"
    contacts = np.loadtxt(lines[1:], delimiter=",", usecols=(0, 1, 2))
    np.testing.assert_allclose(contacts, [[1, 0.5, 1], [-2, 3, 0.25]], atol=5e-6)
    assert (result.exit_code, result.stderr) == (0, "")


def test_predict_to_csv_tells_what_not_to_trust(models, run):
    text = "A,B,C\n800,800,800\n9e9,9e9,9e9\n2000,2000,2000\n2700,-9,2700\n"
    rows = list(csv.DictReader(run("predict", "linear", "-", "--models", models, stdin=text).stdout.splitlines()))
    assert [row["flags"] for row in rows] == ["", "outside beyond", "outside", "outside misfit"]


def test_predict_to_records(presses, models, run):
    records = [
        json.loads(line) for line in run("predict", "linear", presses, "--json", "--models", models).stdout.splitlines()
    ]
    assert [(round(r["x_mm"], 4), r["contact"], r["timestamp"], r["model"]) for r in records] == [
        (1.0, True, None, "linear/1"),
        (-2.0, True, None, "linear/1"),
    ]


def test_predict_from_a_file_of_measured_presses(presses, models, run):
    """Its further columns cost a word on stderr."""
    expected = run("predict", "linear", presses, "--models", models).stdout
    header, *rows = presses.read_text().splitlines()
    presses.write_text("\n".join(["x_mm,y_mm,force_N," + header, *(f"1,,2,{row}" for row in rows)]))
    result = run("predict", "linear", presses, "--models", models)
    assert result.stdout == expected
    assert result.stderr == f"{presses}: ignored columns: ['x_mm', 'y_mm', 'force_N']\n"


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte order mark"])
def test_predict_from_stdin(presses, models, mark, run):
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
def test_predict_refuses_with_the_reason(models, model, text, error, said, run):
    with pytest.raises(error, match=said):
        run("predict", model, "-", "--models", models, stdin=text)


@pytest.mark.parametrize("file", ["nowhere.csv", "."])
def test_predict_without_a_file(models, file, run):
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


def test_stream_counts_records(sensor, models, run):
    result = run("stream", "linear", "--port", sensor.url, "--count", 150, "--models", models)
    records = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(records) == 150
    assert [r["seq"] for r in records] == list(range(records[0]["seq"], records[0]["seq"] + 150))
    assert "taring, leave the film alone" in result.stderr
    assert "tared: A " in result.stderr
    assert "0 lost, 0 repeated, 0 restarts; 0 CRC errors, 0 malformed" in result.stderr.splitlines()[-1]
    assert "p50" in result.stderr.splitlines()[-1]


def test_stream_for_some_seconds(sensor, models, run):
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


def test_stream_without_a_port(models, run):
    with pytest.raises(PortError, match="/dev/ttyNone: cannot be opened"):
        run("stream", "linear", "--port", "/dev/ttyNone", "--models", models)


def test_stream_of_a_port_that_vanishes(film, models, start):
    with VirtualSensor(film.charges, wander(seed=2)) as sensor:
        process = start("stream", "linear", "--port", sensor.url, "--models", models, "--no-reconnect")
        process.stdout.readline()
    _, err = process.communicate(timeout=20)
    assert process.returncode == 1
    assert PortLost.__name__ in err
    assert " frames, 0 lost" in err


def test_stream_to_csv_and_udp(sensor, models, run):
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


def test_stream_of_nothing_ends_in_time(models, run):
    """Also where no record ever comes."""
    silent = PseudoPort()
    result = run("stream", "linear", "--port", silent.url, "--seconds", 0.3, "--models", models)
    silent.close()
    assert (result.exit_code, result.stdout) == (0, "")


def test_record_and_replay(sensor, models, tmp_path, run):
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
def test_a_recording_that_was_interrupted_is_readable(sensor, models, start, tmp_path, number, unwritten, run):
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
    with VirtualSensor(film.charges, rest(seconds=60.0), offset_pC=[5.0, 6.0, 7.0]) as sensor:
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


def test_doctor_in_words(film, models, run):
    hum = lambda q, rng: q + rng.normal(0.0, 0.3, q.shape)  # noqa: E731
    with VirtualSensor(film.charges, rest(60.0), noise=hum, offset_pC=[5.0, -6.0, 150.0]) as sensor:
        result = run("doctor", "--port", sensor.url, "--seconds", 1.5, "--model", "linear", "--models", models)
    assert "at 115200 baud: binary frames of isocharge" in result.stdout
    assert "0 bad pieces" in result.stdout
    assert "0 lost, 0 repeated; a device clock" in result.stdout
    assert "rest near zero on channel 3: 150 pC" in result.stdout
    assert "the amplifier's time constants" in result.stdout


def test_doctor_as_json(film, run):
    with VirtualSensor(film.charges, rest(60.0), offset_pC=[5.0, -6.0, 7.0]) as sensor:
        found = json.loads(run("doctor", "--port", sensor.url, "--seconds", 1.0, "--json").stdout)
    assert found["rate_Hz"] == pytest.approx(200.0, rel=0.02)
    assert [round(channel["offset_pC"], 3) for channel in found["channels"]] == [5.0, -6.0, 7.0]


def test_doctor_fails_where_nothing_is_recognised(command):
    silent = PseudoPort()
    code, out, _ = command("serve", "doctor", "--port", silent.url, "--seconds", 0.5)
    silent.close()
    assert (code, "not one byte came" in out) == (1, True)


def test_doctor_writes_a_file_that_works(film, models, command, tmp_path, run):
    path = tmp_path / "board.toml"
    encode = lambda frame: b"%d;" % frame.seq + b";".join(b"%.3f" % q for q in frame.values) + b"\n"  # noqa: E731
    noise = lambda q, rng: q + rng.normal(0.0, 0.3, q.shape)  # noqa: E731
    with VirtualSensor(film.charges, rest(60.0), noise=noise, encode=encode) as sensor:
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
    with VirtualSensor(film.charges, rest(60.0)) as sensor:
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
    with VirtualSensor(film.charges, rest(60.0)) as sensor:
        code, _, err = command("serve", "doctor", "--port", sensor.url, "--seconds", 0.5, *words)
    assert (code, said in err) == (2, True), err
