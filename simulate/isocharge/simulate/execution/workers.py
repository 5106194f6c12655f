"""Where long work is done: any `concurrent.futures.Executor`, such as processes on this machine or a Dask cluster.

The results do not depend on the executor, on the number of workers, or on which of them finishes first: tasks are cut
beforehand and their results are taken in order.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from typing import TypeVar

from isocharge.common.errors import InputError, WorkersLost
from isocharge.common.extras import require
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.execution.code_version import code_fingerprint

Job = TypeVar("Job")

Result = TypeVar("Result")

AHEAD = 64
"""Most tasks handed out whose results were not taken yet: enough for some thirty workers, few enough for memory."""

CONNECT_S = 10.0
"""Longest wait for a cluster to answer, s."""


def in_order(
    executor: Executor | None, function: Callable[[Job], Result], jobs: Iterable[Job], *, ahead: int = AHEAD
) -> Iterator[Result]:
    """The results of all jobs, in their order; jobs are drawn as they are needed.

    Args:
        executor: Runs the tasks: a process pool with any start method, `Client.get_executor()` of Dask, threads. None
            runs them in this process, one when its result is asked for.
        function: Called with each job; processes must be able to import it.
        jobs: What it is called with.
        ahead: Most tasks handed out whose results were not taken yet.

    Raises:
        WorkersLost: If workers end by themselves, or run another version of isocharge.
    """
    if executor is None:
        yield from map(function, jobs)
        return
    task = partial(run_same_code, code_fingerprint(), function)
    pending: deque[Future[Result]] = deque()
    try:
        for job in jobs:
            with _loss_of_workers():
                pending.append(executor.submit(task, job))
            while pending and (len(pending) >= ahead or all(future.done() for future in pending)):
                yield _result(pending.popleft())
        while pending:
            yield _result(pending.popleft())
    finally:
        for future in pending:
            future.cancel()


def _result(future: Future[Result]) -> Result:
    with _loss_of_workers():
        return future.result()


@contextmanager
def _loss_of_workers() -> Iterator[None]:
    """Turn what executors raise when their workers are gone into WorkersLost."""
    try:
        yield
    except BrokenExecutor as error:
        raise WorkersLost("a worker process ended by itself: out of memory, or killed from outside") from error
    except CancelledError as error:
        raise WorkersLost("the executor was shut down, or lost its workers, before the work was done") from error
    except Exception as error:
        if not type(error).__module__.startswith("distributed."):  # KilledWorker, CommClosedError
            raise
        raise WorkersLost(f"the Dask cluster gave up: {error}") from error


def run_same_code(fingerprint: str, function: Callable[[Job], Result], job: Job) -> Result:
    """Run a job where isocharge is the same as the sender's: else its bytes would differ.

    Raises:
        WorkersLost: If it is another.
    """
    if code_fingerprint() != fingerprint:
        raise WorkersLost(
            f"a worker runs {code_fingerprint()}, expected {fingerprint}; install the same on all of them"
        )
    with single_threaded_blas():
        return function(job)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else multiprocessing.cpu_count()


@contextmanager
def local_workers(count: int) -> Iterator[Executor | None]:
    """Processes on this machine, None for one worker. They end with the block, and if this process is killed."""
    if count == 1:
        yield None
        return
    context = multiprocessing.get_context("spawn")  # a fork copies locks that other threads hold
    watched, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin, initargs=(watched,))
    try:
        yield pool
    except BaseException:
        held.close()  # workers in the middle of a task end, too
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        held.close()
        watched.close()


def _begin(watched: Connection) -> None:
    """Interrupts are the parent's to handle; the worker ends when the parent lets go of its end of the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, args=(watched,), daemon=True).start()


def _end_with_parent(watched: Connection) -> None:
    watched.poll(None)
    os._exit(1)


@contextmanager
def dask_workers(address: str) -> Iterator[Executor]:
    """The workers of a Dask cluster, such as "tcp://10.0.0.1:8786"; they need the same isocharge as this process.

    If a worker is killed, Dask gives its tasks to the others.

    Raises:
        InputError: If this is no address.
        WorkersLost: If the cluster does not answer.
        MissingExtra: If the extra `cluster` is not installed.
    """
    with require("cluster"):
        import dask
        from distributed import Client

    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "100MiB"}):  # a task carries its map
        try:
            client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except ValueError as error:
            raise InputError(f"cluster {address!r}: expected an address like 'tcp://10.0.0.1:8786': {error}") from error
        except OSError as error:
            raise WorkersLost(
                f"no Dask scheduler answers at {address}: {error}; is 'dask scheduler' running?"
            ) from error
        with client:
            executor: Executor = client.get_executor(pure=False)
            try:
                yield executor
            finally:
                executor.shutdown(wait=False)
