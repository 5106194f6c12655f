"""`isocharge simulate contours`: where a charge is constant, and where contours cross."""

import json as json_module
from collections.abc import Mapping as Map
from math import isfinite
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
    position,
)
from isocharge.cli.shared.terminal import say
from isocharge.errors import InputError

if TYPE_CHECKING:
    from isocharge.simulate import Contour, ContourField, DrawnContour, ForwardMap, Mapping, Sensor


def contours_command(
    sensor: SensorArgument,
    probe: ProbeOption = "circle:1.0",
    force: ForceOption = 1.0,
    charge: Annotated[
        list[str] | None,
        typer.Option(
            "--charge", metavar="NAME=pC", help="A contour; may be given again, as A=650. (default: --levels)"
        ),
    ] = None,
    at: Annotated[
        str | None, typer.Option("--at", metavar="X,Y", help="Contours of a press here, mm, and where they meet.")
    ] = None,
    levels: Annotated[int, typer.Option("--levels", min=1, max=100, help="Contours of each electrode.")] = 8,
    radius: Annotated[float, typer.Option("--radius", help="Presses up to here from the centre, mm.")] = 10.0,
    drawn: Annotated[
        bool, typer.Option("--drawn", help="Beside each, the contour as the paper draws it. (default: no)")
    ] = False,
    json: JsonOption = False,
    output: PictureOption = None,
) -> None:
    """Where a press gives an electrode the same charge (pC): isocharge contours, from the field.

    Points lie within 1e-4 mm of the contour. A charge that no press within the radius gives is said, with what can be
    reached.

    Example: isocharge simulate contours three-25um-biaxial --probe triangle:4.0 --at 2,-3 -o contours.svg
    """
    from isocharge.simulate import ContourField, Mapping, load_sensor

    film_sensor = load_sensor(sensor)
    if charge and at is not None:
        raise InputError("expected either --charge or --at, got both")
    wanted = _wanted(film_sensor, charge or [])
    mappings = [Mapping.lines(film_sensor, name) for name in film_sensor.electrode_names] if drawn else []
    if output is not None:
        _check_picture(output)
    reach = max([1e-3 * radius, *(mapping.reach for mapping in mappings)])
    made = _solve(film_sensor, probe, reach, force)
    field = ContourField.of(made, force, 1e-3 * radius)
    if at is not None:
        wanted = _charges_of_press(made, at, force)
    wanted = wanted or {name: tuple(field.even_charges(name, levels)) for name in film_sensor.electrode_names}
    found = {name: [field.contours(name, q) for q in charges] for name, charges in wanted.items()}
    by_hand = _by_hand(made, mappings, wanted, force)
    report = _contours_report(field, wanted, found, by_hand)
    if at is not None and len(film_sensor.electrodes) > 2:
        report["meeting"] = _meeting(field, wanted)
    if output is not None:
        _draw_contours(field, found, by_hand, report.get("meeting"), output)
    typer.echo(json_module.dumps(report) if json else _contours_table(report))


def _wanted(sensor: "Sensor", texts: list[str]) -> dict[str, tuple[float, ...]]:
    """Charges (C) by electrode from "A=650"."""
    from isocharge.simulate.sensor.sensor import electrode_index

    wanted: dict[str, tuple[float, ...]] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            charge = 1e-12 * float(value)
            if not isfinite(charge):
                raise ValueError(value)
        except ValueError as error:
            raise InputError(f"--charge: expected an electrode and pC like 'A=650', got {text!r}") from error
        electrode_index(sensor, name)
        wanted[name] = (*wanted.get(name, ()), charge)
    return wanted


def _charges_of_press(made: "ForwardMap", at: str, force: float) -> dict[str, tuple[float, ...]]:
    import numpy as np

    x, y = position(at)
    charge = made.forward(np.array([x]), np.array([y]), np.array([force]))[0]
    return {name: (float(q),) for name, q in zip(made.sensor.electrode_names, charge, strict=True)}


def _by_hand(
    made: "ForwardMap", mappings: "list[Mapping]", wanted: Map[str, tuple[float, ...]], force: float
) -> "dict[str, list[DrawnContour | None]]":
    from isocharge.simulate import Curves, draw_contour

    curves = {mapping.electrode: Curves.of(made, mapping, force) for mapping in mappings}
    return {
        name: [draw_contour(curves[name], q) for q in charges] for name, charges in wanted.items() if name in curves
    }


def _contours_report(
    field: "ContourField",
    wanted: Map[str, tuple[float, ...]],
    found: "Map[str, list[tuple[Contour, ...]]]",
    by_hand: "Map[str, list[DrawnContour | None]]",
) -> dict[str, Any]:
    made = field.forward_map
    report: dict[str, Any] = {
        "probe": made.probe.notation,
        "force_N": field.force,
        "radius_mm": 1e3 * field.table.radius,
    }
    report["reached_pC"] = {name: [1e12 * q for q in field.reach(name)] for name in made.sensor.electrode_names}
    report["contours"] = [
        {
            "electrode": name,
            "charge_pC": 1e12 * q,
            "pieces_mm": [(1e3 * piece.points).tolist() for piece in pieces],
            "closed": [piece.closed for piece in pieces],
        }
        for name, charges in wanted.items()
        for q, pieces in zip(charges, found[name], strict=True)
    ]
    if by_hand:
        report["drawn"] = [
            {"electrode": name, "charge_pC": 1e12 * q, "points_mm": None if c is None else (1e3 * c.knots).tolist()}
            for name, charges in wanted.items()
            for q, c in zip(charges, by_hand[name], strict=True)
        ]
    return report


def _meeting(field: "ContourField", wanted: Map[str, tuple[float, ...]]) -> dict[str, Any]:
    """Where the contours of one charge for each electrode meet."""
    import numpy as np

    from isocharge.simulate import Meeting, Triangulation

    charge = np.array([[wanted[name][0] for name in field.forward_map.sensor.electrode_names]])
    fix = Triangulation(field.table).locate(charge, field.force)
    status = Meeting(int(fix.status[0]))
    place = [1e3 * float(fix.x[0]), 1e3 * float(fix.y[0])] if status is Meeting.met else None
    return {"status": status.name, "words": status.words, "at_mm": place}


def _contours_table(report: dict[str, Any]) -> str:
    lines = []
    for contour in report["contours"]:
        name, count = contour["electrode"], sum(len(piece) for piece in contour["pieces_mm"])
        low, high = report["reached_pC"][name]
        words = f"{len(contour['pieces_mm'])} piece(s), {count} points"
        if not contour["pieces_mm"]:
            words = f"no contour: within {report['radius_mm']:g} mm it has {low:.1f} to {high:.1f} pC"
        lines.append(f"{name:<10} {contour['charge_pC']:10.2f} pC   {words}")
    if "meeting" in report:
        place = report["meeting"]["at_mm"]
        words = report["meeting"]["words"]
        lines.append(words if place is None else f"{words} at ({place[0]:.4f}, {place[1]:.4f}) mm")
    return "\n".join(lines)


def _draw_contours(
    field: "ContourField",
    found: "Map[str, list[tuple[Contour, ...]]]",
    by_hand: "Map[str, list[DrawnContour | None]]",
    meeting: dict[str, Any] | None,
    output: Path,
) -> None:
    from isocharge.simulate.plots.curves import draw_contours
    from isocharge.simulate.plots.figure import COLOURS, new_figure, save_picture
    from isocharge.simulate.plots.film import draw_electrodes, draw_probe, draw_working_area, frame_film

    made, radius = field.forward_map, field.table.radius
    figure = new_figure(7.4, 8.0)
    axes = figure.subplots()
    for name, colour in zip(made.sensor.electrode_names, COLOURS * len(found), strict=False):
        pieces = [piece for contour in found.get(name, []) for piece in contour]
        draw_contours(axes, pieces, colour, f"{name}, from the field")
        for number, contour in enumerate(c for c in by_hand.get(name, []) if c is not None):
            label = f"{name}, drawn" if number == 0 else None
            axes.plot(*1e3 * contour.points.T, "--", color=colour, lw=0.9, label=label)
    draw_electrodes(axes, made.sensor)
    draw_working_area(axes, radius, f"within {1e3 * radius:g} mm")
    place = meeting["at_mm"] if meeting else None
    corner = (-0.85 * radius, 0.85 * radius) if place is None else (1e-3 * place[0], 1e-3 * place[1])
    draw_probe(axes, made.probe, corner, "probe" if place is None else "probe, where they meet")
    title = f"isocharge contours: {made.sensor.name}, {made.probe.notation}, {field.force:g} N"
    frame_film(axes, made.sensor, radius, title)
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)
    save_picture(figure, output)
    say(f"drawn in {output}")
