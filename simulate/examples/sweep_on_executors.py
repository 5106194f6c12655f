"""The same dataset computed by a process pool and by a Dask cluster.

A sweep accepts any `concurrent.futures.Executor`. The first argument of the script is a folder, and the optional second
argument is the address of a Dask scheduler.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from isocharge.simulate import Circle, Sweep, dask_workers, load_sensor, read_dataset, run_sweep

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    sensor = load_sensor("three-25um-biaxial")
    probes = (Circle(1.0),)
    sweep = Sweep(radius=4.0, samples=2000, seed=1)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        dataset = read_dataset(run_sweep(folder / "pool", sensor, probes, sweep, executor=pool))
    print(f"{len(dataset.samples)} presses, charges up to {dataset.samples.charge_pC.max():.0f} pC")
    if len(sys.argv) > 2:  # the address of a Dask scheduler, like tcp://10.0.0.1:8786
        with dask_workers(sys.argv[2]) as cluster:
            other = read_dataset(run_sweep(folder / "cluster", sensor, probes, sweep, executor=cluster))
        print(
            "equal charges:",
            bool((other.samples.charge_pC == dataset.samples.charge_pC).all()),
        )
