"""An executor that keeps results: errors and cancelled tasks; tests/simulate/dataset goes on with what is kept."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from isocharge.common.errors import WorkersLost
from isocharge.common.resumable_run import resume_parts
from isocharge.simulate.execution.workers import in_order


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
        keeping, calls = run.keeping("solve", pool), []
        assert keeping.submit(calls.append, 1).cancel()
        results = in_order(keeping, calls.append, [2, 3], ahead=2)
        threading.Timer(0.05, lambda: (pool.shutdown(wait=False, cancel_futures=True), gate.set())).start()
        with pytest.raises(WorkersLost, match="before the work was done"):
            next(results)
        assert calls == []
