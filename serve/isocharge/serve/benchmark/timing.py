"""Durations of calls, measured in turns, so that a machine that slows down slows down all of them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array

Clock = Callable[[], int]
"""Time in ns."""

LEAST_CALLS = 3
"""Calls in a turn, however long they take."""

ROUNDS = 10
"""Turns of every contender; the first one warms up and does not count."""


class Contender(NamedTuple):
    """One way to predict.

    Attributes:
        name: What it is, for tables.
        presses: Presses that a call predicts.
        call: Does it once.
    """

    name: str
    presses: int
    call: Callable[[], object]


@dataclass(frozen=True)
class Timing:
    """How long the calls of one contender took.

    Attributes:
        name, presses: As in `Contender`.
        calls: Number of calls that count.
        p50_us, p99_us: Median and 99th percentile of their durations, us.
        presses_per_s: Presses in a second, over all of their time.
    """

    name: str
    presses: int
    calls: int
    p50_us: float
    p99_us: float
    presses_per_s: float

    @classmethod
    def of(cls, name: str, presses: int, durations_ns: Array, in_parallel: int = 1) -> "Timing":
        """From durations, shape (calls,), ns, of which so many ran at a time."""
        p50, p99 = np.percentile(durations_ns, (50, 99)) / 1e3
        rate = in_parallel * presses * len(durations_ns) / (float(durations_ns.sum()) / 1e9)
        return cls(name, presses, len(durations_ns), float(p50), float(p99), rate)


def take_turns(
    contenders: Sequence[Contender],
    seconds: float,
    progress: Callable[[int, int], object] = lambda _done, _all: None,
    clock: Clock = time.perf_counter_ns,
) -> list[Timing]:
    """Time all contenders, one after another in each of ROUNDS.

    Args:
        contenders: What to time.
        seconds: Time for all of it, s; contenders whose calls take long may take longer.
        progress: Called with the rounds done and all rounds.
        clock: ns.

    Returns:
        A timing for each contender, in their order.
    """
    turn_ns = round(seconds * 1e9 / (ROUNDS * max(len(contenders), 1)))
    durations: list[list[int]] = [[] for _ in contenders]
    for number in range(ROUNDS):
        for contender, of_contender in zip(contenders, durations, strict=True):
            turn = _turn(contender.call, turn_ns, clock)
            if number:
                of_contender += turn
        progress(number + 1, ROUNDS)
    return [
        Timing.of(contender.name, contender.presses, np.array(of, float))
        for contender, of in zip(contenders, durations, strict=True)
    ]


def _turn(call: Callable[[], object], turn_ns: int, clock: Clock) -> list[int]:
    """Durations of calls for as long as a turn lasts, ns."""
    durations: list[int] = []
    end = clock() + turn_ns
    while len(durations) < LEAST_CALLS or clock() < end:
        begin = clock()
        call()
        durations.append(clock() - begin)
    return durations
