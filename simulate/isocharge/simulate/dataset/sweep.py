"""Simulation of a sweep: many presses over a range of positions and forces, and their charges.

A forward map is solved for every probe and evaluated for every press. The work is divided into tasks in the same way
for every executor, so that the files are the same for every executor. Finished parts are saved in a folder next to the
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
"""Largest number of presses in a task.

A task then takes about a second, which is long compared with the time for sending the forward map (12 MB) to the
worker.
"""


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
    # The presses are computed before files are written, because SciPy ignores an interrupt in this step.
    presses = sweep.over(probes)

    # An interrupted run is resumed only if all these values are the same.
    identity = {
        "made_by": code_fingerprint(),
        "sensor": sensor_to_dict(sensor),
        "probes": [f"{probe.notation}@{np.rad2deg(probe.angle):.12g}" for probe in probes],
        "sweep": asdict(sweep),
        "solver": asdict(settings),
        "shard": shard,
    }

    # The matrices are small, so BLAS is faster with one thread. At the end of the block, the run becomes the dataset.
    with single_threaded_blas(), resume_folder(folder, identity, fresh=fresh) as run:
        maps = [
            ForwardMap.build(
                sensor,
                probe,
                sweep.radius,
                sweep.force_range,
                settings,
                executor=run.storing_executor(f"solve-{number:02d}", executor),
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
    """Compute and write the shards that an earlier run has not saved. A shard is one file of the dataset.

    Args:
        run: Run whose folder contains the shards. The option `final` means that a shard is a file of the dataset.
        maps: Forward map of each probe.
        presses: All presses of the sweep.
        executor: Executor that computes the charges; this process if None.
        shard: Number of presses in a shard.

    Returns:
        Manifest entries of all shards, in order.
    """
    # Load the shards that an earlier run has saved.
    presses_of_shards = list(_split(presses, shard))
    entries: dict[int, dict[str, Any]] = {}  # by the index of the shard
    for index, shard_presses in enumerate(presses_of_shards):
        data = run.load(shard_name(index), bytes, final=True)
        if data is not None:
            entries[index] = shard_entry(shard_name(index), len(shard_presses), data)
    finished_presses = sum(entry["samples"] for entry in entries.values())
    missing_shards = [index for index in range(len(presses_of_shards)) if index not in entries]
    report("pressing", finished_presses, len(presses))

    # Compute and save the missing shards.
    missing_presses = [presses_of_shards[index] for index in missing_shards]
    missing_samples = _samples(maps, missing_presses, executor)
    for index, samples in zip(missing_shards, missing_samples, strict=True):
        name, data = pack_shard(index, samples, maps[0].sensor)
        run.save(name, data, final=True)
        entries[index] = shard_entry(name, len(samples), data)
        finished_presses += len(samples)
        report("pressing", finished_presses, len(presses))
    return [entries[index] for index in sorted(entries)]


def _split(presses: SweepPresses, size: int) -> Iterator[SweepPresses]:
    """Split presses into parts of equal size."""
    for start in range(0, len(presses), size):
        yield presses[start : start + size]


def _samples(
    maps: Sequence[ForwardMap], shards: Iterable[SweepPresses], executor: Executor | None
) -> Iterator[Samples]:
    """Yield the samples of each shard in order.

    A shard is divided into tasks, each of which computes the charges of some rows of the shard. The workers compute the
    tasks of later shards in advance.

    Args:
        maps: Forward map of each probe.
        shards: Presses of each shard.
        executor: Executor that computes the charges; this process if None.
    """
    # The tasks of later shards are submitted before the samples of earlier shards are yielded. The two loops over the
    # shards are therefore at different positions, and each has its own iterator.
    shards_for_samples, shards_for_tasks = tee(shards)
    tasks = (
        (maps[probe], presses.contact[rows], presses.rotation[rows])
        for presses in shards_for_tasks
        for probe, rows in _tasks(presses, len(maps))
    )
    charges_of_tasks = in_order(executor, _charges, tasks)
    for presses in shards_for_samples:
        charge = np.empty((len(presses), len(maps[0].electrodes)))
        for _, rows in _tasks(presses, len(maps)):  # the same tasks in the same order as above
            charge[rows] = next(charges_of_tasks)
        yield _samples_of_shard(maps, presses, charge)


def _samples_of_shard(maps: Sequence[ForwardMap], presses: SweepPresses, charge: Array) -> Samples:
    """Return the presses of a shard and their charges as samples of a dataset.

    Args:
        maps: Forward map of each probe.
        presses: Presses of the shard.
        charge: Touch charges, shape (n, n_electrode), pC.
    """
    probe_notations = np.array([forward_map.probe.notation for forward_map in maps])
    probe_angles = np.array([forward_map.probe.angle for forward_map in maps])
    x, y, force = (np.ascontiguousarray(column) for column in presses.contact.T)
    rotation_deg = np.rad2deg(probe_angles[presses.probe] + presses.rotation)
    return Samples(
        x_mm=x,
        y_mm=y,
        force_N=force,
        probe=probe_notations[presses.probe],
        orientation_deg=np.mod(np.round(rotation_deg, 9), 360.0),  # without rounding errors just below 360 degrees
        charge_pC=charge,
    )


def _tasks(presses: SweepPresses, n_probes: int) -> Iterator[tuple[int, Integers]]:
    """Divide the presses of a shard, a file of the dataset, into tasks of presses with the same probe.

    A task has at most `TASK_SIZE` presses.

    Args:
        presses: Presses of the shard.
        n_probes: Number of probes of the sweep.

    Yields:
        Number of the probe, and the rows of the shard that belong to the task.
    """
    for probe in range(n_probes):
        rows = np.flatnonzero(presses.probe == probe)
        for start in range(0, rows.size, TASK_SIZE):
            yield probe, rows[start : start + TASK_SIZE]


def _charges(task: tuple[ForwardMap, Array, Array]) -> Array:
    """Compute the touch charges of the presses of a task, shape (n, n_electrode), pC."""
    forward_map, contact, rotation = task
    return forward_map.charges(contact, rotation)
