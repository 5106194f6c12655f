"""100,000 labelled presses: wall time, memory, and the error of the charges against direct solves.

    python tests/benchmarks/bench_sweep.py [--json]

Three probes within 10 mm of the centre, 0.05 to 2 N, turned at random, as `isocharge simulate sweep` makes them, from
the call to the finished dataset: start of the workers, solves, evaluation, checksums. Memory is the peak of the parent
and of the largest worker, added up. Then some of the presses, as many of each probe, are solved one by one on a finer
mesh, and every charge is compared relative to itself.
"""

import resource
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from shared import arguments, print_results

from isocharge.common.progress import listening
from isocharge.simulate import (
    Dataset,
    Resolution,
    SolveSettings,
    Sweep,
    load_sensor,
    local_workers,
    parse_probe,
    press,
    read_dataset,
    run_sweep,
    touch_charge,
)
from isocharge.simulate.execution import in_order

PROBES = ("circle:1.0", "rectangle:4.0x2.0", "triangle:4.0")
SAMPLES = 100_000
CHECKS = 20
"""Number of presses of each probe that are compared with direct solves."""

FINER = Resolution(order=7, around=8, rings=7, rim=2)


def relative_error(dataset: Dataset, row: int) -> np.ndarray:
    """Of the charges of a press, against a direct solve."""
    samples, sensor = dataset.samples, dataset.sensor
    probe = parse_probe(f"{samples.probe[row]}@{samples.orientation_deg[row]:.12g}")
    at, force = (float(samples.x_mm[row]), float(samples.y_mm[row])), float(samples.force_N[row])
    direct = touch_charge(sensor, press(sensor.film, probe, at, force, SolveSettings(resolution=FINER)))
    return np.abs(samples.charge_pC[row] / direct - 1.0)


def main() -> None:
    options = arguments(__doc__)
    sensor, sweep = load_sensor("four-25um-biaxial"), Sweep(10.0, (0.05, 2.0), SAMPLES, 0, "random")
    began, solved_at = time.perf_counter(), []

    def listener(title: str, *_) -> None:
        if title == "pressing":
            solved_at.append(time.perf_counter())

    with tempfile.TemporaryDirectory() as folder, local_workers(2) as executor:
        with listening(listener):
            run_sweep(Path(folder) / "presses", sensor, [*map(parse_probe, PROBES)], sweep, executor=executor)
        seconds, dataset = time.perf_counter() - began, read_dataset(Path(folder) / "presses")
    parent, worker = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    rng, errors = np.random.default_rng(1), {}
    with local_workers(2) as executor:
        for name in PROBES:
            rows = rng.permutation(np.flatnonzero(dataset.samples.probe == name))[:CHECKS]
            errors[name] = np.max([*in_order(executor, partial(relative_error, dataset), rows.tolist())])
    result = {
        "seconds": seconds,
        "solve_seconds": solved_at[0] - began,
        "parent_MB": parent.ru_maxrss / 1024,
        "worker_MB": worker.ru_maxrss / 1024,
        "worst_percent": {name: 100.0 * float(error) for name, error in errors.items()},
    }
    print_results("sweep", options, result)


if __name__ == "__main__":
    main()
