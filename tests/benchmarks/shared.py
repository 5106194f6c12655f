"""What the benchmarks share: options, calls that take turns, percentiles, and how results are printed."""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.serve.benchmark import machine

Calls = dict[str, Callable[[], object]]


def options(page: str, model: str = "three-25um-biaxial", **more: Any) -> argparse.Namespace:
    """What was asked of a benchmark of a model, see `arguments`."""
    return arguments(page, model=model, seed=0, json=False, **more)


def arguments(page: str, **defaults: Any) -> argparse.Namespace:
    """The command's options by name; a default says the type: False is a switch, None the path of a file."""
    parser = argparse.ArgumentParser(description=page, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        kind = {"action": "store_true"} if default is False else {"type": Path if default is None else type(default)}
        parser.add_argument(
            "--" + name.replace("_", "-").lower(), dest=name, default=default, help="%(default)s", **kind
        )
    return parser.parse_args()


def print_results(name: str, asked: argparse.Namespace, results: dict[str, Any]) -> None:
    """Results, a value or a list of rows by title, with the machine: for people, or as one JSON object."""
    if asked.json:
        about = {"benchmark": name, **vars(asked), "machine": machine()}
        print(json.dumps(about | {"results": results}, default=str))
        return
    print(", ".join(f"{key} {value}" for key, value in machine().items()))
    for title, value in results.items():
        if isinstance(value, list):
            print(title, *value, sep="\n    ")
        else:
            print(f"{title}: {value}")


def percentiles(values: Any, shares: tuple[float, ...], digits: int = 1) -> dict[str, float]:
    """By name; empty for no values."""
    return {f"p{share:g}": round(float(np.percentile(values, share)), digits) for share in shares if len(values)}


def take_turns(calls: Calls, rounds: int, number: int) -> dict[str, np.ndarray]:
    """Durations, shape (rounds, number), us, of calls that take turns; a first round warms up and is thrown away."""
    durations: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            durations[name].append(_microseconds(call, number))
    return {name: np.array(of_name[1:]) for name, of_name in durations.items()}


def _microseconds(call: Callable[[], object], number: int) -> np.ndarray:
    clock, durations = time.perf_counter_ns, np.empty(number)
    for i in range(number):
        begin = clock()
        call()
        durations[i] = clock() - begin
    return durations / 1e3


def rows(durations: dict[str, np.ndarray], against: str) -> Iterator[dict[str, Any]]:
    """A row for each call: percentiles, and its p50 over the p50 of `against`, median over rounds and its range."""
    base = np.median(durations[against], axis=1)
    for name, of_name in durations.items():
        ratio = np.median(of_name, axis=1) / base
        yield {
            "call": name,
            "us": percentiles(of_name, (50, 99), 2),
            "ratio_p50": round(float(np.median(ratio)), 3),
            "ratio_range": [round(float(ratio.min()), 3), round(float(ratio.max()), 3)],
        }
