"""Command `isocharge simulate design`, which searches for electrode positions with small position errors."""

from typing import Annotated

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
from isocharge.cli.shared.terminal import say, show, shown_progress
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import InputError
from isocharge.common.files import refuse_existing
from isocharge.simulate import Circle, load_sensor, noise_model, parse_probe
from isocharge.simulate.artwork.design_folder import write_design, write_guard_design
from isocharge.simulate.artwork.leads import straight_leads
from isocharge.simulate.layout.case import NO_NUISANCES, DesignCase, Nuisances, read_goal
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
            metavar="worst|rms|MAP",
            help="Quantity to minimise: the largest error, the root mean square of the errors, or the root mean square "
            "weighted with a map, a CSV file with the columns x_mm, y_mm, weight.",
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
        refuse_search_options(electrodes=electrodes, keep=keep, goal=goal, known=known)
        electrodes = len(described_sensor.electrodes) + 1  # the guard is added to the electrodes of the sensor
        keep = ",".join(described_sensor.electrode_names)
    if electrodes is None:
        raise InputError("--electrodes: expected the number of electrodes, got none; give it, or --guard")
    kept_names = [name.strip() for name in (keep or "").split(",")]
    case = DesignCase(
        described_sensor,
        electrodes,
        radius,
        goal=read_goal(goal),
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
        if guard:
            guard_design = design_guard(case, executor=executor)
            write_guard_design(guard_design, output)
        else:
            result = design(case, executor=executor)
            write_design(result, output)

    # Print the result.
    if guard:
        show(_guard_table(guard_design))
        say(f"{guard_design.summary}; {straight_leads(guard_design.sensor).summary}; files in {output}")
        return
    show(_table(result))
    caution = "" if result.unambiguous else "caution: "
    say(f"{caution}{result.summary}; {straight_leads(result.sensor).summary}; files in {output}")


def refuse_search_options(*, electrodes: int | None, keep: str | None, goal: str, known: bool) -> None:
    """Raise an error if options are given that have no meaning together with `--guard`.

    With `--guard`, all electrodes are kept, and the search minimises the share of presses that are not noticed.

    Args:
        electrodes: Value of `--electrodes`; None if it was not given.
        keep: Value of `--keep`; None if it was not given.
        goal: Value of `--goal`; "worst" if it was not given.
        known: Whether `--known` was given.

    Raises:
        InputError: If one of the options was given.
    """
    is_given = {
        "--electrodes": electrodes is not None,
        "--keep": keep is not None,
        "--goal": goal != "worst",
        "--known": known,
    }
    given_names = [name for name in is_given if is_given[name]]
    if given_names:
        pronoun = "it" if len(given_names) == 1 else "them"
        raise InputError(
            f"--guard: keeps all electrodes of the sensor and adds one, got {', '.join(given_names)} as well; leave "
            f"{pronoun} out"
        )


def _guard_table(guard_design: GuardDesign) -> str:
    """Return the table that the command prints for a guard electrode.

    The table contains the position of the guard electrode. It also contains two results for the sensor without and with
    the guard electrode: the share of the presses outside the working area that are not noticed, and the limits of the
    position error in the working area.

    Args:
        guard_design: Result of the search for a guard electrode.
    """
    x, y = guard_design.guard.centre
    lines = [
        f"{guard_design.guard.name:<10} {x:9.3f} {y:9.3f} mm",
        "                 not noticed   position error limit, mm: worst      rms",
    ]
    # The widths of the columns align the numbers with the words of the first two lines.
    for title, region, limits in (
        ("without guard", guard_design.region_before, guard_design.limits_before),
        ("with guard", guard_design.region_after, guard_design.limits_after),
    ):
        unnoticed_percent = f"{100.0 * region.total_share:.1f} %"
        lines.append(f"{title:<15} {unnoticed_percent:>12} {limits.worst:31.3f} {limits.rms:8.3f}")
    return "\n".join(lines)


def _table(result: Design) -> str:
    """Return the table that the command prints for a new layout.

    The table contains the positions of the electrodes, and the position errors of the initial and the new layout. The
    errors of an initial sensor with fewer than three electrodes are unknown and are omitted.

    Args:
        result: Result of the design.
    """
    lines = []
    for electrode in result.sensor.electrodes:
        x, y = electrode.centre
        lines.append(f"{electrode.name:<10} {x:9.3f} {y:9.3f} mm")

    # Each layout has one line with the errors of the noise alone, and one line with the errors of noise and nuisances.
    lines.append("position error limit, mm     worst      rms")
    for name, errors in (("before", result.errors_before), ("after", result.errors_after)):
        if errors is None:
            continue
        for condition, statistics in errors.to_dict().items():
            title = f"{name}, {condition.replace('_', ' ')}"
            worst = _error_text(statistics["worst_mm"], result.case.radius)
            rms = _error_text(statistics["rms_mm"], result.case.radius)
            lines.append(f"{title:<26} {worst:>7} {rms:>8}")
    return "\n".join(lines)


def _error_text(error: float, radius: float) -> str:
    """Return a position error as text, or "folds" if the error is not smaller than the radius of the disk.

    With such a large error, the charges do not determine the position, because the charge map has a fold.

    Args:
        error: Position error of presses within the disk, mm.
        radius: Radius of the disk, mm.
    """
    return f"{error:.3f}" if error < radius else "folds"
