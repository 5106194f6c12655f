"""`isocharge simulate identify`: what the charges of a sensor determine about a press."""

import json as json_module
from math import degrees, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.forward_maps import solve_forward_map, solve_map_to_search
from isocharge.cli.shared.options import PROBE_HELP, ForceRangeOption, JsonOption, NoiseOption, SensorArgument
from isocharge.cli.shared.terminal import progress, say
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import InputError
from isocharge.common.files import new_folder, refuse_existing, write_whole

if TYPE_CHECKING:
    from isocharge.simulate import ForwardMap, Probe
    from isocharge.simulate.identifiability.identification import Identification

PICTURE, NUMBERS = "identify.png", "identify.json"
"""Files in an output folder."""


def identify_command(
    sensor: SensorArgument,
    probe: Annotated[
        list[str] | None,
        typer.Option(
            "--probe",
            metavar="SHAPE",
            help=f"{PROBE_HELP} May be repeated: are the others distinguished from the first? (default: circle:1.0)",
        ),
    ] = None,
    force: ForceRangeOption = DEFAULT_FORCE_RANGE,
    noise: NoiseOption = "reference",
    error: Annotated[
        float, typer.Option("--error", metavar="MM", help="Largest position error in the working area, mm, rms.")
    ] = 1.0,
    radius: Annotated[
        float | None,
        typer.Option(
            "--radius",
            metavar="MM",
            help="Distance from the centre up to which presses are looked at, mm. (default: to the electrodes' far "
            "corners)",
        ),
    ] = None,
    size: Annotated[
        bool, typer.Option("--size", help="Also say how well the charges determine a circle's radius. (default: no)")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR|PNG",
            help="New folder for map and numbers, or new .png file for the map alone. (default: neither)",
        ),
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            "--html",
            metavar="FILE",
            help="New page for a browser: the map with a slider for the force, in one file. (default: no)",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Say how well the charges determine a press: smallest errors over the film, ambiguities, working area.

    The errors are Cramer-Rao limits, mm for the position and percent for the force: no unbiased method has smaller
    ones.

    Example: isocharge simulate identify three-25um-biaxial --probe circle:1.0 --error 0.5 -o limits
    """
    from isocharge.simulate import load_sensor, noise_model, parse_probe
    from isocharge.simulate.forward.checks import check_determined
    from isocharge.simulate.identifiability.identification import identify

    for path in (output, html):
        if path is not None:
            refuse_existing(path)
    if size and probe and not probe[0].startswith("circle"):
        raise InputError(f"--size: expected a circle as first --probe, whose radius is its size, got {probe[0]!r}")
    if not (isfinite(error) and error > 0.0):
        raise InputError(f"--error: expected a positive number of mm, got {error}")
    film_sensor, noise_level = load_sensor(sensor), noise_model(noise)
    check_determined(len(film_sensor.electrodes))
    if noise_level.white <= 0.0:
        raise InputError(
            f"--noise: expected white noise above 0 pC, got {noise!r}: without noise the errors have no lower limit"
        )
    probes = [parse_probe(text) for text in probe or ["circle:1.0"]]
    maps = [
        solve_map_to_search(film_sensor, each, force)
        if radius is None
        else solve_forward_map(film_sensor, each, 1e-3 * radius, force)
        for each in probes
    ]
    identifications = [identify(forward_map, noise_level, error=1e-3 * error) for forward_map in maps]
    numbers = identifications[0].to_dict()
    numbers["other_probes"] = _confusions(identifications)
    numbers["size"] = _size(maps[0], identifications[0]) if size else []
    if output is not None:
        _write(output, identifications[0], numbers)
    if html is not None:
        _write_page(html, identifications[0])
    typer.echo(json_module.dumps(numbers) if json else _table(numbers))
    say(identifications[0].area.words)
    for row in numbers["other_probes"]:
        say(probe_sentence(row, numbers["probe"]))
    for row in numbers["size"]:
        say(_size_sentence(row))


def _confusions(identifications: "list[Identification]") -> list[dict[str, Any]]:
    """Each of the other probes taken for the first."""
    from isocharge.simulate.identifiability.probe_discrimination import (
        explain_with_other_probe,
        inner_forces,
        spread_contacts,
    )

    first, rows = identifications[0], []
    for other in identifications[1:]:
        reach = min(first.area.radius, other.area.radius)
        for force in inner_forces(first.area.force_range) if reach else ():
            contacts = spread_contacts(reach, force)
            confusion = explain_with_other_probe(other.charges, first.charges, first.noise, contacts)
            rows.append({"probe": _name(other.probe), "within_mm": 1e3 * reach, **confusion.to_dict()})
    return rows


def _name(probe: "Probe") -> str:
    """As on the command line, with the angle."""
    return probe.notation + (f"@{degrees(probe.angle):.4g}" if probe.angle else "")


def _size(forward_map: "ForwardMap", identification: "Identification") -> list[dict[str, Any]]:
    """How well the charges determine a circle's radius."""
    from isocharge.simulate.identifiability.probe_discrimination import radius_limits

    forces, reach = [limits.force for limits in identification.maps], identification.area.radius
    with progress("solving the film under other radii") as advance:
        limits = radius_limits(forward_map, identification.charges, identification.noise, forces, reach, advance)
        return [limit.to_dict() for limit in limits]


def _table(numbers: dict[str, Any]) -> str:
    area = numbers["working_area"]
    head = f"within {area['radius_mm']:g} mm    position, mm: median    rms  worst    force, %: median    rms  worst"
    rows = [
        f"{row['force_N']:8g} N {row['position_median_mm']:25.3f} {row['position_rms_mm']:6.3f} "
        f"{row['position_worst_mm']:6.3f} {row['force_median_percent']:18.2f} {row['force_rms_percent']:6.2f} "
        f"{row['force_worst_percent']:6.2f}"
        for row in numbers["limits_in_working_area"]
    ]
    return "\n".join([head, *rows])


def probe_sentence(row: dict[str, Any], first: str) -> str:
    """For people: how often another probe is distinguished from the first, and the error where it is taken for it."""
    from isocharge.simulate.identifiability import probe_discrimination

    return (
        f"{row['probe']} against {first} at {row['force_N']:.3g} N within {row['within_mm']:.1f} mm: the charges "
        f"differ by {probe_discrimination.DISTINGUISHABLE_SIGMAS:g} standard deviations or more at "
        f"{row['told_apart_share']:.0%} of the positions, by {row['sigmas_median']:.1f} at the median and "
        f"{row['sigmas_most']:.1f} at most. Taken for {first}, its position is wrong by "
        f"{row['position_error_median_mm']:.3f} mm at the median and {row['position_error_p95_mm']:.3f} mm at 95 %."
    )


def _size_sentence(row: dict[str, Any]) -> str:
    x, y = row["best_at_mm"]
    return (
        f"The radius at {row['force_N']:g} N is known to {row['radius_std_median_percent']:.0f} % at the median "
        f"position and to {row['radius_std_best_percent']:.0f} % at the best, ({x:.1f}, {y:.1f}) mm; to a third or "
        f"better at {row['told_share']:.0%} of the positions."
    )


def _write(output: Path, identification: "Identification", numbers: dict[str, Any]) -> None:
    from isocharge.simulate.plots.figure import picture_bytes
    from isocharge.simulate.plots.limit_map import identification_picture

    picture = picture_bytes(identification_picture(identification))
    if output.suffix == ".png":
        write_whole(output, picture)
        return
    with new_folder(output) as folder:
        (folder / PICTURE).write_bytes(picture)
        (folder / NUMBERS).write_bytes(json_module.dumps(numbers, indent=1).encode())


def _write_page(path: Path, identification: "Identification") -> None:
    from isocharge.simulate.pages.resolution_page import resolution_page

    write_whole(path, resolution_page(identification).encode())
    say(f"open {path} in a browser")
