"""Options of several commands, and how their texts are read."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.terminal import progress, progress_rows, say
from isocharge.errors import InputError

if TYPE_CHECKING:
    from isocharge.simulate import ForwardMap, Probe, Sensor

PROBE_HELP = "What presses, mm: circle:R, rectangle:WxH, triangle:SIDE, polygon:X,Y;X,Y;..., each turned by @DEGREES."

SensorArgument = Annotated[str, typer.Argument(metavar="SENSOR", help="Built-in sensor, or a TOML file.")]

ProbeOption = Annotated[str, typer.Option("--probe", help=PROBE_HELP)]

ForceOption = Annotated[float, typer.Option("--force", help="How hard, N, positive pushes.")]

JsonOption = Annotated[bool, typer.Option("--json", help="One JSON object instead of a table.")]

PictureOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="PICTURE", help="Draw it: a new .png, .svg or .pdf. (default: none)"),
]


def _check_picture(output: Path) -> None:
    from isocharge.simulate.plots.figure import check_picture

    check_picture(output)


def _solve(sensor: "Sensor", probe: str, radius: float, force: float) -> "ForwardMap":
    from isocharge.simulate import ForwardMap, parse_probe

    with progress("solving the film") as advance:
        pressing = parse_probe(probe)
        return ForwardMap.build(sensor, pressing, radius * (1.0 + 1e-6), (force, force), progress=advance)


def position(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) * 1e-3 for part in text.split(","))
    except ValueError as error:
        raise InputError(f"--at: expected two numbers in mm like '3,-2', got {text!r}") from error
    return x, y


def number_mm(text: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"--radius: expected a number of mm or 'auto', got {text!r}") from error


def auto_radius(sensor: "Sensor", probes: "list[Probe]", force: tuple[float, float]) -> float:
    """Radius of the disk that is in the working area of every probe under `reference` noise, m."""
    from isocharge.simulate import noise_model, working_area
    from isocharge.simulate.identifiability.identification import map_to_search

    areas = []
    for probe in probes:
        with progress_rows((f"finding the working area of {probe.notation}", "solves")) as (advance,):
            made = map_to_search(sensor, probe, force, advance)
        areas.append(working_area(made, noise_model("reference")))
        say(f"{probe.notation}: {areas[-1].words}")
    radius = min(area.radius for area in areas)
    if radius == 0.0:
        raise InputError(
            "--radius auto: nowhere do the charges tell the contact well enough; see 'isocharge simulate identify', or "
            "give a radius"
        )
    return radius
