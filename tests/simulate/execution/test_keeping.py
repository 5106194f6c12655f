"""An executor that keeps results: in order, saved as they are computed, and not computed twice."""

import threading
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from isocharge.common.errors import WorkersLost
from isocharge.common.resumable_run import resume_parts
from isocharge.simulate.execution.workers import in_order


class Squares:
    """A function of a job that notes its calls."""

    def __init__(self) -> None:
        self.calls: list[int] = []

    def __call__(self, number: int) -> np.ndarray:
        self.calls.append(number)
        return np.array([number**2, np.pi * number])


def squares_of(executor: Executor | None, numbers, function=None) -> list[list[float]]:
    return [result.tolist() for result in in_order(executor, function or Squares(), numbers)]


@pytest.mark.parametrize("threads", [0, 3])
def test_results_of_a_stopped_run_are_loaded(tmp_path, threads):
    """Two were computed before the third failed: they are not computed again, the others are; also in a second call."""
    executor = ThreadPoolExecutor(threads) if threads else None
    expected = squares_of(None, range(5)) + squares_of(None, [7])
    with pytest.raises(KeyboardInterrupt):
        compute_two_and_stop(tmp_path / "out")
    squares = Squares()
    with resume_parts(tmp_path / "out", {}) as run:
        keeping = run.keeping("solve", executor)
        assert squares_of(keeping, range(5), squares) + squares_of(keeping, [7], squares) == expected
        assert sorted(path.stem for path in run.folder.rglob("*.npy")) == [f"solve-{n:04d}" for n in range(6)]
    assert sorted(squares.calls) == [2, 3, 4, 7]


def compute_two_and_stop(folder: Path) -> None:
    def fail_at_two(number: int) -> np.ndarray:
        if number == 2:
            raise KeyboardInterrupt
        return Squares()(number)

    with resume_parts(folder, {}) as run:
        squares_of(run.keeping("solve"), range(5), fail_at_two)


def test_an_error_of_a_task_is_raised_and_not_kept(tmp_path):
    def refuse(number: int) -> np.ndarray:
        raise ZeroDivisionError(number)

    with resume_parts(tmp_path / "out", {}) as run, ThreadPoolExecutor(1) as pool:
        for executor in (None, pool):
            with pytest.raises(ZeroDivisionError):
                squares_of(run.keeping("solve", executor), [1], refuse)
        assert run.is_empty()


def test_cancelling_what_is_kept_cancels_the_task_and_a_pool_that_is_shut_down_is_lost(tmp_path):
    with resume_parts(tmp_path / "out", {}) as run:
        pool, gate = ThreadPoolExecutor(1), threading.Event()
        pool.submit(gate.wait)
        squares = Squares()
        keeping = run.keeping("solve", pool)
        assert keeping.submit(squares, 1).cancel()
        results = in_order(keeping, squares, [2, 3], ahead=2)
        threading.Timer(0.05, lambda: (pool.shutdown(wait=False, cancel_futures=True), gate.set())).start()
        with pytest.raises(WorkersLost, match="before the work was done"):
            next(results)
        assert squares.calls == []
