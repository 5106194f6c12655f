"""`isocharge simulate identify`: what the charges of a sensor can tell about a press."""

import json as json_module
from math import degrees, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isocharge.cli.shared.options import PROBE_HELP, SensorArgument
from isocharge.cli.shared.terminal import progress, say
from isocharge.default_scene import DEFAULT_FORCE_RANGE
from isocharge.errors import InputError
from isocharge.files import new_folder, refuse_existing, write_whole

if TYPE_CHECKING:
    from isocharge.simulate import ForwardMap, Probe, Sensor
    from isocharge.simulate.identifiability.identification import Identification

PICTURE, NUMBERS = "identify.png", "identify.json"
"""Files in an output folder."""

NOISE_HELP = "Noise of the readings: reference, bench, surgery, or a TOML file with white_pC, proportional."


def identify_command(
    sensor: SensorArgument,
    probe: Annotated[
        list[str] | None,
        typer.Option("--probe", help=f"{PROBE_HELP} Given again: can the charges tell it from the first?"),
    ] = None,
    force: Annotated[
        tuple[float, float], typer.Option("--force", metavar="MIN MAX", help="Smallest and largest force, N.")
    ] = DEFAULT_FORCE_RANGE,
    noise: Annotated[str, typer.Option("--noise", metavar="LEVEL|FILE.toml", help=NOISE_HELP)] = "reference",
    error: Annotated[
        float, typer.Option("--error", metavar="MM", help="Position error allowed in the working area at any force.")
    ] = 1.0,
    radius: Annotated[
        float | None,
        typer.Option("--radius", help="How far from the centre to look, mm. (default: to the electrodes' far corners)"),
    ] = None,
    size: Annotated[bool, typer.Option("--size", help="Ask whether the charges tell a circle's radius, too.")] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR|PNG", help="Folder for map and numbers, or file for the map."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="The numbers as one JSON object on stdout.")] = False,
) -> None:
    """What the charges can tell: the least possible errors over the film, where the map folds, and the working area.

    The errors are Cramer-Rao limits, mm and percent; no unbiased method does better.

    Example: isocharge simulate identify three-25um-biaxial --probe circle:1.0 --error 0.5 -o limits
    """
    from isocharge.simulate import load_sensor, noise_model, parse_probe
    from isocharge.simulate.identifiability.identification import identify

    if output is not None:
        refuse_existing(output)
    if size and probe and not probe[0].startswith("circle"):
        raise InputError(f"--size: expected a circle first, whose radius is its size, got {probe[0]!r}")
    if not (isfinite(error) and error > 0.0):
        raise InputError(f"--error: expected a positive number of mm, got {error}")
    film_sensor, level = load_sensor(sensor), noise_model(noise)
    if level.white <= 0.0:
        raise InputError(f"--noise: expected white noise above 0 pC, got {noise!r}: without it nothing limits")
    probes = [parse_probe(text) for text in probe or ["circle:1.0"]]
    reach = None if radius is None else 1e-3 * radius
    maps = [_solve(film_sensor, each, force, reach) for each in probes]
    found = [identify(made, level, error=1e-3 * error) for made in maps]
    numbers = found[0].to_dict()
    numbers["other_probes"] = _mistakes(found)
    numbers["size"] = _size(maps[0], found[0]) if size else []
    if output is not None:
        _write(output, found[0], numbers)
    typer.echo(json_module.dumps(numbers) if json else _table(numbers))
    say(found[0].area.words)
    for row in numbers["other_probes"]:
        say(probe_sentence(row, numbers["probe"]))
    for row in numbers["size"]:
        say(_size_sentence(row))


def _solve(sensor: "Sensor", probe: "Probe", force: tuple[float, float], radius: float | None) -> "ForwardMap":
    from isocharge.simulate import ForwardMap
    from isocharge.simulate.identifiability.identification import map_to_search

    with progress(f"solving the film under {probe.notation}") as advance:
        if radius is None:
            return map_to_search(sensor, probe, force, advance)
        return ForwardMap.build(sensor, probe, radius, force, progress=advance)


def _mistakes(found: "list[Identification]") -> list[dict[str, Any]]:
    """Each of the other probes taken for the first."""
    from isocharge.simulate.identifiability.probe_discrimination import (
        explain_with_other_probe,
        inner_forces,
        spread_contacts,
    )

    first, rows = found[0], []
    for other in found[1:]:
        reach = min(first.area.radius, other.area.radius)
        for force in inner_forces(first.area.force_range) if reach else ():
            taken = explain_with_other_probe(other.charges, first.charges, first.noise, spread_contacts(reach, force))
            rows.append({"probe": _name(other.probe), "within_mm": 1e3 * reach, **taken.to_dict()})
    return rows


def _name(probe: "Probe") -> str:
    """As on the command line, with the angle."""
    return probe.notation + (f"@{degrees(probe.angle):.4g}" if probe.angle else "")


def _size(made: "ForwardMap", found: "Identification") -> list[dict[str, Any]]:
    """How well the charges tell a circle's radius."""
    from isocharge.simulate.identifiability.probe_discrimination import radius_limits

    forces, reach = [each.force for each in found.maps], found.area.radius
    with progress("solving the film under other radii") as advance:
        return [told.to_dict() for told in radius_limits(made, found.charges, found.noise, forces, reach, advance)]


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


def _write(output: Path, found: "Identification", numbers: dict[str, Any]) -> None:
    from isocharge.simulate.plots.limit_map import draw_identification

    text = json_module.dumps(numbers, indent=1).encode()
    if output.suffix == ".png":
        write_whole(output, draw_identification(found))
        return
    with new_folder(output) as folder:
        (folder / PICTURE).write_bytes(draw_identification(found))
        (folder / NUMBERS).write_bytes(text)
