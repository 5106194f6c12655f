"""Measurement of the duration of calls.

A contender is one way to compute predictions, such as a method of the predictor. The speeds of several contenders are
compared. The contenders take turns. Therefore, a change in the speed of the machine affects all contenders equally.
"""

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
from isocharge.serve.model.contact import Contact
from isocharge.serve.model.predictor import Predictor

Clock = Callable[[], int]
"""Function that returns the time, ns."""

ROUNDS = 10
"""Number of turns of every contender. The first turn is a warm-up, whose durations are not used."""

BATCH_SIZES = (16, 256, 4096)
"""Numbers of presses in a batch. The last number is the size of the largest batch that a server accepts by default."""


class Contender(NamedTuple):
    """One way to compute predictions.

    Attributes:
        name: Name of the contender, for tables.
        presses: Number of presses that one call predicts.
        call: Function that predicts the presses once. Its duration is measured.
    """

    name: str
    presses: int
    call: Callable[[], object]


class Timing(NamedTuple):
    """Durations of the calls of one contender.

    Attributes:
        name: Name of the contender.
        presses: Number of presses that one call predicts.
        calls: Number of calls that were timed.
        p50_us: Median of the durations, us.
        p99_us: 99th percentile of the durations, us.
        presses_per_s: Number of presses per second, over the total time of all calls.
    """

    name: str
    presses: int
    calls: int
    p50_us: float
    p99_us: float
    presses_per_s: float


def take_turns(contenders: Sequence[Contender], seconds: float, clock: Clock = time.perf_counter_ns) -> list[Timing]:
    """Measure how long the calls of each contender take. A contender is one way to compute predictions.

    In each round, every contender has one turn, in which it is called repeatedly. The first round only warms up the
    processor and the caches. The durations of its calls are not used.

    Args:
        contenders: Contenders that are measured.
        seconds: Total time of all turns, s. The measurement takes longer if the calls of a contender take long.
        clock: Function that returns the time, ns.

    Returns:
        The timing of each contender, in the order of `contenders`.
    """
    turn_ns = round(seconds * 1e9 / (ROUNDS * len(contenders)))
    durations: list[list[int]] = [[] for _ in contenders]
    for round_number in track(range(ROUNDS), "measuring", ROUNDS):
        for contender, durations_ns in zip(contenders, durations, strict=True):
            if round_number == 1:
                durations_ns.clear()  # the first round, which has the number 0, was the warm-up
            call_end_ns = clock()
            turn_end_ns = call_end_ns + turn_ns
            while call_end_ns < turn_end_ns:
                call_start_ns = clock()
                contender.call()
                call_end_ns = clock()
                durations_ns.append(call_end_ns - call_start_ns)
    return [
        _timing(contender, np.array(durations_ns, float))
        for contender, durations_ns in zip(contenders, durations, strict=True)
    ]


def _timing(contender: Contender, durations_ns: Array) -> Timing:
    """Compute the statistics of the durations of the calls of one contender, shape (calls,), ns."""
    p50_us, p99_us = np.percentile(durations_ns, (50, 99)) / 1e3
    calls = len(durations_ns)
    presses_per_s = contender.presses * calls / float(durations_ns.sum()) * 1e9
    return Timing(contender.name, contender.presses, calls, float(p50_us), float(p99_us), presses_per_s)


def press_charges(predictor: Predictor, golden_pC: Singles) -> Singles:
    """Return charges of as many presses as the largest batch, from the golden vectors that are stored with a model.

    Golden vectors for which the model returns a contact with flags are excluded. The others are repeated in turn.

    Args:
        predictor: Predictor with the model.
        golden_pC: Charges of the golden vectors, shape (n, electrodes), pC.
    """
    flags_of_presses = predictor.validity.batch_flags(predictor.predict_batch(golden_pC))
    is_valid = [not flags for flags in flags_of_presses]
    return np.resize(golden_pC[is_valid], (max(BATCH_SIZES), golden_pC.shape[1]))


def in_process_contenders(predictor: Predictor, charge_pC: Singles) -> list[Contender]:
    """Return the contenders that call methods of a predictor in this process.

    A contender is one way to compute predictions, whose speed is compared with that of the others.

    Two contenders predict one press in each call. In addition, there is one contender for each batch size.

    Args:
        predictor: Predictor with the model.
        charge_pC: Charges of presses, shape (n, electrodes), pC, at least as many as in the largest batch. Each call
            for one press uses the next row.
    """
    # These functions return the charges of the next press, and begin again with the first press after the last one.
    next_array = partial(next, cycle(charge_pC))
    next_list = partial(next, cycle(charge_pC.tolist()))
    out = np.zeros(len(Contact._fields), np.float32)  # receives the results of `predict_into`
    contenders = [
        Contender("predict_into, float32 array", 1, lambda: predictor.predict_into(next_array(), out)),
        Contender("predict, list of numbers", 1, lambda: predictor.predict(next_list())),
    ]
    for batch_size in BATCH_SIZES:
        predict_batch = partial(predictor.predict_batch, charge_pC[:batch_size])
        contenders.append(Contender(f"predict_batch, {batch_size}", batch_size, predict_batch))
    return contenders


def machine(packages: Sequence[str] = ("numpy", "onnxruntime")) -> dict[str, str]:
    """Return the processor, the operating system, and the versions of Python and of packages on this machine.

    Args:
        packages: Names of the packages.
    """
    cpu_file = Path("/proc/cpuinfo")  # exists only on Linux
    lines = cpu_file.read_text("utf-8").splitlines() if cpu_file.exists() else []
    cpu_names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return {
        "cpu": next(cpu_names, platform.processor()),  # the name of the first processor
        "cores": str(os.cpu_count()),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in packages},
    }
