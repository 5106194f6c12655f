"""A checkpointed map: results in order, saved as they are taken, and not computed twice."""

from pathlib import Path

import numpy as np
import pytest

from isocharge.common.resumable_run import resume_parts
from isocharge.simulate.execution.checkpointed_map import CheckpointedMap


def squares(calls: list[int]):
    """A function of a job that notes its calls."""

    def square(number: int) -> np.ndarray:
        calls.append(number)
        return np.array([number**2, np.pi * number])

    return square


def taken(results) -> list[bytes]:
    return [result.tobytes() for result in results]


def test_results_are_those_of_map(tmp_path):
    with resume_parts(tmp_path / "out", {}) as run:
        saving = CheckpointedMap(run, "solve", map)
        assert taken(saving(squares([]), range(4))) == taken(map(squares([]), range(4)))
        assert taken(saving(squares([]), [7])) == taken(map(squares([]), [7]))
        names = sorted(path.stem for path in run.folder.rglob("*.npy"))
        assert names == [f"solve-00-{number:04d}" for number in range(4)] + ["solve-01-0000"]


def test_results_of_a_stopped_run_are_loaded(tmp_path):
    """Two were taken: they are not computed again, the others are."""
    with pytest.raises(KeyboardInterrupt):
        take_two_and_stop(tmp_path / "out")
    calls: list[int] = []
    with resume_parts(tmp_path / "out", {}) as run:
        assert taken(CheckpointedMap(run, "solve", map)(squares(calls), range(5))) == taken(map(squares([]), range(5)))
    assert calls == [2, 3, 4]


def take_two_and_stop(folder: Path) -> None:
    with resume_parts(folder, {}) as run:
        results = CheckpointedMap(run, "solve", map)(squares([]), range(5))
        assert len([next(results), next(results)]) == 2
        raise KeyboardInterrupt
