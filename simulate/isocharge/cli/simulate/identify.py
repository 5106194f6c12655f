"""Command `isocharge simulate identify`: error limits, folds and working area of a sensor."""

import json as json_module
from math import inf
from pathlib import Path
from typing import Annotated, Any

import typer

from isocharge.cli.shared.forward_maps import executor_for
from isocharge.cli.shared.options import ForceRangeOption, JsonOption, NoiseOption, SensorArgument, WorkersOption
from isocharge.cli.shared.probe_option import ProbeOption
from isocharge.cli.shared.terminal import say, show, show_json, shown_progress
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.common.errors import InputError
from isocharge.common.files import new_folder, refuse_existing
from isocharge.simulate import identify, load_sensor, noise_model, parse_probe
from isocharge.simulate.plots.error_maps import identification_picture
from isocharge.simulate.plots.figure import picture_bytes
from isocharge.simulate.plots.mirror_map import mirror_picture

PICTURE = "identify.png"
"""File name of the picture in the output folder."""

MIRROR_PICTURE = "mirror.png"
"""File name of the picture of the mirror region in the output folder."""

NUMBERS = "identify.json"
"""File name of the numbers in the output folder."""


def identify_command(
    sensor: SensorArgument,
    probe: ProbeOption = "circle:1.0",
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
            help="Distance from the centre up to which presses are searched, mm. (default: distance of the outermost "
            "corner of an electrode)",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="New folder for pictures and numbers. (default: none)"),
    ] = None,
    workers: WorkersOption = None,
    json: JsonOption = False,
) -> None:
    """Compute how well the charges determine a press: error limits over the film, ambiguities and working area.

    The errors are Cramer-Rao limits, in mm for the position and in percent for the force. No unbiased method has
    smaller errors. The mirror region is the part of the film outside the working area where a press has the charges
    of a press inside it, so that it cannot be noticed.

    Example: isocharge simulate identify three-25um-biaxial --probe circle:1.0 --error 0.5 -o limits
    """
    if output is not None:
        refuse_existing(output)
    if not 0.0 < error < inf:
        raise InputError(f"--error: expected a positive number of mm, got {error}")
    described_sensor = load_sensor(sensor)
    footprint = parse_probe(probe)
    noise_level = noise_model(noise)
    with shown_progress(), executor_for(workers, None) as pool:
        identified = identify(
            described_sensor, footprint, noise_level, force_range=force, radius=radius, error=error, executor=pool
        )
    numbers = identified.to_dict()
    if output is not None:
        with new_folder(output) as folder:
            (folder / PICTURE).write_bytes(picture_bytes(identification_picture(identified)))
            if identified.mirror is not None:
                (folder / MIRROR_PICTURE).write_bytes(picture_bytes(mirror_picture(identified, identified.mirror)))
            (folder / NUMBERS).write_bytes(json_module.dumps(numbers, indent=1).encode())
    if json:
        show_json(numbers)
    else:
        show(_table(numbers))
    say(identified.summary)
    if identified.mirror is not None:
        say(identified.mirror.summary)


def _table(numbers: dict[str, Any]) -> str:
    """Return the error statistics within the working area as a table with one line for each force.

    Args:
        numbers: Result of `Identification.to_dict`.
    """
    radius_mm = numbers["working_area"]["radius_mm"]
    lines = [f"within {radius_mm:g} mm    position, mm: median    rms  worst    force, %: median    rms  worst"]
    for limits in numbers["limits_in_working_area"]:
        position_text = (
            f"{limits['position_median_mm']:25.3f} {limits['position_rms_mm']:6.3f} {limits['position_worst_mm']:6.3f}"
        )
        force_text = (
            f"{limits['force_median_percent']:18.2f} {limits['force_rms_percent']:6.2f} "
            f"{limits['force_worst_percent']:6.2f}"
        )
        lines.append(f"{limits['force_N']:8g} N {position_text} {force_text}")
    return "\n".join(lines)
