"""Execution of long computations with a `concurrent.futures.Executor`, such as a process pool or a Dask cluster.

The caller divides the work into jobs, and the results are returned in the order of the jobs. The results therefore do
not depend on the executor, on the number of workers, or on the order in which the workers finish.

The functions `local_workers` and `dask_workers` provide executors. A worker with another version of the code refuses
all jobs. In a worker, BLAS uses only one thread.
"""

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from functools import lru_cache, partial
from importlib.metadata import version
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from isocharge.common.errors import InputError, WorkersLost, require

Job = TypeVar("Job")

Result = TypeVar("Result")

MAX_PENDING = 64
"""Largest number of submitted jobs whose results have not been returned yet.

The value suffices for about thirty workers, and limits the memory that finished results occupy.
"""

CONNECT_TIMEOUT_s = 10.0
"""Longest time for which the program waits for a connection to a Dask cluster, s."""

MANAGER_TIMEOUT_s = 2.0
"""Longest time for which the program waits for the manager thread of an abandoned process pool, s."""

POLL_INTERVAL_s = 0.005
"""Time between two checks of the manager thread of an abandoned process pool, s."""


def in_order(executor: Executor | None, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
    """Call a function with every job, in parallel in an executor, and yield the results in the order of the jobs.

    A job is requested from the iterable only when it can be submitted to the executor. At most `MAX_PENDING` jobs are
    submitted whose results have not been yielded yet.

    Args:
        executor: Executor that runs the jobs, such as a process pool with any start method, a thread pool, or
            `Client.get_executor()` of Dask. If None, each job runs in this process when its result is requested.
        function: Function that is called with each job. Worker processes must be able to import it.
        jobs: Argument of each call.

    Raises:
        WorkersLost: If a worker process ends unexpectedly, or runs a different version of isocharge.
    """
    if executor is None:
        yield from map(function, jobs)
        return

    # The workers run the jobs only if they have the same version of the code as this process.
    task = partial(run_same_code, code_versions(), function)
    pending: deque[Future[Result]] = deque()
    try:
        with _executor_errors():
            for job in jobs:
                pending.append(executor.submit(task, job))
                # Yield the oldest result while too many jobs are pending, or while all pending jobs are done. In the
                # first case, this loop may wait for the oldest job. In the second case, no waiting is necessary.
                while pending and (len(pending) >= MAX_PENDING or all(future.done() for future in pending)):
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
    finally:
        # Cancel the remaining jobs after an error, or if the caller requests no further results.
        for future in pending:
            future.cancel()


@contextmanager
def _executor_errors() -> Iterator[None]:
    """Convert exceptions of a `with` block into WorkersLost if they mean that an executor has lost its workers.

    All other exceptions, such as the exceptions of a job, are raised unchanged.
    """
    try:
        yield
    except BrokenExecutor as error:
        raise WorkersLost(
            "a worker process ended unexpectedly: out of memory, killed by another program, or started by a script "
            'without `if __name__ == "__main__":`'
        ) from error
    except CancelledError as error:
        raise WorkersLost("the executor was shut down, or lost its workers, before the work was done") from error
    except Exception as error:
        # Dask raises its own exceptions, such as KilledWorker and CommClosedError of the package `distributed`.
        if not type(error).__module__.startswith("distributed."):
            raise
        raise WorkersLost(f"the Dask cluster stopped the computation: {error}") from error


@lru_cache(maxsize=1)
def code_versions() -> str:
    """Return the versions of isocharge and of the numerical libraries that affect the results of a simulation."""
    return ", ".join(f"{name} {version(name)}" for name in ("isocharge", "numpy", "scipy", "shapely"))


def run_same_code(versions: str, function: Callable[[Job], Result], job: Job) -> Result:
    """Run a job in a worker if the worker has the same version of the code as the process that sent the job.

    Args:
        versions: Result of `code_versions` in the process that sent the job.
        function: Function that is called with the job.
        job: Argument of the call.

    Returns:
        Result of the call.

    Raises:
        WorkersLost: If the worker has another version of the code, which might lead to other results.
    """
    if code_versions() != versions:
        raise WorkersLost(
            f"a worker runs {code_versions()}, expected {versions}; install the same versions on all workers"
        )
    with threadpool_limits(limits=1, user_api="blas"):
        return function(job)


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else multiprocessing.cpu_count()


@contextmanager
def local_workers(count: int) -> Iterator[Executor | None]:
    """Start worker processes on this machine for the duration of a `with` block, and provide their executor.

    The workers end when the `with` block ends, and also if this process is killed.

    Args:
        count: Number of worker processes. If it is 1, no process is started, and None takes the place of the executor.
    """
    if count == 1:
        yield None
        return

    # The start method "spawn" is used, because a fork would copy locks that other threads hold.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_initialise_worker)
    try:
        yield pool
    except BaseException:  # includes KeyboardInterrupt
        _abandon(pool)  # kills the workers, so that `shutdown` does not wait for running jobs
        raise
    finally:
        pool.shutdown(cancel_futures=True)  # waits until all workers have ended


def _abandon(pool: ProcessPoolExecutor) -> None:
    """End the workers of a process pool although they are still computing, and wait until the pool has ended.

    The method `ProcessPoolExecutor.shutdown` is not sufficient, because it waits until the running jobs are completed.
    This function ends the workers. A thread of this process, the manager, then notices that the workers have ended, and
    closes the pool. Three precautions are necessary.

    First, all futures are cancelled, and the workers may end only after the manager has discarded the cancelled
    futures. If the workers ended earlier, the manager would fail with an InvalidStateError. Second, a worker may end
    while it sends a result. The manager would wait forever for the rest of the result, unless this process closes its
    own writing end of the pipe. Third, a job that is larger than the buffer of a pipe may still be on its way to the
    workers. The thread that sends the job would wait forever, unless this process closes its own reading end of the
    pipe (https://github.com/python/cpython/issues/94777).

    Args:
        pool: Process pool whose results are no longer needed.
    """
    internals: Any = pool  # access to private attributes, which mypy does not know
    manager: threading.Thread | None = internals._executor_manager_thread
    job_queue = internals._call_queue
    result_queue = internals._result_queue
    workers = list(internals._processes.values())
    pool.shutdown(wait=False, cancel_futures=True)
    if manager is None:
        return  # no job was submitted, so there are no workers

    # Wait until the manager has discarded the cancelled futures. The manager then resets the flag
    # `_cancel_pending_futures`.
    _wait_until(lambda: not internals._cancel_pending_futures or not manager.is_alive())

    # End the workers, and wait until the manager has noticed that they ended. This process closes its
    # writing end of the pipe of the results, so that the manager does not wait for the rest of a result.
    for worker in workers:
        worker.kill()
    result_queue._writer.close()
    _wait_until(lambda: not manager.is_alive())

    # If a job is still being sent, close the reading end of its pipe in this process, so that the sending fails.
    sender: threading.Thread | None = job_queue._thread
    if sender is not None and sender.is_alive():
        job_queue._reader.close()
    manager.join()


def _wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition is true, but at most for MANAGER_TIMEOUT_s."""
    deadline = time.monotonic() + MANAGER_TIMEOUT_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(POLL_INTERVAL_s)


def _initialise_worker() -> None:
    """Prepare a new worker process.

    The worker ignores the signals that end a command, because the parent process handles them. A service manager sends
    SIGTERM to all processes at once. The worker ends if the parent process ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait until the parent process ends or is killed, and then end this process."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def dask_workers(address: str) -> Iterator[Executor]:
    """Connect to a Dask cluster for the duration of a `with` block, and provide the executor of its workers.

    The workers must have the same version of isocharge as this process. If a worker is killed, Dask runs its tasks on
    the other workers.

    Args:
        address: Address of the scheduler, such as "tcp://10.0.0.1:8786".

    Raises:
        InputError: If the address is not valid.
        WorkersLost: If the scheduler does not answer.
        MissingExtra: If the extra `cluster` is not installed.
    """
    with require("cluster"):
        import dask
        from distributed import Client

    # A task contains a forward map of many MB, about which Dask would warn.
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "100MiB"}):
        try:
            client = Client(address, timeout=CONNECT_TIMEOUT_s, set_as_default=False)
        except ValueError as error:
            raise InputError(f"cluster {address!r}: expected an address like 'tcp://10.0.0.1:8786': {error}") from error
        except OSError as error:
            raise WorkersLost(
                f"no Dask scheduler answers at {address}: {error}; is 'dask scheduler' running?"
            ) from error
        with client:
            # With `pure=False`, Dask does not compute the keys of the tasks from their arguments, which are large.
            executor = client.get_executor(pure=False)
            try:
                yield executor
            finally:
                executor.shutdown(wait=False)
