"""The commands as a user and a script meet them: data on stdout, words on stderr, a clean end."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from isocharge.cli.serve import serve_app
from isocharge.errors import ChargeError, InputError, ModelError, OutputExists, PortError, PortLost, SensorError
from isocharge.serve import BinaryParser, Port, VirtualSensor, wander

PROGRAM = [sys.executable, "-c", "from isocharge.cli.serve import serve_app; serve_app()"]


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
def start():
    """A command in a process of its own, ended with the test."""
    started = []

    def start(*arguments):
        process = subprocess.Popen(
            PROGRAM + [str(a) for a in arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def sensor(film):
    with VirtualSensor(film.charge_pC, wander(seed=2, seconds=20.0)) as sensor:
        yield sensor


@pytest.mark.parametrize("command", ["predict", "stream", "virtual"])
def test_help_has_an_example(command):
    text = run(command, "--help").stdout
    assert f"Example: isocharge serve {command} three-25um-biaxial" in " ".join(text.split())


def test_predict_to_csv(presses, models):
    result = run("predict", "linear", presses, "--models", models)
    lines = result.stdout.splitlines()
    assert lines[0] == "x_mm,y_mm,force_N,x_std_mm,y_std_mm,force_std_N,misfit"
    np.testing.assert_allclose(np.loadtxt(lines[1:], delimiter=",")[:, :3], [[1, 0.5, 1], [-2, 3, 0.25]], atol=5e-6)
    assert (result.exit_code, result.stderr) == (0, "")


def test_predict_to_records(presses, models):
    records = [
        json.loads(line) for line in run("predict", "linear", presses, "--json", "--models", models).stdout.splitlines()
    ]
    assert [(round(r["x_mm"], 4), r["contact"], r["timestamp"], r["model"]) for r in records] == [
        (1.0, True, None, "linear/1"),
        (-2.0, True, None, "linear/1"),
    ]


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte order mark"])
def test_predict_from_stdin(presses, models, mark):
    expected = run("predict", "linear", presses, "--models", models).stdout
    text = mark + presses.read_bytes().replace(b"\n", b"\r\n") + b"\r\n"
    assert run("predict", "linear", "-", "--models", models, stdin=text).stdout == expected


@pytest.mark.parametrize(
    ("model", "text", "error", "said"),
    [
        ("linear", "A,B\n1,2\n", ChargeError, "stdin: expected one column for each .*missing: 'C'"),
        ("linear", "A,B,C\n1,2,\n", ChargeError, "stdin, line 2: electrode 'C'"),
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
        process = start("stream", "linear", "--port", sensor.url, "--models", models)
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
    with pytest.raises(OutputExists, match="film: something is there already"):
        run("virtual", "three-25um-biaxial", "--link", taken, "--seconds", "0")
    assert taken.read_text() == "mine"


def test_virtual_sensor_that_is_unknown():
    with pytest.raises(SensorError):
        run("virtual", "five-25um-biaxial")
