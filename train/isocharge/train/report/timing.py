"""How long predictions take.

Machines are noisy, so the contenders take turns: rounds of a few milliseconds each, the first thrown away. A turn
begins with calls that only warm up, because another contender has just used the cache.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array
from isocharge.common.progress import track

WARM_UP = 0.2
"""Share of a turn's calls that only warm up."""

MOST_CALLS = 2000
"""Calls in a turn at most."""

Call = Callable[[], object]

Clock = Callable[[], int]
"""Time in ns."""


@contextmanager
def one_thread() -> Iterator[None]:
    """BLAS, OpenMP and torch on one thread for the block."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(threads)


def durations(
    contenders: Mapping[str, Sequence[Call]],
    rounds: int,
    round_ms: float,
    least: int = 3,
    clock: Clock = time.perf_counter_ns,
) -> dict[str, Array]:
    """Durations of calls.

    Args:
        contenders: For each, calls that are made in turn.
        rounds: How often each has its turn; one more to warm up.
        round_ms: Length of a turn, ms.
        least: Calls in a turn at least.
        clock: ns.

    Returns:
        For each contender shape (rounds, calls), us.
    """
    counts, taken = {}, {name: list[Array]() for name in contenders}
    for name, calls in contenders.items():
        first = np.median(_durations(calls, least, clock))
        counts[name] = int(np.clip(1e3 * round_ms / first, least, MOST_CALLS))
    for _ in track(range(rounds + 1), "timing"):
        for name, calls in contenders.items():
            taken[name].append(_durations(calls, counts[name], clock))
    return {name: np.array(turns[1:]) for name, turns in taken.items()}


def _durations(calls: Sequence[Call], count: int, clock: Clock) -> Array:
    """Durations of `count` calls in turn, after some to warm up, us."""
    warm_up = max(1, round(WARM_UP * count))
    taken = np.empty(warm_up + count)
    for number in range(len(taken)):
        call = calls[number % len(calls)]
        begin = clock()
        call()
        taken[number] = clock() - begin
    return taken[warm_up:] / 1e3
