"""`isocharge simulate sweep`: a dataset of many presses."""

import json as json_module
from contextlib import AbstractContextManager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.options import SensorArgument, auto_radius, number_mm
from isocharge.cli.shared.terminal import progress_rows, say
from isocharge.default_scene import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.errors import InputError

if TYPE_CHECKING:
    from isocharge.simulate.execution.workers import Workers

MOST_WORKERS = 64

SWEEP_ROWS = (("solving the film", "solves"), ("pressing", "presses"))
"""Titles and units of a sweep's progress."""


class Orientation(StrEnum):
    """How probes are turned in a sweep."""

    fixed = "fixed"
    random = "random"


class Sampling(StrEnum):
    """How the presses of a sweep are spread."""

    sobol = "sobol"
    random = "random"
    grid = "grid"


def sweep_command(
    sensor: SensorArgument,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Dataset folder to make.")],
    probe: Annotated[
        list[str] | None, typer.Option("--probe", help="What presses; may be given again. (default: circle:1.0)")
    ] = None,
    radius: Annotated[
        str,
        typer.Option(
            "--radius", metavar="MM|auto", help="Largest distance from the centre, mm, or auto: the working area's."
        ),
    ] = f"{1e3 * DEFAULT_RADIUS}",
    force: Annotated[
        tuple[float, float], typer.Option("--force", metavar="MIN MAX", help="Smallest and largest force, N.")
    ] = DEFAULT_FORCE_RANGE,
    samples: Annotated[int, typer.Option("--samples", help="How many presses.")] = 20_000,
    orientation: Annotated[
        Orientation, typer.Option("--orientation", help="Turn the probe further in each press.")
    ] = Orientation.fixed,
    sampling: Annotated[
        Sampling, typer.Option("--sampling", help="How the presses are spread; a grid takes at most --samples.")
    ] = Sampling.sobol,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the presses.")] = 0,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, max=MOST_WORKERS, help="Processes; the data do not depend on them. (default: cores)"
        ),
    ] = None,
    cluster: Annotated[
        str | None, typer.Option("--cluster", metavar="ADDR", help="Dask cluster instead, as tcp://10.0.0.1:8786.")
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Throw away what a stopped run left.")] = False,
) -> None:
    """Simulate many presses, spread over the working area and the forces, and write them as a dataset.

    A run that was stopped or killed leaves DIR.part; the same command goes on from there and writes the same bytes.

    Example: isocharge simulate sweep three-25um-biaxial --probe circle:1.0 --radius 8 --force 0.05 2 -o presses
    """
    from isocharge.resumable_run import refuse_finished
    from isocharge.simulate import Sweep, SweepCallbacks, load_sensor, parse_probe, run_sweep

    if workers and cluster:
        raise InputError("expected either --workers or --cluster, got both")
    film_sensor, probes = load_sensor(sensor), [parse_probe(text) for text in probe or ["circle:1.0"]]
    refuse_finished(output)
    reach = auto_radius(film_sensor, probes, force) if radius == "auto" else 1e-3 * number_mm(radius)
    sweep = Sweep(reach, force, samples, seed, orientation.value, sampling.value)
    try:
        with _workers(workers, cluster) as crew, progress_rows(*SWEEP_ROWS) as (solving, sampled):
            run_sweep(
                output,
                film_sensor,
                probes,
                sweep,
                workers=crew,
                callbacks=SweepCallbacks(solving, sampled, say),
                fresh=fresh,
            )
    except KeyboardInterrupt:
        if (part := output.with_name(f"{output.name}.part")).exists():
            say(f"stopped; what is done is kept in {part}, and the same command goes on")
        raise
    say(f"{json_module.loads((output / 'manifest.json').read_text())['samples']} presses in {output}")


def _workers(workers: int | None, cluster: str | None) -> AbstractContextManager["Workers"]:
    from isocharge.simulate.execution.workers import cores, dask_workers, local_workers

    return dask_workers(cluster) if cluster else local_workers(workers or min(cores(), MOST_WORKERS))
