"""What the tests of the commands share."""

import os
import tempfile
from functools import partial
from itertools import chain, islice
from types import SimpleNamespace

import numpy as np
import pytest

from boards import TcpBoard, encoded_frames, taps


@pytest.fixture
def presses(tmp_path, film):
    """A CSV of two presses, columns not in the model's order."""
    path = tmp_path / "presses.csv"
    charge_pC = film.charge_pC([1.0, -2.0], [0.5, 3.0], [1.0, 0.25])
    np.savetxt(path, np.roll(charge_pC, 1, axis=1), delimiter=",", header="C,A,B", comments="")
    return path


@pytest.fixture(scope="session")
def frames(tmp_path_factory, film):
    """A file of bytes: rest, a press, rest, 300 frames in all."""
    path = tmp_path_factory.mktemp("frames") / "frames.bin"
    rows = taps(film, at=(2.0, 1.0), force_N=0.5, rest=150, press=100)
    path.write_bytes(b"".join(encoded_frames(islice(rows, 300))))
    return path


@pytest.fixture
def run(command):
    """A function that runs `isocharge serve ...` in this process with some bytes as its stdin."""

    def invoke(*arguments, stdin=b""):
        with tempfile.TemporaryFile() as file:
            file.write(stdin)
            file.seek(0)
            os.dup2(file.fileno(), 0)
        exit_code, stdout, stderr = command("serve", *arguments)
        return SimpleNamespace(exit_code=exit_code, stdout=stdout, stderr=stderr)

    original_stdin = os.dup(0)
    yield invoke
    os.dup2(original_stdin, 0)
    os.close(original_stdin)


@pytest.fixture
def stream(run, models):
    """A function that runs `serve stream` with the linear model and a port."""
    return lambda port, *words: run("stream", "linear", "--port", port, "--models", models, *words)


@pytest.fixture
def recorded(frames, stream, tmp_path):
    """A recording of these frames, and the lines that were printed."""
    path = tmp_path / "touch.rec"
    return path, stream(frames, "--record", path).stdout


@pytest.fixture
def start_stream(start_command, models):
    """A function that starts `serve stream` with the linear model and a port in a new process."""
    return partial(start_command, "serve", "stream", "linear", "--models", models, "--port")


@pytest.fixture
def board_until(film):
    """A board that is tapped, and does something after 400 frames."""

    def make(act):
        rows = taps(film)
        return TcpBoard(chain(islice(rows, 400), _after(act), rows))

    return make


def _after(act):
    """No rows; but whoever asks for them has the act done."""
    act()
    yield from ()
