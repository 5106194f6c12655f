"""Command `isocharge simulate sweep`, which writes a dataset of many simulated presses."""

from typing import Annotated, Literal

import typer

from isocharge.cli.shared.forward_maps import DEFAULT_PROBE, ProbesOption, executor_for, sweep_radius, warn_of_stress
from isocharge.cli.shared.options import (
    ForceRangeOption,
    NewFolderOption,
    RadiusOption,
    SensorArgument,
    WorkersOption,
)
from isocharge.cli.shared.terminal import say, shown_progress
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.files import check_new_output
from isocharge.simulate import Sweep, load_sensor, parse_probe, run_sweep


def sweep_command(
    sensor: SensorArgument,
    output: NewFolderOption,
    probe: ProbesOption = None,
    radius: RadiusOption = f"{DEFAULT_RADIUS}",
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    samples: Annotated[int, typer.Option(help="Number of presses of all probes together.")] = 20_000,
    orientation: Annotated[
        Literal["fixed", "random"],
        typer.Option(help="Angle of the probe: as given, or random for each press."),
    ] = "fixed",
    seed: Annotated[int, typer.Option(min=0, help="Seed of random numbers. Equal seeds give equal results.")] = 0,
    workers: WorkersOption = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Dask scheduler whose workers solve the presses instead, such as tcp://10.0.0.1:8786. (default: none)",
        ),
    ] = None,
) -> None:
    """Simulate many presses at different positions and forces, and write their charges as a dataset for training.

    Example: isocharge simulate sweep three-25um-biaxial --probe circle:1.0 --radius 8 --force 0.05 2 -o presses
    """
    film_sensor = load_sensor(sensor)
    probes = [parse_probe(text) for text in probe or [DEFAULT_PROBE]]

    check_new_output(output)
    _, max_force = force
    warn_of_stress(film_sensor.film, probes, max_force)
    with shown_progress(), executor_for(workers, cluster) as executor:
        # The option `radius` is a number of mm, or "auto" for the radius of the working area.
        largest_distance = sweep_radius(radius, film_sensor, probes, force, executor)
        sweep = Sweep(largest_distance, force, samples, seed, orientation)
        run_sweep(output, film_sensor, probes, sweep, executor=executor)
    say(f"{samples} presses in {output}")
