"""100,000 labelled presses: wall time, memory, and the error of the charges against direct solves.

    python tests/benchmarks/bench_sweep.py [--samples 100000] [--workers 2] [--checks 120] [--seed 0] [--json]

Three probes within 10 mm of the centre, 0.05 to 2 N, turned at random, as `isocharge simulate sweep` makes them, from
the call to the finished dataset: start of the workers, solves, evaluation, checksums. Memory is the peak of the parent
and of the largest worker, added up. Then some of the presses, as many of each probe, are solved one by one on a finer
mesh, and every charge is compared relative to itself.
"""

import argparse
import json
import os
import platform
import resource
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import scipy

from isocharge.common.progress import listening
from isocharge.simulate import (
    Dataset,
    Resolution,
    SolveSettings,
    Sweep,
    load_sensor,
    parse_probe,
    press,
    read_dataset,
    run_sweep,
    touch_charge,
)
from isocharge.simulate.execution.workers import local_workers

PROBES = ("circle:1.0", "rectangle:4.0x2.0", "triangle:4.0")
FINER = Resolution(order=7, around=16, rings=8, rim=2)


@dataclass(frozen=True)
class Run:
    """What was measured.

    Attributes:
        seconds: From the call to the finished dataset.
        solve_seconds: Of these, until the last map was solved and checked.
        cpu_seconds: Of all processes, user and system.
        memory_MB: Peak of the parent plus that of the largest worker for each worker.
        solves: Equilibria.
        within: Share of the charges within 0.1 %.
        worst: Largest relative error, and that of each probe.
    """

    samples: int
    workers: int
    sensor: str
    seconds: float
    solve_seconds: float
    cpu_seconds: float
    memory_MB: float
    parent_MB: float
    worker_MB: float
    solves: int
    interpolation_error: float
    checks: int
    within: float
    within_half: float
    worst: float
    worst_of: dict[str, float]


def measure(sensor_name: str, samples: int, workers: int, checks: int, seed: int) -> Run:
    sensor = load_sensor(sensor_name)
    sweep = Sweep(10.0, (0.05, 2.0), samples, seed, "random")
    began, solved_at = time.perf_counter(), []
    with tempfile.TemporaryDirectory() as folder:
        with (
            local_workers(workers) as executor,
            listening(lambda title, *_: solved_at.append(time.perf_counter()) if title == "pressing" else None),
        ):
            probes = [parse_probe(text) for text in PROBES]
            run_sweep(Path(folder) / "presses", sensor, probes, sweep, executor=executor)
        seconds = time.perf_counter() - began
        usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        parent, worker = (used.ru_maxrss / 1024 for used in usage)
        dataset = read_dataset(Path(folder) / "presses")
    errors = compare(dataset, checks, workers)
    every = np.concatenate(list(errors.values()))
    return Run(
        samples=samples,
        workers=workers,
        sensor=sensor_name,
        seconds=seconds,
        solve_seconds=solved_at[0] - began,
        cpu_seconds=sum(used.ru_utime + used.ru_stime for used in usage),
        memory_MB=parent + (workers * worker if workers > 1 else 0.0),
        parent_MB=parent,
        worker_MB=worker,
        solves=dataset.manifest["solver"]["solves"],
        interpolation_error=dataset.manifest["solver"]["interpolation_error"],
        checks=checks,
        within=float((every < 1e-3).mean()),
        within_half=float((every < 5e-3).mean()),
        worst=float(every.max()),
        worst_of={name: float(error.max()) for name, error in errors.items()},
    )


def compare(dataset: Dataset, checks: int, workers: int) -> dict[str, np.ndarray]:
    """Relative errors of the charges of some presses of each probe, shape (n, n_electrode)."""
    errors, rng = {}, np.random.default_rng(1)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for name in PROBES:
            rows = rng.permutation(np.flatnonzero(dataset.samples.probe == name))[: checks // len(PROBES)]
            direct = np.array(
                list(pool.map(solve, [dataset.sensor] * rows.size, map(press_of, [dataset] * rows.size, rows)))
            )
            errors[name] = np.abs(dataset.samples.charge_pC[rows] / direct - 1.0)
    return errors


def press_of(dataset: Dataset, row: int) -> tuple[str, float, float, float]:
    """Probe, x and y in mm, force in N."""
    samples = dataset.samples
    probe = f"{samples.probe[row]}@{samples.orientation_deg[row]:.12g}"
    return probe, float(samples.x_mm[row]), float(samples.y_mm[row]), float(samples.force_N[row])


def solve(sensor, one: tuple[str, float, float, float]) -> np.ndarray:
    """Touch charges, pC."""
    probe, x, y, force = one
    solved = press(sensor.film, parse_probe(probe), (x, y), force, SolveSettings(resolution=FINER))
    return touch_charge(sensor, solved)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="four-25um-biaxial")
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--checks", type=int, default=120)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    run = measure(options.sensor, options.samples, options.workers, options.checks, options.seed)
    machine = {
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "machine": platform.machine(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }
    if options.json:
        print(json.dumps({**asdict(run), **machine}))
        return
    print(
        f"{run.samples} presses on {run.sensor} with {', '.join(PROBES)}, {run.workers} workers: {run.seconds:.1f} s, "
        f"of which {run.solve_seconds:.1f} s solving ({run.solves} solves, interpolated to "
        f"{run.interpolation_error:.1e}); "
        f"{run.cpu_seconds:.1f} s of CPU"
    )
    print(f"peak memory {run.memory_MB:.0f} MB: parent {run.parent_MB:.0f}, each worker {run.worker_MB:.0f}")
    print(
        f"charges of {run.checks} presses against direct solves: {run.within:.1%} within 0.1 %, {run.within_half:.1%} "
        f"within 0.5 %, worst {run.worst:.2%} ("
        + ", ".join(f"{name} {error:.2%}" for name, error in run.worst_of.items())
        + ")"
    )
    print(", ".join(f"{name} {value}" for name, value in machine.items()))


if __name__ == "__main__":
    main()
