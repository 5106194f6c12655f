"""Command `isocharge simulate sweep`, which writes a dataset of many simulated presses."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from isocharge.cli.shared.forward_maps import executor_for, sweep_radius, warn_of_stress
from isocharge.cli.shared.options import (
    ClusterOption,
    ForceRangeOption,
    RadiusOption,
    SensorArgument,
    StressLimitOption,
    WorkersOption,
)
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS, DEFAULT_STRESS_LIMIT
from isocharge.common.files import refuse_existing
from isocharge.simulate import Sweep, load_sensor, parse_probe, run_sweep
from isocharge.simulate.sensor.probe import PROBE_HELP


def sweep_command(
    sensor: SensorArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="New folder for the dataset, which must not exist yet.",
        ),
    ],
    probe: Annotated[
        list[str] | None,
        typer.Option("--probe", metavar="SHAPE", help=f"{PROBE_HELP} May be repeated. (default: circle:1.0)"),
    ] = None,
    radius: RadiusOption = f"{DEFAULT_RADIUS}",
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    samples: Annotated[int, typer.Option("--samples", help="Number of presses of all probes together.")] = 20_000,
    orientation: Annotated[
        Literal["fixed", "random"],
        typer.Option("--orientation", help="Angle of the probe: as given, or random for each press."),
    ] = "fixed",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the presses. Equal seeds give equal data.")] = 0,
    stress_limit: StressLimitOption = DEFAULT_STRESS_LIMIT,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
) -> None:
    """Simulate many presses at different positions and forces, and write their charges as a dataset for training.

    Example: isocharge simulate sweep three-25um-biaxial --probe circle:1.0 --radius 8 --force 0.05 2 -o presses
    """
    film_sensor = load_sensor(sensor)
    probes = [parse_probe(text) for text in probe or ["circle:1.0"]]

    refuse_existing(output)
    _, max_force = force
    warn_of_stress(film_sensor.film, probes, max_force, stress_limit)
    with shown_progress(), executor_for(workers, cluster) as executor:
        largest_distance = sweep_radius(radius, film_sensor, probes, force)
        sweep = Sweep(largest_distance, force, samples, seed, orientation)
        run_sweep(output, film_sensor, probes, sweep, executor=executor)
    say(f"{samples} presses in {output}")
