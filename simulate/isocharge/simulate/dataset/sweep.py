"""Simulation of a sweep: many presses over a range of positions and forces, and their charges.

A forward map is solved for every probe and evaluated for every press. Both are divided into tasks that do not depend on
the executor, so that the files do not depend on the executor either. Finished parts are saved in a folder next to the
dataset, from which an interrupted run is resumed.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict
from itertools import tee
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.common.progress import report
from isocharge.common.resumable_run import ResumableRun, output_errors, refuse_finished, resume_folder
from isocharge.simulate.dataset.sampling import SAMPLING_DESCRIPTIONS, Sweep, SweepPresses
from isocharge.simulate.dataset.shards import (
    Samples,
    pack_shard,
    shard_entry,
    shard_name,
    write_dataset,
    write_manifest,
)
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.execution.code_version import code_fingerprint
from isocharge.simulate.execution.workers import in_order
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.simulate.solver.load_case import SolveSettings

SHARD_SIZE = 16384
"""Default number of samples in a shard."""

TASK_SIZE = 8192
"""Largest number of presses in a task. A task then takes about a second, which is long compared with the time for
sending the forward map (12 MB) to the worker."""


def run_sweep(
    folder: Path,
    sensor: Sensor,
    probes: Sequence[Probe],
    sweep: Sweep,
    settings: SolveSettings = SolveSettings(),
    *,
    executor: Executor | None = None,
    shard: int = SHARD_SIZE,
    fresh: bool = False,
) -> Path:
    """Simulate a sweep and write it as a dataset.

    If a run is interrupted, a call with the same arguments resumes it.

    Args:
        folder: Folder to create. It must not exist yet.
        sensor: Sensor.
        probes: Probes, which alternate.
        sweep: Definition of the presses.
        settings: Settings of the solver.
        executor: Executor that runs the tasks, such as a process pool or the executor of a Dask cluster; this process
            if absent. The files do not depend on the executor.
        shard: Number of samples in a shard.
        fresh: Whether to delete the saved parts of an earlier run instead of resuming it.

    Returns:
        Path of the folder.

    Raises:
        SceneError: If the film cannot be pressed as required.
        OutputExists: If the folder already exists, or if there is an unfinished run with different settings. The error
            is raised before the computation starts.
        OutputError: If a file cannot be written. The finished parts remain saved.
        WorkersLost: If the workers of the executor end. The finished parts remain saved.
    """
    folder = Path(folder)
    probes = tuple(probes)
    refuse_finished(folder)
    presses = sweep.over(probes)  # before files are written, because SciPy ignores an interrupt here
    identity = {
        "made_by": code_fingerprint(),
        "sensor": sensor_to_dict(sensor),
        "probes": [f"{probe.notation}@{np.rad2deg(probe.angle):.12g}" for probe in probes],
        "sweep": asdict(sweep),
        "solver": asdict(settings),
        "shard": shard,
    }
    with single_threaded_blas(), resume_folder(folder, identity, fresh=fresh) as run:
        maps = [
            ForwardMap.build(
                sensor,
                probe,
                sweep.radius,
                sweep.force_range,
                settings,
                executor=run.keeping(f"solve-{number:02d}", executor),
            )
            for number, probe in enumerate(probes)
        ]
        entries = _finish_shards(run, maps, presses, executor, shard)
        with output_errors(folder):
            write_manifest(run.data, folder.name, sensor, entries, _manifest_entries(maps, sweep))
    return folder


def solve_maps(
    sensor: Sensor,
    probes: Sequence[Probe],
    sweep: Sweep,
    settings: SolveSettings = SolveSettings(),
    *,
    executor: Executor | None = None,
) -> tuple[ForwardMap, ...]:
    """Solve a forward map for each probe over the ranges of a sweep; see `run_sweep` for the arguments."""
    return tuple(
        ForwardMap.build(sensor, probe, sweep.radius, sweep.force_range, settings, executor=executor)
        for probe in probes
    )


def write_sweep(folder: Path, maps: Sequence[ForwardMap], sweep: Sweep) -> Path:
    """Write the dataset of a sweep in this process from forward maps that have already been solved.

    Args:
        folder: Folder to create.
        maps: Forward map of each probe.
        sweep: Definition of the presses.

    Returns:
        Path of the folder.
    """
    presses = sweep.over([forward_map.probe for forward_map in maps])
    return write_dataset(
        folder, maps[0].sensor, _samples(maps, _split(presses, SHARD_SIZE), None), _manifest_entries(maps, sweep)
    )


def _manifest_entries(maps: Sequence[ForwardMap], sweep: Sweep) -> dict[str, Any]:
    """Return the entries of the manifest that describe the sweep."""
    return {
        "probes": list(dict.fromkeys(forward_map.probe.notation for forward_map in maps)),
        "ranges": {
            "radius_mm": float(f"{sweep.radius:.12g}"),
            "force_N": list(sweep.force_range),
            "orientation": sweep.orientation,
        },
        "sampling": SAMPLING_DESCRIPTIONS[sweep.sampling],
        "seed": sweep.seed,
        "noise": "clean",
        "solver": {
            "theory": maps[0].theory.name,
            "mesh": {forward_map.probe.notation: forward_map.resolution.description for forward_map in maps},
            "solves": sum(forward_map.solves for forward_map in maps),
            "interpolation_error": max(forward_map.error for forward_map in maps),
        },
    }


def _finish_shards(
    run: ResumableRun, maps: Sequence[ForwardMap], presses: SweepPresses, executor: Executor | None, shard: int
) -> list[dict[str, Any]]:
    """Compute and write the shards that are not saved yet, and return the manifest entries of all shards in order."""
    parts = list(_split(presses, shard))
    entries: dict[int, dict[str, Any]] = {}
    for number, part in enumerate(parts):
        data = run.load(shard_name(number), bytes, final=True)
        if data is not None:
            entries[number] = shard_entry(shard_name(number), len(part), data)
    done = sum(entry["samples"] for entry in entries.values())
    missing = [number for number in range(len(parts)) if number not in entries]
    report("pressing", done, len(presses))
    missing_samples = _samples(maps, (parts[number] for number in missing), executor)
    for number, samples in zip(missing, missing_samples, strict=True):
        name, data = pack_shard(number, samples, maps[0].sensor)
        run.save(name, data, final=True)
        entries[number] = shard_entry(name, len(samples), data)
        done += len(samples)
        report("pressing", done, len(presses))
    return [entry for _, entry in sorted(entries.items())]


def _split(presses: SweepPresses, size: int) -> Iterator[SweepPresses]:
    """Split presses into parts of equal size."""
    for start in range(0, len(presses), size):
        yield presses[start : start + size]


def _samples(
    maps: Sequence[ForwardMap], shards: Iterable[SweepPresses], executor: Executor | None
) -> Iterator[Samples]:
    """Compute the samples of each shard in order. The workers compute later shards in advance."""
    shards, shards_for_tasks = tee(shards)
    tasks = (
        (maps[number], part.contact[rows], part.rotation[rows])
        for part in shards_for_tasks
        for number, rows in _tasks(part, len(maps))
    )
    charges = in_order(executor, _charges, tasks)
    notation = np.array([forward_map.probe.notation for forward_map in maps])
    angle = np.array([forward_map.probe.angle for forward_map in maps])
    for part in shards:
        charge = np.empty((len(part), len(maps[0].electrodes)))
        for _, rows in _tasks(part, len(maps)):
            charge[rows] = next(charges)
        x, y, force = (np.ascontiguousarray(column) for column in part.contact.T)
        rotation = np.mod(np.round(np.rad2deg(angle[part.probe] + part.rotation), 9), 360.0)
        yield Samples(x, y, force, notation[part.probe], rotation, charge)


def _tasks(part: SweepPresses, probes: int) -> Iterator[tuple[int, Integers]]:
    """Return the tasks of a shard as the number of the probe and the rows of the shard."""
    for number in range(probes):
        rows = np.flatnonzero(part.probe == number)
        for start in range(0, rows.size, TASK_SIZE):
            yield number, rows[start : start + TASK_SIZE]


def _charges(task: tuple[ForwardMap, Array, Array]) -> Array:
    """Compute the touch charges of the presses of a task, shape (n, n_electrode), pC."""
    forward_map, contact, rotation = task
    return forward_map.charges(contact, rotation)
