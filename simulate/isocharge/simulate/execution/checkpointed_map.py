"""A map function whose results are kept in a resumable run, so that a killed run does not solve twice."""

import io
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.resumable_run import ResumableRun

JobMap = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""Applies a function to jobs and gives the results in their order: `map`, an executor's `map`, `Workers.in_order`."""


class CheckpointedMap:
    """A `JobMap` that keeps its results, which are arrays, in a resumable run, and loads those that it already has.

    A result's file name is (number of the map call, index of the job), so the same run finds its results again.
    """

    def __init__(self, run: ResumableRun, name: str, map_jobs: JobMap) -> None:
        self._run, self._name, self._map_jobs, self._calls = run, name, map_jobs, 0

    def __call__(self, function: Callable[[Any], Array], jobs: Iterable[Any]) -> Iterator[Array]:
        """The results of all jobs, in their order; new ones are saved as they are taken."""
        jobs = list(jobs)
        names = [f"{self._name}-{self._calls:02d}-{number:04d}.npy" for number in range(len(jobs))]
        self._calls += 1
        saved = [self._load(name) for name in names]
        missing = [job for job, result in zip(jobs, saved, strict=True) if result is None]
        return self._merged(names, saved, iter(self._map_jobs(function, missing)))

    def _merged(self, names: list[str], saved: list[Array | None], computed: Iterator[Array]) -> Iterator[Array]:
        for name, result in zip(names, saved, strict=True):
            if result is None:
                result = next(computed)
                self._run.save(name, _npy(result))
            yield result

    def _load(self, name: str) -> Array | None:
        return self._run.load_as(name, _array)


def _array(data: bytes) -> Array:
    array = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise ValueError(f"expected an array of numbers, got {getattr(array, 'dtype', 'an archive')}")
    return array


def _npy(array: Array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
