"""Where the work of a sweep is done: in this process, in processes on this machine, or on a Dask cluster.

All of them are one `concurrent.futures.Executor`. What they compute does not depend on which, on how many, or on who
is first: tasks are cut beforehand and their results are taken in order.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Generic, TypeVar

from isocharge.common.errors import InputError, WorkersLost
from isocharge.common.extras import require
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.execution.code_version import code_fingerprint

Job = TypeVar("Job")

Result = TypeVar("Result")

AHEAD = 16
"""Tasks handed out before the first result is back."""

CONNECT_S = 10.0
"""Longest wait for a cluster to answer, s."""


@dataclass(frozen=True)
class Workers:
    """Who does the work.

    Attributes:
        executor: Runs the tasks; None runs them in this process.
        ahead: Tasks to hand out before the first result is back: enough to keep workers busy, few enough for memory.
    """

    executor: Executor | None = None
    ahead: int = AHEAD

    def in_order(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
        """The results of all jobs, in their order; jobs are drawn as workers come free."""
        if self.executor is None:
            yield from map(function, jobs)
            return
        pending: deque[Future[Result]] = deque()
        try:
            for job in jobs:
                pending.append(self.executor.submit(SameCodeOnly(function), job))
                if len(pending) >= self.ahead:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()


class SameCodeOnly(Generic[Job, Result]):
    """A function that a worker runs only if it has the same isocharge as the sender: else its bytes would differ."""

    def __init__(self, function: Callable[[Job], Result]) -> None:
        self._function, self._fingerprint = function, code_fingerprint()

    def __call__(self, job: Job) -> Result:
        if code_fingerprint() != self._fingerprint:
            raise WorkersLost(
                f"a worker runs {code_fingerprint()}, expected {self._fingerprint}; install the same on all of them"
            )
        return self._function(job)


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Processes on this machine, none for one worker. They end with the block, and if this process is killed.

    Raises:
        WorkersLost: If one of them ends by itself.
    """
    if count == 1:
        yield Workers()
        return
    context = multiprocessing.get_context("spawn")  # a fork copies locks that other threads hold
    watched, held = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin, initargs=(watched,))
    try:
        yield Workers(pool, 2 * count + 2)
    except BaseException as error:
        held.close()
        if isinstance(error, BrokenExecutor):
            raise WorkersLost("a worker process ended by itself: out of memory, or killed from outside") from error
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        held.close()
        watched.close()


def _begin(watched: Connection) -> None:
    """Interrupts are the parent's to handle; the worker ends when the parent lets go of its end of the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    single_threaded_blas().__enter__()  # for good
    threading.Thread(target=_end_with_parent, args=(watched,), daemon=True).start()


def _end_with_parent(watched: Connection) -> None:
    watched.poll(None)
    os._exit(1)


@contextmanager
def dask_workers(address: str) -> Iterator[Workers]:
    """The workers of a Dask cluster, such as "tcp://10.0.0.1:8786"; they need the same isocharge as this process.

    A worker that is killed is no matter as long as others are left: Dask gives its tasks to them.

    Raises:
        InputError: If this is no address.
        WorkersLost: If the cluster does not answer, or is lost.
        MissingExtra: If the extra `cluster` is not installed.
    """
    with require("cluster"):
        import dask
        from distributed import Client
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

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
            executor = client.get_executor(pure=False)
            try:
                yield Workers(executor, 2 * sum(client.ncores().values()) + 2)
            except (KilledWorker, CancelledError, CommClosedError) as error:
                raise WorkersLost(f"the Dask cluster at {address} gave up: {error}") from error
            finally:
                executor.shutdown(wait=False)
