"""`isocharge simulate curves`: charge along lines from an electrode."""

import json as json_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.options import (
    ForceOption,
    JsonOption,
    PictureOption,
    ProbeOption,
    SensorArgument,
    _check_picture,
    _solve,
)
from isocharge.cli.shared.terminal import say

if TYPE_CHECKING:
    from isocharge.simulate import Curves, Mapping, Sensor

FINE = 81
"""Presses on a line of a picture."""


def curves_command(
    sensor: SensorArgument,
    probe: ProbeOption = "circle:1.0",
    force: ForceOption = 1.0,
    electrode: Annotated[
        str, typer.Option("--from", metavar="NAME", help="Electrode that the lines leave from.")
    ] = "A",
    angles: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--angles", metavar="MIN MAX", help="First and last line, degrees from x. (default: 70 about the centre)"
        ),
    ] = None,
    angle_step: Annotated[float, typer.Option("--angle-step", help="Between lines, degrees.")] = 10.0,
    step: Annotated[float, typer.Option("--step", help="Between presses on a line, mm.")] = 4.0,
    length: Annotated[float, typer.Option("--length", help="Of the lines, mm.")] = 20.0,
    json: JsonOption = False,
    output: PictureOption = None,
) -> None:
    """Charge (pC) of an electrode against the distance (mm) of a press from it, on lines at even angles.

    Example: isocharge simulate curves three-25um-biaxial --probe triangle:4.0 --from A --angles 35 90 -o curves.png
    """
    import numpy as np

    from isocharge.simulate import Curves, Mapping, load_sensor

    film_sensor = load_sensor(sensor)
    ends = None if angles is None else (np.deg2rad(angles[0]), np.deg2rad(angles[1]))
    mapping = Mapping.lines(film_sensor, electrode, ends, np.deg2rad(angle_step), 1e-3 * step, 1e-3 * length)
    if output is not None:
        _check_picture(output)
    made = _solve(film_sensor, probe, mapping.reach, force)
    curves = Curves.of(made, mapping, force)
    if output is not None:
        _draw_curves(film_sensor, curves, Curves.of(made, mapping.finer(FINE), force), output)
    typer.echo(json_module.dumps(_curves_report(curves)) if json else _curves_table(curves))


def _curves_report(curves: "Curves") -> dict[str, Any]:
    import numpy as np

    return {
        "electrode": curves.mapping.electrode,
        "probe": curves.probe.notation,
        "force_N": curves.force,
        "lines": [
            {
                "angle_deg": float(np.rad2deg(angle)),
                "distance_mm": (1e3 * curves.mapping.distance).tolist(),
                "x_mm": (1e3 * at[:, 0]).tolist(),
                "y_mm": (1e3 * at[:, 1]).tolist(),
                "charge_pC": dict(zip(curves.electrodes, (1e12 * charge.T).tolist(), strict=True)),
            }
            for angle, at, charge in zip(curves.mapping.angle, curves.mapping.points, curves.charge, strict=True)
        ],
    }


def _curves_table(curves: "Curves") -> str:
    import numpy as np

    name, shown = curves.mapping.electrode, 1e3 * curves.mapping.distance
    lines = [
        f"charge of {name}, pC, against the distance from its centre; {curves.probe.notation}, {curves.force:g} N",
        f"{'line':>8} " + "".join(f"{d:7.4g} mm" for d in shown),
    ]
    for angle, own in zip(np.rad2deg(curves.mapping.angle), curves.own, strict=True):
        lines.append(f"{angle:5.4g} deg " + "".join(f"{1e12 * charge:10.1f}" for charge in own))
    return "\n".join(lines)


def _draw_curves(sensor: "Sensor", curves: "Curves", smooth: "Curves", output: Path) -> None:
    from isocharge.simulate.plots.curves import draw_curves
    from isocharge.simulate.plots.figure import new_figure, save_picture

    figure = new_figure(12.0, 5.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    draw_curves(left, curves, smooth)
    _draw_scheme(right, sensor, curves.mapping)
    figure.suptitle(f"{sensor.name}, {curves.probe.notation}, {curves.force:g} N")
    save_picture(figure, output)
    say(f"drawn in {output}")


def _draw_scheme(axes: Any, sensor: "Sensor", mapping: "Mapping") -> None:
    from isocharge.simulate.plots.curves import draw_mapping
    from isocharge.simulate.plots.film import draw_electrodes, frame_film

    draw_mapping(axes, mapping)
    draw_electrodes(axes, sensor, highlight=mapping.electrode)
    frame_film(axes, sensor, mapping.reach + 1e-3, f"lines from {mapping.electrode}")
