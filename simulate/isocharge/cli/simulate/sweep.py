"""`isocharge simulate sweep`: a dataset of many presses."""

import json as json_module
from contextlib import AbstractContextManager
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.forward_maps import sweep_radius
from isocharge.cli.shared.options import (
    PROBE_HELP,
    ClusterOption,
    ForceRangeOption,
    FreshOption,
    NewFolderOption,
    RadiusOption,
    SensorArgument,
    WorkersOption,
    most_workers,
)
from isocharge.cli.shared.terminal import progress_rows, say
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError

if TYPE_CHECKING:
    from isocharge.simulate.execution.workers import Workers

SWEEP_ROWS = (("solving the film", "solves"), ("pressing", "presses"))
"""Titles and units of the progress bars of a sweep."""


class Orientation(StrEnum):
    """Angle of the probe in each press."""

    fixed = "fixed"
    random = "random"


class Sampling(StrEnum):
    """How the presses of a sweep spread over positions and forces."""

    sobol = "sobol"
    random = "random"
    grid = "grid"


def sweep_command(
    sensor: SensorArgument,
    output: NewFolderOption,
    probe: Annotated[
        list[str] | None,
        typer.Option("--probe", metavar="SHAPE", help=f"{PROBE_HELP} May be repeated. (default: circle:1.0)"),
    ] = None,
    radius: RadiusOption = f"{1e3 * DEFAULT_RADIUS}",
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    samples: Annotated[int, typer.Option("--samples", help="Number of presses, of all probes together.")] = 20_000,
    orientation: Annotated[
        Orientation, typer.Option("--orientation", help="Angle of the probe: as given, or a random one in each press.")
    ] = Orientation.fixed,
    sampling: Annotated[
        Sampling,
        typer.Option(
            "--sampling", help="How presses spread over positions and forces; a grid has at most --samples of them."
        ),
    ] = Sampling.sobol,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the presses; the same seed, the same data.")] = 0,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    fresh: FreshOption = False,
) -> None:
    """Simulate many presses, spread over positions and forces, and write their charges as a dataset for training.

    A run that was stopped or killed leaves DIR.part; the same command goes on from there and writes the same bytes.

    Example: isocharge simulate sweep three-25um-biaxial --probe circle:1.0 --radius 8 --force 0.05 2 -o presses
    """
    from isocharge.common.resumable_run import refuse_finished
    from isocharge.simulate import Sweep, SweepCallbacks, load_sensor, parse_probe, run_sweep

    if workers and cluster:
        raise InputError("expected either --workers or --cluster, got both")
    film_sensor, probes = load_sensor(sensor), [parse_probe(text) for text in probe or ["circle:1.0"]]
    refuse_finished(output)
    reach = sweep_radius(radius, film_sensor, probes, force)
    sweep = Sweep(reach, force, samples, seed, orientation.value, sampling.value)
    try:
        with _workers(workers, cluster) as pool, progress_rows(*SWEEP_ROWS) as (solving, sampled):
            run_sweep(
                output,
                film_sensor,
                probes,
                sweep,
                workers=pool,
                callbacks=SweepCallbacks(solving, sampled, say),
                fresh=fresh,
            )
    except KeyboardInterrupt:
        if (part := output.with_name(f"{output.name}.part")).exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on from there")
        raise
    say(f"{json_module.loads((output / 'manifest.json').read_text())['samples']} presses in {output}")


def _workers(workers: int | None, cluster: str | None) -> AbstractContextManager["Workers"]:
    from isocharge.simulate.execution.workers import dask_workers, local_workers

    return dask_workers(cluster) if cluster else local_workers(most_workers(workers))
