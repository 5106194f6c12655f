"""Workers: equal bytes from any executor, killed workers, Dask clusters, and the end of all worker processes."""

import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import pytest
from tests.simulate.conftest import COARSE

from isocharge.common.errors import InputError, WorkersLost
from isocharge.common.progress import listening
from isocharge.simulate import Circle, Sweep, load_sensor, run_sweep
from isocharge.simulate import execution as module
from isocharge.simulate.execution import dask_workers, in_order, local_workers
from worker_jobs import kill_this_process, send_half_of_a_result, waited

SENSOR = load_sensor("three-25um-biaxial")
SWEEP = Sweep(radius=3.0, force_range=(1.0, 1.0), samples=60, seed=7, orientation="random", outside=15)


def sweep_with(executor: Executor | None, target: Path) -> dict[str, bytes]:
    """The files of a small sweep of two probes in shards of ten."""
    run_sweep(target, SENSOR, (Circle(1.0), Circle(0.8)), SWEEP, COARSE, executor=executor, shard=10)
    return {path.name: path.read_bytes() for path in target.iterdir()}


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> dict[str, bytes]:
    """Files that a sweep in one process writes."""
    with local_workers(1) as executor:
        assert executor is None
        return sweep_with(executor, tmp_path_factory.mktemp("one") / "presses")


def test_bytes_from_two_workers_are_equal_to_those_from_one_process(tmp_path, expected):
    with local_workers(2) as executor:
        assert sweep_with(executor, tmp_path / "presses") == expected


def test_killed_worker_process_raises_workers_lost_and_leaves_nothing_so_that_the_sweep_can_be_repeated(tmp_path):
    killed = []

    def kill(title: str, *_) -> None:
        if title == "pressing" and not killed:
            killed.append(executor.submit(os.getpid).result())
            os.kill(killed[0], signal.SIGKILL)

    with (
        pytest.raises(WorkersLost, match="a worker process ended unexpectedly"),
        local_workers(2) as executor,
        listening(kill),
    ):
        sweep_with(executor, tmp_path / "presses")
    assert list(tmp_path.iterdir()) == []


def test_pool_ends_if_its_workers_are_killed_while_large_jobs_are_being_sent():
    """A pipe holds 64 KiB, so a job of 4 MiB is still being sent when the workers end."""
    jobs = [bytes(4 << 20)] * 20
    with pytest.raises(WorkersLost, match="a worker process ended unexpectedly"), local_workers(2) as executor:
        list(in_order(executor, kill_this_process, jobs))


def test_pool_with_cancelled_futures_can_be_abandoned(monkeypatch):
    """The thread that manages the pool would fail if it found cancelled futures when the workers end."""
    thread_errors = []
    monkeypatch.setattr(threading, "excepthook", thread_errors.append)
    with pytest.raises(KeyboardInterrupt):
        interrupt_after_cancelling_futures()
    assert not thread_errors


def test_pool_can_be_abandoned_while_a_worker_sends_a_result(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        interrupt_while_sending(tmp_path / "began")


def interrupt_while_sending(began: Path) -> None:
    with local_workers(2) as executor:
        executor.submit(send_half_of_a_result, began)
        while not began.exists():
            time.sleep(0.01)
        raise KeyboardInterrupt


def interrupt_after_cancelling_futures() -> None:
    with local_workers(2) as executor:
        executor.submit(os.getpid).result()  # the workers have started
        futures = [executor.submit(waited, 3600.0) for _ in range(20)]
        while not futures[1].running():
            time.sleep(0.001)
        for future in futures:
            future.cancel()
        raise KeyboardInterrupt


def test_in_order_returns_results_in_order_and_consumes_jobs_as_needed(monkeypatch):
    monkeypatch.setattr(module, "MAX_PENDING", 5)
    drawn = []

    def jobs() -> Iterator[float]:
        for number in range(20):
            drawn.append(number)
            yield 0.002 * (number % 3)

    with ThreadPoolExecutor(4) as pool:
        results = in_order(pool, waited, jobs())
        assert next(results) == 0.0
        assert len(drawn) <= 5
        assert [0.0, *results] == [0.002 * (number % 3) for number in range(20)]


def test_worker_with_a_different_version_is_refused(monkeypatch):
    """Results of a different version could differ."""
    versions = module.code_versions()
    monkeypatch.setattr(module, "code_versions", lambda: "isocharge 9.9")
    expected = rf"a worker runs isocharge 9\.9, expected isocharge {re.escape(version('isocharge'))}, numpy"
    with pytest.raises(WorkersLost, match=expected):
        module.run_same_code(versions, waited, 0.0)


# Dask


@pytest.fixture(scope="module")
def cluster():
    """A worker process on loopback."""
    distributed = pytest.importorskip("distributed")
    with (
        pytest.MonkeyPatch.context() as patch,
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
        ) as cluster,
    ):
        patch.setattr(module, "CONNECT_TIMEOUT_s", 120.0)  # a busy machine needs more time
        yield cluster


def pids(cluster) -> list[int]:
    return [nanny.pid for nanny in cluster.workers.values() if nanny.pid]


def test_bytes_from_dask_are_equal_although_a_worker_is_killed(cluster, tmp_path, expected):
    """The worker is killed during the solves, and Dask starts a new one."""
    killed = []

    def kill(title: str, done: int, *_) -> None:
        if title.startswith("solving") and done >= 2 and not killed:
            killed.append(pids(cluster)[0])
            os.kill(killed[0], signal.SIGKILL)

    with dask_workers(cluster.scheduler_address) as executor, listening(kill):
        assert sweep_with(executor, tmp_path / "presses") == expected
    assert killed
    assert killed[0] not in pids(cluster)


def test_dask_scheduler_that_does_not_answer_raises_workers_lost(monkeypatch):
    monkeypatch.setattr(module, "CONNECT_TIMEOUT_s", 0.3)
    with pytest.raises(WorkersLost, match="no Dask scheduler answers at tcp://127"):
        dask_workers("tcp://127.0.0.1:9").__enter__()
    with pytest.raises(InputError, match="cluster 'carrier-pigeon://1': expected an address like"):
        dask_workers("carrier-pigeon://1").__enter__()
