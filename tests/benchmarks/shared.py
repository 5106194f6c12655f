"""What the benchmarks share: options, calls that take turns, percentiles, and how results are printed."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.serve.benchmark import Contender, machine, take_turns


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
    """Results by title, a value, rows or values by name, with the machine: for people, or as one JSON object."""
    if asked.json:
        about = {"benchmark": name, **vars(asked), "machine": machine()}
        print(json.dumps(about | {"results": results}, default=str))
        return
    print(", ".join(f"{key} {value}" for key, value in machine().items()))
    for title, value in results.items():
        lines = [f"{name}: {item}" for name, item in value.items()] if isinstance(value, dict) else value
        print(*([title, *lines] if isinstance(lines, list) else [f"{title}: {lines}"]), sep="\n    ")


def percentiles(values: Any, shares: tuple[float, ...], digits: int = 1) -> dict[str, float]:
    """By name; empty for no values."""
    return {f"p{share:g}": round(float(np.percentile(values, share)), digits) for share in shares if len(values)}


def in_turns(contenders: Sequence[Contender], seconds: float) -> list[dict[str, Any]]:
    """A row for each: percentiles of the time for a press, and its median over that of the first."""
    timings = take_turns(contenders, seconds)
    first = timings[0].p50_us / timings[0].presses
    return [
        {
            "call": timing.name,
            "p50_us": round(timing.p50_us / timing.presses, 3),
            "p99_us": round(timing.p99_us / timing.presses, 3),
            "ratio_p50": round(timing.p50_us / timing.presses / first, 3),
        }
        for timing in timings
    ]
