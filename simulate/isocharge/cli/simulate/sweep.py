"""`isocharge simulate sweep`: a dataset of many presses."""

import json as json_module
from enum import StrEnum
from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import caution_of_stress, executor_for, shown_run, sweep_radius
from isocharge.cli.shared.options import (
    PROBE_HELP,
    ClusterOption,
    ForceRangeOption,
    FreshOption,
    NewFolderOption,
    RadiusOption,
    SensorArgument,
    StressLimitOption,
    WorkersOption,
)
from isocharge.cli.shared.terminal import say
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS, DEFAULT_STRESS_LIMIT
from isocharge.common.resumable_run import refuse_finished
from isocharge.simulate import Sweep, load_sensor, parse_probe, run_sweep


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
    radius: RadiusOption = f"{DEFAULT_RADIUS}",
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
    stress_limit: StressLimitOption = DEFAULT_STRESS_LIMIT,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    fresh: FreshOption = False,
) -> None:
    """Simulate many presses, spread over positions and forces, and write their charges as a dataset for training.

    A run that was stopped or killed leaves DIR.part; the same command goes on from there and writes the same bytes.

    Example: isocharge simulate sweep three-25um-biaxial --probe circle:1.0 --radius 8 --force 0.05 2 -o presses
    """
    film_sensor, probes = load_sensor(sensor), [parse_probe(text) for text in probe or ["circle:1.0"]]
    refuse_finished(output)
    caution_of_stress(film_sensor.film, probes, force[1], stress_limit)
    with shown_run(output), executor_for(workers, cluster) as executor:
        reach = sweep_radius(radius, film_sensor, probes, force)
        sweep = Sweep(reach, force, samples, seed, orientation.value, sampling.value)
        run_sweep(output, film_sensor, probes, sweep, executor=executor, fresh=fresh)
    say(f"{json_module.loads((output / 'manifest.json').read_text())['samples']} presses in {output}")
