"""Command `isocharge simulate design`, which searches for electrode positions with small position errors."""

from typing import Annotated, cast

import typer

from isocharge.cli.shared.forward_maps import executor_for, warn_of_stress
from isocharge.cli.shared.options import (
    ForceOption,
    NewFolderOption,
    NoiseOption,
    SensorArgument,
    StressLimitOption,
    WorkersOption,
)
from isocharge.cli.shared.probe_option import ProbeOption
from isocharge.cli.shared.terminal import say, show_result, shown_progress
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import InputError
from isocharge.common.files import refuse_existing
from isocharge.simulate import Circle, load_sensor, noise_model, parse_probe
from isocharge.simulate.artwork.design_folder import write_design, write_guard_design
from isocharge.simulate.artwork.leads import straight_leads
from isocharge.simulate.layout.case import NO_NUISANCES, DesignCase, Goal, Nuisances
from isocharge.simulate.layout.design import Design, design
from isocharge.simulate.layout.guard import GuardDesign, design_guard


def design_command(
    sensor: SensorArgument,
    output: NewFolderOption,
    radius: Annotated[
        float, typer.Option("--radius", metavar="MM", help="Largest distance of a press from the film's centre, mm.")
    ],
    electrodes: Annotated[
        int | None,
        typer.Option(
            "--electrodes",
            metavar="N",
            help="Number of electrodes, 3 to 8, including kept ones. Required, except with --guard.",
        ),
    ] = None,
    guard: Annotated[
        bool,
        typer.Option(
            "--guard",
            help="Keep all electrodes of SENSOR, and add one square with which presses outside the radius can be "
            "noticed. (default: search all positions)",
        ),
    ] = False,
    goal: Annotated[
        str,
        typer.Option(
            "--goal",
            metavar="worst|rms",
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
        typer.Option(
            "--keep", metavar="NAMES", help="Electrodes of SENSOR that are kept, such as A,B. (default: none)"
        ),
    ] = None,
    side: Annotated[
        float | None,
        typer.Option("--side", metavar="MM", help="Side of the new squares, mm. (default: that of SENSOR's squares)"),
    ] = None,
    probe: ProbeOption = "circle:1.0",
    force: ForceOption = 1.0,
    noise: NoiseOption = "reference",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the search. Equal seeds give equal designs.")] = 0,
    stress_limit: StressLimitOption = DEFAULT_STRESS_LIMIT,
    workers: WorkersOption = None,
) -> None:
    """Search for the electrode positions with the smallest position errors.

    The command writes a sensor file, drawings and the errors into a new folder. The errors are Cramer-Rao limits in mm.
    Probe radius, pretension and gains are uncertain unless --known is given.

    With --guard, the command searches for the position of one further square. The errors in the folder are then caused
    by the noise alone. The folder also contains pictures of the mirror region without and with this square.

    Example: isocharge simulate design four-25um-biaxial --electrodes 4 --radius 15 -o over-15mm

    Example: isocharge simulate design four-25um-biaxial --guard --radius 8 -o guarded
    """
    # Check the options, and describe the search.
    refuse_existing(output)
    footprint = parse_probe(probe)
    if not isinstance(footprint, Circle):
        raise InputError(f"--probe: expected circle:RADIUS, for which layouts are designed, got {probe}")
    described_sensor = load_sensor(sensor)
    if guard:
        search_options = {"--electrodes": electrodes, "--keep": keep, "--goal": goal != "worst", "--known": known}
        given_names = [name for name, value in search_options.items() if value]
        if given_names:
            raise InputError(
                f"--guard: keeps all electrodes of the sensor and adds one, got {', '.join(given_names)} as well; "
                "leave them out"
            )
        electrodes = len(described_sensor.electrodes) + 1  # the guard is added to the electrodes of the sensor
        keep = ",".join(described_sensor.electrode_names)
    if electrodes is None:
        raise InputError("--electrodes: expected the number of electrodes, got none; give it, or --guard")
    kept_names = [name.strip() for name in (keep or "").split(",")]
    case = DesignCase(
        described_sensor,
        electrodes,
        radius,
        goal=cast(Goal, goal),
        keep=tuple(name for name in kept_names if name),
        probe=footprint,
        force=force,
        noise=noise_model(noise),
        nuisances=NO_NUISANCES if known else Nuisances(),
        side=side,
        seed=seed,
    )
    warn_of_stress(case.sensor.film, [footprint], force, stress_limit)

    # Search for the positions, and write the files.
    with shown_progress(), executor_for(workers, None) as executor:
        result: Design | GuardDesign
        if guard:
            result = design_guard(case, executor=executor)
            write_guard_design(result, output)
        else:
            result = design(case, executor=executor)
            write_design(result, output)
    results = result.to_dict()
    del results["case"]
    if isinstance(result, GuardDesign):
        limits = {"before": result.limits_before, "after": result.limits_after}
        results = {"guard": results["guard"], "position_limit": limits}
    show_result(results, json=False)
    caution = "" if guard or results["unambiguous"] else "caution: "
    say(f"{caution}{result.summary}; {straight_leads(result.sensor).summary}; files in {output}")
