"""An executor whose results are kept in a resumable run, so that a killed run does not solve twice."""

import io
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from typing import Any

import numpy as np

from isocharge.arrays import Array
from isocharge.resumable_run import ResumableRun
from isocharge.simulate.execution.workers import SameCodeOnly


class CheckpointedExecutor(Executor):
    """An executor whose `map` keeps its results, if they are arrays, in a draft, and does not work for them again.

    The results of a call are named by their place in it and by the call's place among the others: both depend on the
    run alone.
    """

    def __init__(self, draft: ResumableRun, name: str, inner: Executor | None) -> None:
        self._draft, self._name, self._inner, self._calls = draft, name, inner, 0

    def map(self, fn: Callable[..., Any], *iterables: Iterable[Any], **_options: Any) -> Iterator[Any]:
        """As of any executor; finished results are saved as they are taken."""
        jobs = list(zip(*iterables, strict=False))
        names = [f"{self._name}-{self._calls:02d}-{number:04d}.npy" for number in range(len(jobs))]
        self._calls += 1
        kept = [self._load(name) for name in names]
        left = [job for job, result in zip(jobs, kept, strict=True) if result is None]
        made = self._inner.map(SameCodeOnly(Spread(fn)), left) if self._inner and left else map(Spread(fn), left)
        return self._merged(names, kept, iter(made))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Not remembered."""
        if self._inner is None:
            raise RuntimeError("expected an executor to submit to, got none: without one there is only map")
        return self._inner.submit(fn, *args, **kwargs)

    def _merged(self, names: list[str], kept: list[Array | None], made: Iterator[Any]) -> Iterator[Any]:
        for name, result in zip(names, kept, strict=True):
            if result is not None:
                yield result
                continue
            fresh = next(made)
            if isinstance(fresh, np.ndarray):
                self._draft.save(name, _npy(fresh))
            yield fresh

    def _load(self, name: str) -> Array | None:
        data = self._draft.load(name)
        return None if data is None else np.load(io.BytesIO(data), allow_pickle=False)


class Spread:
    """A function of several arguments as one of their tuple."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, arguments: tuple[Any, ...]) -> Any:
        return self._function(*arguments)


def _npy(array: Array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
