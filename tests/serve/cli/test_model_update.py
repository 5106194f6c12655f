"""SIGHUP to a running `serve stream`: it goes on with the latest version of its model, and loses nothing by it."""

import fcntl
import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import termios
from functools import partial

import pytest

from isocharge.serve import VirtualSensor, wander


@pytest.fixture
def repository(film, tmp_path):
    """A model repository that may be written to, with `linear/1`."""
    film.write(tmp_path / "models")
    return tmp_path / "models"


@pytest.fixture
def sensor(film):
    with VirtualSensor(film.charges, wander(seed=2, seconds=60.0), offset_pC=[5.0, 6.0, 7.0]) as sensor:
        yield sensor


@pytest.fixture
def start(start_command, sensor, repository):
    return partial(start_command, "serve", "stream", "linear", "--port", sensor.url, "--models", repository)


def records_of(process, most):
    return (json.loads(process.stdout.readline()) for _ in range(most))


def until_tared(records):
    return next(record for record in records if record["tare_pC"])


def test_a_new_version_serves_without_losing_a_frame(film, repository, start, tmp_path, command):
    process = start("--record", tmp_path / "touch.rec")
    records = records_of(process, 3000)
    first = until_tared(records)
    film.write(repository, version=2)
    process.send_signal(signal.SIGHUP)
    later = []
    while not later or (later[-1]["model"] == "linear/1" or len(later) < 200):
        later.append(next(records))
    process.send_signal(signal.SIGINT)
    printed, err = process.communicate(timeout=20)
    later += [json.loads(line) for line in printed.splitlines(keepends=True) if line.endswith("\n")]
    assert {record["model"] for record in later} == {"linear/1", "linear/2"}
    seqs = [record["seq"] for record in (first, *later)]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))
    assert {flag for record in later for flag in record["flags"]} <= {"outside"}  # neither gap nor tare
    assert all(record["tare_pC"] == first["tare_pC"] for record in later)
    assert "linear/2 serves from now on, after linear/1" in err

    _, again, _ = command("serve", "replay", tmp_path / "touch.rec", "--models", repository)
    replayed = [json.loads(line) for line in again.splitlines()]
    assert replayed[-len(later) :] == later
    _, fixed, _ = command("serve", "replay", tmp_path / "touch.rec", "--models", repository, "--model", "linear/1")
    assert {json.loads(line)["model"] for line in fixed.splitlines()} == {"linear/1"}


def damaged(film, repository):
    version = film.write(repository, version=2)
    (version / "model.onnx").write_bytes((version / "model.onnx").read_bytes()[:-1])


def answering_otherwise(film, repository):
    """Intact, but this machine computes other answers than its golden vectors."""
    golden = film.write(repository, version=2) / "golden.json"
    content = json.loads(golden.read_text())
    content["outputs"]["contact"][0][0] += 1.0
    golden.write_text(json.dumps(content))


def of_another_sensor(make_film, repository):
    other = make_film(4).write(repository.parent / "four", version=2)
    shutil.copytree(other, repository / "linear" / "2")


def of_another_version(film, repository):
    film.write(repository, version=2)
    (repository / "linear" / "2").rename(repository / "linear" / "9")


def not_there(film, repository):  # noqa: ARG001
    shutil.rmtree(repository / "linear")


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (not_there, "ModelError: no model 'linear'"),
        (damaged, "model.onnx: expected sha256"),
        (answering_otherwise, "golden"),
        (of_another_version, "expected version 9, got linear/2"),
        (
            of_another_sensor,
            "model linear/2: expected the electrodes ('A', 'B', 'C') of linear/1, got ('A', 'B', 'C', ",
        ),
    ],
)
def test_a_bad_version_is_refused_and_the_old_one_serves_on(film, make_film, repository, start, spoil, said):
    process = start()
    records = records_of(process, 3000)
    until_tared(records)
    spoil(make_film if spoil is of_another_sensor else film, repository)
    process.send_signal(signal.SIGHUP)
    lines = []
    while not lines or "refused" not in lines[-1]:
        lines.append(process.stderr.readline())
        assert lines[-1], lines
    assert "linear/1 serves on, because the new model is refused" in lines[-1]
    assert said in lines[-1]
    shutil.rmtree(repository / "linear" / "9", ignore_errors=True)
    film.write(repository, version=3)
    process.send_signal(signal.SIGHUP)
    assert next(record for record in records if record["model"] != "linear/1")["model"] == "linear/3"


def test_closing_the_terminal_still_ends_the_stream(sensor, repository):
    """Closing a terminal sends SIGHUP, too."""
    master, slave = pty.openpty()
    words = [sys.executable, "-m", "isocharge.cli", "serve", "stream", "linear", "--output", "none"]
    process = subprocess.Popen(
        [*words, "--port", sensor.url, "--models", str(repository)],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(slave)
    said = b""
    while b"tared" not in said:
        said += os.read(master, 4096)
    os.close(master)
    assert process.wait(20) == 0


def test_a_film_has_a_name(start, tmp_path, repository, command):
    process = start("--name", "left, \u00fc", "--count", "20", "--record", tmp_path / "touch.rec")
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    assert {json.loads(line)["frame_id"] for line in out.splitlines()} == {"left, \u00fc"}
    assert command("serve", "replay", tmp_path / "touch.rec", "--models", repository)[1] == out


@pytest.mark.parametrize("name", ["", "a\nb", "x" * 101])
def test_a_name_that_is_none(command, repository, name):
    code, _, err = command("serve", "stream", "linear", "--port", "p", "--models", repository, "--name", name)
    assert code == 2
    assert "--name: expected 1 to 100 printable characters" in err
