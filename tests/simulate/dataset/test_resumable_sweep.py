"""Resumed sweeps: equal bytes after interruptions, damaged parts, and folders that must not be changed."""

import re
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path

import pytest

from isocharge.common.errors import OutputExists, SceneError, SolveError
from isocharge.common.progress import listening
from isocharge.common.resumable_run import draft_of, resume_folder
from isocharge.simulate import Circle, Resolution, SolveSettings, Sweep, Theory, load_sensor, run_sweep
from isocharge.simulate.forward import forward_map

SENSOR = load_sensor("three-25um-biaxial")
QUICK = SolveSettings(theory=Theory(stretching=True, bending=False, pretensioned=False), resolution=Resolution(4, 8, 4))
SWEEP = Sweep(radius=3.0, force_range=(1.0, 1.0), samples=60, seed=7, outside=15)


class Stopped(BaseException):
    """Interruption of a sweep, which is not an `Exception`, like the interruption by Ctrl-C."""


class Counting(Executor):
    """Executor that runs all jobs in this process and counts them."""

    def __init__(self) -> None:
        self.jobs = 0

    def submit(self, function, /, *arguments):
        self.jobs += 1
        future: Future = Future()
        future.set_result(function(*arguments))
        return future


def sweep_to(target: Path, **options) -> Path:
    arguments = {"probes": (Circle(1.0),), "sweep": SWEEP, "settings": QUICK, "shard": 10} | options
    return run_sweep(target, SENSOR, **arguments)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[dict[str, bytes], int]:
    """The files of an uninterrupted run, and its number of jobs."""
    executor = Counting()
    return files(sweep_to(tmp_path_factory.mktemp("whole") / "presses", executor=executor)), executor.jobs


def sweep_until(target: Path, phase: str, count: int, **options) -> None:
    """Run a sweep and interrupt it when its progress in a phase ("solving" or "pressing") reaches a number."""

    def listener(title: str, done: int, *_) -> None:
        if title.startswith(phase) and done >= count:
            raise Stopped

    with pytest.raises(Stopped), listening(listener):
        sweep_to(target, **options)


@pytest.fixture
def stopped(tmp_path) -> Path:
    """The target of a sweep that was interrupted after all solves and two shards of ten presses."""
    sweep_until(tmp_path / "presses", "pressing", 20)
    return tmp_path / "presses"


@pytest.mark.parametrize(("phase", "count"), [("solving", 3), ("pressing", 0), ("pressing", 60)])
def test_stopped_run_is_resumed_with_the_same_bytes(tmp_path, whole, phase, count):
    target = tmp_path / "presses"
    first = Counting()
    second = Counting()
    reports = []
    sweep_until(target, phase, count, executor=first)
    assert [path.name for path in tmp_path.iterdir()] == ["presses.part"]
    with listening(lambda title, done, _total, _note: reports.append(done) if title == "pressing" else None):
        sweep_to(target, executor=second)
    expected, jobs = whole
    assert (files(target), [path.name for path in tmp_path.iterdir()]) == (expected, ["presses"])
    assert first.jobs + second.jobs == jobs  # no job is done twice
    assert reports[0] == (count if phase == "pressing" else 0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sweep": replace(SWEEP, samples=70)}, "sweep.samples is 60 there, 70 here"),
        ({"probes": (Circle(2.0),)}, r"probes is \['circle:1.0@0'\] there, \['circle:2.0@0'\] here"),
        ({"settings": SolveSettings()}, "solver.resolution is .*; solver.theory is"),
    ],
)  # fmt: skip
def test_draft_of_different_settings_is_not_changed(stopped, whole, changes, message):
    before = sorted(draft_of(stopped).rglob("*"))
    with pytest.raises(
        OutputExists, match=rf"presses\.part holds the unfinished run of other settings: {message}.*--fresh"
    ):
        sweep_to(stopped, **changes)
    assert sorted(draft_of(stopped).rglob("*")) == before
    assert files(sweep_to(stopped)) == whole[0]


@pytest.mark.parametrize(("content", "fresh"), [(None, True), ("{", False)])
def test_existing_folder_is_not_changed(tmp_path, content, fresh):
    """The folder belongs to the user, or its `run.json` is damaged."""
    folder = tmp_path / "presses.part"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    if content is not None:
        (folder / "run.json").write_text(content)
        (folder / "lock").touch()
    with pytest.raises(OutputExists, match=r"presses\.part is in the way: it holds no run\.json that can be read"):
        sweep_to(tmp_path / "presses", fresh=fresh)
    assert (folder / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(("name", "damage"), [("parts/solve-00-0001.npy", "flipped"), ("data/shard-00001.npz", "gone")])
def test_damaged_part_is_reported_and_computed_again(stopped, whole, damage, name, caplog):
    path = draft_of(stopped) / name
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(bytes(data))
    reason = ".*No such file.*" if damage == "gone" else r"expected sha256 .*\.\.\."
    sweep_to(stopped)
    assert re.search(rf"{path.name} is damaged: {reason}; computed again", caplog.text)
    assert files(stopped) == whole[0]


def test_part_without_checksum_is_computed_again(stopped, whole):
    """A process that is killed may leave a part without a checksum, or a temporary file.

    These parts are computed again, and the temporary file does not become a part of the dataset.
    """
    (draft_of(stopped) / "data" / ".0123abcd.draft").write_bytes(b"half")
    for name in ("solve-00-0001.npy", "shard-00001.npz"):
        (draft_of(stopped) / "parts" / f"{name}.sha256").unlink()
    (draft_of(stopped) / "data/shard-00001.npz").write_bytes(b"half a sh")
    sweep_to(stopped)
    assert files(stopped) == whole[0]


def test_second_run_on_the_same_draft_is_refused(tmp_path):
    def other_run(*_):
        with pytest.raises(OutputExists, match=r"another process is at work in .*presses\.part; wait for it"):
            sweep_to(tmp_path / "presses", fresh=True)
        raise Stopped

    with pytest.raises(Stopped), listening(other_run):
        sweep_to(tmp_path / "presses")


def test_run_killed_after_renaming_the_dataset_removes_the_draft_when_resumed(stopped):
    """The dataset is complete, but its draft was not yet removed. It is removed, and nothing is computed again."""
    draft_of(stopped).joinpath("data").rename(stopped)
    with pytest.raises(OutputExists, match="presses is already there"):
        sweep_to(stopped)
    assert not draft_of(stopped).exists()
    assert stopped.exists()


def save_and_raise(target: Path, error: BaseException) -> None:
    with resume_folder(target, {"a": (1, 2)}) as draft:
        draft.save("part", b"1")
        raise error


def test_run_that_would_fail_again_leaves_no_draft(tmp_path):
    with pytest.raises(SolveError):
        save_and_raise(tmp_path / "new" / "out", SolveError("no equilibrium"))
    assert list(tmp_path.iterdir()) == []


def test_run_that_refuses_an_input_keeps_its_finished_parts(tmp_path):
    """The input may be a file that somebody mends."""
    with pytest.raises(SceneError):
        save_and_raise(tmp_path / "out", SceneError("no such press"))
    with resume_folder(tmp_path / "out", {"a": (1, 2)}) as draft:
        assert draft.load("part", bytes) == b"1"
        draft.save("data", b"2", final=True)


DRIVER = """
import os, sys
from pathlib import Path
sys.path[:0] = {path!r}
from isocharge.simulate import *
from isocharge.common.progress import listening
from isocharge.simulate.forward import forward_map
from isocharge.simulate.execution.workers import local_workers

def killed(title, done, *_):
    if title == "pressing" and done >= 20:
        os.kill(os.getpid(), 9)

if __name__ == "__main__":
    forward_map.CHECK_COUNT = {check_count}  # as in the process that resumes the run
    membrane = Theory(stretching=True, bending=False, pretensioned=False)
    quick = SolveSettings(theory=membrane, resolution=Resolution(4, 8, 4))
    sweep = Sweep(radius=3.0, force_range=(1.0, 1.0), samples=60, seed=7, outside=15)
    with local_workers(2) as executor, listening(killed):
        print(executor.submit(os.getpid).result(), flush=True)
        run_sweep(Path(sys.argv[1]), load_sensor("three-25um-biaxial"), (Circle(1.0),), sweep, quick, shard=10,
                  executor=executor)
"""


def test_killed_run_is_resumed_with_the_same_bytes(tmp_path, whole):
    """The run is killed by SIGKILL between two shards, and its workers end as well."""
    script = tmp_path / "driver.py"
    script.write_text(DRIVER.format(path=sys.path, check_count=forward_map.CHECK_COUNT))
    run = subprocess.run([sys.executable, script, tmp_path / "presses"], capture_output=True, text=True, timeout=100)
    assert run.returncode == -signal.SIGKILL, run.stderr
    assert [path.exists() for path in (tmp_path / "presses", draft_of(tmp_path / "presses"))] == [False, True]
    for pid in map(int, run.stdout.split()):
        deadline = time.monotonic() + 10.0
        while is_running(pid) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not is_running(pid)
    executor = Counting()
    sweep_to(tmp_path / "presses", executor=executor)
    assert files(tmp_path / "presses") == whole[0]
    assert executor.jobs < whole[1]


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
