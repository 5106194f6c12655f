"""A sweep: many presses spread over the working area and the forces, and their charges.

A forward map is solved for every probe and evaluated for every press. Both are cut into tasks that do not depend on the
executor, so neither do the bytes. Finished parts are kept in a folder next to the dataset, so that a run that was
killed goes on.
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
from isocharge.simulate.dataset.sampling import PLANS, Sweep, SweepPresses
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

SHARD = 16384
"""Samples per shard."""

TASK = 8192
"""Presses per task: a second of work, long compared with sending the map to the worker (12 MB)."""


def run_sweep(
    folder: Path,
    sensor: Sensor,
    probes: Sequence[Probe],
    sweep: Sweep,
    settings: SolveSettings = SolveSettings(),
    *,
    executor: Executor | None = None,
    shard: int = SHARD,
    fresh: bool = False,
) -> Path:
    """Simulate a sweep and write it as a dataset. Killed and called again with the same arguments, it goes on.

    Args:
        folder: Folder to write; must not exist yet.
        sensor: The sensor.
        probes: The objects that press, in turn.
        sweep: Which presses to sample.
        settings: How the film is solved.
        executor: Does the work: a process pool, the executor of a Dask cluster; this process if absent. The bytes
            written do not depend on it.
        shard: Samples per shard.
        fresh: Throw away the parts of an earlier run.

    Returns:
        The folder.

    Raises:
        SceneError: If a press cannot exist.
        OutputExists: If the folder is already there, or an unfinished run of other settings; raised before the work
            begins.
        OutputError: If the file system refuses; the finished work is kept.
        WorkersLost: If the executor's workers end; the finished work is kept.
    """
    folder, probes = Path(folder), tuple(probes)
    refuse_finished(folder)
    presses = sweep.over(probes)  # before anything is written: scipy's Sobol tables swallow an interrupt
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
            write_manifest(run.data, folder.name, sensor, entries, _about(maps, sweep))
    return folder


def solve_maps(
    sensor: Sensor,
    probes: Sequence[Probe],
    sweep: Sweep,
    settings: SolveSettings = SolveSettings(),
    *,
    executor: Executor | None = None,
) -> tuple[ForwardMap, ...]:
    """A forward map for each probe, over the sweep's ranges."""
    return tuple(
        ForwardMap.build(sensor, probe, sweep.radius, sweep.force_range, settings, executor=executor)
        for probe in probes
    )


def write_sweep(folder: Path, maps: Sequence[ForwardMap], sweep: Sweep) -> Path:
    """Write a sweep's presses and charges, given the solved maps, in this process; see `run_sweep`."""
    presses = sweep.over([forward_map.probe for forward_map in maps])
    return write_dataset(folder, maps[0].sensor, _samples(maps, _cut(presses, SHARD), None), _about(maps, sweep))


def _about(maps: Sequence[ForwardMap], sweep: Sweep) -> dict[str, Any]:
    """The manifest's entries about the sweep."""
    return {
        "probes": list(dict.fromkeys(forward_map.probe.notation for forward_map in maps)),
        "ranges": {
            "radius_mm": float(f"{sweep.radius:.12g}"),
            "force_N": list(sweep.force_range),
            "orientation": sweep.orientation,
        },
        "sampling": PLANS[sweep.sampling],
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
    """Write the shards that the run does not have yet; the manifest's entry of each shard, in order."""
    parts = list(_cut(presses, shard))
    entries: dict[int, dict[str, Any]] = {}
    for number, part in enumerate(parts):
        if (data := run.load(shard_name(number), bytes, final=True)) is not None:
            entries[number] = shard_entry(shard_name(number), len(part), data)
    done = sum(entry["samples"] for entry in entries.values())
    missing = [number for number in range(len(parts)) if number not in entries]
    report("pressing", done, len(presses))
    for number, samples in zip(missing, _samples(maps, (parts[each] for each in missing), executor), strict=True):
        name, data = pack_shard(number, samples, maps[0].sensor)
        run.save(name, data, final=True)
        entries[number] = shard_entry(name, len(samples), data)
        done += len(samples)
        report("pressing", done, len(presses))
    return [entry for _, entry in sorted(entries.items())]


def _cut(presses: SweepPresses, size: int) -> Iterator[SweepPresses]:
    for start in range(0, len(presses), size):
        yield presses[start : start + size]


def _samples(
    maps: Sequence[ForwardMap], shards: Iterable[SweepPresses], executor: Executor | None
) -> Iterator[Samples]:
    """Samples of each shard, in order; the workers run ahead of the one that is taken."""
    shards, coming = tee(shards)
    tasks = (
        (maps[number], part.contact[rows], part.rotation[rows])
        for part in coming
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
    """Tasks of a shard: number of the probe and rows of the shard."""
    for number in range(probes):
        rows = np.flatnonzero(part.probe == number)
        for start in range(0, rows.size, TASK):
            yield number, rows[start : start + TASK]


def _charges(task: tuple[ForwardMap, Array, Array]) -> Array:
    """Touch charges of a task's presses, shape (n, n_electrode), pC."""
    forward_map, contact, rotation = task
    return forward_map.charges(contact, rotation)
