"""`isocharge simulate contours`: where a charge is constant, and where contours cross."""

import json as json_module
from collections.abc import Mapping as Map
from collections.abc import Sequence
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.forward_maps import SLACK, solve_forward_map
from isocharge.cli.shared.options import (
    ForceOption,
    JsonOption,
    PictureOption,
    ProbeOption,
    SensorArgument,
    position_of,
)
from isocharge.cli.shared.terminal import say
from isocharge.common.errors import InputError
from isocharge.common.number_text import number_of

if TYPE_CHECKING:
    from isocharge.simulate import ContourField, DrawnContour, ForwardMap, Mapping, Sensor

Charges = Map[str, Sequence[float]]
"""Charges of the contours, C, by electrode."""


def contours_command(
    sensor: SensorArgument,
    probe: ProbeOption = "circle:1.0",
    force: ForceOption = 1.0,
    charge: Annotated[
        list[str] | None,
        typer.Option(
            "--charge",
            metavar="NAME=PC",
            help="Electrode and charge of one contour, pC, as A=650; may be repeated. (default: --levels)",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(
            "--at",
            metavar="X,Y",
            help="Position of a press, mm: the contours of its charges, and where they meet. (default: --levels)",
        ),
    ] = None,
    levels: Annotated[
        int, typer.Option("--levels", min=1, max=100, help="Number of evenly spaced contours of each electrode.")
    ] = 8,
    radius: Annotated[
        float, typer.Option("--radius", metavar="MM", help="Largest distance of a press from the film's centre, mm.")
    ] = 10.0,
    drawn: Annotated[
        bool,
        typer.Option("--drawn", help="Add the contours that the paper's graphical method draws by hand. (default: no)"),
    ] = False,
    json: JsonOption = False,
    output: PictureOption = None,
) -> None:
    """Find all positions at which a press gives an electrode the same charge (pC): its isocharge contours.

    Points lie within 1e-4 mm of the contour. If no press within the radius gives a charge, the table says which charges
    occur.

    Example: isocharge simulate contours three-25um-biaxial --probe triangle:4.0 --at 2,-3 -o contours.svg
    """
    from isocharge.simulate import ContourField, Mapping, load_sensor, parse_probe
    from isocharge.simulate.contours.graphical_method import drawn_to_dicts
    from isocharge.simulate.plots.figure import check_picture, save_picture
    from isocharge.simulate.plots.pictures import contours_picture

    film_sensor = load_sensor(sensor)
    if charge and at is not None:
        raise InputError("expected either --charge or --at, got both")
    charges = _charges_of_options(film_sensor, charge or [])
    mappings = [Mapping.lines(film_sensor, name) for name in film_sensor.electrode_names] if drawn else []
    if output is not None:
        check_picture(output)
    reach = SLACK * max([1e-3 * radius, *(mapping.reach for mapping in mappings)])
    forward_map = solve_forward_map(film_sensor, parse_probe(probe), reach, (force, force))
    field = ContourField.of(forward_map, force, 1e-3 * radius)
    if at is not None:
        charges = _charges_of_press(forward_map, at, force)
    charges = charges or {name: field.even_charges(name, levels) for name in film_sensor.electrode_names}
    contours = {name: [field.contours(name, value) for value in values] for name, values in charges.items()}
    by_hand = _contours_by_hand(forward_map, mappings, charges, force)
    report = field.to_dict(charges, contours)
    if by_hand:
        report["drawn"] = drawn_to_dicts(charges, by_hand)
    if at is not None and len(film_sensor.electrodes) > 2:
        report["meeting"] = _meeting(field, charges)
    if output is not None:
        save_picture(contours_picture(field, contours, by_hand, _meeting_position(report)), output)
        say(f"drawn in {output}")
    typer.echo(json_module.dumps(report) if json else _table(report))


def _charges_of_options(sensor: "Sensor", texts: list[str]) -> Charges:
    """Charges by electrode from texts like "A=650"."""
    from isocharge.simulate.sensor.sensor import electrode_index

    charges: dict[str, list[float]] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            charge = 1e-12 * number_of(value)
            if not isfinite(charge):
                raise ValueError(value)
        except ValueError as error:
            raise InputError(f"--charge: expected an electrode and pC like 'A=650', got {text!r}") from error
        electrode_index(sensor, name)
        charges.setdefault(name, []).append(charge)
    return charges


def _charges_of_press(forward_map: "ForwardMap", at: str, force: float) -> Charges:
    import numpy as np

    x, y = position_of(at)
    charge = forward_map.forward(np.array([x]), np.array([y]), np.array([force]))[0]
    return {name: [float(value)] for name, value in zip(forward_map.electrode_names, charge, strict=True)}


def _contours_by_hand(
    forward_map: "ForwardMap", mappings: "list[Mapping]", charges: Charges, force: float
) -> "dict[str, list[DrawnContour | None]]":
    from isocharge.simulate import Curves, draw_contour

    curves = {mapping.electrode: Curves.of(forward_map, mapping, force) for mapping in mappings}
    return {
        name: [draw_contour(curves[name], value) for value in values]
        for name, values in charges.items()
        if name in curves
    }


def _meeting(field: "ContourField", charges: Charges) -> dict[str, Any]:
    """Where the contours of one charge for each electrode meet."""
    import numpy as np

    from isocharge.simulate import Triangulation

    charge = np.array([[charges[name][0] for name in field.forward_map.electrode_names]])
    return Triangulation(field.table).locate(charge, field.force).to_dict(0)


def _meeting_position(report: dict[str, Any]) -> tuple[float, float] | None:
    """Where the contours of a report meet, m."""
    x_y_mm = report.get("meeting", {}).get("at_mm")
    return None if x_y_mm is None else (1e-3 * x_y_mm[0], 1e-3 * x_y_mm[1])


def _table(report: dict[str, Any]) -> str:
    lines = [_row(contour, report) for contour in report["contours"]]
    if "meeting" in report:
        position, sentence = report["meeting"]["at_mm"], report["meeting"]["words"]
        lines.append(sentence if position is None else f"{sentence} at ({position[0]:.4f}, {position[1]:.4f}) mm")
    return "\n".join(lines)


def _row(contour: dict[str, Any], report: dict[str, Any]) -> str:
    name, pieces = contour["electrode"], contour["pieces_mm"]
    low, high = report["reached_pC"][name]
    text = f"{len(pieces)} piece(s), {sum(map(len, pieces))} points"
    if not pieces:
        text = f"no contour: within {report['radius_mm']:g} mm it has {low:.1f} to {high:.1f} pC"
    return f"{name:<10} {contour['charge_pC']:10.2f} pC   {text}"
