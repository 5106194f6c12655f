"""SIGHUP to a running `serve stream`: it goes on with the latest version of its model, and loses nothing by it."""

import fcntl
import os
import pty
import shutil
import signal
import subprocess
import sys
import termios
from itertools import islice

import pytest

from boards import TcpBoard, interrupt, taps, until
from model_files import golden_fault
from serve.cli.test_commands import records_of


@pytest.fixture
def repository(film, tmp_path):
    """A model repository that may be written to, with `linear/1`."""
    film.write(tmp_path / "models")
    return tmp_path / "models"


@pytest.fixture
def stream(run, repository):
    """Follow rows of charges until the board ends the command; its records, and the words of `run`."""

    def follow(rows, *words):
        with TcpBoard(rows) as board:
            result = run("stream", "linear", "--port", board.url, "--models", repository, *words)
        return records_of(result.stdout)

    return follow


BAD = {
    "ModelError: no model 'linear'": shutil.rmtree,
    # Intact, but this machine computes other answers than its golden vectors.
    "golden": lambda folder: golden_fault(lambda golden: golden["outputs"]["contact"][0].__setitem__(0, 9.0))(
        folder / "2"
    ),
    "expected linear/9, as the folders are called, got linear/2": lambda folder: (folder / "2").rename(folder / "9"),
}
"""What is said, and what has been done to the folder of a model with a version 2."""


def test_a_new_version_serves_without_losing_a_frame(film, repository, stream, caplog, tmp_path, run):
    """After bad ones, of which each is refused while the old one serves on."""
    folder = repository / "linear"

    def refused(tapping, message):
        interrupt(signal.SIGHUP)
        yield from until(tapping, lambda: "linear/1 serves on, because the new model is refused" in caplog.text)
        assert message in caplog.text
        caplog.clear()

    def rows():
        tapping = taps(film)
        yield from islice(tapping, 400)
        for message, spoil in BAD.items():
            film.write(repository, version=2)
            spoil(folder)
            yield from refused(tapping, message)
            shutil.rmtree(folder, ignore_errors=True)
        film.with_electrodes(4).write(repository, version=2)
        yield from refused(tapping, "expected the electrodes ('A', 'B', 'C') of linear/1, got ('A', 'B', 'C', ")
        shutil.rmtree(folder)
        film.write(repository, version=3)
        interrupt(signal.SIGHUP)
        yield from until(tapping, lambda: "linear/3 serves from now on, after linear/1" in caplog.text)
        yield from islice(tapping, 200)
        interrupt()
        yield from tapping

    records = stream(rows(), "--record", tmp_path / "touch.rec")
    models = [record["model"] for record in records]
    assert (set(models), models[0], models[-1]) == ({"linear/1", "linear/3"}, "linear/1", "linear/3")
    assert [record["seq"] - records[0]["seq"] for record in records] == list(range(len(records)))
    later = [record for record in records if record["tare_pC"]]
    assert {flag for record in later for flag in record["flags"]} == set()  # neither gap nor tare

    film.write(repository)
    again = run("replay", tmp_path / "touch.rec", "--models", repository).stdout
    assert records_of(again) == records
    fixed = run("replay", tmp_path / "touch.rec", "--models", repository, "--model", "linear/1").stdout
    assert {record["model"] for record in records_of(fixed)} == {"linear/1"}


def test_closing_the_terminal_still_ends_the_stream(film, repository):
    """Closing a terminal sends SIGHUP, too."""
    master, slave = pty.openpty()
    words = [sys.executable, "-m", "isocharge.cli", "serve", "stream", "linear", "--output", "none"]
    with TcpBoard(taps(film)) as board:
        process = subprocess.Popen(
            [*words, "--port", board.url, "--models", str(repository)],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        os.close(slave)
        terminal_output = b""
        while b"tared" not in terminal_output:
            terminal_output += os.read(master, 4096)
        os.close(master)
        assert process.wait(60) == 0
