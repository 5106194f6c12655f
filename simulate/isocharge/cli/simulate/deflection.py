"""`isocharge simulate deflection`: how a film deflects, as a table for the live page."""

import json
from pathlib import Path
from typing import Annotated

import typer

from isocharge.cli.shared.options import ProbeOption, SensorArgument
from isocharge.cli.shared.terminal import progress, say
from isocharge.common.errors import InputError


def deflection_command(
    sensor: SensorArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="File to write, JSON; it must not exist yet.")
    ],
    probe: ProbeOption = "circle:1.0",
) -> None:
    """Compute how a film deflects (mm) under presses at several distances and forces, for the 3D view of the live page.

    The page looks for the file as deflection.json in the folder of the model's version; the film of the released models
    comes with isocharge. Takes some seconds.

    Example: isocharge simulate deflection my-sensor.toml -o models/my-sensor/1/deflection.json
    """
    from isocharge.common.files import refuse_existing, write_whole
    from isocharge.simulate import Circle, load_sensor, parse_probe
    from isocharge.simulate.forward.deflection import deflection_field

    refuse_existing(output)
    footprint = parse_probe(probe)
    if not isinstance(footprint, Circle):
        raise InputError(f"--probe: expected a round one like circle:1.0, got {probe!r}")
    with progress("solving the film") as advance:
        field = deflection_field(load_sensor(sensor).film, footprint, progress=advance)
    write_whole(output, json.dumps(field.to_json()).encode() + b"\n")
    say(f"{output}: up to {float(field.deflection_mm.max()):.2f} mm at {field.force_N[-1]:g} N")
