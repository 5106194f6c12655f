"""How long predictions take: one at a time, and many.

Machines are noisy, so the contenders take turns: rounds of a few milliseconds each, the first thrown away. A round of a
contender begins with calls that only warm up, because another one has just used the cache.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Array
from isocharge.common.progress import Progress

WARM_UP = 0.2
"""Share of a round's calls that only warm up."""

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


def latencies(
    contenders: Mapping[str, Sequence[Call]],
    rounds: int,
    round_ms: float,
    progress: Progress,
    clock: Clock = time.perf_counter_ns,
) -> dict[str, Array]:
    """Durations of single predictions.

    Args:
        contenders: For each, calls that predict one press each, of several presses.
        rounds: How often each has its turn; one more to warm up.
        round_ms: Length of a turn, ms; at least three calls.
        progress: Called with the rounds done and all rounds.
        clock: ns.

    Returns:
        For each contender shape (rounds, calls), us.
    """
    counts = {name: _calls_in(calls, round_ms, clock) for name, calls in contenders.items()}
    durations: dict[str, list[Array]] = {name: [] for name in contenders}
    for number in range(rounds + 1):
        for name, calls in contenders.items():
            durations[name].append(_durations(calls, counts[name], clock))
        progress(number + 1, rounds + 1)
    return {name: np.array(taken[1:]) for name, taken in durations.items()}


def _calls_in(calls: Sequence[Call], milliseconds: float, clock: Clock) -> int:
    first = _durations(calls, 5, clock)
    return int(np.clip(1e3 * milliseconds / np.median(first), 3, 2000))


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


def throughputs(
    contenders: Mapping[str, Callable[[Array], object]],
    charge_pC: Array,
    rounds: int,
    longest_s: float,
    progress: Progress,
    clock: Clock = time.perf_counter_ns,
) -> dict[str, float]:
    """Predictions per second in batches.

    Args:
        contenders: Functions of a batch of charges.
        charge_pC: The batch, shape (n, n_electrode).
        rounds: Turns of each; the median counts, the first only warms up.
        longest_s: Where one batch takes longer than this, its first rows are timed instead.
        progress: Called with the rounds done and all rounds.
        clock: ns.
    """
    rows = {name: _rows_within(predict, charge_pC, longest_s, clock) for name, predict in contenders.items()}
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(rounds + 1):
        for name, predict in contenders.items():
            seconds[name].append(_seconds(predict, charge_pC[: rows[name]], clock))
        progress(number + 1, rounds + 1)
    return {name: rows[name] / float(np.median(taken[1:])) for name, taken in seconds.items()}


def _rows_within(predict: Callable[[Array], object], charge_pC: Array, longest_s: float, clock: Clock) -> int:
    """All rows, or a 64th of them where a first try says that all take longer than `longest_s`."""
    few = max(1, len(charge_pC) // 64)
    taken = min(_seconds(predict, charge_pC[:few], clock) for _ in range(2))
    return len(charge_pC) if taken * len(charge_pC) / few <= longest_s else few


def _seconds(predict: Callable[[Array], object], charge_pC: Array, clock: Clock) -> float:
    begin = clock()
    predict(charge_pC)
    return 1e-9 * (clock() - begin)
