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
    """A function of a job that notes its calls, and is interrupted at one of them."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.calls: list[int] = []
        self.stop_at = stop_at

    def __call__(self, number: int) -> np.ndarray:
        if number == self.stop_at:
            raise KeyboardInterrupt
        self.calls.append(number)
        return np.array([number**2, np.pi * number])


def kept_squares(folder: Path, squares: Squares, executor: Executor | None = None) -> list[list[float]]:
    """Two calls of one run."""
    with resume_parts(folder, {}) as run:
        keeping = run.keeping("solve", executor)
        return [result.tolist() for numbers in (range(5), [7]) for result in in_order(keeping, squares, numbers)]


@pytest.mark.parametrize("threads", [0, 3])
def test_results_of_a_stopped_run_are_loaded(tmp_path, threads):
    """Two were computed before the third failed: they are not computed again, the others are; also in a second call."""
    with pytest.raises(KeyboardInterrupt):
        kept_squares(tmp_path / "out", Squares(stop_at=2))
    squares = Squares()
    results = kept_squares(tmp_path / "out", squares, ThreadPoolExecutor(threads) if threads else None)
    assert results == [[n**2, np.pi * n] for n in (0, 1, 2, 3, 4, 7)]
    assert sorted(squares.calls) == [2, 3, 4, 7]


def test_an_error_of_a_task_is_raised_and_not_kept(tmp_path):
    def refuse(number: int) -> np.ndarray:
        raise ZeroDivisionError(number)

    with resume_parts(tmp_path / "out", {}) as run, ThreadPoolExecutor(1) as pool:
        for executor in (None, pool):
            with pytest.raises(ZeroDivisionError):
                next(in_order(run.keeping("solve", executor), refuse, [1]))
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
