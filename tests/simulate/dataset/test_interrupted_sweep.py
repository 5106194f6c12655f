"""Interrupted sweeps: no part of a dataset remains, and the workers of a killed process end."""

import signal
import sys
import time
from pathlib import Path

import pytest
from tests.simulate.conftest import COARSE

from isocharge.common.errors import OutputExists
from isocharge.common.progress import listening
from isocharge.simulate import Circle, Sweep, load_sensor, run_sweep
from isocharge.simulate.forward import forward_map
from processes import finished

SENSOR = load_sensor("three-25um-biaxial")
SWEEP = Sweep(radius=3.0, force_range=(1.0, 1.0), samples=60, seed=7, outside=15)


class Stopped(BaseException):
    """Interruption of a sweep, which is not an `Exception`, like the interruption by Ctrl-C."""


@pytest.mark.parametrize(("phase", "count"), [("solving", 3), ("pressing", 20)])
def test_interrupted_sweep_leaves_no_files(tmp_path, phase, count):
    def listener(title: str, done: int, *_) -> None:
        if title.startswith(phase) and done >= count:
            raise Stopped

    with pytest.raises(Stopped), listening(listener):
        run_sweep(tmp_path / "new" / "presses", SENSOR, (Circle(1.0),), SWEEP, COARSE, shard=10)
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_refused_before_the_computation(tmp_path):
    with pytest.raises(OutputExists, match="is already there"), listening(pytest.fail):
        run_sweep(tmp_path, SENSOR, (Circle(1.0),), SWEEP, COARSE)


DRIVER = """
import os, sys
from pathlib import Path
sys.path[:0] = {path!r}
from isocharge.simulate import *
from isocharge.common.progress import listening
from isocharge.simulate.forward import forward_map
from isocharge.simulate.execution import local_workers

def killed(title, done, *_):
    if title == "pressing" and done >= 20:
        os.kill(os.getpid(), 9)

if __name__ == "__main__":
    forward_map.CHECK_COUNT = {check_count}
    membrane = Theory(bending=False)
    quick = SolveSettings(theory=membrane, resolution=Resolution(4, 8, 4))
    sweep = Sweep(radius=3.0, force_range=(1.0, 1.0), samples=60, seed=7, outside=15)
    with local_workers(2) as executor, listening(killed):
        print(executor.submit(os.getpid).result(), flush=True)
        run_sweep(Path(sys.argv[1]), load_sensor("three-25um-biaxial"), (Circle(1.0),), sweep, quick, shard=10,
                  executor=executor)
"""


def test_workers_end_with_a_killed_process(tmp_path):
    """The process is killed by SIGKILL between two shards. No dataset appears, and its workers end as well."""
    script = tmp_path / "driver.py"
    script.write_text(DRIVER.format(path=sys.path, check_count=forward_map.CHECK_COUNT))
    run = finished([sys.executable, script, tmp_path / "presses"], timeout=100)
    assert run.returncode == -signal.SIGKILL, run.stderr
    assert not (tmp_path / "presses").exists()
    for pid in map(int, run.stdout.split()):
        deadline = time.monotonic() + 10.0
        while is_running(pid) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not is_running(pid)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
