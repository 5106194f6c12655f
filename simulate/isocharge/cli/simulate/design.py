"""Command `isocharge simulate design`, which searches for electrode positions with small position errors."""

from typing import Annotated

import typer

from isocharge.cli.shared.forward_maps import ProbeOption, executor_for, warn_of_stress
from isocharge.cli.shared.options import (
    ForceOption,
    MapRadiusOption,
    NewFolderOption,
    NoiseOption,
    SensorArgument,
    WorkersOption,
)
from isocharge.cli.shared.terminal import say, show_result, shown_progress
from isocharge.common.files import check_new_output
from isocharge.simulate import load_sensor, noise_model, parse_probe
from isocharge.simulate.artwork import write_design
from isocharge.simulate.layout.case import NO_NUISANCES, DesignCase, Goal, Nuisances
from isocharge.simulate.layout.design import design


def design_command(
    sensor: SensorArgument,
    output: NewFolderOption,
    radius: MapRadiusOption,
    electrodes: Annotated[int, typer.Option(metavar="N", help="Number of electrodes, 3 to 8, including kept ones.")],
    goal: Annotated[
        Goal,
        typer.Option(
            help="Quantity to minimise: the largest error, or the root mean square of the errors.",
        ),
    ] = "worst",
    known: Annotated[
        bool,
        typer.Option(
            "--known",
            help="Assume that probe radius, pretension and gains are known exactly. (default: standard deviations of "
            "0.3 mm, 0.1 MPa and 0.2 %)",
        ),
    ] = False,
    keep: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Electrodes of SENSOR that are kept, such as A,B. (default: none)"),
    ] = None,
    side: Annotated[
        float | None,
        typer.Option(metavar="MM", help="Side of the new squares, mm. (default: that of SENSOR's squares)"),
    ] = None,
    probe: ProbeOption = "circle:1.0",
    force: ForceOption = 1.0,
    noise: NoiseOption = "reference",
    workers: WorkersOption = None,
) -> None:
    """Search for the electrode positions with the smallest position errors.

    The command writes a sensor file, drawings and the errors into a new folder. The errors are Cramer-Rao limits in mm.
    Probe radius, pretension and gains are uncertain unless --known is given.

    Example: isocharge simulate design four-25um-biaxial --electrodes 4 --radius 15 -o over-15mm

    Example: isocharge simulate design four-25um-biaxial --electrodes 5 --keep A,B,C,D --radius 8 -o one-more
    """
    # Check the options, and describe the search.
    check_new_output(output)
    footprint = parse_probe(probe)
    case = DesignCase(
        load_sensor(sensor),
        electrodes,
        radius,
        goal=goal,
        keep=tuple(map(str.strip, keep.split(","))) if keep else (),
        probe=footprint,
        force=force,
        noise=noise_model(noise),
        nuisances=NO_NUISANCES if known else Nuisances(),
        side=side,
    )
    warn_of_stress(case.sensor.film, [footprint], force)

    # Search for the positions, and write the files.
    with shown_progress(), executor_for(workers) as executor:
        result = design(case, executor=executor)
        write_design(result, output)
    results = result.to_dict()
    del results["case"]  # repeats the options of the command
    show_result(results)
    # The charges of the layout are unambiguous if there are no folds and no pairs of contacts with the same charges.
    caution = "" if result.unambiguous else "caution: "
    say(f"{caution}{result.summary}; files in {output}")
