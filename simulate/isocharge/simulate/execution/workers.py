"""Execution of long computations with a `concurrent.futures.Executor`, such as a process pool or a Dask cluster.

The work is divided into jobs beforehand, and the results are returned in the order of the jobs. The results therefore
do not depend on the executor, on the number of workers, or on the order in which the workers finish.
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
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from isocharge.common.errors import InputError, WorkersLost
from isocharge.common.extras import require
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.execution.code_version import code_fingerprint

Job = TypeVar("Job")

Result = TypeVar("Result")

MAX_PENDING = 64
"""Default of the largest number of submitted jobs whose results have not been returned yet.

It is enough for about thirty workers and limits the memory that finished results occupy.
"""

CONNECT_TIMEOUT_s = 10.0
"""Longest time to wait for a connection to a Dask cluster, s."""

MANAGER_TIMEOUT_s = 2.0
"""Longest time to wait for the thread that manages an abandoned process pool, s."""

POLL_INTERVAL_s = 0.005
"""Interval between two checks of the thread that manages an abandoned process pool, s."""


def in_order(
    executor: Executor | None, function: Callable[[Job], Result], jobs: Iterable[Job], *, max_pending: int = MAX_PENDING
) -> Iterator[Result]:
    """Call a function with every job and yield the results in the order of the jobs.

    A job is taken from the iterable only when it can be submitted.

    Args:
        executor: Executor that runs the jobs, such as a process pool with any start method, a thread pool, or
            `Client.get_executor()` of Dask. If it is None, each job runs in this process when its result is requested.
        function: Function that is called with each job. Worker processes must be able to import it.
        jobs: Arguments of the calls.
        max_pending: Largest number of submitted jobs whose results have not been returned yet.

    Raises:
        WorkersLost: If a worker process ends unexpectedly, or runs a different version of isocharge.
    """
    if executor is None:
        yield from map(function, jobs)
        return
    task = partial(run_same_code, code_fingerprint(), function)
    pending: deque[Future[Result]] = deque()
    try:
        for job in jobs:
            with _executor_errors():
                pending.append(executor.submit(task, job))
            # Yield results if too many jobs are pending. Results are also yielded if no job is running any more.
            while pending and (len(pending) >= max_pending or all(future.done() for future in pending)):
                yield _result(pending.popleft())
        while pending:
            yield _result(pending.popleft())
    finally:  # after an error, or if the caller needs no further results
        for future in pending:
            future.cancel()


def _result(future: Future[Result]) -> Result:
    """Wait for a future and return its result."""
    with _executor_errors():
        return future.result()


@contextmanager
def _executor_errors() -> Iterator[None]:
    """Convert the exceptions that executors raise when they lose workers into WorkersLost."""
    try:
        yield
    except BrokenExecutor as error:
        raise WorkersLost("a worker process ended unexpectedly: out of memory, or killed by another program") from error
    except CancelledError as error:
        raise WorkersLost("the executor was shut down, or lost its workers, before the work was done") from error
    except Exception as error:
        if not type(error).__module__.startswith("distributed."):  # KilledWorker, CommClosedError
            raise
        raise WorkersLost(f"the Dask cluster stopped the computation: {error}") from error


def run_same_code(fingerprint: str, function: Callable[[Job], Result], job: Job) -> Result:
    """Run a job in a worker after checking that the worker runs the same code as the sender.

    Args:
        fingerprint: Result of `code_fingerprint` in the sending process.
        function: Function to call.
        job: Argument of the call.

    Raises:
        WorkersLost: If the code of the worker differs, because its results would then differ as well.
    """
    if code_fingerprint() != fingerprint:
        raise WorkersLost(
            f"a worker runs {code_fingerprint()}, expected {fingerprint}; install the same versions on all workers"
        )
    with single_threaded_blas():
        return function(job)


def cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else multiprocessing.cpu_count()


@contextmanager
def local_workers(count: int) -> Iterator[Executor | None]:
    """Start worker processes on this machine.

    The workers end when the `with` block ends, and also if this process is killed.

    Args:
        count: Number of worker processes. For 1, no process is started and the executor is None.
    """
    if count == 1:
        yield None
        return
    context = multiprocessing.get_context("spawn")  # a fork would copy locks that other threads hold
    worker_end, parent_end = context.Pipe(duplex=False)  # a worker ends when the parent's end is closed
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_initialise_worker, initargs=(worker_end,))
    try:
        yield pool
    except BaseException:  # also an interrupt; the running jobs are not completed
        _abandon(pool, parent_end)
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        parent_end.close()
        worker_end.close()


def _abandon(pool: ProcessPoolExecutor, parent_end: Connection) -> None:
    """End the workers of a pool although they are still computing, and wait until the pool has ended.

    The method `ProcessPoolExecutor.shutdown` is not sufficient, because the thread that manages the pool in this
    process can fail or wait forever if the workers end unexpectedly. This function prevents two such cases:

    - A future was cancelled before the workers end. The manager then fails with an InvalidStateError, unless it has
      discarded the cancelled futures before.
    - A job that is larger than the pipe is being sent when the workers end. The sending waits forever if this process
      itself keeps a reading end of the pipe open (https://github.com/python/cpython/issues/94777).

    Args:
        pool: Process pool whose results are not needed.
        parent_end: End of the pipe that keeps the workers running.
    """
    internals: Any = pool  # the attributes below are private, and mypy does not know them
    manager: threading.Thread | None = internals._executor_manager_thread
    job_queue = internals._call_queue
    pool.shutdown(wait=False, cancel_futures=True)
    if manager is None:
        return  # no job was submitted, so there are no workers

    # Wait until the manager has discarded the cancelled futures, which resets the flag. Then end the workers.
    _wait_until(lambda: not internals._cancel_pending_futures or not manager.is_alive())
    parent_end.close()
    _wait_until(lambda: not manager.is_alive())

    # If a job is still being sent, close the reading end of the pipe in this process, so that the sending fails.
    sender: threading.Thread | None = job_queue._thread
    if sender is not None and sender.is_alive():
        job_queue._reader.close()
    manager.join()


def _wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition is true, but at most for MANAGER_TIMEOUT_s."""
    end = time.monotonic() + MANAGER_TIMEOUT_s
    while not condition() and time.monotonic() < end:
        time.sleep(POLL_INTERVAL_s)


def _initialise_worker(worker_end: Connection) -> None:
    """Prepare a worker: ignore interrupts, and end the worker when the parent process closes its end of the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, args=(worker_end,), daemon=True).start()


def _end_with_parent(worker_end: Connection) -> None:
    """Wait until the parent closes its end of the pipe, and then end this process."""
    worker_end.poll(None)
    os._exit(1)


@contextmanager
def dask_workers(address: str) -> Iterator[Executor]:
    """Connect to the workers of a Dask cluster, which must run the same version of isocharge as this process.

    If a worker is killed, Dask runs its tasks on the other workers.

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

    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "100MiB"}):  # tasks contain a map
        try:
            client = Client(address, timeout=CONNECT_TIMEOUT_s, set_as_default=False)
        except ValueError as error:
            raise InputError(f"cluster {address!r}: expected an address like 'tcp://10.0.0.1:8786': {error}") from error
        except OSError as error:
            raise WorkersLost(
                f"no Dask scheduler answers at {address}: {error}; is 'dask scheduler' running?"
            ) from error
        with client:
            # With `pure=False`, Dask does not compute the keys of the tasks from their large arguments.
            executor: Executor = client.get_executor(pure=False)
            try:
                yield executor
            finally:
                executor.shutdown(wait=False)
