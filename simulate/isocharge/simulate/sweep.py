"""A sweep: many presses spread over the working area and the forces, and their charges."""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.stats import qmc

from isocharge.errors import SceneError
from isocharge.files import refuse_existing
from isocharge.simulate.arrays import Array
from isocharge.simulate.dataset import Samples, write_dataset
from isocharge.simulate.forward import ForwardMap, Progress
from isocharge.simulate.probe import Probe
from isocharge.simulate.sensor import Sensor

MOST_SAMPLES = 10_000_000
"""Largest sweep: about 600 MB on disk."""

SHARD = 16384
"""Samples per shard."""


@dataclass(frozen=True)
class Sweep:
    """What to sample.

    Attributes:
        radius: Presses are spread uniformly over the disk of this radius, m.
        force_range: Forces are spread uniformly in the logarithm between these, N.
        samples: How many, shared equally among the probes.
        seed: Of the sequence.
        orientation: "fixed" (0) or "random" angle of the probe.
    """

    radius: float = 8e-3
    force_range: tuple[float, float] = (0.05, 2.0)
    samples: int = 20_000
    seed: int = 0
    orientation: Literal["fixed", "random"] = "fixed"

    def __post_init__(self) -> None:
        if not 1 <= self.samples <= MOST_SAMPLES:
            bound = "at least 1" if self.samples < 1 else f"at most {MOST_SAMPLES}"
            raise SceneError(f"samples: expected {bound}, got {self.samples}")
        if self.orientation not in ("fixed", "random"):
            raise SceneError(f"orientation: expected 'fixed' or 'random', got {self.orientation!r}")

    def presses(self) -> tuple[Array, Array, Array, Array]:
        """x, y (m), force (N) and orientation (rad) of every sample, each of shape (samples,).

        Scrambled Sobol points: fewer gaps and clumps than independent draws (Owen 1998).
        """
        bits = int(np.ceil(np.log2(max(self.samples, 2))))
        unit = qmc.Sobol(4, rng=np.random.default_rng(self.seed)).random_base2(bits)[: self.samples]
        distance, angle = self.radius * np.sqrt(unit[:, 0]), 2.0 * np.pi * unit[:, 1]
        low, high = np.log(self.force_range)
        turned = 2.0 * np.pi * unit[:, 3] if self.orientation == "random" else np.zeros(self.samples)
        force = np.clip(np.exp(low + (high - low) * unit[:, 2]), *self.force_range)
        return distance * np.cos(angle), distance * np.sin(angle), force, turned


def run_sweep(
    folder: Path,
    sensor: Sensor,
    probes: tuple[Probe, ...],
    sweep: Sweep,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Path:
    """Simulate a sweep and write it as a dataset.

    Args:
        folder: Where; must not exist yet.
        sensor: The sensor.
        probes: The objects that press; sample i belongs to probe i modulo their number.
        sweep: What to sample.
        executor: Where the solves run; the bytes written do not depend on it.
        progress: Told how many distances are solved.

    Returns:
        The folder.

    Raises:
        SceneError: If a press cannot exist.
        OutputExists: If the folder is already there; said before the work begins.
    """
    refuse_existing(folder)
    return write_sweep(folder, solve_maps(sensor, probes, sweep, executor=executor, progress=progress), sweep)


def solve_maps(
    sensor: Sensor,
    probes: tuple[Probe, ...],
    sweep: Sweep,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> tuple[ForwardMap, ...]:
    """A forward map for each probe, over the sweep's ranges."""
    if not probes:
        raise SceneError("probes: expected at least one, got none")
    return tuple(
        ForwardMap.build(sensor, probe, sweep.radius, sweep.force_range, executor=executor, progress=progress)
        for probe in probes
    )


def write_sweep(folder: Path, maps: tuple[ForwardMap, ...], sweep: Sweep) -> Path:
    """Write a sweep's presses and charges, given the solved maps; see `run_sweep`."""
    about = {
        "probes": [made.probe.notation for made in maps],
        "ranges": {
            "radius_mm": float(f"{sweep.radius * 1e3:.12g}"),
            "force_N": list(sweep.force_range),
            "orientation": sweep.orientation,
        },
        "sampling": "scrambled Sobol, uniform over the disk, log-uniform in force",
        "seed": sweep.seed,
        "noise": "clean",
        "solver": _solver(maps),
    }
    presses = sweep.presses()  # before anything is written: scipy's Sobol tables swallow an interrupt
    return write_dataset(folder, maps[0].sensor, _shards(maps, presses), about)


def _solver(maps: tuple[ForwardMap, ...]) -> dict[str, Any]:
    resolution = maps[0].resolution
    return {
        "theory": maps[0].theory.name,
        "order": resolution.order,
        "around": resolution.around,
        "rings": resolution.rings,
        "rim": resolution.rim,
        "solves": sum(len(made.table) for made in maps),
        "interpolation_error": max(made.error for made in maps),
    }


def _shards(maps: tuple[ForwardMap, ...], presses: tuple[Array, Array, Array, Array]) -> Iterator[Samples]:
    x, y, force, turned = presses
    which = np.arange(x.size) % len(maps)
    notation = np.array([made.probe.notation for made in maps])
    for start in range(0, x.size, SHARD):
        part = slice(start, start + SHARD)
        charge = np.empty((len(x[part]), len(maps[0].sensor.electrodes)))
        for number, made in enumerate(maps):
            mine = which[part] == number
            charge[mine] = made.forward(x[part][mine], y[part][mine], force[part][mine], turned[part][mine])
        yield Samples(
            x_mm=x[part] * 1e3,
            y_mm=y[part] * 1e3,
            force_N=force[part],
            probe=notation[which[part]],
            orientation_deg=np.rad2deg(turned[part]),
            charge_pC=charge * 1e12,
        )
