"""`isocharge simulate curves`: charge along lines from an electrode."""

import json as json_module
from typing import TYPE_CHECKING, Annotated

import typer

from isocharge.cli.shared.forward_maps import SLACK, solve_forward_map
from isocharge.cli.shared.options import ForceOption, JsonOption, PictureOption, ProbeOption, SensorArgument
from isocharge.cli.shared.terminal import say

if TYPE_CHECKING:
    from isocharge.simulate import Curves

FINE = 81
"""Presses on a line of a picture."""


def curves_command(
    sensor: SensorArgument,
    probe: ProbeOption = "circle:1.0",
    force: ForceOption = 1.0,
    electrode: Annotated[
        str, typer.Option("--from", metavar="NAME", help="Electrode whose charge it is, and where the lines begin.")
    ] = "A",
    angles: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--angles",
            metavar="MIN MAX",
            help="Directions of the first and the last line, degrees from the x axis. (default: 70 degrees to either "
            "side of the direction to the film's centre)",
        ),
    ] = None,
    angle_step: Annotated[float, typer.Option("--angle-step", help="Angle from line to line, degrees.")] = 10.0,
    step: Annotated[float, typer.Option("--step", help="Distance from press to press on a line, mm.")] = 4.0,
    length: Annotated[float, typer.Option("--length", help="Length of the lines, mm.")] = 20.0,
    json: JsonOption = False,
    output: PictureOption = None,
) -> None:
    """Show how an electrode's charge (pC) falls with the distance (mm) of the press from it, in several directions.

    Example: isocharge simulate curves three-25um-biaxial --probe triangle:4.0 --from A --angles 35 90 -o curves.png
    """
    import numpy as np

    from isocharge.simulate import Curves, Mapping, load_sensor, parse_probe
    from isocharge.simulate.plots.figure import check_picture, save_picture
    from isocharge.simulate.plots.pictures import curves_picture

    film_sensor = load_sensor(sensor)
    ends = None if angles is None else (np.deg2rad(angles[0]), np.deg2rad(angles[1]))
    mapping = Mapping.lines(film_sensor, electrode, ends, np.deg2rad(angle_step), 1e-3 * step, 1e-3 * length)
    if output is not None:
        check_picture(output)
    forward_map = solve_forward_map(film_sensor, parse_probe(probe), SLACK * mapping.reach, (force, force))
    curves = Curves.of(forward_map, mapping, force)
    if output is not None:
        smooth = Curves.of(forward_map, mapping.finer(FINE), force)
        save_picture(curves_picture(film_sensor, curves, smooth), output)
        say(f"drawn in {output}")
    typer.echo(json_module.dumps(curves.to_dict()) if json else _table(curves))


def _table(curves: "Curves") -> str:
    import numpy as np

    name, distances = curves.mapping.electrode, 1e3 * curves.mapping.distance
    lines = [
        f"charge of {name}, pC, against the distance from its centre; {curves.probe.notation}, {curves.force:g} N",
        f"{'line':>8} " + "".join(f"{distance:7.4g} mm" for distance in distances),
    ]
    for angle, charges in zip(np.rad2deg(curves.mapping.angle), curves.own, strict=True):
        lines.append(f"{angle:5.4g} deg " + "".join(f"{1e12 * charge:10.1f}" for charge in charges))
    return "\n".join(lines)
