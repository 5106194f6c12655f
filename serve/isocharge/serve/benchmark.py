"""Durations of calls, measured in turns, so that a machine that slows down slows down all of them."""

import os
import platform
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib import metadata
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Singles
from isocharge.common.progress import track
from isocharge.serve.prediction.predictor import Predictor

Clock = Callable[[], int]
"""Time in ns."""

LEAST_CALLS = 3
"""Calls in a turn, however long they take."""

ROUNDS = 10
"""Turns of every contender; the first one warms up and does not count."""

BATCHES = (16, 256, 4096)
"""Presses in a batch; the last is the largest that a server takes by default."""

CHARGES = 4096
"""Presses that the calls cycle through."""


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


class Timing(NamedTuple):
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
    def of(cls, name: str, presses: int, durations_ns: Array) -> "Timing":
        """From durations, shape (calls,), ns."""
        p50, p99 = np.percentile(durations_ns, (50, 99)) / 1e3
        rate = presses * len(durations_ns) / (float(durations_ns.sum()) / 1e9)
        return cls(name, presses, len(durations_ns), float(p50), float(p99), rate)


def take_turns(contenders: Sequence[Contender], seconds: float, clock: Clock = time.perf_counter_ns) -> list[Timing]:
    """Time all contenders, one after another in each of ROUNDS.

    Args:
        contenders: What to time.
        seconds: Time for all of it, s; contenders whose calls take long may take longer.
        clock: ns.

    Returns:
        A timing for each contender, in their order.
    """
    turn_ns = round(seconds * 1e9 / (ROUNDS * max(len(contenders), 1)))
    durations: list[list[int]] = [[] for _ in contenders]
    for number in track(range(ROUNDS), "measuring", ROUNDS):
        for contender, of_contender in zip(contenders, durations, strict=True):
            turn = _turn(contender.call, turn_ns, clock)
            if number:
                of_contender += turn
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


def press_charges(predictor: Predictor, golden_pC: Singles, seed: int = 0) -> Singles:
    """Presses drawn from the golden vectors of a model, pC: from those that it takes for presses, without a flag.

    Shape (CHARGES, electrodes) from (n, electrodes).
    """
    flags = predictor.validity.batch_flags(predictor.predict_batch(golden_pC))
    sound: Singles = golden_pC[[not words for words in flags]]
    return sound[np.random.default_rng(seed).integers(0, len(sound), CHARGES)]


def in_process_contenders(predictor: Predictor, charge_pC: Singles) -> list[Contender]:
    """Every method of a predictor.

    Args:
        predictor: The model.
        charge_pC: Shape (n, electrodes), pC; each call of one press takes the next row. Batches above n are left out.
    """
    rows, lists, out = cycle(charge_pC), cycle(charge_pC.tolist()), np.zeros(7, np.float32)
    contenders = [
        Contender("predict_into, float32 array", 1, lambda: predictor.predict_into(next(rows), out)),
        Contender("predict, list of numbers", 1, lambda: predictor.predict(next(lists))),
    ]
    return contenders + [
        Contender(f"predict_batch, {n}", n, partial(predictor.predict_batch, charge_pC[:n]))
        for n in BATCHES
        if n <= len(charge_pC)
    ]


def machine(packages: Sequence[str] = ("numpy", "onnxruntime")) -> dict[str, str]:
    """Where figures were measured: processor, cores, system, Python, and the versions of packages."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text("utf-8").splitlines() if info.exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return {
        "cpu": next(names, platform.processor()),
        "cores": str(os.cpu_count()),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in packages},
    }
