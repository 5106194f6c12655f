"""Presses that a command simulates because it was given none."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from isocharge.simulate import Dataset, Probe, Sensor, Sweep, read_dataset, run_sweep

SAMPLES = 24_000
"""Number of presses."""


def simulated_presses(sensor: Sensor, probes: Sequence[Probe], radius: float, force: tuple[float, float]) -> Dataset:
    """A sweep within a radius (mm) and a range of forces (N), else with its defaults, deleted once it is read.

    It takes a few seconds, so one process is enough.
    """
    with TemporaryDirectory() as folder:
        sweep = Sweep(radius, force, samples=SAMPLES)
        return read_dataset(run_sweep(Path(folder) / "presses", sensor, probes, sweep))
