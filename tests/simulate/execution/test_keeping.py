"""Executor that saves results in a resumable run: errors, cancelled tasks and a pool that is shut down.

Tests in tests/simulate/dataset resume runs from the saved results.
"""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from isocharge.common.errors import WorkersLost
from isocharge.common.resumable_run import resume_parts
from isocharge.simulate.execution.workers import in_order


def test_error_of_a_task_is_raised_and_not_saved(tmp_path):
    def refuse(number: int) -> np.ndarray:
        raise ZeroDivisionError(number)

    with resume_parts(tmp_path / "out", {}) as run, ThreadPoolExecutor(1) as pool:
        for executor in (None, pool):
            with pytest.raises(ZeroDivisionError):
                next(in_order(run.storing_executor("solve", executor), refuse, [1]))
        assert run.is_empty()


def test_cancel_of_a_saving_future_cancels_the_task_and_shutdown_of_the_pool_raises_workers_lost(tmp_path):
    with resume_parts(tmp_path / "out", {}) as run:
        pool = ThreadPoolExecutor(1)
        gate = threading.Event()
        pool.submit(gate.wait)
        saving_executor = run.storing_executor("solve", pool)
        calls = []
        assert saving_executor.submit(calls.append, 1).cancel()

        def shut_down() -> None:
            pool.shutdown(wait=False, cancel_futures=True)
            gate.set()

        results = in_order(saving_executor, calls.append, [2, 3], max_pending=2)
        threading.Timer(0.05, shut_down).start()
        with pytest.raises(WorkersLost, match="before the work was done"):
            next(results)
        assert calls == []
